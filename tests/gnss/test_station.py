"""RINEX of a station with a known place: read as RTKLIB reads it, placed where RTKLIB puts it, and
with two frequencies where it is.

Two hours at Esbjerg, 240 epochs 30 s apart. RTKLIB's single-point solution has the same mask,
broadcast ionosphere and Saastamoinen's troposphere, but weighs otherwise, and knows nothing of
what the ionosphere's model leaves in common. Measured with one frequency, at most of any epoch, and
in the mean: GPS 3.4 and 0.8 m, Galileo 0.9 and 0.3, BeiDou 2.1 and 0.8, as BeiDou-2 may have an
offset of its own here.

The header's place is in ETRS89, which moves with Europe; satellites are in the ITRF. ITRF2014 to
ETRF2014 is a rotation of 0.085, 0.531 and -0.770 mas a year since 1989.0 (EUREF Technical Note 1):
at Esbjerg, 2020.48, 0.50 m north and 0.56 m east. The antenna stands 0.216 m above the marker.
"""

from __future__ import annotations

import gzip
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import hatanaka
import numpy as np
import pytest

from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch, System
from drivers.raw.rinex import ObservationReader
from drivers.raw.rinex_nav import Broadcast, navigation
from fusiond.gnss.ecef import ned_axes, to_geodetic
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from tests.drivers.raw.frames import differences
from tests.places import DATA

STATION = DATA / "station_esbc"
OBSERVATIONS = STATION / "ESBC00DNK_R_20201770000_02H_30S_MO.crx.gz"
NAVIGATION = STATION / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz"
PLACE = np.array([3582105.2910, 532589.7313, 5232754.8054])
"""APPROX POSITION XYZ of its header, to centimetres."""
ROTATION_RAD = np.radians(np.array([0.085, 0.531, -0.770]) / 3.6e6) * (2020.48 - 1989.0)
ANTENNA_M = 0.216
ONE_FREQUENCY = {"G": "1C", "E": "1C", "C": "2I"}

pytestmark = pytest.mark.skipif(
    not STATION.is_dir(), reason=f"station_esbc is absent: {STATION} (set FUSIOND_DATA)"
)
Positions = dict[float, Any]


@pytest.fixture(scope="module")
def texts() -> tuple[str, str]:
    observations = hatanaka.decompress(OBSERVATIONS).decode()
    return observations, gzip.decompress(NAVIGATION.read_bytes()).decode()


@pytest.fixture(scope="module")
def epochs(texts: tuple[str, str]) -> list[RawGnssEpoch]:
    counters = Counter[str]()
    found = list(ObservationReader("station", texts[0], counters).epochs())
    assert counters == {
        "epochs_raw": 240,
        "measured_G": 11_027,
        "measured_E": 9_523,
        "measured_C": 5_647,
        "measured_glonass": 2_239,
        "measured_sbas": 1_118,
        "measured_qzss": 85,
    }
    return found


@pytest.fixture(scope="module")
def records(texts: tuple[str, str]) -> list[Broadcast]:
    counters = Counter[str]()
    found = navigation("station", texts[1], counters)
    assert counters == {
        "ephemerides": 2_216,
        "ionospheres": 1,
        "sbas_not_used": 2_130,
        "glonass_not_used": 510,
        "qzss_not_used": 15,
    }
    return sorted(found, key=lambda record: record.gps_s)


