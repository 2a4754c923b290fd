"""RINEX observation and navigation files, line by line; whole ones: tests/gnss/test_station.py."""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import UtcStamp
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Bdgim,
    Ephemeris,
    Klobuchar,
    RawGnssEpoch,
)
from drivers.raw.rinex import ObservationReader, RinexError, version_and_type
from drivers.raw.rinex_nav import Broadcast, navigation


def head(text: str, label: str) -> str:
    return f"{text:<60}{label}\n"


def header(version: str = "3.05", kind: str = "OBSERVATION DATA", *more: str) -> str:
    first = head(f"{version:>9}           {kind:<20}M", "RINEX VERSION / TYPE")
    return first + "".join(more) + head("", "END OF HEADER")


TYPES = head("G    4 C1C L1C D1C S1C", "SYS / # / OBS TYPES")
BEIDOU = head("C    5 C1P D1P C2I C7I S2I", "SYS / # / OBS TYPES")
NOW = "> 2026 12 01 02 14 47.0000000  {flag} {n:2d}\n"
"""GPS time; UTC 02:14:29, 1796091269 s of POSIX time, week 2447, 180887 s."""


def observed(*values: float | None) -> str:
    return "".join(" " * 16 if v is None else f"{v:14.3f}  " for v in values)


def epochs(text: str) -> tuple[list[RawGnssEpoch], Counter[str]]:
    counters = Counter[str]()
    return list(ObservationReader("gnss", text, counters).epochs()), +counters


@pytest.mark.parametrize(
    ("flag", "lock_s", "carrier"),
    [
        (" ", math.inf, 1.5),
        ("0", math.inf, 1.5),
        ("1", 0.0, 1.5),
        ("2", math.inf, None),
        ("3", 0.0, None),
    ],
)
def test_loss_of_lock_and_half_cycles(flag: str, lock_s: float, carrier: float | None) -> None:
    """Bit 0: the lock was lost since the epoch before. Bit 1: half a cycle may be missing."""
    line = f"G05{22_000_000.125:14.3f}  {1.5:14.3f}{flag}7{-1234.5:14.3f}  {45.0:14.3f}  \n"
    (epoch,), counters = epochs(
        header("3.05", "OBSERVATION DATA", TYPES) + NOW.format(flag=0, n=1) + line
    )
    assert epoch.signals[0].lock_s == lock_s
    assert epoch.signals[0].carrier_cycles == carrier
    assert counters["half_cycle_open"] == (carrier is None)


def test_an_epoch() -> None:
    line = f"G05{observed(22_000_000.125, 115_610_000.5, -1234.5, 45.25)}\n"
    (epoch,), counters = epochs(
        header("3.05", "OBSERVATION DATA", TYPES) + NOW.format(flag=0, n=1) + line
    )
    assert (epoch.week, epoch.tow_s, epoch.stamp) == (
        2447,
        180_887.0,
        UtcStamp(1_796_091_269 * 10**9),
    )
    (signal,) = epoch.signals
    wavelength = SPEED_OF_LIGHT_M_S / CARRIER_HZ["G", "1"]
    assert (signal.satellite, signal.signal) == ("G05", "1C")
    assert signal.pseudorange_m == 22_000_000.125
    assert signal.carrier_cycles == 115_610_000.5
    assert signal.range_rate_m_s == pytest.approx(1234.5 * wavelength)
    assert signal.cno_db_hz == 45.25
    assert counters == {"epochs_raw": 1, "measured_G": 1}


def test_what_was_not_measured() -> None:
    """Blank, zero, a line that ends early; a system that is not used; a blank in a number."""
    lines = (
        f"C21{observed(2.2e7, None, 0.0, 2.3e7, 40.0)}\n"
        f"C22{observed(2.2e7)}\n"
        f"R01{observed(2.2e7)}\n"
        f"C 6{observed(None, None, 2.3e7)}\n"
    )
    (epoch,), counters = epochs(
        header("4.01", "OBSERVATION DATA", BEIDOU) + NOW.format(flag=0, n=4) + lines
    )
    assert [(s.satellite, s.signal) for s in epoch.signals] == [
        ("C21", "1P"), ("C21", "7I"), ("C22", "1P"), ("C06", "2I"),
    ]  # fmt: skip
    assert counters["measured_glonass"] == 1


def test_b1i_of_3_02_was_called_c1i() -> None:
    types = head("C    2 C1I S1I", "SYS / # / OBS TYPES")
    text = NOW.format(flag=0, n=1) + f"C21{observed(2.2e7, 40.0)}\n"
    (old,), _ = epochs(header("3.02", "OBSERVATION DATA", types) + text)
    assert [s.signal for s in old.signals] == ["2I"]
    (new,), _ = epochs(header("3.04", "OBSERVATION DATA", types) + text)
    assert [s.signal for s in new.signals] == ["1I"]


