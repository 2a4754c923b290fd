"""Logs in the text of Vector and PEAK: what is no frame is passed over, a bad line costs a line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fusiond.files.csv_tables import TableError
from tests.offline.can_files import FRAMES, asc, read, same, written
from tests.offline.recorded_bus import BEGIN_S


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


@pytest.mark.parametrize("stamps", ["absolute", "relative"])
def test_decimal_commas(stamps: str, tmp_path: Path, zone: Callable[[str], None]) -> None:
    """Of a Windows whose numbers have them, with an event that has no channel."""
    zone("UTC")
    last = [0.0]

    def commas(text: str) -> str:
        def moved(m: re.Match[str]) -> str:
            now, before = float(m[1]), last[0]
            last[0] = now
            shown = now - before if stamps == "relative" else now
            return f"\n   {shown:.6f} ".replace(".", ",")

        return "   0,000000 CANFD   Start\n" + re.sub(r"\n\s*([\d.]+) ", moved, "\n" + text)[1:]

    header = f"date Thu Oct 9 08:53:20.000 2025\nbase hex  timestamps {stamps}\n"
    found, refused, _ = read(asc(tmp_path / "c.asc", header=header, change=commas))
    assert refused.all() == []
    same(found, FRAMES, within_s=1e-3)


@pytest.mark.parametrize(
    ("day", "days"),
    [
        ("Do Okt 9", 0),
        ("Do. Dez. 9", 61),
        ("So Mrz 9", -214),
        ("So M\xe4r 9", -214),
        ("mer. juil. 9", -92),
        ("lun. juin 9", -122),
        ("sam. ao\xfbt 9", -61),
        ("gio ott 9", 0),
        ("jue. ene. 9", -273),
    ],
)
def test_dates_of_another_windows(
    day: str, days: int, tmp_path: Path, zone: Callable[[str], None]
) -> None:
    zone("UTC")
    path = asc(tmp_path / "bus.asc")
    said = path.read_bytes().replace(b"Thu Oct 9", day.encode("cp1252"))
    path.write_bytes(said)
    found, refused, _ = read(path)
    assert found[0].timestamp - FRAMES[0].timestamp == pytest.approx(days * 86_400.0)
    assert len(found) == len(FRAMES)
    assert refused.all() == []


@pytest.mark.parametrize("day", ["lun. foo. 25", "Mon Foo 25"])
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


def test_trc_with_decimal_commas(tmp_path: Path) -> None:
    path = written(tmp_path / "bus.trc", FRAMES)
    points = re.compile(r"(?m)^(;\$STARTTIME=\d+|\s*\d+\s+\d+)\.(\d+)")
    text, changed = points.subn(r"\1,\2", path.read_text())
    assert changed > len(FRAMES)
    path.write_text(text)
    found, refused, told = read(path)
    same(found, FRAMES, 1.0)
    assert (refused.all(), told) == ([], ["the date of a TRC log has no zone: taken as UTC"])


def test_a_version_of_trc_that_is_not_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bus.trc"
    path.write_text(";$FILEVERSION=1.2\n;\n     1)  0.000 1  Rx  07E8  2  03 41\n")
    with pytest.raises(TableError, match=r"TRC of version 1\.2; versions 1\.0, 1\.1, 1\.3"):
        read(path)


def test_what_the_reader_only_warns_of_is_counted(
    tmp_path: Path, zone: Callable[[str], None], capfd: pytest.CaptureFixture[str]
) -> None:
    """It would write a line a frame on the terminal."""
    zone("UTC")
    odd = "   0.1 CANFD   1 Rx 7E8 1 0 8 3 01 02 03 0 0 0 0 0 0 0 0\n"
    path = asc(tmp_path / "bus.asc", change=lambda text: odd * 3 + text)
    found, refused, _ = read(path)
    assert len(found) == len(FRAMES) + 3
    (warned,) = refused.all()
    assert (warned.reason, warned.times) == ("length_or_type_odd", 3)
    assert capfd.readouterr().err == ""
