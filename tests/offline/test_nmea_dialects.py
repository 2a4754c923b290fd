"""Dialects of receivers and loggers: other talkers, rates, orders, digits and line ends.

Each row is what a receiver sends in ten seconds, or what a program leaves of it; numbers are those
of `test_case_variants`.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import pytest

from tests.offline.test_case_variants import GSA_3D, PLACE, SECONDS, read

Epoch = Callable[[int], list[str]]
ELSEWHERE = PLACE.replace("4712.0000000", "4712.0050000")
GSV = [
    f"{talker}GSV,3,{k},11,03,03,111,00,04,15,270,00,06,01,010,00,13,06,292,00"
    for talker in ("GP", "GL", "GA", "GB", "GQ")
    for k in (1, 2, 3)
]


def gga(at: str, talker: str = "GN", place: str = PLACE, quality: int = 1) -> str:
    return f"{talker}GGA,{at},{place},{quality},14,0.9,403.0,M,47.0,M,,"


def rmc(at: str, talker: str = "GN", status: str = "A", mode: str = "A", place: str = PLACE) -> str:
    return f"{talker}RMC,{at},{status},{place},3.0,90.0,240326,,,{mode}"


def times(second: int, rate_hz: int = 1) -> list[str]:
    return [f"0733{second:02d}.{100 * k // rate_hz:02d}" for k in range(rate_hz)]


def at(second: int) -> str:
    return times(second)[0]


def log(epoch: Epoch) -> bytes:
    bodies = [body for second in range(2, 2 + SECONDS) for body in epoch(second)]
    return b"".join(f"${b}*{reduce(xor, b.encode(), 0):02X}\r\n".encode() for b in bodies)


def usual(second: int) -> list[str]:
    return [gga(at(second)), rmc(at(second))]


def of(*bodies: Callable[[str], str]) -> Epoch:
    return lambda second: [body(at) for at in times(second) for body in bodies]


def at_rate(rate_hz: int, *bodies: Callable[[str], str]) -> Epoch:
    return lambda second: [body(at) for at in times(second, rate_hz) for body in bodies]


@pytest.mark.parametrize(
    ("epoch", "fixes"),
    [
        (of(lambda t: gga(t, "BD"), rmc), SECONDS),
        (of(lambda t: gga(t, "GP"), lambda t: rmc(t, "QZ")), SECONDS),
        (of(lambda t: gga(t, "GB"), lambda t: gga(t, "GP"), rmc), SECONDS),
        (of(lambda t: rmc(t, "BD"), lambda t: gga(t, "BD")), SECONDS),
        (at_rate(5, rmc, gga), 5 * SECONDS),
        (at_rate(10, gga, rmc), 10 * SECONDS),
        (lambda s: [usual(s)[0], *GSV, usual(s)[1]], SECONDS),
        (lambda s: [*GSV, *usual(s), *GSV], SECONDS),
        (lambda s: [usual(s)[0], *[GSA_3D] * 20, *GSV, usual(s)[1]], SECONDS),
        (of(gga, lambda t: rmc(f"{t}0")), SECONDS),
        (of(gga, lambda t: rmc(t[:-3])), SECONDS),
        (of(gga, rmc, lambda t: f"PUBX,00,{t},{PLACE},450.0,G3,1.0,1.5,0.1,0.0,0.0"), SECONDS),
        (of(lambda t: "PQTMEPE,2,1.0,1.0,2.0,1.4,2.4", gga, rmc), SECONDS),
        (of(lambda t: gga(t, place=PLACE.replace(",008", ",8")), rmc), SECONDS),
    ],
)
def test_every_order_and_rate_gives_all_fixes(tmp_path: Path, epoch: Epoch, fixes: int) -> None:
    found, _, said = read(tmp_path, log(epoch))
    assert [fix.v_ned_m_s is not None for fix in found] == [True] * fixes
    assert {fix.height_m for fix in found} == {450.0}
    assert said == ""


@pytest.mark.parametrize(
    ("quality", "status", "mode", "taken", "words"),
    [
        (2, "D", "D", 2, ""),
        (4, "R", "R", 4, ""),
        (5, "F", "F", 5, ""),
        (4, "D", "", 4, ""),
        (3, "P", "P", 3, ""),
        (9, "A", "D", 2, ""),
        (6, "A", "E", None, "dead reckoning"),
        (6, "E", "E", None, "dead reckoning"),
        (1, "E", "", None, "dead reckoning"),
        (8, "S", "S", None, "simulates"),
        (7, "M", "M", None, "put in by hand"),
        (1, "V", "N", None, "the receiver has no fix"),
    ],
)
def test_quality_and_status_together(
    tmp_path: Path, quality: int, status: str, mode: str, taken: int | None, words: str
) -> None:
    epoch = of(lambda t: gga(t, quality=quality), lambda t: rmc(t, status=status, mode=mode))
    fixes, _, said = read(tmp_path, log(epoch))
    assert [fix.quality for fix in fixes] == [taken] * SECONDS * (taken is not None)
    assert words in said


def _one_digit(data: bytes) -> bytes:
    return data.replace(b"*0", b"*")


@pytest.mark.parametrize(
    "change",
    [
        _one_digit,
        lambda data: _one_digit(data).lower().replace(b"gn", b"GN").upper(),
        lambda data: data.replace(b"\r\n", b"\n\r"),
        lambda data: data.replace(b"\r\n", b"\r\r\n"),
        lambda data: data.replace(b"\r\n", b"\r\n\0"),
        lambda data: data.replace(b"\r\n", b""),
        lambda data: data.replace(b"\r\n", b"\r\n\x11").replace(b"$", b"\x13$"),
        lambda data: data.replace(b"$", b"07:33:02.120\t$"),
        lambda data: data.replace(b"$", b"b'$").replace(b"\r\n", b"\\r\\n'\n"),
        lambda data: data.replace(b"$", b"1774337582.1,$"),
        lambda data: data.decode().encode("utf-16"),
        gzip.compress,
    ],
)
def test_lines_as_programs_leave_them(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    fixes, _, said = read(tmp_path, change(log(usual)))
    assert len(fixes) == SECONDS
    assert "checksum" not in said


@pytest.mark.parametrize(
    ("epoch", "words"),
    [
        (of(gga, lambda t: rmc(t).replace("240326", "000000")), "RMC has '000000' for a date"),
        (of(gga, lambda t: rmc(t).replace("240326", "")), "that of RMC is empty"),
        (of(gga), "RMC or ZDA missing"),
        (of(gga, lambda t: f"GNZDA,{t},24,03,26,00,00"), "the receiver's date is 0026-03-24"),
        (of(lambda t: gga(t, place=PLACE.replace("4712", "4762"))), "cannot be true"),
    ],
)
def test_the_cause_is_named(tmp_path: Path, epoch: Epoch, words: str) -> None:
    fixes, _, said = read(tmp_path, log(epoch))
    assert fixes == []
    assert words in said


def test_a_height_in_feet_is_none(tmp_path: Path) -> None:
    epoch = of(lambda t: gga(t).replace("403.0,M", "1322.2,F"), rmc)
    fixes, _, said = read(tmp_path, log(epoch))
    assert {fix.height_m for fix in fixes} == {None}
    assert "not in metres" in said


@pytest.mark.parametrize(
    "epoch",
    [
        # Of one instant, one after the other, and by turns; half a second apart.
        lambda s: [*usual(s), gga(at(s), "GP", ELSEWHERE), rmc(at(s), "GP")],
        lambda s: [gga(at(s), "GP", ELSEWHERE), *usual(s), rmc(at(s), "GP")],
        lambda s: [*usual(s), gga(f"0733{s:02d}.50", "GP", ELSEWHERE), rmc(f"0733{s:02d}.50")],
    ],
)
def test_two_receivers_on_one_line_are_named(tmp_path: Path, epoch: Epoch) -> None:
    fixes, _, said = read(tmp_path, log(epoch))
    assert fixes
    assert "two receivers are on this line" in said


def test_one_receiver_under_two_names_is_one(tmp_path: Path) -> None:
    both = of(lambda t: gga(t, "GP"), gga, lambda t: rmc(t, "GP"), rmc)
    for epoch in (
        both,
        lambda s: [usual(s)[0].replace("GN", "GP" if s < 6 else "GN"), usual(s)[1]],
    ):
        fixes, _, said = read(tmp_path, log(epoch))
        assert len(fixes) == SECONDS
        assert said == ""
