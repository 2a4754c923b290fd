"""What a unit's samples say of its noise: at once where it is new noise, later what motion adds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.navigation.vibration import MEMORY_S, Vibration

Array = NDArray[np.float64]

RATE_NOISE, FORCE_NOISE = 1e-4, 2e-3
SHEET = np.repeat([RATE_NOISE**2, FORCE_NOISE**2], 3)


def _noise(rate_hz: float, seconds: float, seed: int) -> Array:
    """Samples (n, 6) of white noise of the sheet's density."""
    rng = np.random.default_rng([40, seed])
    return rng.standard_normal((round(seconds * rate_hz), 6)) * np.sqrt(SHEET * rate_hz)


def _densities(
    samples: Array, rate_hz: float, at_once: int = 10**6, shares: tuple[tuple[int, float], ...] = ()
) -> Array:
    """After each of the samples (n, 6), of the sheet's (1), handed over so many at once."""
    vibration = Vibration(1.0 / rate_hz, RATE_NOISE, FORCE_NOISE)
    for since_ns, share in shares:
        vibration.shares.add(since_ns, np.full(6, share))
    found, times = np.zeros_like(samples), np.arange(len(samples)) * round(1e9 / rate_hz)
    for first in range(0, len(samples), at_once):
        part = slice(first, first + at_once)
        vibration.follow(times[part], samples[part], found[part])
    densities: Array = found / SHEET
    return densities


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0])
def test_noise_that_rises_tenfold_is_integrated_from_its_second_second_on(rate_hz: float) -> None:
    """What attitude and velocity have integrated since then, P gets, as well as a second tells."""
    begin = round(20.0 * rate_hz)
    integrals = []
    for seed in range(5):
        samples = _noise(rate_hz, 26.0, seed)
        samples[begin:] *= 10.0
        found = _densities(samples, rate_hz)
        assert found[: begin + round(0.5 * rate_hz)].max() < 30.0
        integrals.append(np.cumsum(found[begin:], axis=0) / rate_hz)
    for seconds in (1.5, 3.0, 6.0):
        now = np.array([each[round(seconds * rate_hz) - 1] for each in integrals]) / 99.0
        assert 0.6 * seconds < now.mean() < 1.4 * seconds
        assert now.min() > 0.3 * seconds


def test_a_bump_is_no_noise() -> None:
    """Shaken at 9 and 23 Hz for 0.4 s, a hundred times the noise: the mean over ten seconds has its
    share of that, and nothing more is made of it. So with a blow."""
    rate_hz = 100.0
    samples = _noise(rate_hz, 40.0, 7)
    t, sd = np.arange(len(samples)) / rate_hz, np.sqrt(SHEET * rate_hz)
    bump = (t >= 20.0) & (t < 20.4)
    for hz in (9.0, 23.0):
        samples[bump] += 100.0 * sd * np.sin(2.0 * math.pi * hz * t[bump])[:, None]
    blow = round(30.0 * rate_hz)
    samples[blow : blow + 3] += 100.0 * sd
    second = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    found = _densities(samples, rate_hz)
    for first_s, last_s in ((10, 20), (20, 30), (30, 40)):
        of = slice(round(first_s * rate_hz) - 2, round(last_s * rate_hz) - 2)
        share = np.sum(second[of] ** 2, axis=0) / 6.0 / rate_hz**2 / MEMORY_S / SHEET
        highest = found[round(first_s * rate_hz) : round(last_s * rate_hz)].max(axis=0)
        before = found[round(first_s * rate_hz) - 1]
        assert (highest < before + share + 2.0).all()


def test_parts_of_a_second_may_come_in_any_number() -> None:
    samples = _noise(100.0, 8.0, 9)
    samples[500:] *= 12.0
    whole = _densities(samples, 100.0)
    assert whole.max() > 1000.0
    for at_once in (1, 7, 64):
        assert _densities(samples, 100.0, at_once).tobytes() == whole.tobytes()


def test_a_share_counts_from_its_instant_on_and_never_less_than_the_sheet() -> None:
    """A hundred times the sheet's density: a tenth of it is ten, a thousandth the sheet's own."""
    samples = 10.0 * _noise(100.0, 40.0, 9)
    shares = ((20_000_000_000, 0.1), (30_000_000_000, 0.001))
    whole = 1.0 + _densities(samples, 100.0)
    for at_once in (10**6, 7):
        found = 1.0 + _densities(samples, 100.0, at_once, shares)
        assert (found[:2000] == whole[:2000]).all()
        assert found[2000:3000] == pytest.approx(0.1 * whole[2000:3000])
        assert (found[3000:] == 1.0).all()
