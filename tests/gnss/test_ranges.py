"""Range model against RTKLIB's parts to 1 cm; store, group delays, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    Klobuchar,
    RawSignal,
)
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from fusiond.gnss.group_delay import GPS_L5_SIGMA_M, group_delay
from fusiond.gnss.orbit import CONSTANTS
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.store import EphemerisStore
from tests.gnss.examples import (
    ephemeris,
    examples,
    oracle_pseudorange,
    oracle_state,
    signals_epoch,
)

WEEK, TOE = 2381, 388800.0
ALPHA = (1.4901e-8, 2.2352e-8, -5.9605e-8, -1.1921e-7)
BETA = (1.1264e5, 1.4746e5, -1.3107e5, -5.8982e5)
GPS_IONO = Klobuchar("made", 0, "G", ALPHA, BETA)
FREE = RangeOptions(elevation_mask_rad=0.0, cno_mask_db_hz=0.0)
SIGNAL = {"G": "1C", "E": "1C", "C": "2I"}


def _store(made: list[Ephemeris], *more: Klobuchar) -> EphemerisStore:
    store = EphemerisStore()
    for message in [*made, *more]:
        store.add(message)
    return store


def _under(e: Ephemeris, tow_s: float, away_rad: float) -> np.ndarray:
    """A receiver some angle away from below the satellite."""
    lat, lon, _ = to_geodetic(*oracle_state(e, WEEK, tow_s)[0])
    north = away_rad if lat < 0 else -away_rad
    return np.array(to_ecef(lat + north, lon + 0.1, 432.0))


@pytest.mark.parametrize("signal_of", [SIGNAL, {"G": "2W", "E": "7Q", "C": "6I"}])
@pytest.mark.parametrize("away", [0.1, 0.7, 1.05])
def test_pseudorange_model_is_that_of_rtklib(signal_of: dict[str, str], away: float) -> None:
    """Geometry, clock, group delay, troposphere and ionosphere put together from RTKLIB's."""
    made = examples(WEEK, TOE)[:-2]  # each satellite once
    tow, clock_m = TOE + 900.0, 12345.0
    model = RangeModel(_store(made, GPS_IONO), FREE)
    for e in made:
        at = _under(e, tow, away)
        name = signal_of[e.system]
        delay = group_delay(e, name)
        assert delay is not None
        p = oracle_pseudorange(e, WEEK, tow, at, name, delay.delay_s, clock_m, (*ALPHA, *BETA))
        shown = tow + clock_m / SPEED_OF_LIGHT_M_S
        rows = model.rows(signals_epoch(WEEK, shown, [RawSignal(e.system, e.prn, name, p)]), at)
        assert rows.satellites == (e.satellite,)
        assert rows.elevation_rad[0] < 1.5 - 0.8 * away
        assert rows.troposphere_m[0] > 2.0
        assert rows.ionosphere_m[0] > 1.0
        assert abs(rows.pseudorange_m[0] - rows.range_m[0] - clock_m) < 0.01, e.satellite


def test_rate_is_the_derivative_of_the_pseudorange() -> None:
    """RTKLIB's ranges in vacuo, differenced: a moving receiver, a drifting clock."""
    made = examples(WEEK, TOE)[:-2]
    tow, drift = TOE + 900.0, 55.0
    model = RangeModel(_store(made), FREE)
    for e in made:
        at = _under(e, tow, 0.6)
        v = np.array([20.0, -11.0, 7.0])
        p = [
            oracle_pseudorange(e, WEEK, tow + s, at + v * s, "1C", 0.0, drift * s)
            for s in (-1.0, 1.0)
        ]
        here = oracle_pseudorange(e, WEEK, tow, at, "1C", 0.0, 0.0)
        signal = RawSignal(e.system, e.prn, SIGNAL[e.system], here, (p[1] - p[0]) / 2.0)
        rows = model.rows(signals_epoch(WEEK, tow, [signal]), at)
        expected = rows.line_of_sight[0] @ (rows.velocity[0] - v) + drift
        assert rows.rate_m_s[0] == pytest.approx(expected, abs=2e-4)


def test_line_of_sight_elevation_and_azimuth() -> None:
    e = examples(WEEK, TOE)[0]
    at = _under(e, TOE, 0.5)
    p = oracle_pseudorange(e, WEEK, TOE, at, "1C", 0.0, 0.0)
    rows = RangeModel(_store([e]), FREE).rows(
        signals_epoch(WEEK, TOE, [RawSignal("G", e.prn, "1C", p)]), at
    )
    lat, lon, _ = to_geodetic(*at)
    ned = ned_axes(lat, lon).T @ (rows.position[0] - at)
    assert rows.range_m[0] == pytest.approx(np.linalg.norm(ned), abs=1e-6)
    assert rows.elevation_rad[0] == pytest.approx(math.asin(-ned[2] / rows.range_m[0]), abs=1e-12)
    assert rows.azimuth_rad[0] == pytest.approx(math.atan2(ned[1], ned[0]) % (2 * math.pi))
    assert np.linalg.norm(rows.line_of_sight[0]) == pytest.approx(1.0)


