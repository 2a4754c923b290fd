"""What fixes and velocities of one receiver show of an error that lasts for seconds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.wander import ASSUMED, LAG_S, LASTS_S, Fix, Wander
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.simulation.markov import gauss_markov

Array = NDArray[np.float64]

LAT, LON = 0.53, 3.1415
STATED_M, VELOCITY_SD_M_S, OFFSET_SD_S = 4.0, 0.05, 0.14
NORTH_M, EAST_M = meridian_radius(LAT), transverse_radius(LAT) * math.cos(LAT)


def _driven(t_s: Array) -> tuple[Array, Array]:
    """Way (n, 2) and velocity (n, 2) of a vehicle that speeds up, turns and crosses 180 deg."""
    speed, rate = 12.0 + 8.0 * np.sin(t_s / 9.0), 0.05
    v = np.column_stack((speed * np.cos(rate * t_s), speed * np.sin(rate * t_s)))
    step = np.diff(t_s, prepend=t_s[0])[:, None]
    between = np.vstack((v[:1], 0.5 * (v[1:] + v[:-1])))
    return np.cumsum(between * step, axis=0), v


def _shown(
    seed: int,
    error_m: float,
    lasts_s: float = LASTS_S,
    rate_hz: float = 5.0,
    seconds: float = 600.0,
    noise_m: float = 0.6,
    late_s: float = 0.0,
) -> Wander:
    """What fixes with such an error have shown, their velocities valid `late_s` later than they."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    way, v = _driven(t_s)
    n = len(t_s)
    e = gauss_markov(rng, (n, 2), step_s=1.0 / rate_hz, correlation_s=lasts_s, sigma=error_m)
    fixes = way + e + rng.standard_normal((n, 2)) * noise_m
    v = np.column_stack([np.interp(t_s + late_s, t_s, v[:, axis]) for axis in range(2)])
    v = v + rng.standard_normal((n, 2)) * VELOCITY_SD_M_S
    wander = Wander(OFFSET_SD_S)
    for k in range(n):
        lat, lon = LAT + fixes[k, 0] / NORTH_M, LON + fixes[k, 1] / EAST_M
        lon -= 2.0 * math.pi if lon > math.pi else 0.0
        north, east = v[k].tolist()
        wander.take(Fix(round(t_s[k] * 1e9), lat, lon, (north, east), VELOCITY_SD_M_S))
    return wander


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("late_s", [0.0, 0.15])
def test_the_size_of_an_error_that_lasts_as_the_state_does(rate_hz: float, late_s: float) -> None:
    """Noise, the velocities' own and an offset in time between both neither add to it nor take
    from it. Sixteen drives of twenty minutes know their mean to a twentieth."""
    how = {"rate_hz": rate_hz, "late_s": late_s, "seconds": 1200.0}
    found = [_shown(seed, 2.0, **how).sd_m(STATED_M) for seed in range(16)]
    mean = math.sqrt(float(np.mean(np.square(found))))
    print(f"{mean:.2f} of 2 m")
    assert mean == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("lasts_s", [10.0, 60.0])
def test_of_errors_of_other_lengths_what_is_right_over_a_lag(lasts_s: float) -> None:
    within = (1.0 - math.exp(-LAG_S / lasts_s)) / (1.0 - math.exp(-LAG_S / LASTS_S))
    how = {"lasts_s": lasts_s, "seconds": 1200.0}
    found = [_shown(seed, 2.0, **how).sd_m(STATED_M) for seed in range(16)]
    mean = math.sqrt(float(np.mean(np.square(found))))
    print(f"{mean:.2f}, {2.0 * math.sqrt(within):.2f} m")
    assert mean == pytest.approx(2.0 * math.sqrt(within), rel=0.15)


@pytest.mark.parametrize(("error_m", "lasts_s"), [(0.0, 30.0), (1.0, 1800.0)])
def test_noise_and_what_lasts_for_half_an_hour_are_none(error_m: float, lasts_s: float) -> None:
    found = [_shown(seed, error_m, lasts_s).sd_m(1.5) for seed in range(8)]
    print(found)
    assert max(found) < 0.5


def test_before_anything_is_shown_half_of_what_is_stated() -> None:
    assert Wander(OFFSET_SD_S).sd_m(2.0) == 0.0  # no velocity, nothing to compare with
    for shown in (_shown(0, 2.0, seconds=10.0), _shown(0, 2.0, rate_hz=0.3)):
        assert shown.sd_m(2.0) == pytest.approx(2.0 * math.sqrt(ASSUMED))


def test_no_more_than_is_stated() -> None:
    assert _shown(0, 6.0, seconds=300.0).sd_m(2.0) == 2.0


def test_a_fix_that_comes_twice_begins_the_way_anew() -> None:
    twice = Wander(OFFSET_SD_S)
    for t_ns in (0, 1_000_000_000, 1_000_000_000):
        twice.take(Fix(t_ns, LAT, LON, (1.0, 0.0), VELOCITY_SD_M_S))
    assert twice.sd_m(2.0) == pytest.approx(2.0 * math.sqrt(ASSUMED))