@pytest.fixture(scope="module")
def oracle(texts: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    """RTKLIB's observations and navigation data of the same files."""
    rtk = pytest.importorskip("pyrtklib", reason="pyrtklib has wheels for x86-64 only")
    folder: Path = tmp_path_factory.mktemp("rinex")
    obs, nav = rtk.obs_t(), rtk.nav_t()
    for name, text in zip(("o.rnx", "n.rnx"), texts, strict=True):
        (folder / name).write_text(text)
        assert rtk.readrnx(str(folder / name), 1, "", obs, nav, rtk.sta_t()) == 1
    rtk.uniqnav(nav)
    rtk.sortobs(obs)
    return obs, nav


def antenna() -> np.ndarray:
    """Its antenna in the ITRF, in which broadcast ephemerides are."""
    x, y, z = ROTATION_RAD
    etrf = np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    lat, lon, _ = to_geodetic(*PLACE)
    found: np.ndarray = np.linalg.solve(etrf, PLACE) - ANTENNA_M * ned_axes(lat, lon)[:, 2]
    return found


def placed(
    epochs: list[RawGnssEpoch],
    records: list[Broadcast],
    systems: tuple[System, ...],
    signals: dict[str, str] | None = None,
) -> dict[float, SinglePoint]:
    """By second of week, with what had been sent by then; of `signals`, one a system, if given."""
    store, at, found = EphemerisStore(), 0, {}
    model = RangeModel(store, RangeOptions(systems=systems))
    for whole in epochs:
        epoch = whole
        if signals is not None:
            kept = tuple(s for s in whole.signals if s.signal == signals[s.system])
            epoch = replace(whole, signals=kept)
        now = epoch.week * 604_800 + epoch.tow_s
        while at < len(records) and records[at].gps_s <= now:
            store.add(records[at].message)
            at += 1
        solved = single_point(model, epoch, PLACE)
        assert not isinstance(solved, str), (epoch.tow_s, solved)
        found[epoch.tow_s] = solved
    return found


def placed_by_rtklib(obs: Any, nav: Any, system: System) -> Positions:
    import pyrtklib as rtk  # noqa: PLC0415

    options = rtk.prcopt_default
    options.mode, options.elmin = rtk.PMODE_SINGLE, np.radians(10.0)
    options.ionoopt, options.tropopt = rtk.IONOOPT_BRDC, rtk.TROPOPT_SAAS
    options.navsys = {"G": rtk.SYS_GPS, "E": rtk.SYS_GAL, "C": rtk.SYS_CMP}[system]
    found: Positions = {}
    begin = 0
    while begin < obs.n:
        t, end = obs.data[begin].time, begin
        while end < obs.n and abs(rtk.timediff(obs.data[end].time, t)) < 1e-3:
            end += 1
        block = rtk.Arr1Dobsd_t(end - begin)
        for k in range(begin, end):
            block[k - begin] = obs.data[k]
        sol, states = rtk.sol_t(), rtk.Arr1Dssat_t(rtk.MAXSAT)
        azel, said = rtk.Arr1Ddouble(2 * (end - begin)), rtk.Arr1Dchar(128)
        if rtk.pntpos(block.ptr, end - begin, nav, options, sol, azel, states.ptr, said):
            week = rtk.Arr1Dint(1)
            found[round(rtk.time2gpst(t, week), 3)] = np.array([sol.rr[k] for k in range(3)])
        begin = end
    return found


@pytest.mark.parametrize(
    ("system", "each_m", "mean_m", "error_m"),
    [
        ("G", 4.0, 0.9, 2.5),
        ("E", 1.0, 0.4, 1.0),
        ("C", 2.4, 0.9, 1.1),
        pytest.param(
            *("C", 0.8, 0.3, 1.1),
            marks=pytest.mark.xfail(strict=True, reason="BeiDou-2 has an offset here, not there"),
        ),
    ],
)
def test_position_by_position_against_rtklib(
    epochs: list[RawGnssEpoch],
    records: list[Broadcast],
    oracle: tuple[Any, Any],
    system: System,
    each_m: float,
    mean_m: float,
    error_m: float,
) -> None:
    ours = placed(epochs, records, (system,), ONE_FREQUENCY)
    theirs = placed_by_rtklib(*oracle, system)
    assert ours.keys() == theirs.keys()
    assert len(ours) == 240
    axes = ned_axes(*to_geodetic(*PLACE)[:2])
    apart = np.array([(ours[t].position - theirs[t]) @ axes for t in ours])
    assert np.linalg.norm(apart, axis=1).max() < each_m
    assert np.linalg.norm(apart.mean(axis=0)) < mean_m
    off = np.array([(ours[t].position - PLACE) @ axes for t in ours])
    their_off = np.array([(theirs[t] - PLACE) @ axes for t in ours])
    level = float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
    assert level < error_m
    assert level < 1.1 * float(np.sqrt((their_off[:, :2] ** 2).sum(axis=1).mean()))


def off_by(found: dict[float, SinglePoint], half: slice) -> tuple[float, float, float]:
    """RMS horizontally and in three dimensions (m), and NEES a degree, of a part of the epochs."""
    axes = ned_axes(*to_geodetic(*PLACE)[:2])
    place, part = antenna(), list(found.values())[half]
    off = np.array([s.position - place for s in part])
    nees = np.array([o @ np.linalg.solve(s.covariance, o) for o, s in zip(off, part, strict=True)])
    ned = off @ axes
    level = float(np.sqrt((ned[:, :2] ** 2).sum(axis=1).mean()))
    return level, float(np.sqrt((ned**2).sum(axis=1).mean())), float(nees.mean()) / 3.0


SCORED = slice(120, None)
"""Constants were chosen on the first hour."""


def test_the_place_is_that_of_the_itrf() -> None:
    lat, lon, _ = to_geodetic(*PLACE)
    ned = (antenna() - PLACE) @ ned_axes(lat, lon)
    assert ned == pytest.approx([0.498, 0.555, -0.218], abs=2e-3)


@pytest.mark.parametrize(
    ("systems", "level_m", "whole_m"),
    [(("G", "E", "C"), 0.4, 0.6), (("E",), 0.3, 0.5), (("G",), 2.1, 2.6), (("C",), 0.9, 1.9)],
    ids=["all", "Galileo", "GPS", "BeiDou"],
)
def test_two_frequencies_are_decimetres_right(
    epochs: list[RawGnssEpoch],
    records: list[Broadcast],
    systems: tuple[System, ...],
    level_m: float,
    whole_m: float,
) -> None:
    """Measured, second hour: all 0.27 and 0.35 m, Galileo 0.19 and 0.33, GPS 1.91 and 2.35 (G28,
    one of seven, is 3 m off by its broadcast clock), BeiDou 0.71 and 1.58 (half of it of the second
    generation). With one frequency 0.79 and 1.14, 0.35 and 1.77, 1.67 and 1.72, 0.54 and 0.80."""
    level, whole, nees = off_by(placed(epochs, records, systems), SCORED)
    assert level < level_m
    assert whole < whole_m
    assert nees < 1.4


@pytest.mark.parametrize(
    ("system", "signal", "level_m", "whole_m"),
    [
        ("G", "1C", 2.2, 2.5),
        ("G", "2W", 2.6, 2.9),
        ("G", "2L", 2.6, 2.9),
        ("E", "1C", 0.6, 2.0),
        ("E", "5Q", 0.8, 3.4),
        ("E", "7Q", 0.8, 3.3),
        ("C", "2I", 0.8, 1.7),
        ("C", "6I", 2.6, 3.6),
    ],
)
def test_each_signal_alone(
    epochs: list[RawGnssEpoch],
    records: list[Broadcast],
    system: System,
    signal: str,
    level_m: float,
    whole_m: float,
) -> None:
    """Each with its group delay: one left out, or of the other sign, is of metres."""
    found = placed(epochs, records, (system,), {system: signal, **_OTHERS[system]})
    level, whole, _ = off_by(found, slice(None))
    assert level < level_m
    assert whole < whole_m


_OTHERS: dict[System, dict[str, str]] = {
    s: {other: "" for other in "GEC" if other != s} for s in ("G", "E", "C")
}


def test_ephemerides_are_those_of_rtklib_field_by_field(
    records: list[Broadcast], oracle: tuple[Any, Any]
) -> None:
    import pyrtklib as rtk  # noqa: PLC0415

    letters = {rtk.SYS_GPS: "G", rtk.SYS_GAL: "E", rtk.SYS_CMP: "C"}
    mine: dict[tuple[str, str, float, float], Ephemeris] = {}
    for _, m in records:
        if isinstance(m, Ephemeris):
            mine[m.satellite, "fnav" * (m.message == "fnav"), m.toe_s, m.clock_bias_s] = m
    compared = Counter[str]()
    for k in range(oracle[1].n):
        eph = oracle[1].eph[k]
        prn = rtk.Arr1Dint(1)
        letter = letters.get(rtk.satsys(eph.sat, prn))
        if letter is None:
            continue
        message = "fnav" * (letter == "E" and bool(eph.code & 0x100))
        ours = mine[f"{letter}{prn[0]:02d}", message, eph.toes, eph.f0]
        assert differences(ours, eph) == {}, ours.satellite
        assert ours.week == eph.week
        compared[letter] += 1
    assert min(compared[letter] for letter in "GEC") > 200


def test_observations_are_those_of_rtklib(
    epochs: list[RawGnssEpoch], oracle: tuple[Any, Any]
) -> None:
    import pyrtklib as rtk  # noqa: PLC0415

    obs, _ = oracle
    mine = {
        (e.tow_s, s.satellite): {x.pseudorange_m for x in e.signals if x.satellite == s.satellite}
        for e in epochs[:20]
        for s in e.signals
    }
    compared = 0
    for k in range(obs.n):
        one = obs.data[k]
        week, prn = rtk.Arr1Dint(1), rtk.Arr1Dint(1)
        tow_s = round(rtk.time2gpst(one.time, week), 3)
        system = rtk.satsys(one.sat, prn)
        letter = {rtk.SYS_GPS: "G", rtk.SYS_GAL: "E", rtk.SYS_CMP: "C"}.get(system)
        found = mine.get((tow_s, f"{letter}{prn[0]:02d}"))
        if found is None:
            continue
        assert {one.P[i] for i in range(3) if one.P[i]} <= found
        compared += 1
    assert compared > 500


def test_ionosphere_of_the_header(records: list[Broadcast]) -> None:
    (model,) = [m for _, m in records if isinstance(m, Klobuchar)]
    assert model.alpha == (4.6566e-09, 1.4901e-08, -5.9605e-08, -1.1921e-07)
    assert model.beta == (81920.0, 98304.0, -65536.0, -524290.0)