def test_header_lines_that_change_numbers() -> None:
    many = head("G   14 C1C C1W C2L C2W C5Q D1C D2L D2W D5Q L1C L2L L2W L5Q", "SYS / # / OBS TYPES")
    rest = head("       S1C", "SYS / # / OBS TYPES")
    scale = head("G   10  1 C1C", "SYS / SCALE FACTOR")
    bdt = head("  2026    12     1     2    14   47.0000000     BDT", "TIME OF FIRST OBS")
    leap = head("    19", "LEAP SECONDS")
    values = [None] * 13
    line = f"G05{observed(2.2e8, *values[1:], 45.0)}\n"
    (epoch,), _ = epochs(
        header("3.05", "OBSERVATION DATA", many, rest, scale, bdt, leap)
        + NOW.format(flag=0, n=1)
        + line
    )
    (signal,) = epoch.signals
    assert (signal.pseudorange_m, signal.cno_db_hz) == (2.2e7, 45.0)
    assert epoch.tow_s == 180_901.0
    assert epoch.stamp == UtcStamp((1_796_091_269 + 14 - 1) * 10**9)


def test_events_are_passed_and_may_rename_observables() -> None:
    line = f"G05{observed(2.2e7, None, None, 45.0)}\n"
    event = (
        NOW.format(flag=4, n=2)
        + head("moved", "COMMENT")
        + head("G    1 C5Q", "SYS / # / OBS TYPES")
    )
    slips = NOW.format(flag=6, n=1) + line
    found, counters = epochs(
        header("3.05", "OBSERVATION DATA", TYPES)
        + NOW.format(flag=0, n=1) + line + slips + event + NOW.format(flag=1, n=1) + line
    )  # fmt: skip
    assert [[s.signal for s in e.signals] for e in found] == [["1C"], ["5Q"]]
    assert counters["events_passed"] == 2


def test_damage_costs_its_line() -> None:
    good = NOW.format(flag=0, n=2) + f"G05{observed(2.2e7)}\nG06{observed(2.3e7)}\n"
    text = good.replace("22000000.000", "22000x00.000") + "> rubbish\n\nmore of it\n" + good
    (first, second), counters = epochs(header("3.05", "OBSERVATION DATA", TYPES) + text)
    assert [len(e.signals) for e in (first, second)] == [1, 2]
    assert counters["lines_unreadable"] == 3
    far = good.replace("G06", "G40").replace("22000000.000", "   22000.000")
    (epoch,), counters = epochs(header("3.05", "OBSERVATION DATA", TYPES) + far)
    assert epoch.signals == ()
    assert counters["pseudorange_implausible"] == counters["prn_unknown"] == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the first line does not say so"),
        (header("1.00", "OBSERVATION DATA"), "RINEX 1.00; versions 2 to 4 are read"),
        (header("x", "OBSERVATION DATA"), "no RINEX version"),
        (header("3.05", "NAVIGATION DATA"), "has no observations"),
        (header("3.05", "OBSERVATION DATA"), "names no observables"),
        (header("3.05", "OBSERVATION DATA", TYPES)[:150], "header has no end"),
        (
            header("3.05", "OBSERVATION DATA", TYPES, head(" " * 48 + "GLO", "TIME OF FIRST OBS")),
            "GLO time",
        ),
    ],
)
def test_no_observations_says_why(text: str, words: str) -> None:
    with pytest.raises(RinexError, match=words):
        ObservationReader("gnss", text, Counter())


# --------------------------------------------------------------------------- navigation


def row(*values: float) -> str:
    return "    " + "".join(f"{v:19.12E}" for v in values) + "\n"


CLOCK = "".join(f"{v:19.12E}" for v in (1.5e-4, -2e-12, 0.0))
ORBIT = (
    row(77.0, 50.5, 4.5e-9, 1.25),
    row(1e-6, 0.0123, 8e-6, 5282.625),
    row(180_000.0, 1e-8, -2.5, -3e-8),
    row(0.96, 200.25, 0.75, -8e-9),
)


def legacy(satellite: str = "C21", *, sent: float = 180_030.0, sources: float = 0.0) -> str:
    """Toe 180,000 s of the system's own week."""
    first = f"{satellite} 2026 12 01 02 00 00{CLOCK}\n"
    rest = (row(3e-10, sources, 1091.0, 0.0), row(2.0, 0.0, 4e-9, 5e-9), row(sent, 0.0))
    return first + "".join((*ORBIT, *rest))


