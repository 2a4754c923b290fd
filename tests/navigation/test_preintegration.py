"""What is integrated side by side is what one sample after another comes to."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.navigation.preintegration import LANES, integrate_sensed
from fusiond.navigation.rotation import dcm_from_quaternion, rotate_quaternion, skew

Array = NDArray[np.float64]


def _one_by_one(
    times: NDArray[np.int64], samples: Array, biases: Array, counts: list[int]
) -> tuple[Array, Array, Array]:
    """As `integrate_sensed` writes it."""
    q, v, d, s = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    begin = dcm_from_quaternion(q)
    found = [(v, begin, np.hstack([d, s]))]
    for h, (*rate, x, y, z) in zip(np.diff(times) * 1e-9, samples.tolist(), strict=True):
        half = 0.5 * h * (np.array(rate) - biases[3:])
        rotate_quaternion(q, *half, False)
        c = dcm_from_quaternion(q)
        rotate_quaternion(q, *half, False)
        f = c @ (np.array([x, y, z]) - biases[:3])
        s = s - h * skew(f) @ (d - 0.5 * h * c)
        v, d = v + h * f, d - h * c
        found.append((v, dcm_from_quaternion(q), np.hstack([d, s])))
    gained, turned, slopes = zip(*(found[count] for count in counts), strict=True)
    return np.array(gained), np.array(turned), np.array(slopes)


@pytest.mark.parametrize("rate_sd", [0.05, 3.0, 60.0])
def test_intervals_side_by_side(rate_sd: float) -> None:
    """More of them than lanes; of other lengths, and of none."""
    rng = np.random.default_rng(round(rate_sd))
    counts = [0, 0, 3, 3, 60, 61, 75, 80, 90, 90, 110, 111, 112, 130, 131, 180, 180, 200]
    assert len(counts) > 2 * LANES
    times = np.cumsum(rng.integers(8_000_000, 12_000_000, counts[-1] + 1))
    samples = np.hstack(
        [rng.normal(0.0, rate_sd, (counts[-1], 3)), rng.normal(0.0, 9.8, (counts[-1], 3))]
    )
    biases, k = rng.normal(0.0, 0.1, 6), len(counts)
    found = np.empty((k, 3)), np.empty((k, 3, 3)), np.empty((k, 3, 6))
    integrate_sensed(times, samples, biases, np.array(counts), *found)
    for one, other in zip(found, _one_by_one(times, samples, biases, counts), strict=True):
        assert one == pytest.approx(other, rel=1e-11, abs=1e-11)