def test_variance_grows_towards_the_horizon_and_with_weakness() -> None:
    e = examples(WEEK, TOE)[0]

    def row(away: float, cno: float | None, sd: float | None = None) -> tuple[float, float]:
        at = _under(e, TOE, away)
        p = oracle_pseudorange(e, WEEK, TOE, at, "1C", 0.0, 0.0)
        signal = RawSignal("G", e.prn, "1C", p, 1.0, None, cno, sd, sd)
        rows = RangeModel(_store([e], GPS_IONO), FREE).rows(signals_epoch(WEEK, TOE, [signal]), at)
        return float(rows.variance[0]), float(rows.ionosphere_sigma_m[0])

    assert row(1.0, 45.0)[0] > row(0.5, 45.0)[0] > row(0.1, 45.0)[0]
    assert row(0.5, 30.0)[0] > row(0.5, 45.0)[0] > row(0.5, None)[0]
    assert row(0.5, 45.0, 2.0)[0] - row(0.5, 45.0)[0] == pytest.approx(4.0)
    assert row(1.0, 45.0)[1] > row(0.1, 45.0)[1] > 0.5


def test_masks_and_missing_ephemerides_are_refused_by_name() -> None:
    e = examples(WEEK, TOE)
    sick = replace(e[1], healthy=False)
    c = e[5]
    at = _under(e[0], TOE, 0.3)
    p = oracle_pseudorange(e[0], WEEK, TOE, at, "1C", 0.0, 0.0)
    signals = [
        RawSignal("G", e[0].prn, "1C", p, cno_db_hz=20.0),
        RawSignal("G", sick.prn, "1C", 2.2e7),
        RawSignal("G", 7, "1C", 2.2e7),
        RawSignal("C", c.prn, "1P", 2.2e7),
        RawSignal("C", c.prn, "5P", 2.2e7),
    ]
    epoch = signals_epoch(WEEK, TOE, signals)
    model = RangeModel(_store([e[0], sick, c]))
    assert set(model.rows(epoch, at).refused) == {
        (e[0].satellite, "weak_signal"),
        (sick.satellite, "unhealthy"),
        ("G07", "no_ephemeris"),
        (c.satellite, "no_group_delay"),
    }
    late = signals_epoch(WEEK, TOE + 7300.0, signals[:1])
    assert model.rows(late, at).refused == ((e[0].satellite, "stale_ephemeris"),)
    strong = signals_epoch(WEEK, TOE, [replace(signals[0], cno_db_hz=40.0)])
    assert model.rows(strong, -at).refused == ((e[0].satellite, "low_elevation"),)
    assert model.rows(strong, at).satellites == (e[0].satellite,)
    # what was refused for want of an ephemeris serves as soon as one is there
    model.store.add(replace(e[0], prn=7))
    assert ("G07", "no_ephemeris") not in model.rows(epoch, at).refused


def test_preferred_signal_serves_and_the_next_if_it_is_absent() -> None:
    c = examples(WEEK, TOE)[5]
    at = _under(c, TOE, 0.3)
    p = oracle_pseudorange(c, WEEK, TOE, at, "2I", 0.0, 0.0)
    both = [RawSignal("C", c.prn, "6I", p), RawSignal("C", c.prn, "2I", p)]
    model = RangeModel(_store([c]), FREE)
    assert model.rows(signals_epoch(WEEK, TOE, both), at).signals == ("2I",)
    rows = model.rows(signals_epoch(WEEK, TOE, both[:1]), at)
    assert (rows.signals, rows.measured_at.tolist()) == (("6I",), [0])
    none = RangeModel(_store([c]), replace(FREE, systems=("G",))).rows(
        signals_epoch(WEEK, TOE, both), at
    )
    assert none.satellites == ()
    assert none.position.shape == (0, 3)


def test_store_keeps_both_issues_over_a_changeover() -> None:
    old = ephemeris("G", 3, week=WEEK, toe_s=7200.0)
    motion = math.sqrt(CONSTANTS["G"].gm) / old.sqrt_a**3 + old.mean_motion_correction
    new = replace(
        old,
        toe_s=14400.0,
        toc_s=14400.0,
        issue=8,
        mean_anomaly=old.mean_anomaly + 7200.0 * motion,
        ascending_node=old.ascending_node + 7200.0 * old.ascending_node_rate,
    )
    store = _store([old, new])
    assert store.select("G", 3, WEEK, 10000.0) is old
    assert store.select("G", 3, WEEK, 11000.0) is new
    assert store.select("G", 3, WEEK, 0.0) is old
    assert store.select("G", 3, WEEK, -1.0) == "stale_ephemeris"
    assert store.select("G", 3, WEEK, 21601.0) == "stale_ephemeris"
    assert store.select("G", 4, WEEK, 0.0) == "no_ephemeris"
    version = store.version
    store.add(replace(new, t_seen_ns=5))
    assert store.version == version
    store.add(replace(new, healthy=False, issue=9))
    assert store.select("G", 3, WEEK, 7200.0) == "unhealthy"
    assert len(store) == 1