def cnav(name: str = "CNV1", *, health: float = 0.0, flags: float = 0.0) -> str:
    """RINEX 4: rates in the first row and the fifth; delays in the seventh."""
    first = f"> EPH C21 {name}\nC21 2026 12 01 02 00 00{CLOCK}\n"
    rates = row(0.0125, 50.5, 4.5e-9, 1.25)
    rest = (
        row(3e-10, 2e-14, 3.0, 180_000.0),
        row(0.0, 0.0, 0.0, 0.0),
        row(8e-10, 0.0, 4e-9, -9e-9) if name == "CNV1" else row(0.0, 7e-10, 4e-9, -9e-9),
        row(2.0, health, flags, 77.0),
        row(180_060.0, 0.0, 0.0, 77.0),
    )
    return first + "".join((rates, *ORBIT[1:], *rest))


def records(text: str) -> tuple[list[Broadcast], Counter[str]]:
    counters = Counter[str]()
    return navigation("gnss", text, counters), +counters


def nav3(*more: str) -> str:
    return header("3.05", "NAVIGATION DATA") + "".join(more)


def nav4(*more: str) -> str:
    return header("4.01", "NAVIGATION DATA") + "".join(more)


def test_an_ephemeris_and_when_it_was_sent() -> None:
    ((sent_s, e),), counters = records(nav3(legacy()))
    assert isinstance(e, Ephemeris)
    assert (e.satellite, e.message, e.week, e.toe_s, e.toc_s) == (
        "C21",
        "d1",
        1091,
        180_000.0,
        180_000.0,
    )
    assert sent_s == 2447 * 604_800 + 180_030 + 14
    assert (e.sqrt_a, e.eccentricity, e.mean_anomaly) == (5282.625, 0.0123, 1.25)
    assert (e.crs, e.crc, e.cuc, e.cus, e.cic, e.cis) == (50.5, 200.25, 1e-6, 8e-6, 1e-8, -3e-8)
    assert e.group_delay_s == (4e-9, 5e-9)
    assert (e.issue, e.accuracy_m, e.healthy) == (77, 2.0, True)
    assert counters == {"ephemerides": 1}


@pytest.mark.parametrize("sent", [0.0, 0.9999e9, 0.9999e9 * 60])
def test_a_transmission_that_is_a_filler_is_toe(sent: float) -> None:
    ((sent_s, _),), _ = records(nav3(legacy(sent=sent)))
    assert sent_s == 2447 * 604_800 + 180_014


@pytest.mark.parametrize(
    ("text", "message", "delays"),
    [
        (nav3(legacy("G05")), "lnav", (4e-9,)),
        (nav3(legacy("C60")), "d2", (4e-9, 5e-9)),
        (nav3(legacy("E05", sources=517.0)), "inav", (4e-9, 5e-9)),
        (nav3(legacy("E05", sources=258.0)), "fnav", (4e-9,)),
        (nav4("> EPH E05 FNAV\n", legacy("E05")), "fnav", (4e-9,)),
        (nav4("> EPH G05 LNAV\n", legacy("G05")), "lnav", (4e-9,)),
        (nav4(cnav("CNV1")), "bcnav1", (4e-9, -9e-9, 8e-10)),
        (nav4(cnav("CNV2")), "bcnav2", (4e-9, -9e-9, 7e-10)),
    ],
)
def test_messages_and_their_delays(text: str, message: str, delays: tuple[float, ...]) -> None:
    ((_, e),), _ = records(text)
    assert isinstance(e, Ephemeris)
    assert (e.message, e.group_delay_s) == (message, delays)
    rates = (0.0125, 2e-14) if message.startswith("bcnav") else (0.0, 0.0)
    assert (e.semi_major_rate, e.mean_motion_rate) == rates
    assert e.issue == 77


def test_health_of_cnav() -> None:
    for health, flags, good in (
        (0, 0, True),
        (1, 0, False),
        (0, 1, True),
        (0, 2, False),
        (0, 4, False),
    ):
        ((_, e),), _ = records(nav4(cnav(health=health, flags=flags)))
        assert isinstance(e, Ephemeris)
        assert e.healthy == good


def test_records_that_are_not_used_are_counted() -> None:
    text = nav4(
        "> EPH R01 FDMA\n", legacy("R01"), "> EPH G05 CNV2\n", legacy("G05"), cnav("CNV3"),
        "> STO GAUT\n", row(1.0), "> EPH G05 LNAV\n", legacy("G05"),
        "> ION E05 IFNV\n", "    2026 12 01 02 00 00" + CLOCK + "\n", row(0.0),
    )  # fmt: skip
    found, counters = records(text)
    assert len(found) == 1
    assert counters == {
        "ephemerides": 1, "glonass_not_used": 1, "gps_cnav_not_used": 1, "bcnav_not_used": 1,
        "records_not_used": 1, "ionosphere_not_used": 1,
    }  # fmt: skip


