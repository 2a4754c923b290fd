"""What fixes and velocities of one receiver show of an error that lasts for seconds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.fix_error_correlation import (
    LAG_S,
    LASTS_S,
    SETTLES_NS,
    Fix,
    FixErrors,
    Shares,
    share_of,
)
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


def _receiver(
    seed: int,
    error_m: float,
    lasts_s: float = LASTS_S,
    rate_hz: float = 5.0,
    seconds: float = 600.0,
    noise_m: float = 0.6,
    late_s: float = 0.0,
    velocity_sd_m_s: float = VELOCITY_SD_M_S,
    wanders: bool = True,
) -> FixErrors:
    """One whose fixes have such an error, of which they state all; their velocities are valid
    `late_s` later than they."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    way, v = _driven(t_s)
    n = len(t_s)
    e = gauss_markov(rng, (n, 2), step_s=1.0 / rate_hz, correlation_s=lasts_s, sigma=error_m)
    fixes = way + e + rng.standard_normal((n, 2)) * noise_m
    v = np.column_stack([np.interp(t_s + late_s, t_s, v[:, axis]) for axis in range(2)])
    v = v + rng.standard_normal((n, 2)) * velocity_sd_m_s
    shown, variance = FixErrors(OFFSET_SD_S, wanders), error_m**2 + noise_m**2
    for k in range(n):
        lat, lon = LAT + fixes[k, 0] / NORTH_M, LON + fixes[k, 1] / EAST_M
        lon -= 2.0 * math.pi if lon > math.pi else 0.0
        north, east = v[k].tolist()
        t_ns = round(t_s[k] * 1e9)
        shown.waiting.append(Fix(t_ns, lat, lon, variance, (north, east), velocity_sd_m_s))
    shown.shares(round(t_s[-1] * 1e9) + SETTLES_NS)
    return shown


def _shown(seed: int, *what: float, **how: Any) -> Shares:
    """What its fixes have shown."""
    return _receiver(seed, *what, **how).shares(1 << 60)


def _mean(drives: int, *what: float, **how: float) -> Array:
    """Shares (3,) of some drives."""
    found = np.array([_shown(seed, *what, **how) for seed in range(drives)])
    print(found.mean(axis=0).round(3), found.std(axis=0).round(3))
    assert np.allclose(found.sum(axis=1), 1.0, atol=0.011)
    return np.asarray(found.mean(axis=0))


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("late_s", [0.0, 0.15])
def test_the_size_of_an_error_that_lasts_as_the_state_does(rate_hz: float, late_s: float) -> None:
    """Noise, the velocities' own and an offset in time between both neither add to it nor take
    from it."""
    how = {"rate_hz": rate_hz, "late_s": late_s, "seconds": 1200.0}
    white, wanders, lasts = _mean(16, 2.0, **how)
    assert white == pytest.approx(0.36 / 4.36, abs=0.03)
    assert wanders > 0.65  # the rest is not told from what lasts longer
    assert wanders + lasts == pytest.approx(4.0 / 4.36, abs=0.03)


@pytest.mark.parametrize("lasts_s", [10.0, 60.0])
def test_of_errors_of_other_lengths_what_is_right_over_a_lag(lasts_s: float) -> None:
    """The rest of what lasts longer lasts for good; no share is more than one."""
    within = (1.0 - math.exp(-LAG_S / lasts_s)) / (1.0 - math.exp(-LAG_S / LASTS_S))
    _, wanders, lasts = _mean(16, 2.0, lasts_s=lasts_s, seconds=1200.0)
    expected = min(within * 4.0 / 4.36, 0.9)
    assert wanders == pytest.approx(expected, abs=0.15)
    assert lasts + wanders > 0.75


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_white_errors_are_soon_told(rate_hz: float) -> None:
    """A minute leaves a quarter of the sigma to what lasts at 1 Hz; five minutes a sixth."""
    for seconds, most in ((60.0, 0.25), (300.0, 0.15)):
        white, wanders, lasts = _mean(16, 0.0, rate_hz=rate_hz, seconds=seconds, noise_m=1.5)
        assert wanders + lasts < most * most * (1.0 if rate_hz > 5.0 else 4.0), seconds
        assert white > 0.7


def test_what_lasts_for_half_an_hour_is_neither_white_nor_over_soon() -> None:
    white, wanders, lasts = _mean(8, 1.0, 1800.0, noise_m=0.6)
    assert white == pytest.approx(0.36 / 1.36, abs=0.05)
    assert wanders < 0.1
    assert lasts == pytest.approx(1.0 / 1.36, abs=0.1)


