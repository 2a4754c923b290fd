r"""Gyros whose axes are not square: the noise that this is, while the vehicle turns.

    e_i = sum m_ij w_j,   j other than i,   m_ij ~ N(0, m^2)

A bend of angle Theta leaves an attitude error of m Theta about the axes across it, and the bend
back takes it away again. A filter without states for m_ij takes it for white noise that adds as
much in a bend of Theta, a quarter turn:

    density of e_i = m^2 Theta |w_j, w_k|

more in smaller bends, less in larger ones. w is smoothed: shaking turns the vehicle nowhere. States
would need a third parameter of each axis in the kernels; what is measured with this noise stands in
docs/vehicle.md.

Source: Groves, 2nd ed., section 4.4.2 (cross-coupling errors).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

BEND_RAD = 0.5 * math.pi
"""Theta: a street corner."""
SMOOTH_S = 0.5
"""A fifth of the time that a corner takes; engine and road shake ten times faster."""


@compiled("void(f8[:, ::1], f8, f8, f8[::1], f8[:, ::1])")
def _follow(samples: Array, gain: float, times: float, mean: Array, out: Array) -> None:
    """Add to columns 0 to 2 of `out` (m, 6) the density after each of `samples` (m, 6); `mean` (3,)
    goes on from call to call."""
    for i in range(samples.shape[0]):
        for axis in range(3):
            mean[axis] += gain * (samples[i, axis] - mean[axis])
        x, y, z = mean[0], mean[1], mean[2]
        out[i, 0] += times * math.sqrt(y * y + z * z)
        out[i, 1] += times * math.sqrt(x * x + z * z)
        out[i, 2] += times * math.sqrt(x * x + y * y)


class Crosstalk:
    """Follows the rates. `period_s` is that of the samples, `misalignment_rad` m."""

    def __init__(self, period_s: float, misalignment_rad: float) -> None:
        self._gain = 1.0 - math.exp(-period_s / SMOOTH_S)
        self._times = misalignment_rad**2 * BEND_RAD
        self._mean = np.zeros(3)

    def follow(self, samples: Array, densities: Array) -> None:
        """Add the density, (rad/s)^2/Hz, after each of samples (m, 6) to the first three columns of
        `densities` (m, 6)."""
        _follow(samples, self._gain, self._times, self._mean, densities)
