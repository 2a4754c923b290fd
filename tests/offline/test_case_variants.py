"""Public bug reports of others' parsers, each in several forms: all end in fixes, a count or one
sentence.

What receivers and loggers of all makes have been seen to send: each row alters what a receiver says
in ten seconds, or what a recorder writes of a bus. Numbers are those of the cases.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.measurements import Heading, PositionFix
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import ImuTable
from fusiond.offline.can_log_reader import Refusals, messages
from fusiond.offline.measurement_files import READERS
from tests.offline.can_files import FRAMES, asc, same, written

SECONDS = 10
OF_WEEK = ImuTable(200000.0 + np.arange(0.0, SECONDS, 0.1), np.zeros((10 * SECONDS, 6)), [])
PLACE = "4712.0000000,N,00812.0000000,E"
Parts = list[str]
Alter = Callable[[Parts], list[Parts]]
"""Makes sentences of one, by its fields."""


def epoch(second: int) -> list[Parts]:
    at = f"07330{second}.00" if second < 10 else f"0733{second}.00"
    bodies = (
        f"GNGGA,{at},{PLACE},1,14,0.9,403.0,M,47.0,M,,",
        f"GNRMC,{at},A,{PLACE},3.0,90.0,240326,,,A,V",
        "GNTHS,30.00,A",
    )
    return [body.split(",") for body in bodies]


def log(alter: Alter, begin: int = 2) -> bytes:
    bodies = (
        ",".join(p) for s in range(begin, begin + SECONDS) for e in epoch(s) for p in alter(e)
    )
    return b"".join(f"${b}*{reduce(xor, b.encode(), 0):02X}\r\n".encode() for b in bodies)


def kind(parts: Parts) -> str:
    return parts[0][2:]


def field(of: str, at: int, value: str) -> Alter:
    """One field of a kind of sentence is another."""
    return lambda p: [[*p[:at], value, *p[at + 1 :]] if kind(p) == of else p]


def only(*kinds: str) -> Alter:
    return lambda p: [p] if kind(p) in kinds else []


def talker(name: str) -> Alter:
    return lambda p: [[name + kind(p), *p[1:]]]


def instead(of: str, *bodies: str) -> Alter:
    return lambda p: [b.split(",") for b in bodies] if kind(p) == of else [p]


def beside(of: str, *bodies: str) -> Alter:
    return lambda p: [p, *(b.split(",") for b in bodies)] if kind(p) == of else [p]


def gns(p: Parts) -> list[Parts]:
    """GNS for GGA, without the separation."""
    return [["GNGNS", *p[1:6], "AAAA", *p[7:10], "", "", "", "V"] if kind(p) == "GGA" else p]


GSA_2D, GSA_3D = (
    f"GNGSA,A,{mode},02,08,10,23,27,,,,,,,,1.6,1.3,0.9,{k}" for mode, k in ((2, 1), (3, 2))
)


def read(tmp_path: Path, data: bytes) -> tuple[list[PositionFix], int, str]:
    """Fixes, how many headings, and what is said."""
    path = tmp_path / "case.nmea"
    path.write_bytes(data)
    try:
        rows, said = READERS["nmea"](path, OF_WEEK, "gnss")
    except TableError as error:
        return [], 0, str(error)
    found = [row.measurement for row in rows]
    fixes = [m for m in found if isinstance(m, PositionFix)]
    return fixes, sum(isinstance(m, Heading) for m in found), "; ".join(map(str, said))


# --------------------------------------------------------------------------- NMEA


@pytest.mark.parametrize("status", "ADFRP")
@pytest.mark.parametrize("mode", [True, False])
def test_01_every_status_that_is_valid_is_a_fix_with_velocity(
    tmp_path: Path, status: str, mode: bool
) -> None:
    def alter(p: Parts) -> list[Parts]:
        return [[*p[:2], status, *(p[3:] if mode else p[3:12])] if kind(p) == "RMC" else p]

    fixes, _, said = read(tmp_path, log(alter))
    assert [fix.v_ned_m_s is not None for fix in fixes] == [True] * SECONDS
    assert "no fix" not in said


@pytest.mark.parametrize(
    ("case", "alter", "words"),
    [
        ("01", field("RMC", 2, "V"), "the receiver has no fix"),
        ("01", field("RMC", 2, "N"), "the receiver has no fix"),
        ("01", field("RMC", 2, "E"), "dead reckoning"),
        ("01", field("RMC", 2, "S"), "simulates"),
        ("01", field("RMC", 2, "M"), "put in by hand"),
        ("04", only("GGA"), "no measurement with a date (RMC or ZDA missing)"),
        ("04", field("RMC", 9, ""), "no measurement with a date (that of RMC is empty)"),
        ("04", field("RMC", 9, "000000"), "RMC has '000000' for a date, which is none"),
        ("04", instead("GGA", "GPVTG,90,T,,M,1,N,2,K,A"), ""),
        ("15", talker("PQ"), "positions of talker PQ"),
        ("15", talker("LC"), "positions of talker LC (Loran-C)"),
        ("15", talker("EC"), "positions of talker EC (a chart display)"),
        ("15", talker("gn"), "small letters"),
        ("16", field("GGA", 6, "0"), "the receiver has no fix"),
        ("16", field("GGA", 6, "6"), "dead reckoning"),
        ("16", field("GGA", 6, "7"), "put in by hand"),
        ("16", field("GGA", 6, "8"), "simulates"),
        ("16", field("GGA", 6, "10"), "a GGA quality that NMEA does not know"),
    ],
)
def test_what_is_no_fix_is_one_sentence(
    tmp_path: Path, case: str, alter: Alter, words: str
) -> None:
    fixes, _, said = read(tmp_path, log(lambda p: [] if kind(p) == "THS" else alter(p)))
    assert words in said
    assert bool(fixes) == (words == "")


@pytest.mark.parametrize(
    ("case", "alter", "height_m", "geoid_known", "words"),
    [
        ("02", field("GGA", 11, ""), 403.0, False, "height_above_sea"),
        ("02", field("GGA", 11, "0.0"), 403.0, False, "height_above_sea"),
        ("02", field("GGA", 11, "0"), 403.0, False, "height_above_sea"),
        ("02", field("GGA", 11, "999.9"), 403.0, False, "height_above_sea"),
        ("02", field("GGA", 9, ""), None, True, "height_missing"),
        ("02", gns, 403.0, False, "height_above_sea"),
        ("03", beside("RMC", GSA_2D), 450.0, True, ""),
        ("03", beside("RMC", GSA_2D, GSA_3D), 450.0, True, ""),
        ("03", beside("RMC", GSA_3D, GSA_2D), 450.0, True, ""),
        ("04", only("RMC"), None, True, "rmc_alone"),
        ("04", lambda p: [p[:12]] if kind(p) == "RMC" else [], None, True, "rmc_alone"),
        ("16", field("GGA", 6, "A"), None, True, "bad_field"),
    ],
)
def test_a_height_is_known_or_it_is_said(
    tmp_path: Path, case: str, alter: Alter, height_m: float | None, geoid_known: bool, words: str
) -> None:
    fixes, _, said = read(tmp_path, log(alter))
    assert fixes
    assert words in said
    assert {fix.height_m for fix in fixes} == {height_m}
    assert {fix.geoid_sd_m == 0.0 for fix in fixes} == {geoid_known}


@pytest.mark.parametrize("name", ["GI", "GQ", "QZ", "BD", "GB", "GA", "GL", "GP"])
def test_15_every_talker_of_satellites_is_read(tmp_path: Path, name: str) -> None:
    assert len(read(tmp_path, log(talker(name)))[0]) == SECONDS


@pytest.mark.parametrize(
    ("printed", "quality"), [("2", 2), ("3", 3), ("4", 4), ("5", 5), ("9", 2), ("", 1)]
)
def test_16_qualities(tmp_path: Path, printed: str, quality: int) -> None:
    fixes, _, _ = read(tmp_path, log(field("GGA", 6, printed)))
    assert [fix.quality for fix in fixes] == [quality] * SECONDS


@pytest.mark.parametrize(
    ("alter", "headings", "words"),
    [
        (lambda p: [p], SECONDS, ""),
        (instead("THS", "GNHDT,30.00,T"), SECONDS, ""),
        (instead("THS", "GPTHS,30.00,A"), SECONDS, ""),
        (field("THS", 2, "E"), 0, "heading_mode_refused"),
        (field("THS", 2, "V"), 0, "heading_mode_refused"),
        (instead("THS", "HCHDM,30.00,M"), 0, "compass_not_configured"),
        (instead("THS", "HCHDG,30.00,,,2.5,E"), 0, "compass_not_configured"),
        (instead("THS", "GNHPR,073302.00,30.00,0.1,0.2,4,12,1.0,0000"), 0, "$GNHPR"),
        (instead("THS", "PTNL,AVR,073302.00,30.0,Yaw,0.1,Tilt,,,1.0,3,1.5,12"), 0, "$PTNL,AVR"),
    ],
)
def test_11_headings_are_used_or_named(
    tmp_path: Path, alter: Alter, headings: int, words: str
) -> None:
    fixes, found, said = read(tmp_path, log(alter))
    assert (len(fixes), found) == (SECONDS, headings)
    assert words in said


def _unsummed(line: bytes) -> bytes:
    return line.partition(b"*")[0]


@pytest.mark.parametrize(
    ("change", "fixes", "words"),
    [
        (_unsummed, 0, "without a checksum"),
        (lambda line: line[: line.index(b"*") + 1], 0, "without a checksum"),
        (lambda line: line[: line.index(b"*")] + b"*00", 0, "wrong checksums"),
        (lambda line: _unsummed(line) + line[line.index(b"*") :].lower(), SECONDS, ""),
        (lambda line: b"  " + line + b"  ", SECONDS, ""),
        (lambda line: b"2026-03-24T07:33:02.000Z " + line, SECONDS, ""),
        (lambda line: b"\\s:gnss,c:1774337582*5B\\" + line, SECONDS, ""),
        (lambda line: b'7;"' + line + b'"', SECONDS, ""),
    ],
)
@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
def test_14_lines_as_programs_leave_them(
    tmp_path: Path, change: Callable[[bytes], bytes], fixes: int, words: str, end: bytes
) -> None:
    lines = log(lambda p: [p]).split(b"\r\n")[:-1]
    found, _, said = read(tmp_path, end.join(map(change, lines)) + end)
    assert len(found) == fixes
    assert words in said


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 0, 1), (2, 1, 0), (1, 2, 0)])
def test_05_the_order_of_an_epochs_sentences_is_anybodys(
    tmp_path: Path, order: tuple[int, ...]
) -> None:
    lines = log(lambda p: [p]).split(b"\r\n")[:-1]
    turned = [lines[k + each] for k in range(0, len(lines), 3) for each in order]
    fixes, headings, _ = read(tmp_path, b"\r\n".join(turned) + b"\r\n")
    assert [fix.v_ned_m_s is not None for fix in fixes] == [True] * SECONDS
    assert headings >= SECONDS - 1


# --------------------------------------------------------------------------- recorders

CANDUMP = b"".join(
    f"({m.timestamp:.6f}) can0 {m.arbitration_id:03X}#{m.data.hex().upper()}\n".encode()
    for m in FRAMES
)
LINES = CANDUMP.split(b"\n")
HALF = len(LINES) // 2


def bus_of(tmp_path: Path, name: str, data: bytes) -> tuple[list[can.Message], Refusals, str]:
    path = tmp_path / name
    path.write_bytes(data)
    refused, told = Refusals(), list[str]()
    try:
        found = list(messages(path, refused, lambda code, text: told.append(text)))
    except TableError as error:
        return [], refused, str(error)
    return found, refused, "; ".join(told)


@pytest.mark.parametrize(
    ("data", "lost", "refused"),
    [
        (b"\n".join([*LINES[:HALF], b"\0" * 512, *LINES[HALF:]]), 0, 1),
        (b"\n".join([*LINES[:HALF], b"\xff" * 4096, *LINES[HALF:]]), 0, 1),
        (b"\n".join(LINES[:HALF]) + b"\n" + b"\0" * 5000, len(LINES) - 1 - HALF, 1),
        (b"\n".join([b"# logger 1", *LINES[:HALF], b"# again", b"", *LINES[HALF:]]), 0, 2),
        (b"\n".join([*LINES[:HALF], LINES[HALF] + LINES[HALF + 1], *LINES[HALF + 2 :]]), 2, 1),
        (CANDUMP.replace(b"\n", b"\r\n"), 0, 0),
        (b"\xef\xbb\xbf" + CANDUMP, 0, 0),
        (CANDUMP.decode().encode("utf-16"), 0, 0),
        (CANDUMP.replace(b"#", b"##1"), 0, 0),
        (re.sub(rb"(?m)$", b" R", CANDUMP.rstrip(b"\n")), 0, 0),
    ],
)
def test_08_a_bad_line_costs_a_line(tmp_path: Path, data: bytes, lost: int, refused: int) -> None:
    found, counted, _ = bus_of(tmp_path, "bus.log", data)
    assert len(found) == len(FRAMES) - lost
    assert len(counted.all()) == refused


@pytest.mark.parametrize("cut", [0, 1, 60, 143, 144, 300, 1000])
def test_06_a_cut_blf_is_read_up_to_there_or_says_so(tmp_path: Path, cut: int) -> None:
    whole = written(tmp_path / "whole.blf", FRAMES).read_bytes()
    found, refused, said = bus_of(tmp_path, "cut.blf", whole[:cut])
    assert len(found) < len(FRAMES)
    assert said or refused.all() or not found
    assert "buffer" not in said  # a word of Python's, not of the file


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig", "shift-jis", "utf-16"])
@pytest.mark.parametrize("at", ["head", "middle", "end"])
def test_09_a_comment_in_any_encoding(tmp_path: Path, encoding: str, at: str) -> None:
    text = asc(tmp_path / "bus.asc").read_bytes().decode()
    comment = "// テスト" if encoding == "shift-jis" else "// Prüfstand Süd"
    lines = text.split("\n")
    lines.insert({"head": 2, "middle": len(lines) // 2, "end": len(lines)}[at], comment)
    found, _, _ = bus_of(tmp_path, "other.asc", "\n".join(lines).encode(encoding))
    same(found, FRAMES)


@pytest.mark.parametrize(
    "line",
    [
        "   0.000000 CANFD   Start of measurement",
        "   0.000000 Start of measurement",
        "   0.010000 log trigger event",
        "   0.010100 CAN 1 Status:chip status error active",
        "   0.010200 1  Statistic: D 100 R 0 XD 0 XR 0 E 0 O 0 B 10.2%",
        "   0.010400 J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F",
        "   0.010500 SV: 2 0 1 ::x = 1",
    ],
)
def test_07_lines_of_canoe_that_are_no_frames_are_passed_over(tmp_path: Path, line: str) -> None:
    text = asc(tmp_path / "bus.asc").read_bytes().decode()
    head, _, rest = text.partition("internal events logged\n")
    data = f"{head}internal events logged\n{line}\n{rest}"
    found, refused, _ = bus_of(tmp_path, "other.asc", data.encode())
    same(found, FRAMES)
    assert refused.all() == []
