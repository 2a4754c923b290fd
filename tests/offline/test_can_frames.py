"""Logs as recorders, editors and power losses leave them: a bad line costs a line, by number."""

from __future__ import annotations

import gzip
import importlib.util
import random
import re
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from fusiond.files.csv_tables import TableError
from fusiond.offline.can_frames import Refusals, channels, messages
from tests.offline.recorded_bus import BEGIN_S, bus, candump
from tests.places import DATA

CASES = DATA.parent / "cases"
FRAMES = list(bus(2))


def read(path: Path) -> tuple[list[can.Message], Refusals, list[str]]:
    """Messages, refusals, and what was told of zones."""
    refused = Refusals()
    told: list[str] = []
    found = list(messages(path, refused, lambda code, text: told.append(text)))
    return found, refused, told


def same(found: list[can.Message], expected: list[can.Message], within_s: float = 1e-5) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert (a.arbitration_id, bytes(a.data)) == (b.arbitration_id, bytes(b.data))
        assert a.is_extended_id == b.is_extended_id
        assert a.timestamp == pytest.approx(b.timestamp, abs=within_s)


def written(path: Path, frames: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in frames:
            logger(message)
    return path


def asc(path: Path, *, header: str = "", change: Callable[[str], str] = str) -> Path:
    """The frames as CANoe writes them, by a clock in UTC."""
    lines = [
        f"   {m.timestamp - BEGIN_S:.6f} 1  {m.arbitration_id:X}             Rx   d "
        f"{m.dlc} {m.data.hex(' ').upper()}"
        for m in FRAMES
    ]
    date = header or "date Thu Oct 9 08:53:20.000 2025\nbase hex  timestamps absolute\n"
    path.write_bytes(
        (date + "internal events logged\n").encode() + change("\n".join(lines)).encode()
    )
    return path


# --------------------------------------------------------------------------- candump


DAMAGED = {
    "comment": b"# logger 1.4 started\n",
    "zeros": b"\0" * 4096 + b"\n",
    "zeros without an end": b"\0" * 100_000,
    "half a line": b"(1760000000.5000\n",
    "half a frame": b"(1760000000.500000) can0 009#0X\n",
    "no number": b"(yesterday) can0 009#00\n",
    "cp1252": "# Prüfstand Süd\n".encode("cp1252"),
    "no text": bytes(range(1, 10)) + bytes(range(11, 13)) + bytes(range(14, 256)) + b"\n",
    "a line without an end": b"x" * 200_000 + b"\n",
}


@pytest.mark.parametrize("damage", DAMAGED)
@pytest.mark.parametrize("at", [0, 1, 100, len(FRAMES)])
@pytest.mark.parametrize("suffix", [".log", ".log.gz"])
def test_a_bad_line_of_candump(damage: str, at: int, suffix: str, tmp_path: Path) -> None:
    lines = [f"{line}\n".encode() for line in candump(FRAMES)]
    content = b"".join([*lines[:at], DAMAGED[damage], *lines[at:]])
    path = tmp_path / f"bus{suffix}"
    path.write_bytes(gzip.compress(content) if suffix.endswith("gz") else content)
    found, refused, _ = read(path)
    same(found, FRAMES)
    (line,) = refused.all()
    assert (line.line, line.reason) == (at + 1, "unreadable")
    assert len(line.detail) < 400
    assert channels(path) == {"can0"}


def test_many_bad_lines_are_told_by_the_first_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text("\n".join(f"{line}\n# {k}" for k, line in enumerate(candump(FRAMES))))
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert sum(each.times for each in refused.all()) == len(FRAMES)
    assert str(refused.all()[0]) == "line 2: unreadable: '# 0'"
    assert str(refused.all()[-1]) == f"unreadable: {len(FRAMES) - 20} more"


def terminal(stamp: Callable[[float], str], tail: str = "") -> list[str]:
    last = [BEGIN_S]

    def said(m: can.Message) -> str:
        text = stamp(m.timestamp - last[0] if stamp is delta else m.timestamp)
        last[0] = m.timestamp
        return f" {text}  can0  {m.arbitration_id:03X}   [{m.dlc}]  {m.data.hex(' ').upper()}{tail}"

    return [said(m) for m in FRAMES]


def absolute(t_s: float) -> str:
    return f"({t_s:.6f})"


def delta(t_s: float) -> str:
    return f"({t_s:010.6f})"


@pytest.mark.parametrize("tail", ["", "   'abc#['"])
def test_candumps_terminal_form(tail: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text("\n".join(terminal(absolute, tail)))
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert refused.all() == []
    assert {m.channel for m in found} == {"can0"}


def test_stamps_since_the_beginning_and_since_the_last_frame(tmp_path: Path) -> None:
    zero = tmp_path / "zero.log"
    zero.write_text("\n".join(terminal(lambda t_s: delta(t_s - BEGIN_S))))
    first = [m.timestamp - BEGIN_S for m in FRAMES]
    assert [m.timestamp for m in read(zero)[0]] == pytest.approx(first, abs=1e-5)
    between = tmp_path / "delta.log"
    between.write_text("\n".join(terminal(delta)))
    assert [m.timestamp for m in read(between)[0]] == pytest.approx(first, abs=1e-3)


def test_dates_of_candump_are_of_this_computers_zone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zone: Callable[[str], None]
) -> None:
    zone("UTC-2")
    path = tmp_path / "bus.log"
    path.write_text(" (2025-10-09 10:53:20.500000)  can0  009   [2]  01 02\n")
    (message,), refused, told = read(path)
    assert message.timestamp == pytest.approx(BEGIN_S + 0.5)
    assert refused.all() == []
    assert told == [
        "the dates of candump -t A have no zone: taken as local time of this computer, UTC "
        "(UTC+0200)"
    ]


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("\x1b[32m (1.5)  can0  \x1b[31m7E8\x1b[0m   [2]  01 02\x1b[0m", (0x7E8, False, b"\1\2")),
        (" (1.5)  can1  RX - -  18FEF100   [2]  01 02", (0x18FEF100, True, b"\1\2")),
        (" (1.5)  can0  7E8  [12]  " + "AA " * 12, (0x7E8, False, b"\xaa" * 12)),
        (" (1.5)  can0  7E8  [02]  01 02", (0x7E8, False, b"\1\2")),
        (" (1.5)  can0  7E8   [0] ", (0x7E8, False, b"")),
        (" (1.5)  can0  7E8   [4]  remote request", "remote"),
        (" (1.5)  can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME", "error"),
        ("(1.5) can0 20000004#0001000000000000", "error"),
        ("(1.5) can0 7E8#R4", "remote"),
        ("(1.5) can0 7E8##0AABB R", (0x7E8, False, b"\xaa\xbb")),
    ],
)
def test_lines_that_candump_writes(line: str, kind: Any, tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text(line + "\n")
    (m,), refused, _ = read(path)
    assert refused.all() == []
    assert m.timestamp == 1.5
    if kind == "remote":
        assert m.is_remote_frame
    elif kind == "error":
        assert m.is_error_frame
    else:
        assert (m.arbitration_id, m.is_extended_id, bytes(m.data)) == kind


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("  can0  7E8   [2]  01 02\n", "terminal form without times: record with candump -L"),
        ("hello\n", r"line 1: unreadable: 'hello'; candump writes logs with -L or -l"),
    ],
)
def test_what_candump_did_not_log(content: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text(content * 3)
    with pytest.raises(TableError, match=words):
        read(path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_what_a_shell_of_windows_made_of_it(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_bytes("\r\n".join(candump(FRAMES)).encode(encoding))
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert refused.all() == []


# --------------------------------------------------------------------------- Vector's text


@pytest.fixture
def zone(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Of this computer."""

    def of(name: str) -> None:
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield of
    monkeypatch.undo()
    time.tzset()


def test_the_zone_of_an_asc_log_is_told(tmp_path: Path, zone: Callable[[str], None]) -> None:
    for name, hours, offset in (("UTC", 0.0, "+0000"), ("CET-1CEST", 2.0, "+0200")):
        zone(name)
        found, _, told = read(asc(tmp_path / "bus.asc"))
        assert FRAMES[0].timestamp - found[0].timestamp == pytest.approx(hours * 3600.0)
        (text,) = told
        assert text.startswith("the dates of an ASC log have no zone: taken as local time")
        assert text.endswith(f"(UTC{offset})")


@pytest.mark.parametrize(
    "line",
    [
        "   0.000000 CANFD   Start of measurement",
        "   0.000000 CANFD   Something else of nobody's channel",
        "   0.000000 Start of measurement",
        "// Prüfstand Süd",
        "   0.100000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%",
    ],
)
@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_lines_of_asc_that_are_no_frames(
    line: str, encoding: str, tmp_path: Path, zone: Callable[[str], None]
) -> None:
    zone("UTC")
    path = asc(tmp_path / "bus.asc")
    head, sep, rest = path.read_bytes().partition(b"logged\n")
    path.write_bytes(head + sep + line.encode(encoding) + b"\n" + rest)
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert refused.all() == []


@pytest.mark.parametrize(
    "bad", ["   0.100000 1  7E8             Rx   d x 01", "   0.1 CANFD   1 Rx 7E8 1 0 8 y 01"]
)
def test_a_bad_line_of_asc(bad: str, tmp_path: Path, zone: Callable[[str], None]) -> None:
    zone("UTC")
    path = asc(tmp_path / "bus.asc", change=lambda text: f"{bad}\n{text}\n{bad}")
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert [each.line for each in refused.all()] == [4, len(FRAMES) + 5]


def test_zeros_in_asc_are_counted(tmp_path: Path, zone: Callable[[str], None]) -> None:
    zone("UTC")
    path = asc(tmp_path / "bus.asc", change=lambda text: text.replace("\n", "\n" + "\0" * 5000, 1))
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert [str(each) for each in refused.all()] == ["line 5: unreadable: a block of zeros"]


def test_asc_before_the_trigger_and_by_differences(
    tmp_path: Path, zone: Callable[[str], None]
) -> None:
    zone("UTC")
    early = 1.25

    def before(text: str) -> str:
        def moved(m: re.Match[str]) -> str:
            return f"\n   {float(m[1]) - early:.6f} "

        return re.sub(r"\n\s*([\d.]+) ", moved, "\n" + text)[1:]

    found, refused, _ = read(asc(tmp_path / "bus.asc", change=before))
    assert refused.all() == []
    assert [m.timestamp - BEGIN_S for m in found] == pytest.approx(
        [m.timestamp - BEGIN_S - early for m in FRAMES], abs=1e-5
    )
    last = [0.0]

    def differences(text: str) -> str:
        def moved(m: re.Match[str]) -> str:
            now, before = float(m[1]), last[0]
            last[0] = now
            return f"\n   {now - before:.6f} "

        # What is no frame counts as well.
        event = "   0.250000 1  Statistic: D 0\n"
        return event + re.sub(r"\n\s*([\d.]+) ", moved, "\n" + text)[1:]

    header = "date Thu Oct 9 08:53:20.000 2025\nbase hex  timestamps relative\n"
    found, refused, _ = read(asc(tmp_path / "r.asc", header=header, change=differences))
    assert refused.all() == []
    assert [m.timestamp - BEGIN_S for m in found] == pytest.approx(
        [m.timestamp - BEGIN_S + 0.25 for m in FRAMES], abs=1e-3
    )


@pytest.mark.parametrize("day", ["lun. juil. 25", "Mon Foo 25"])
def test_a_date_that_nobody_knows(day: str, tmp_path: Path) -> None:
    """What stands behind it is read: here that numbers are decimal."""
    header = f"date {day} 10:46:41.023 2021\nbase dec  timestamps absolute\n"
    frame = "   0.5 1  2024             Rx   d 2 16 255\n"
    found, _, told = read(asc(tmp_path / "bus.asc", header=header, change=lambda text: frame))
    ((m,), (text,)) = found, told
    assert (m.timestamp, m.arbitration_id, bytes(m.data)) == (0.5, 2024, b"\x10\xff")
    assert text == "the log has no date that is understood: its times count from its beginning"


# --------------------------------------------------------------------------- PEAK


@pytest.mark.parametrize(
    "bad", ["   17)", "     17        x.5 DT  1     0009 Rx -  2    01 02", "\0" * 900, "?"]
)
def test_trc(bad: str, tmp_path: Path) -> None:
    path = written(tmp_path / "bus.trc", FRAMES)
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith(";"))
    lines.insert(first + 50, bad)
    path.write_text("\n".join(lines))
    found, refused, told = read(path)
    same(found, FRAMES, 1.0)  # its beginning is dated, its stamps are milliseconds
    spacing = [m.timestamp - found[0].timestamp for m in found]
    assert spacing == pytest.approx([m.timestamp - BEGIN_S for m in FRAMES], abs=2e-3)
    assert [(each.line, each.reason) for each in refused.all()] == [(first + 51, "unreadable")]
    assert told == ["the date of a TRC log has no zone: taken as UTC"]


# --------------------------------------------------------------------------- Vector's binary


def containers(path: Path) -> list[tuple[int, int]]:
    """Where each begins and ends."""
    data, at, found = path.read_bytes(), 144, []
    while at < len(data):
        size = struct.unpack_from("<L", data, at + 8)[0]
        found.append((at, at + size + size % 4))
        at = found[-1][1]
    return found


@pytest.fixture
def long_blf(tmp_path: Path) -> tuple[Path, list[can.Message]]:
    """Several containers, objects that go on from one to the next."""
    frames = list(bus(90))
    return written(tmp_path / "bus.blf", frames), frames


def test_blf_as_it_is(long_blf: tuple[Path, list[can.Message]]) -> None:
    path, frames = long_blf
    assert len(containers(path)) > 3
    found, refused, told = read(path)
    same(found, frames)
    assert refused.all() == []
    assert told == ["the date of a BLF log has no zone: taken as UTC"]


def test_frames_before_the_trigger_are_before_the_beginning(
    long_blf: tuple[Path, list[can.Message]],
) -> None:
    path, frames = long_blf
    header = bytearray(path.read_bytes())
    begin, end = containers(path)[0]
    content = bytearray(zlib.decompress(header[begin + 32 : end]))
    at = content.find(b"LOBJ")
    early = 0
    while 0 <= at < len(content) - 48 and early < 40:
        (ns,) = struct.unpack_from("<Q", content, at + 24)
        struct.pack_into("<q", content, at + 24, ns - 3 * 10**9)
        early += 1
        at = content.find(b"LOBJ", at + 4)
    packed = zlib.compress(bytes(content))
    size = 32 + len(packed)
    head = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, size, 10, 2, len(content))
    path.write_bytes(header[:begin] + head + packed + bytes(size % 4) + header[end:])
    found, refused, _ = read(path)
    assert refused.all() == []
    assert len(found) == len(frames)
    moved = [f.timestamp - m.timestamp for f, m in zip(found, frames, strict=True)]
    assert moved[1:40] == pytest.approx([-3.0] * 39, abs=1e-5)
    assert moved[40:] == pytest.approx([0.0] * len(moved[40:]), abs=1e-5)


@pytest.mark.parametrize("damage", ["zeros", "a byte", "cut out", "the signature"])
def test_a_damaged_container_costs_itself(
    damage: str, long_blf: tuple[Path, list[can.Message]]
) -> None:
    path, frames = long_blf
    data = bytearray(path.read_bytes())
    begin, end = containers(path)[1]
    if damage == "zeros":
        data[begin:end] = bytes(end - begin)
    elif damage == "a byte":
        data[begin + 1000] ^= 0x40
    elif damage == "cut out":
        del data[begin + 100 : begin + 5000]
    else:
        data[begin] = 0
    path.write_bytes(data)
    found, refused, _ = read(path)
    share = 1.0 / len(containers(written(path.with_name("whole.blf"), frames)))
    assert (1.0 - 1.2 * share) * len(frames) < len(found) < len(frames)
    assert 1 <= len(refused.all()) <= 2
    assert {each.reason for each in refused.all()} == {"unreadable"}
    stamps = {round(m.timestamp, 5) for m in frames}
    assert sum(round(m.timestamp, 5) in stamps for m in found) > 0.99 * len(found)
    assert found[-1].timestamp == pytest.approx(frames[-1].timestamp, abs=1e-5)


def test_blf_that_is_cut(long_blf: tuple[Path, list[can.Message]]) -> None:
    path, frames = long_blf
    path.write_bytes(path.read_bytes()[:-5000])
    found, refused, _ = read(path)
    assert 0.5 * len(frames) < len(found) < len(frames)
    same(found, frames[: len(found)])
    assert [each.reason for each in refused.all()] == ["cut"]


# --------------------------------------------------------------------------- all of them


@pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is missing: set FUSIOND_DATA")
@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("06_pretrigger.blf", 0),
        ("07_canfd_start_of_measurement.asc", 0),
        ("08_nul_block.log", 1),
        ("09_cp1252_comment.asc", 0),
        ("12_peak.trc", 0),
        ("13_candump_view.log", 0),
    ],
)
def test_logs_of_others(name: str, bad: int) -> None:
    found, refused, _ = read(CASES / name)
    assert len(found) == 1200
    assert sum(each.times for each in refused.all()) == bad
    stamps = [m.timestamp for m in found]
    assert stamps == sorted(stamps)


def mutated(content: bytes, draw: random.Random) -> bytes:
    """Bytes changed, taken out, put in, repeated, moved, or cut."""
    data = bytearray(content)
    for _ in range(draw.randint(1, 4)):
        at, size = draw.randrange(len(data) + 1), draw.choice([1, 1, 2, 4, 17, 300])
        match draw.randrange(7):
            case 0:
                data[at : at + 1] = bytes([draw.randrange(256)])
            case 1:
                del data[at : at + size]
            case 2:
                data[at:at] = draw.randbytes(size)
            case 3:
                data[at:at] = data[at : at + size]
            case 4:
                data[at : at + size] = bytes(size)
            case 5:
                data[at : at + size] = draw.choice(
                    [b"\n", b"[", b"#", b"(", b")", b"-", b".", b"LOBJ"]
                )
            case _:
                del data[at:]
        if not data:
            return b""
    return bytes(data)


@pytest.mark.parametrize(
    "name", ["bus.log", "view.log", "bus.asc", "bus.trc", "bus.blf", "bus.log.gz"]
)
def test_any_damage_ends_in_frames_a_count_or_a_sentence(name: str, tmp_path: Path) -> None:
    frames = FRAMES[:60]
    path = tmp_path / name
    if name == "view.log":
        path.write_text("\n".join(terminal(absolute)[:60]))
    else:
        written(path, frames)
    whole, draw = path.read_bytes(), random.Random(40)
    for _ in range(300):
        path.write_bytes(mutated(whole, draw))
        try:
            found, refused, _ = read(path)
        except TableError as error:
            assert str(path) in str(error)  # noqa: PT017
            continue
        assert all(each.reason in ("unreadable", "cut") for each in refused.all())
        assert len(found) <= 16 * len(frames)  # pieces may be repeated


@pytest.mark.skipif(
    importlib.util.find_spec("asammdf") is None,
    reason="the package asammdf is not installed: pip install 'fusiond[mf4]'",
)
@pytest.mark.parametrize("content", [b"hello", b"MDF     4.10    " + bytes(range(256)) * 9])
def test_what_is_no_mf4(content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """asammdf's own file fails a second time as it is deleted, and says so on the terminal."""
    path = tmp_path / "bus.mf4"
    path.write_bytes(content)
    with pytest.raises(TableError, match=r"cannot be read as \.mf4: cut: .* MdfException: "):
        read(path)
    assert capfd.readouterr().err == ""
