r"""Noise equivalent of unmodelled scale factors while the vehicle turns.

    e_i = s_i w_i,   d_i = k_i f_i,   s_i ~ N(0, s^2), k_i ~ N(0, k^2)

of gyros and accelerometers. A bend of angle Theta about an axis leaves s Theta of attitude about
it, a change V of the velocity along an axis k V; the bend back, or the stop, takes it away again. A
filter without states for them takes it for white noise that adds as much in a bend, or in that part
V' of a stop that a filter which gets fixes takes together:

    density of e_i = s^2 Theta |w_i|,   of d_i = k^2 V' |f_i|

w and f smoothed, and less their mean of a minute, which are biases and gravity: what k makes of
gravity is a bias. Theta and V' are those of `fusiond.navigation.crosstalk`. As of axes out of
square bends the same way round add up to more than this says, and there and back to less.

Source: Groves, 2nd ed., section 4.4.2 (scale factor errors).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.crosstalk import BEND_RAD, MEAN_S, SMOOTH_S, WITHIN_FIXES_M_S, Crosstalk

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


@compiled("void(f8[:, ::1], f8, f8, f8, f8, f8[::1], f8[:, ::1])")
def _follow(
    samples: Array,
    gain: float,
    slow_gain: float,
    of_rates: float,
    of_forces: float,
    mean: Array,
    out: Array,
) -> None:
    """Add to `out` (m, 6) the density after each of `samples` (m, 6). `mean` (13,) persists from
    call to call: smoothed rates and forces, their means, and the number of samples."""
    for i in range(samples.shape[0]):
        mean[12] += 1.0
        fast, slow = max(gain, 1.0 / mean[12]), max(slow_gain, 1.0 / mean[12])
        for axis in range(6):
            mean[axis] += fast * (samples[i, axis] - mean[axis])
            mean[6 + axis] += slow * (samples[i, axis] - mean[6 + axis])
            factor = of_rates if axis < 3 else of_forces
            out[i, axis] += factor * abs(mean[axis] - mean[6 + axis])


class ScaleNoise(Crosstalk):
    """Noise equivalent of scale factors, also with misaligned axes. `rate_scale` and `force_scale`
    are one sigma, without unit."""

    def __init__(
        self, period_s: float, misalignment_rad: float, rate_scale: float, force_scale: float
    ) -> None:
        super().__init__(period_s, misalignment_rad)
        self._gains = 1.0 - math.exp(-period_s / SMOOTH_S), 1.0 - math.exp(-period_s / MEAN_S)
        self._factors = rate_scale**2 * BEND_RAD, force_scale**2 * WITHIN_FIXES_M_S
        self._seen = np.zeros(13)

    def follow(self, times: Stamps, samples: Array, densities: Array) -> None:
        super().follow(times, samples, densities)
        _follow(samples, *self._gains, *self._factors, self._seen, densities)
