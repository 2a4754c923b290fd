"""Logs of candump as editors and power losses leave them: a bad line costs a line, by number."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from fusiond.files.csv_tables import TableError
from fusiond.offline.can_log_reader import channels
from tests.offline.can_files import FRAMES, absolute, delta, read, same, terminal
from tests.offline.recorded_bus import BEGIN_S, candump

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


def test_two_buses_of_one_file_are_no_differences(tmp_path: Path) -> None:
    """Each counts from the beginning, and the file has a block of the one, then of the other."""
    path = tmp_path / "zero.log"
    lines = terminal(lambda t_s: delta(t_s - BEGIN_S))
    blocks = [lines[k : k + 30] for k in range(0, len(lines), 30)]
    path.write_text("\n".join(line for block in blocks for line in block * 2))
    last = FRAMES[-1].timestamp - BEGIN_S
    assert max(m.timestamp for m in read(path)[0]) == pytest.approx(last, abs=1e-5)


@pytest.mark.parametrize("form", ["date", "difference"])
def test_what_candump_logs_with_other_stamps(
    form: str, tmp_path: Path, zone: Callable[[str], None]
) -> None:
    """`candump -L -t A` and `-t d`."""
    zone("UTC")
    path, last, lines = tmp_path / "bus.log", BEGIN_S, []
    for m, line in zip(FRAMES, candump(iter(FRAMES)), strict=True):
        day = datetime.fromtimestamp(m.timestamp)
        stamp = f"{day:%Y-%m-%d %H:%M:%S.%f}" if form == "date" else f"{m.timestamp - last:010.6f}"
        lines.append(f"({stamp}){line.partition(')')[2]}")
        last = m.timestamp
    path.write_text("\n".join(lines))
    found, refused, told = read(path)
    begin = BEGIN_S if form == "date" else 0.0
    expected = [m.timestamp - BEGIN_S for m in FRAMES]
    assert [m.timestamp - begin for m in found] == pytest.approx(expected, abs=1e-3)
    assert refused.all() == []
    assert len(told) == (form == "date")


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
        (" (1.5)  can0  7E8   {C}  " + "AA " * 8, (0x7E8, False, b"\xaa" * 8)),
        ("(1.5) can0 7E8#" + "AA" * 8 + "_C", (0x7E8, False, b"\xaa" * 8)),
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


@pytest.mark.parametrize("name", ["bus.log", "bus.log.gz"])
@pytest.mark.parametrize("zipped", [True, False])
def test_a_log_is_unpacked_by_what_it_is(name: str, zipped: bool, tmp_path: Path) -> None:
    path = tmp_path / name
    data = "\n".join(candump(FRAMES)).encode()
    path.write_bytes(gzip.compress(data) if zipped else data)
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert refused.all() == []


def test_carriage_returns_alone_end_lines(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_bytes("\r".join(candump(FRAMES)).encode())
    found, refused, _ = read(path)
    same(found, FRAMES)
    assert refused.all() == []
