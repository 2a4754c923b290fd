"""RINEX 2.11 files: what they say is what the same file says in RINEX 3."""

from __future__ import annotations

from collections import Counter

import pytest

from drivers.measurements import UtcStamp
from drivers.raw.messages import Ephemeris, Klobuchar
from drivers.raw.rinex import ObservationReader, RinexError, version_and_type
from drivers.raw.rinex2_to_3 import as_version_3
from drivers.raw.rinex_nav import navigation


def head(text: str, label: str) -> str:
    return f"{text:<60}{label}\n"


def first(kind: str, system: str = "G (GPS)", version: str = "2.11") -> str:
    return head(f"{version:>9}           {kind:<20}{system}", "RINEX VERSION / TYPE")


TYPES = head("     7    C1    L1    L2    P2    D1    S1    S2", "# / TYPES OF OBSERV")
END = head("", "END OF HEADER")
OBSERVATIONS = first("OBSERVATION DATA", "M (MIXED)") + TYPES + END


def values(*numbers: float | None, flags: str = "  ") -> str:
    """Of a satellite, five a line."""
    fields = [" " * 16 if v is None else f"{v:14.3f}{flags}" for v in numbers]
    rows = ["".join(fields[at : at + 5]) for at in range(0, len(fields), 5)]
    return "".join(f"{row.rstrip()}\n" for row in rows)


def epoch_line(satellites: list[str], flag: int = 0, second: str = " 0.0000000") -> str:
    date = f" 05  3 24 13 10 {second}  {flag}{len(satellites):3}"
    rows = [satellites[at : at + 12] for at in range(0, len(satellites), 12)] or [[]]
    lines = [date + "".join(rows[0]), *(" " * 32 + "".join(row) for row in rows[1:])]
    return "".join(f"{line}\n" for line in lines)


ONE = values(2.2e7, 1.15e8, 9.0e7, 2.2000002e7, -1234.5, 45.25, 30.5)


def read(text: str) -> tuple[list, Counter[str]]:  # type: ignore[type-arg]
    counters = Counter[str]()
    reader = ObservationReader("gnss", as_version_3(text), counters)
    return list(reader.epochs()), +counters


def test_an_epoch() -> None:
    (epoch,), counters = read(OBSERVATIONS + epoch_line(["G 5"]) + ONE)
    assert epoch.week == 1315
    assert epoch.tow_s == 4 * 86_400 + 13 * 3600 + 600
    # 2005-03-24 13:10:00 GPS time, 13 leap seconds
    assert epoch.stamp == UtcStamp((1_111_669_800 - 13) * 10**9)
    by_name = {s.signal: s for s in epoch.signals}
    assert set(by_name) == {"1C", "2W"}
    assert by_name["1C"].pseudorange_m == 2.2e7
    assert by_name["1C"].carrier_cycles == 1.15e8
    assert by_name["1C"].range_rate_m_s == pytest.approx(1234.5 * 299_792_458.0 / 1575.42e6)
    assert by_name["1C"].cno_db_hz == 45.25
    assert by_name["2W"].pseudorange_m == 2.2000002e7
    assert by_name["2W"].carrier_cycles == 9.0e7
    assert by_name["2W"].cno_db_hz == 30.5
    assert counters == {"epochs_raw": 1, "measured_G": 2}


def test_more_satellites_than_a_line_holds() -> None:
    satellites = [f"G{prn:2}" for prn in range(1, 15)] + ["R 3", "E11"]
    text = OBSERVATIONS + epoch_line(satellites) + ONE * len(satellites)
    (epoch, after), counters = read(text + epoch_line(["G 5"], second="30.0000000") + ONE)
    assert len({s.satellite for s in epoch.signals}) == 15
    assert {s.signal for s in epoch.signals if s.system == "E"} == {"1X"}
    assert counters["measured_glonass"] == 1
    assert after.tow_s - epoch.tow_s == 30.0


@pytest.mark.parametrize("satellite", ["  5", "G05", "G 5"])
def test_a_system_that_is_left_blank_is_gps(satellite: str) -> None:
    (epoch,), _ = read(OBSERVATIONS + epoch_line([satellite]) + ONE)
    assert {s.satellite for s in epoch.signals} == {"G05"}


def test_events_and_cycle_slips_are_passed() -> None:
    """An event may rename the observables; cycle slips look like observations."""
    renamed = head("     2    C1    S1", "# / TYPES OF OBSERV")
    event = epoch_line([], flag=4)[:29] + "  1\n" + renamed
    slips = epoch_line(["G 5"], flag=6) + ONE
    text = OBSERVATIONS + epoch_line(["G 5"]) + ONE + slips + event
    text += epoch_line(["G 5"], second=" 1.0000000") + values(2.1e7, 40.0)
    (_, epoch), counters = read(text)
    (signal,) = epoch.signals
    assert (signal.pseudorange_m, signal.cno_db_hz) == (2.1e7, 40.0)
    assert counters["events_passed"] == 1
    assert "lines_unreadable" not in counters


def test_a_line_that_is_no_epoch_costs_itself() -> None:
    text = OBSERVATIONS + "nonsense\n" + epoch_line(["G 5"]) + ONE
    (_,), counters = read(text)
    assert counters["lines_unreadable"] == 1


NUMBERS = [
    [2.3e-4, 1.1e-12, 0.0],
    [45.0, -12.5, 4.5e-9, 0.7],
    [-6.0e-7, 0.011, 8.0e-6, 5153.7],
    [396_000.0, 1.0e-7, 2.1, -5.0e-8],
    [0.96, 210.0, -1.4, -8.1e-9],
    [3.0e-10, 1.0, 1315.0, 0.0],
    [2.0, 0.0, -1.1e-8, 45.0],
    [388_818.0, 4.0],
]


def fortran(number: float) -> str:
    return f"{number:19.12E}".replace("E", "D")


def test_navigation() -> None:
    ion = head(f"  {'':0}" + "".join(f"{x:12.4E}" for x in (1e-8, 2e-8, -6e-8, -1e-7)), "ION ALPHA")
    beta = head("  " + "".join(f"{x:12.4E}" for x in (9e4, 9e4, -1e5, -6e5)), "ION BETA")
    rows = ["".join(map(fortran, row)) for row in NUMBERS]
    record = f" 5 05  3 24 14  0  0.0{rows[0]}\n" + "".join(f"   {row}\n" for row in rows[1:])
    text = first("N: GPS NAV DATA", "") + ion.replace("E", "D", 0) + beta + END + record
    counters = Counter[str]()
    found = navigation("gnss", as_version_3(text), counters)
    ionosphere, ephemeris = (each.message for each in found)
    assert isinstance(ionosphere, Klobuchar)
    assert ionosphere.alpha == (1e-8, 2e-8, -6e-8, -1e-7)
    assert isinstance(ephemeris, Ephemeris)
    assert (ephemeris.satellite, ephemeris.week, ephemeris.toe_s) == ("G05", 1315, 396_000.0)
    assert ephemeris.clock_bias_s == 2.3e-4
    assert ephemeris.sqrt_a == 5153.7
    assert counters["ephemerides"] == 1


def test_of_another_version_or_kind() -> None:
    three = first("OBSERVATION DATA", "M", "3.05") + END
    assert as_version_3(three) == three
    assert as_version_3("nonsense") == "nonsense"
    with pytest.raises(RinexError, match="type 'G' is not read"):
        as_version_3(first("GLONASS NAV DATA") + END)
    with pytest.raises(RinexError, match=r"RINEX 1.00; versions 2 to 4 are read"):
        version_and_type(first("OBSERVATION DATA", "", "1.00"))
