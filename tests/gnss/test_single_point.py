"""Single-point solution, dilution of precision, the best four."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from drivers.raw.messages import SYSTEMS, Ephemeris, Klobuchar, RawGnssEpoch, RawSignal
from fusiond.gnss.best_four_satellites import EXHAUSTIVE_UP_TO, best_four, gdop_squared
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.group_delay import group_delay
from fusiond.gnss.orbit import Orbits
from fusiond.gnss.ranges import RangeModel
from fusiond.gnss.single_point import SinglePoint, dops, single_point
from fusiond.gnss.store import EphemerisStore
from tests.gnss.examples import ephemeris, oracle_pseudorange, signals_epoch, vector
from tests.gnss.examples import rtk as pyrtklib

WEEK, TOE = 2381, 388800.0
TOW = TOE + 777.0
LAT, LON, HEIGHT = 0.5328, 1.9958, 38.0
HERE = np.array(to_ecef(LAT, LON, HEIGHT))
VELOCITY = ned_axes(LAT, LON) @ (12.0, -7.0, 0.5)
DRIFT = 80.0
CLOCK = {"G": 4000.0, "E": 4003.0, "C": 3981.0}
ALPHA = (1.4901e-8, 2.2352e-8, -5.9605e-8, -1.1921e-7)
BETA = (1.1264e5, 1.4746e5, -1.3107e5, -5.8982e5)
SIGNAL = {"G": "1C", "E": "1C", "C": "2I"}


def _sky() -> list[Ephemeris]:
    """All of many satellites that stand higher than 12 degrees over the place."""
    made = [ephemeris("G", n, week=WEEK, toe_s=TOE, seed=3) for n in range(1, 33)]
    made += [ephemeris("E", n, week=WEEK, toe_s=TOE, seed=3) for n in range(1, 31)]
    made += [ephemeris("C", n, week=WEEK - 1356, toe_s=TOE, seed=3) for n in range(19, 45)]
    away = Orbits.of(made).at(WEEK, TOW).position - HERE
    up = away @ ned_axes(LAT, LON)[:, 2] / -np.linalg.norm(away, axis=1)
    return [e for e, u in zip(made, up, strict=True) if u > math.sin(math.radians(12.0))]


SKY = _sky()


def _pseudorange(e: Ephemeris, after_s: float, iono: bool = True) -> float:
    delay = group_delay(e, SIGNAL[e.system])
    assert delay is not None
    return oracle_pseudorange(
        e,
        WEEK,
        TOW + after_s,
        HERE + VELOCITY * after_s,
        SIGNAL[e.system],
        delay.delay_s,
        CLOCK[e.system] + DRIFT * after_s,
        (*ALPHA, *BETA) if iono else (),
    )


def _epoch(satellites: list[Ephemeris]) -> RawGnssEpoch:
    """Measurements by RTKLIB's models, at the time that GPS's clock offset shows."""
    signals = []
    for e in satellites:
        rate = (_pseudorange(e, 0.5, False) - _pseudorange(e, -0.5, False)) / 1.0
        # the receiver has one clock; what differs between systems is delay in its channels
        signals.append(
            RawSignal(e.system, e.prn, SIGNAL[e.system], _pseudorange(e, 0.0), rate, None, 45.0)
        )
    return signals_epoch(WEEK, TOW + CLOCK["G"] / 299_792_458.0, signals)


EPOCH = _epoch(SKY)


def _model() -> RangeModel:
    store = EphemerisStore()
    for message in [*SKY, Klobuchar("made", 0, "G", ALPHA, BETA)]:
        store.add(message)
    return RangeModel(store)


def _solve(epoch: RawGnssEpoch, guess: np.ndarray | None = None) -> SinglePoint:
    found = single_point(_model(), epoch, guess)
    assert not isinstance(found, str), found
    return found


@pytest.mark.parametrize("guess", [None, HERE + 3e5, HERE + 10.0])
def test_position_velocity_and_clocks_from_rtklibs_ranges(guess: np.ndarray | None) -> None:
    found = _solve(EPOCH, guess)
    assert len(found.rows.satellites) == len(SKY) > 15
    assert np.linalg.norm(found.position - HERE) < 0.05
    for system, clock in CLOCK.items():
        assert found.clock_m[system] == pytest.approx(clock, abs=0.05)
    assert found.velocity is not None
    assert np.linalg.norm(found.velocity - VELOCITY) < 2e-3
    assert found.drift_m_s == pytest.approx(DRIFT, abs=2e-3)
    assert found.consistent
    assert found.redundancy == len(SKY) - 6


def test_four_satellites_of_one_system_and_no_fewer() -> None:
    gps = [e for e in SKY if e.system == "G"]
    found = _solve(_epoch(gps[:4]))
    assert np.linalg.norm(found.position - HERE) < 1.0
    assert found.redundancy == 0
    assert found.consistent
    assert single_point(_model(), _epoch(gps[:3])) == "too_few"
    others = [e for e in SKY if e.system == "C"]
    assert single_point(_model(), _epoch([*gps[:3], others[0]])) == "too_few"  # two clocks
    assert single_point(_model(), _epoch([])) == "too_few"


@pytest.mark.parametrize("error_m", [-60.0, 60.0, 400.0])
def test_the_bad_one_is_found_and_left_out(error_m: float) -> None:
    for k in (0, len(SKY) // 2, len(SKY) - 1):
        signals = list(EPOCH.signals)
        signals[k] = replace(signals[k], pseudorange_m=signals[k].pseudorange_m + error_m)
        found = _solve(replace(EPOCH, signals=tuple(signals)))
        assert (signals[k].satellite, "residual") in found.refused
        assert len([r for r in found.refused if r[1] == "residual"]) == 1
        assert np.linalg.norm(found.position - HERE) < 0.5


def test_covariance_is_what_noise_does() -> None:
    """500 epochs with noise as stated: NEES of position within its 99.9 % interval."""
    rng = np.random.default_rng(5)
    model = _model()
    rows = model.rows(EPOCH, HERE)
    nees = []
    for _ in range(500):
        error = np.sqrt(rows.variance) * rng.standard_normal(len(rows.satellites))
        error += rows.ionosphere_sigma_m * rng.standard_normal()
        signals = [
            replace(s, pseudorange_m=s.pseudorange_m + e)
            for s, e in zip(EPOCH.signals, error, strict=True)
        ]
        found = single_point(model, replace(EPOCH, signals=tuple(signals)), HERE)
        assert not isinstance(found, str)
        d = found.position - HERE
        nees.append(d @ np.linalg.solve(found.covariance, d))
    # chi^2 with 1500 degrees of freedom over 500: 3 +- 3.29 sqrt(6 / 500)
    assert abs(np.mean(nees) - 3.0) < 3.29 * math.sqrt(6.0 / 500.0)


def test_velocity_covariance_is_what_noise_does() -> None:
    """500 epochs with noise of the rates as stated: NEES of velocity within its 99.9 % interval."""
    rng = np.random.default_rng(6)
    model = _model()
    quiet = single_point(model, EPOCH, HERE)
    assert not isinstance(quiet, str)
    sd = dict(zip(quiet.rows.satellites, np.sqrt(quiet.rows.rate_variance), strict=True))
    nees = []
    for _ in range(500):
        signals = []
        for s in EPOCH.signals:
            assert s.range_rate_m_s is not None
            error = sd[s.satellite] * rng.standard_normal()
            signals.append(replace(s, range_rate_m_s=s.range_rate_m_s + error))
        found = single_point(model, replace(EPOCH, signals=tuple(signals)), HERE)
        assert not isinstance(found, str)
        assert found.velocity is not None
        assert found.velocity_covariance is not None
        d = found.velocity - quiet.velocity
        nees.append(d @ np.linalg.solve(found.velocity_covariance, d))
    assert abs(np.mean(nees) - 3.0) < 3.29 * math.sqrt(6.0 / 500.0)


def test_dops_of_one_system_are_those_of_rtklib() -> None:
    rows = _model().rows(EPOCH, HERE)
    gps = rows.system == SYSTEMS.index("G")
    ours = dops(rows.line_of_sight[gps], rows.system[gps], HERE)
    assert ours is not None
    azel = np.column_stack([rows.azimuth_rad[gps], rows.elevation_rad[gps]]).ravel()
    out = vector(0, 0, 0, 0)
    pyrtklib.dops(int(gps.sum()), vector(*azel), 0.0, out)
    theirs = [out[i] for i in range(4)]
    assert [ours.gdop, ours.pdop, ours.hdop, ours.vdop] == pytest.approx(theirs, rel=1e-6)
    assert ours.gdop**2 == pytest.approx(ours.pdop**2 + ours.tdop**2)
    assert ours.pdop**2 == pytest.approx(ours.hdop**2 + ours.vdop**2)


def test_dops_with_three_clocks_are_the_spread_of_the_solution() -> None:
    """Scatter of plain least squares with unit noise, taken with the same lines of sight."""
    rows = _model().rows(EPOCH, HERE)
    ours = dops(rows.line_of_sight, rows.system, HERE)
    assert ours is not None
    clocks = [(rows.system == s).astype(float) for s in sorted(set(rows.system))]
    h = np.column_stack([-rows.line_of_sight @ ned_axes(LAT, LON), *clocks])
    noise = np.random.default_rng(2).standard_normal((len(h), 20000))
    x = np.linalg.lstsq(h, noise, rcond=None)[0]
    assert ours.hdop == pytest.approx(math.sqrt((x[:2] ** 2).sum(0).mean()), rel=0.02)
    assert ours.vdop == pytest.approx(x[2].std(), rel=0.02)
    assert ours.tdop == pytest.approx(math.sqrt((x[3:] ** 2).sum(0).mean()), rel=0.02)
    assert ours.gdop == pytest.approx(math.sqrt((x**2).sum(0).mean()), rel=0.02)
    few = rows.system == rows.system[0]
    assert dops(rows.line_of_sight[few][:3], rows.system[few][:3], HERE) is None


def _random_sky(rng: np.random.Generator, n: int) -> np.ndarray:
    up = rng.uniform(0.17, 1.0, n)
    level, azimuth = np.sqrt(1 - up * up), rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), up])


@pytest.mark.parametrize("n", [4, 8, EXHAUSTIVE_UP_TO, EXHAUSTIVE_UP_TO + 1, 22])
def test_best_four_against_every_four(n: int) -> None:
    rng = np.random.default_rng(n)
    sets = np.array(list(combinations(range(n), 4)))
    ratios = []
    for _ in range(15):
        sky = _random_sky(rng, n)
        found = best_four(sky)
        assert found is not None
        members, gdop = found
        assert len(set(members.tolist())) == 4
        h = np.column_stack([-sky[members], np.ones(4)])
        assert gdop == pytest.approx(math.sqrt(np.trace(np.linalg.inv(h.T @ h))), rel=1e-9)
        ratios.append(gdop / math.sqrt(gdop_squared(sky, sets).min()))
    exhaustive = n <= EXHAUSTIVE_UP_TO
    assert max(ratios) < (1.0 + 1e-9 if exhaustive else 1.07)
    assert np.median(ratios) < 1.0 + 1e-9


def test_best_four_of_what_has_no_geometry() -> None:
    sky = _random_sky(np.random.default_rng(0), 3)
    assert best_four(sky) is None
    assert best_four(np.repeat(sky, 2, axis=0)[:5]) is None
    assert best_four(np.repeat(sky, 8, axis=0)) is None
