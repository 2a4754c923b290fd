"""Compiled kernels: IMU samples corrected by a filter's estimates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled("void(f8[::1], i8[::1], i8[::1], f8[::1])")
def sensor_estimates(
    xi: Array, sensor_slot: Indices, sensor_kind: Indices, estimate: Array
) -> None:
    """Write `estimate` (12,) of the parameters `xi` (n,): rate bias, force bias, their scales."""
    for k in range(12):
        estimate[k] = 0.0
    for i in range(12):
        if sensor_kind[i] == PLAIN:
            estimate[i // 2] += xi[sensor_slot[i]]
        elif sensor_kind[i] == SCALE:
            estimate[6 + i // 2] += xi[sensor_slot[i]]


@compiled("void(f8[::1], i8, f8[::1], f8[::1], f8[::1])")
def compensate(samples: Array, i: int, estimate: Array, rate: Array, force: Array) -> None:
    """Write `rate` and `force` (3,) of sample i of `samples` (6 m,), corrected by `estimate`
    (12,)."""
    at = 6 * i
    for j in range(3):
        rate[j] = (samples[at + j] - estimate[j]) / (1.0 + estimate[6 + j])
        force[j] = (samples[at + 3 + j] - estimate[3 + j]) / (1.0 + estimate[9 + j])


@compiled("b1(i8[::1], f8[::1], i8, i8, f8[::1], f8[::1])", forceinline=True)
def slopes(
    times: Indices, samples: Array, i: int, gap_ns: int, rate_slope: Array, force_slope: Array
) -> bool:
    """Write the slopes (3,), a second, of rate and force over sample i of `samples` (6 m,); True if
    a gap precedes it.

    Zero if the sample before has another duration: beside a gap, at the start.
    """
    silent = i > 0 and times[i] - times[i - 1] > gap_ns
    if i > 1 and not silent and times[i - 1] - times[i - 2] <= gap_ns:
        between = 2e9 / (times[i] - times[i - 2])
        at, before = 6 * i, 6 * i - 6
        for j in range(3):
            rate_slope[j] = (samples[at + j] - samples[before + j]) * between
            force_slope[j] = (samples[at + 3 + j] - samples[before + 3 + j]) * between
    else:
        for j in range(3):
            rate_slope[j] = 0.0
            force_slope[j] = 0.0
    return silent
