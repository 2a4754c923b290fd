r"""Noise equivalent of sensor-axis errors without states, while the vehicle turns and accelerates.

Axes that are not square:

    e_i = sum m_ij w_j,   d_i = sum n_ij f_j,   j other than i,   m_ij, n_ij ~ N(0, m^2)

of gyros and accelerometers. While the vehicle turns about one body axis u, the gyros measure the
turn of a body that is rotated by a constant, M u. The attitude is accurate for axes that deviate
from the housing by m (`fusiond.estimators.published_state` publishes it so); relative to them
gravity has a constant error in the body, a bias of the accelerometers. Nothing grows. u is the
vertical of a vehicle on a road, here the direction of the mean force. Turns about another axis do
not fit: a bend of angle Theta about it leaves an error of m Theta about the lateral axes, and the
bend back removes it. A filter without states for m_ij treats this as white noise that adds as much
in a bend of Theta:

    density of e_i = m^2 Theta |w_j, w_k|,   w less its mean and its part along u

more in smaller bends, less in larger ones. The same applies to forces beside gravity, by n and by m
of the gyros' axes in which they are resolved. Along u each change V of the vehicle's own velocity
adds sqrt(2) m V. Across u the turn about u is a heading, which the filter follows; the rest of n
(its symmetric part) turns with the vehicle, so that only the part within a filter's memory with
fixes counts:

    density of d = 2 m^2 V |f_2, f_3| along u,   m^2 / 2 V' |f_2, f_3| across,   f less its mean

Rates and forces are smoothed, as vibration does not move the vehicle. States would need a third
parameter of each axis in the kernels; results with this noise are in docs/vehicle.md.

Scale factors, of a model that has no states for them:

    e_i = s_i w_i,   d_i = k_i f_i,   s_i ~ N(0, s^2), k_i ~ N(0, k^2)

A bend of angle Theta about an axis leaves s Theta of attitude about it, a change V of the velocity
along an axis k V; the bend back, or the stop, takes it away again. A filter without states for them
treats this as white noise that adds as much in a bend, or in the part V' of a stop within a
filter's memory with fixes:

    density of e_i = s^2 Theta |w_i|,   of d_i = k^2 V' |f_i|

w and f are without their means, biases and gravity: k times gravity is a bias. Bends in one
direction add up to more than this, bends to and fro to less.

Source: Groves, 2nd ed., section 4.4.2 (cross-coupling and scale factor errors).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.sample_noise_factors import FromInstants

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

BEND_RAD = 0.5 * math.pi
"""Angle theta: a street corner."""
STOP_M_S, WITHIN_FIXES_M_S = 8.0, 2.0
"""Speeds V: a stop in a street, or a corner; V': a second or two of either. With 40 m/s for V'
sigma of a velocity is 1.3 times too large on simulated drives that were looked at."""
SMOOTH_S = 0.5
"""A fifth of the time that a corner takes; engine and road shake ten times faster."""
MEAN_S = 60.0
"""The mean force is gravity, the mean rate a bias: a vehicle speeds up and brakes in a minute."""


@compiled("void(f8[:, ::1], UniTuple(f8, 2), UniTuple(f8, 5), f8[::1], f8[:, ::1], f8[:, ::1])")
def _follow(
    samples: Array,
    gains: tuple[float, float],
    factors: tuple[float, float, float, float, float],
    mean: Array,
    out: Array,
    scaled: Array,
) -> None:
    """Add the densities after each of `samples` (m, 6).

    To `out` (m, 6) those by axes out of square, to `scaled` (m, 6) those by scale factors; `gains`
    are those of the smoothed samples and of their means, `factors` of rates, of forces along the
    vertical and across, and of both scale factors. `mean` (13,) goes on from call to call: smoothed
    rates and forces, their means, and their number of samples."""
    gain, slow_gain = gains
    of_rates, along_up, across_up, rate_scale, force_scale = factors
    for i in range(samples.shape[0]):
        mean[12] += 1.0
        fast, slow = max(gain, 1.0 / mean[12]), max(slow_gain, 1.0 / mean[12])
        square = along = 0.0
        for axis in range(6):
            mean[axis] += fast * (samples[i, axis] - mean[axis])
            mean[6 + axis] += slow * (samples[i, axis] - mean[6 + axis])
            factor = rate_scale if axis < 3 else force_scale
            scaled[i, axis] += factor * abs(mean[axis] - mean[6 + axis])
        for axis in range(3):
            along += (mean[axis] - mean[6 + axis]) * mean[9 + axis]
            square += mean[9 + axis] * mean[9 + axis]
        share = along / square if square > 0.0 else 0.0
        x = mean[0] - mean[6] - share * mean[9]
        y = mean[1] - mean[7] - share * mean[10]
        z = mean[2] - mean[8] - share * mean[11]
        out[i, 0] += of_rates * math.sqrt(y * y + z * z)
        out[i, 1] += of_rates * math.sqrt(x * x + z * z)
        out[i, 2] += of_rates * math.sqrt(x * x + y * y)
        total = 0.0
        for axis in range(3):
            total += (mean[3 + axis] - mean[9 + axis]) ** 2
        for axis in range(3):
            beside = math.sqrt(max(0.0, total - (mean[3 + axis] - mean[9 + axis]) ** 2))
            up = mean[9 + axis] * mean[9 + axis] / square if square > 0.0 else 0.0
            out[i, 3 + axis] += (up * along_up + (1.0 - up) * across_up) * beside


class Crosstalk:
    """Noise equivalent of crosstalk and of scale factors without states for samples `period_s`
    apart; `misalignment_rad` is m, `rate_scale` and `force_scale` one sigma of scale factors."""

    def __init__(
        self,
        period_s: float,
        misalignment_rad: float,
        rate_scale: float = 0.0,
        force_scale: float = 0.0,
    ) -> None:
        self._gain = 1.0 - math.exp(-period_s / SMOOTH_S)
        self._slow_gain = 1.0 - math.exp(-period_s / MEAN_S)
        square = misalignment_rad**2
        self._times = (
            *(square * BEND_RAD, 2.0 * square * STOP_M_S),
            0.5 * square * WITHIN_FIXES_M_S,
            rate_scale**2 * BEND_RAD,
            force_scale**2 * WITHIN_FIXES_M_S,
        )
        self._mean = np.zeros(13)
        self.squares = FromInstants()
        """Factor (1,) of m^2 as estimated for the unit (fusiond.navigator.imu_grade)."""

    def follow(self, times: Stamps, samples: Array, densities: Array) -> None:
        """Add the densities, (rad/s)^2/Hz and (m/s^2)^2/Hz, after each of samples (m, 6) at `times`
        (m,) ns to `densities` (m, 6)."""
        found = np.zeros_like(densities)
        gains = self._gain, self._slow_gain
        _follow(samples, gains, self._times, self._mean, found, densities)
        for rows, square in self.squares.rows(times):
            found[rows] *= square
        densities += found