def test_ionosphere() -> None:
    rows = (
        head("GPSA   4.6566E-09  1.4901E-08 -5.9605E-08 -1.1921E-07", "IONOSPHERIC CORR"),
        head("GPSB   8.1920E+04  9.8304E+04 -6.5536E+04 -5.2429E+05", "IONOSPHERIC CORR"),
        head("BDSA   4.6566D-09  1.4901E-08 -5.9605E-08 -1.1921E-07", "IONOSPHERIC CORR"),
    )
    (old,), counters = records(header("3.05", "NAVIGATION DATA", *rows))
    expected = (4.6566e-09, 1.4901e-08, -5.9605e-08, -1.1921e-07)
    assert isinstance(old.message, Klobuchar)
    assert (old.message.system, old.message.alpha) == ("G", expected)
    assert counters == {"ionospheres": 1}
    first = "    2026 12 01 02 00 00" + "".join(f"{v:19.12E}" for v in expected[:3]) + "\n"
    text = nav4(
        "> ION C21 D1D2\n", first, row(expected[3], 81_920.0, 98_304.0, -65_536.0), row(-524_290.0)
    )
    (new,), _ = records(text)
    assert isinstance(new.message, Klobuchar)
    assert (new.message.system, new.message.alpha) == ("C", expected)
    assert new.message.beta == (81_920.0, 98_304.0, -65_536.0, -524_290.0)
    alpha = (26.25, 2.75, 9.5, 7.75, -11.25, -0.625, 0.75, 1.875, 0.5)
    first = "    2026 12 01 02 00 00" + "".join(f"{v:19.12E}" for v in alpha[:3]) + "\n"
    text = nav4("> ION C21 CNVX\n", first, row(*alpha[3:7]), row(*alpha[7:]))
    (third,), counters = records(text)
    assert third.message == Bdgim("gnss", 0, alpha)
    assert counters == {"ionospheres": 1}


def test_damage_costs_its_record() -> None:
    bad = legacy("G07").replace("5.28262500", "5.2x262500")
    wild = legacy("G08").replace("5.282625000000E+03", "5.282625000000E-03")
    found, counters = records(nav3(legacy("G05"), bad, wild, legacy("G99"), legacy("G06")[:200]))
    assert [m.message.satellite for m in found if isinstance(m.message, Ephemeris)] == ["G05"]
    assert counters == {
        "ephemerides": 1, "records_unreadable": 2, "ephemeris_implausible": 1,
        "satellite_unknown": 1,
    }  # fmt: skip


OBSERVATION_SEED = (
    header("3.05", "OBSERVATION DATA", TYPES, BEIDOU)
    + (NOW.format(flag=0, n=2) + f"G05{observed(2.2e7, 1e8, 5.0, 40.0)}\nC21{observed(2.2e7)}\n")
    * 2
)
NAVIGATION_SEEDS = (
    nav3(legacy("G05"), legacy("C21")),
    nav4(cnav(), "> EPH G05 LNAV\n", legacy("G05")),
)


def mutated(text: str, rng: random.Random) -> str:
    """Characters changed, put in and taken out, lines cut, doubled and exchanged."""
    lines = text.split("\n")
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(lines))
        line, k = lines[at], rng.randrange(max(1, len(lines[at]) + 1))
        lines[at] = rng.choice(
            (
                line[:k] + rng.choice("0123456789 .-+EDGC>xé") + line[k + 1 :],
                line[:k] + rng.choice(" 9G>") + line[k:],
                line[:k],
                line + "\n" + line,
                lines[rng.randrange(len(lines))],
            )
        )
    return "\n".join(lines)


@given(st.randoms(use_true_random=False))
@settings(max_examples=400, deadline=None)
def test_mutated_files_are_read_or_refused(rng: random.Random) -> None:
    try:
        for epoch in ObservationReader("gnss", mutated(OBSERVATION_SEED, rng), Counter()).epochs():
            assert 0.0 <= epoch.tow_s < 604_800.0
    except RinexError:
        pass
    for seed in NAVIGATION_SEEDS:
        try:
            for record in navigation("gnss", mutated(seed, rng), Counter()):
                assert record.message.source == "gnss"
        except RinexError:
            pass


def test_version_and_type() -> None:
    assert version_and_type(header()) == (3.05, "O")