def test_beidou_ages_in_its_own_time_and_galileo_for_four_hours() -> None:
    c = ephemeris("C", 21, week=WEEK - 1356, toe_s=3600.0)
    e = ephemeris("E", 5, week=WEEK, toe_s=3600.0)
    f = replace(e, message="fnav", issue=3)
    store = _store([c, e, f])
    assert store.select("C", 21, WEEK, 3600.0 + 7214.0) is c
    assert store.select("C", 21, WEEK, 3600.0 + 7214.1) == "stale_ephemeris"
    assert store.select("E", 5, WEEK, 18000.0, "1") is e
    assert store.select("E", 5, WEEK, 18000.0, "5") is f
    assert store.select("E", 5, WEEK, 18000.1) == "stale_ephemeris"


def test_group_delays() -> None:
    """Ionosphere-free pairs of GPS L1/L2 and Galileo E1/E5b need no delay: that is the clock's."""
    g = ephemeris("G", 3, week=WEEK, toe_s=0.0)
    e = ephemeris("E", 3, week=WEEK, toe_s=0.0)
    f = replace(e, message="fnav")
    c = ephemeris("C", 30, week=WEEK - 1356, toe_s=0.0)

    def free(message: Ephemeris, a: str, b: str) -> float:
        gamma = (CARRIER_HZ[message.system, a[0]] / CARRIER_HZ[message.system, b[0]]) ** 2
        first, second = group_delay(message, a), group_delay(message, b)
        assert first is not None and second is not None  # noqa: PT018
        return (gamma * first.delay_s - second.delay_s) / (gamma - 1.0)

    assert free(g, "1C", "2W") == pytest.approx(0.0, abs=1e-20)
    assert free(e, "1C", "7Q") == pytest.approx(0.0, abs=1e-20)
    assert free(f, "1C", "5Q") == pytest.approx(0.0, abs=1e-20)
    # E5a by the I/NAV clock: off by what the two clocks differ
    assert free(e, "1C", "5Q") == pytest.approx(e.group_delay_s[1] - e.group_delay_s[0], abs=1e-20)
    assert group_delay(g, "5Q") == (g.group_delay_s[0], GPS_L5_SIGMA_M)
    assert group_delay(c, "6I") == (0.0, 0.0)
    assert group_delay(c, "2I") == (c.group_delay_s[0], 0.0)
    assert group_delay(c, "7I") == (c.group_delay_s[1], 0.0)
    for message, name in ((c, "1P"), (c, "5P"), (c, "7P"), (e, "6B"), (e, "8Q"), (f, "7Q")):
        assert group_delay(message, name) is None
    one = replace(c, message="bcnav1", group_delay_s=(4e-9, -9e-9, 8e-10))
    two = replace(one, message="bcnav2")
    shares = {"1P": 4e-9, "1D": 4.8e-9, "1X": 4.2e-9, "5P": -9e-9, "6I": 0.0}
    for name, delay in shares.items():
        assert group_delay(one, name) == pytest.approx((delay, 0.0))
    for name, delay in {"1P": 4e-9, "5P": -9e-9, "5D": -8.2e-9, "5X": -8.6e-9}.items():
        assert group_delay(two, name) == pytest.approx((delay, 0.0))
    for message, name in ((one, "5D"), (one, "5X"), (two, "1D"), (one, "2I"), (two, "7I")):
        assert group_delay(message, name) is None


def test_ionosphere_of_the_own_system_is_preferred() -> None:
    c, g = examples(WEEK, TOE)[5], examples(WEEK, TOE)[0]
    strong = Klobuchar("made", 0, "C", (1e-7, 0.0, 0.0, 0.0), (172800.0, 0.0, 0.0, 0.0))
    delays = {}
    for name, models in (
        ("G", (GPS_IONO,)),
        ("C", (strong,)),
        ("GC", (GPS_IONO, strong)),
        ("", ()),
    ):
        for e, signal in ((g, "1C"), (c, "2I")):
            at = _under(e, TOE, 0.4)
            epoch = signals_epoch(WEEK, TOE, [RawSignal(e.system, e.prn, signal, 2.3e7)])
            rows = RangeModel(_store([g, c], *models), FREE).rows(epoch, at)
            delays[name, e.system] = (
                float(rows.ionosphere_m[0]),
                float(rows.ionosphere_sigma_m[0]),
            )
    assert delays["GC", "G"] == delays["G", "G"]
    assert delays["GC", "C"] == delays["C", "C"] != delays["G", "C"]
    assert delays["C", "G"][0] > 0
    assert delays["", "G"][0] == 0.0
    assert delays["", "G"][1] > 5.0


def test_an_epoch_without_signals() -> None:
    rows = RangeModel(_store([])).rows(signals_epoch(WEEK, TOE, []), np.zeros(3))
    assert rows.satellites == ()
    assert rows.refused == ()