def test_what_velocities_do_not_resolve_is_not_told() -> None:
    """Fixes of centimetres a second apart, velocities of decimetres: as before anything came."""
    how = {"noise_m": 0.014, "wanders": False}
    coarse = _shown(0, 0.014, rate_hz=1.0, velocity_sd_m_s=0.1, **how)
    assert coarse.lasts == pytest.approx(0.25, abs=0.03)
    fine = _shown(0, 0.014, rate_hz=10.0, lasts_s=1800.0, velocity_sd_m_s=0.02, **how)
    assert fine.lasts == pytest.approx(0.5, abs=0.06)


def test_before_anything_is_shown_most_is_shared() -> None:
    for white, wanders, lasts in (FixErrors(OFFSET_SD_S).shares(0), _shown(0, 2.0, rate_hz=0.3)):
        assert white == pytest.approx(0.25)
        assert wanders == lasts == pytest.approx(0.375)


def _fixes(count: int) -> list[Fix]:
    """One a second, on the spot, alike to a metre."""
    rng = np.random.default_rng(7)
    places = LAT + rng.standard_normal(count) / NORTH_M
    v = 0.1 * rng.standard_normal((count, 2))
    return [
        Fix(k * 1_000_000_000, lat, LON, 4.0, (north, east), VELOCITY_SD_M_S)
        for k, (lat, (north, east)) in enumerate(zip(places.tolist(), v.tolist(), strict=True))
    ]


def test_the_order_in_which_fixes_come_leaves_no_trace() -> None:
    """Each counts by those of ten seconds before it, whatever has come since."""
    fixes, found = _fixes(60), []
    for late in (lambda k: 0, lambda k: 8 * (k % 3 == 0), lambda k: 5 * (k % 2)):
        errors, shares = FixErrors(OFFSET_SD_S), {}
        for k, fix in sorted(enumerate(fixes), key=lambda one: (one[0] + late(one[0]), one[0])):
            errors.waiting.append(fix)
            shares[k] = errors.shares(fix.t_ns)
        found.append([shares[k] for k in range(len(fixes))])
    assert found[0] == found[1] == found[2]
    assert len(set(found[0])) > 45


def test_a_fix_that_comes_twice_or_far_too_late_tells_nothing() -> None:
    fixes = _fixes(30)
    end_ns = 29_000_000_000 + SETTLES_NS
    once, again = FixErrors(OFFSET_SD_S), FixErrors(OFFSET_SD_S)
    for fix in fixes:
        once.waiting.append(fix)
    for fix in (*fixes[:5], fixes[4], *fixes[5:]):
        again.waiting.append(fix)
    assert once.shares(end_ns) == again.shares(end_ns)
    again.waiting.append(fixes[3])
    assert once.shares(end_ns) == again.shares(end_ns)


@pytest.mark.parametrize("sigma", [1e-3, 0.05, 0.3, 10.0])
@pytest.mark.parametrize("x", [-5.0, -0.1, 0.0, 0.03, 0.5, 0.99, 1.3, 4.0])
def test_a_share_is_its_mean_by_likelihood(x: float, sigma: float) -> None:
    """By sums over a fine grid."""
    y = np.linspace(0.0, 1.0, 20001)
    near = min(max(x, -4.0 * sigma), 1.0 + 4.0 * sigma)
    likelihood = np.exp(-0.5 * ((near - y) / sigma) ** 2)
    some = np.trapezoid(likelihood, y) if hasattr(np, "trapezoid") else np.trapz(likelihood, y)
    first = likelihood * y
    mean = np.trapezoid(first, y) if hasattr(np, "trapezoid") else np.trapz(first, y)
    expected = mean / (math.exp(-0.5 * (near / sigma) ** 2) + some)
    assert share_of(x, sigma) == pytest.approx(float(expected), abs=2e-3)


@pytest.mark.parametrize("error_m", [0.0, 2.0])
def test_the_next_start_begins_with_what_was_shown(error_m: float) -> None:
    """A fifth of ten minutes; what comes then outweighs it in some."""
    known = _receiver(0, error_m)
    shown = tuple(0.2 * x for x in known.shown)
    at_first, carried = FixErrors(OFFSET_SD_S), FixErrors(OFFSET_SD_S)
    carried.take_up(shown)
    found, before, now = known.shares(1 << 60), at_first.shares(0), carried.shares(0)
    print(found, before, now)
    assert abs(now.white - found.white) < 0.3 * abs(before.white - found.white)
    assert sum(now) == pytest.approx(1.0, abs=0.011)
