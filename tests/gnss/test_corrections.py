"""Corrections of a service: beside RTKLIB, of an epoch's ranges; when they are not applied."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.raw.messages import (
    SPEED_OF_LIGHT_M_S,
    Correction,
    CorrectionPart,
    Ephemeris,
    RawGnssEpoch,
    RawSignal,
    System,
)
from fusiond.gnss.corrections import Corrections, issue_of
from fusiond.gnss.group_delay import group_delay
from fusiond.gnss.orbit import NOT_CORRECTED, Orbits, gps_time
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.scenarios import SCENARIOS

SIGNALS: tuple[tuple[System, str], ...] = (("G", "1C"), ("G", "2L"), ("C", "2I"), ("C", "6I"))
ORBIT = (1.5, -2.5, 0.7, 1e-3, 2e-3, -5e-4)
CLOCK = (-3.0, 1e-3, 0.0)
INTERVAL_S = 10.0


def sky() -> tuple[RawGnssEpoch, list[Ephemeris]]:
    """An epoch of the simulated drive without noise, and what its satellites broadcast."""
    quiet = dict.fromkeys(
        (
            *("pseudorange_sd_m", "multipath_sd_m", "signal_in_space_sd_m", "wet_delay_sd_m"),
            *("inter_system_sd_m", "cno_sd_db"),
        ),
        0.0,
    )
    made = GnssRaw(
        SCENARIOS["drive"].truth(20.0),
        GnssRawOptions(rate_hz=1.0, signals=SIGNALS, **quiet),  # type: ignore[arg-type]
        np.random.default_rng(3),
    )
    epoch = made.epoch(10)
    return epoch, made.broadcast(11.0, {(s.system, s.prn) for s in epoch.signals})


def part(
    e: Ephemeris, name: CorrectionPart, epoch: RawGnssEpoch, age_s: float = 2.0, **changed: object
) -> Correction:
    values = {"orbit": ORBIT, "clock": CLOCK, "fast_clock": (0.25,), "accuracy": (0.4,), "bias": ()}
    made = Correction(
        *("service", 0, e.system, e.prn, name, epoch.week, epoch.tow_s - age_s, INTERVAL_S),
        *((1, 2, 3), issue_of(e) if name == "orbit" else -1, values[name]),
    )
    return replace(made, **changed)  # type: ignore[arg-type]


def bias(e: Ephemeris, epoch: RawGnssEpoch) -> Correction:
    """Biases that stand for the broadcast group delays."""
    names = tuple(name for system, name in SIGNALS if system == e.system)
    delays = [group_delay(e, name) for name in names]
    values = tuple(-SPEED_OF_LIGHT_M_S * d.delay_s for d in delays if d is not None)
    return part(e, "bias", epoch, values=values, signals=names)


def store_of(*messages: Ephemeris | Correction) -> EphemerisStore:
    store = EphemerisStore()
    for message in messages:
        store.add(message)
    return store


def solved(store: EphemerisStore, epoch: RawGnssEpoch) -> SinglePoint:
    found = single_point(RangeModel(store, RangeOptions(systems=("G", "C"))), epoch)
    assert isinstance(found, SinglePoint)
    return found


def test_satellite_is_where_rtklib_puts_it() -> None:
    rtk = pytest.importorskip("pyrtklib", reason="pyrtklib has wheels for x86-64 only")
    epoch, broadcast = sky()
    e = next(e for e in broadcast if e.system == "G")
    nav, eph = rtk.nav_t(), rtk.Arr1Deph_t(1)
    week, toe = gps_time(e.system, e.week, e.toe_s)
    one = eph[0]
    one.sat, one.iode, one.iodc, one.week = rtk.satno(rtk.SYS_GPS, e.prn), e.issue, e.issue, week
    one.toe = one.ttr = rtk.gpst2time(week, toe)
    one.toc, one.toes, one.A = rtk.gpst2time(week, e.toc_s), toe, e.sqrt_a**2
    pairs = {
        "e": "eccentricity", "i0": "inclination", "OMG0": "ascending_node", "omg": "perigee",
        "M0": "mean_anomaly", "deln": "mean_motion_correction", "idot": "inclination_rate",
        "OMGd": "ascending_node_rate", "f0": "clock_bias_s", "f1": "clock_drift",
        "f2": "clock_drift_rate",
    }  # fmt: skip
    for theirs, ours in pairs.items():
        setattr(one, theirs, getattr(e, ours))
    for name in ("cuc", "cus", "crc", "crs", "cic", "cis"):
        setattr(one, name, getattr(e, name))
    nav.eph, nav.n, nav.nmax = eph, 1, 1
    t_s = epoch.tow_s
    ssr = nav.ssr[one.sat - 1]
    for k in range(2):
        ssr.t0[k], ssr.udi[k], ssr.iod[k] = rtk.gpst2time(epoch.week, t_s - 7.0), INTERVAL_S, 3
    for k in range(3):
        ssr.deph[k], ssr.ddeph[k], ssr.dclk[k] = ORBIT[k], ORBIT[3 + k], CLOCK[k]
    ssr.iode, ssr.update = e.issue, 1
    rs, dts, var = rtk.Arr1Ddouble(6), rtk.Arr1Ddouble(2), rtk.Arr1Ddouble(1)
    svh, t = rtk.Arr1Dint(1), rtk.gpst2time(epoch.week, t_s)
    assert rtk.satpos(t, t, one.sat, rtk.EPHOPT_SSRAPC, nav, rs, dts, var, svh) == 1
    columns = (1.0, epoch.week, t_s - 2.0, *ORBIT, epoch.week, t_s - 2.0, *CLOCK)
    ours = Orbits.of([e], [columns]).at(epoch.week, t_s)
    assert ours.position[0] == pytest.approx([rs[k] for k in range(3)], abs=2e-3)
    # It has relativity by position and velocity, which is 4 mm more here.
    assert ours.clock_s[0] == pytest.approx(dts[0], abs=2e-11)
    plain = Orbits.of([e], [NOT_CORRECTED]).at(epoch.week, t_s)
    assert np.linalg.norm(ours.position[0] - plain.position[0]) == pytest.approx(3.0, abs=0.1)


def test_corrected_ranges_are_those_of_the_true_orbits_and_clocks() -> None:
    """Broadcast clocks that are off by 3 to 9 m, and corrections that say so: the place is that of
    clocks that are right."""
    epoch, broadcast = sky()
    right = solved(store_of(*broadcast), epoch)
    off = {e.satellite: 3.0 + (k % 7) for k, e in enumerate(broadcast)}
    wrong = [
        replace(e, clock_bias_s=e.clock_bias_s - off[e.satellite] / SPEED_OF_LIGHT_M_S)
        for e in broadcast
    ]
    bad = solved(store_of(*wrong), epoch)
    assert np.linalg.norm(bad.position - right.position) > 1.0
    given = [
        message
        for e in wrong
        for message in (
            part(e, "orbit", epoch, values=(0.0,) * 6),
            part(e, "clock", epoch, values=(off[e.satellite], 0.0, 0.0)),
            bias(e, epoch),
        )
    ]
    mended = solved(store_of(*wrong, *given), epoch)
    assert mended.rows.satellites == right.rows.satellites
    assert np.linalg.norm(mended.position - right.position) < 0.05  # other weights
    assert (mended.rows.lasting < right.rows.lasting - 0.3).all()  # 0.6 m of orbits are 0.15


def test_an_orbit_moves_its_range_by_its_radial_part() -> None:
    epoch, broadcast = sky()
    guess = solved(store_of(*broadcast), epoch).position
    given = [m for e in broadcast for m in (part(e, "orbit", epoch), bias(e, epoch))]
    clocks = [part(e, "clock", epoch, values=(0.0, 0.0, 0.0)) for e in broadcast]
    ranges = []
    for store in (store_of(*broadcast), store_of(*broadcast, *given, *clocks)):
        rows = RangeModel(store, RangeOptions(systems=("G", "C"))).rows(epoch, guess)
        ranges.append(dict(zip(rows.satellites, rows.range_m, strict=True)))
    # Of a geostationary satellite, which hardly moves, along is no direction to speak of.
    moving = [s for s in ranges[0] if s not in ("C59", "C60", "C61")]
    shorter = np.array([ranges[0][s] - ranges[1][s] for s in moving])
    # Radial 1.5 m nearly along the line of sight, along and across at most a quarter of theirs.
    assert np.abs(shorter - ORBIT[0]).max() < 0.25 * np.hypot(*ORBIT[1:3])


def signals_of(store: EphemerisStore, epoch: RawGnssEpoch) -> tuple[set[str], dict[str, str]]:
    rows = RangeModel(store, RangeOptions(systems=("G", "C"))).rows(epoch, np.zeros(3))
    return set(rows.satellites), dict(rows.refused)


def test_what_does_not_belong_together_is_not_applied() -> None:
    epoch, broadcast = sky()
    e = broadcast[0]
    whole = {name: part(e, name, epoch) for name in ("orbit", "clock")}
    parts = [whole["orbit"], whole["clock"], bias(e, epoch)]
    of = e.system, e.prn, epoch.week, epoch.tow_s
    applied = store_of(e, *parts).corrected(*of)
    assert applied is not None
    assert applied.sigma_m == pytest.approx(0.15, abs=1e-4)
    assert store_of(e, *parts[:2]).corrected(*of) is None
    assert store_of(e, parts[0], parts[2]).corrected(*of) is None
    another = replace(parts[1], solution=(1, 2, 4))
    assert store_of(e, parts[0], another, parts[2]).corrected(*of) is None
    issue = replace(parts[0], issue=parts[0].issue + 1)
    assert store_of(e, issue, *parts[1:]).corrected(*of) is None
    ill = replace(e, healthy=False)
    assert store_of(ill, *parts).corrected(*of) is None
    old = [replace(p, tow_s=epoch.tow_s - 31.0) for p in parts[:2]]
    assert store_of(e, old[0], parts[1], parts[2]).corrected(*of) is None
    assert store_of(e, parts[0], old[1], parts[2]).corrected(*of) is None
    rare = [replace(p, interval_s=60.0) for p in old]
    late = store_of(e, *rare, parts[2]).corrected(*of)
    assert late is not None
    assert late.sigma_m == pytest.approx(np.hypot(0.15, 0.031))
    # An older one that comes late does not stand for the newer.
    kept = Corrections()
    for p in (*parts, *old):
        kept.add(p)
    assert kept.issue(*of) == parts[0].issue


def test_a_fast_clock_and_an_accuracy_belong_to_a_clock() -> None:
    epoch, broadcast = sky()
    e = broadcast[0]
    parts = [part(e, "orbit", epoch), part(e, "clock", epoch), bias(e, epoch)]
    of = e.system, e.prn, epoch.week, epoch.tow_s
    more = store_of(e, *parts, part(e, "fast_clock", epoch), part(e, "accuracy", epoch))
    found = more.corrected(*of)
    assert found is not None
    assert found.columns[-3] == CLOCK[0] + 0.25
    assert found.sigma_m == pytest.approx(0.4, abs=1e-4)
    other = store_of(e, *parts, part(e, "fast_clock", epoch, solution=(1, 2, 9)))
    found = other.corrected(*of)
    assert found is not None
    assert found.columns[-3] == CLOCK[0]


def test_a_system_goes_by_corrections_whole_or_not_at_all() -> None:
    epoch, broadcast = sky()
    gps = [e for e in broadcast if e.system == "G"]
    parts = [
        m for e in gps for m in (part(e, "orbit", epoch), part(e, "clock", epoch), bias(e, epoch))
    ]
    served, refused = signals_of(store_of(*broadcast), epoch)
    assert {e.satellite for e in gps} <= served
    few, _ = signals_of(store_of(*broadcast, *parts[:3]), epoch)
    assert few == served
    most = 3 * (len(gps) - 1)
    served, refused = signals_of(store_of(*broadcast, *parts[:most]), epoch)
    assert refused[gps[-1].satellite] == "no_correction"
    assert {e.satellite for e in gps[:-1]} <= served
    assert any(s.startswith("C") for s in served)
    # A signal that no bias is known of does not serve: the clock is another one to it.
    first = [replace(m, signals=("2L",), values=m.values[-1:]) if m.part == "bias" else m
             for m in parts]  # fmt: skip
    model = RangeModel(store_of(*broadcast, *first), RangeOptions(systems=("G",)))
    assert set(model.rows(epoch, np.zeros(3)).signals) == {"2L"}


def test_signals_of_an_epoch() -> None:
    """The simulated epoch has what the tests above take it to have."""
    epoch, broadcast = sky()
    names = {(s.system, s.signal) for s in epoch.signals if isinstance(s, RawSignal)}
    assert names == set(SIGNALS)
    assert len(broadcast) > 12
