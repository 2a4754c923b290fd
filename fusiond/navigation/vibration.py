r"""The noise of an inertial sensor on this vehicle, now: what engine and road shake into it.

With means y_k of n samples, each over tau = n T, the Hadamard variance

    H(tau) = < (y_k - 2 y_{k-1} + y_{k-2})^2 > / 6

is N^2 / tau for white noise of density N^2, whatever the bias and its drift. Motion, and vibration
that averages out, only add to tau H(tau) at one tau or another, so the smallest over several tau
bounds the density that attitude and velocity integrate. The mean is over the last seconds and past
samples alone: an engine that starts is in it at once, and a replay gives the same numbers.

Source: Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section 5.2.9.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

# Means of 1, 4 and 16 samples: 10 to 160 ms at 100 Hz, faster than suspension and steering.
LEVELS, RATIO = 3, 4
# Seconds that the mean looks back: what an engine's speed or a road's surface takes to change.
MEMORY_S = 10.0
# Differences that a level needs before it counts: its estimate is then good to a factor of two.
FEWEST = 10
# The sheet's noise stands while what is seen is below so many times its density: the smallest of
# three estimates over some hundred differences exceeds it once in 10^4.
EXCESS = 1.5

# Of each level and axis: sum and count of the present mean, the two means before, how many there
# were, and tau H.
_SUM, _COUNT, _LAST, _BEFORE, _MEANS, _DENSITY = range(6)


@compiled("void(f8[:, ::1], f8, f8, f8[::1], f8[:, :, ::1], f8[:, ::1])")
def _follow(
    samples: Array, period_s: float, memory_s: float, sheet: Array, memory: Array, out: Array
) -> None:
    """Write `out` (m, 6), the smallest density so far after each of `samples` (m, 6) beyond that of
    `sheet` (6,), 0 where it is not above it by EXCESS.

    `memory` (LEVELS, 6, 6) goes on from call to call.
    """
    for i in range(samples.shape[0]):
        for axis in range(6):
            smallest = np.inf
            wanted = 1.0
            for level in range(memory.shape[0]):
                # A row of its own would be counted in and out at each sample: five times the time.
                memory[level, axis, _SUM] += samples[i, axis]
                memory[level, axis, _COUNT] += 1.0
                if memory[level, axis, _COUNT] >= wanted:
                    mean = memory[level, axis, _SUM] / wanted
                    last, before = memory[level, axis, _LAST], memory[level, axis, _BEFORE]
                    means = memory[level, axis, _MEANS]
                    if means >= 2.0:
                        tau = wanted * period_s
                        found = (mean - 2.0 * last + before) ** 2 / 6.0 * tau
                        gain = max(1.0 / (means - 1.0), min(1.0, tau / memory_s))
                        memory[level, axis, _DENSITY] += gain * (
                            found - memory[level, axis, _DENSITY]
                        )
                    memory[level, axis, _BEFORE], memory[level, axis, _LAST] = last, mean
                    memory[level, axis, _MEANS] = means + 1.0
                    memory[level, axis, _SUM] = memory[level, axis, _COUNT] = 0.0
                if memory[level, axis, _MEANS] >= FEWEST:
                    smallest = min(smallest, memory[level, axis, _DENSITY])
                wanted *= RATIO
            above = smallest < np.inf and smallest > EXCESS * sheet[axis]
            out[i, axis] = smallest - sheet[axis] if above else 0.0


class Vibration:
    """Follows each axis. `rate_noise` (rad/s/sqrt(Hz)) and `force_noise` (m/s^2/sqrt(Hz)) are the
    data sheet's, `period_s` that of the samples."""

    def __init__(self, period_s: float, rate_noise: float, force_noise: float) -> None:
        self._period_s = period_s
        self._sheet = np.repeat([rate_noise**2, force_noise**2], 3)
        self._memory = np.zeros((LEVELS, 6, 6))

    def follow(self, samples: Array, densities: Array) -> None:
        """Write to `densities` (m, 6) that beyond the sheet's, (rad/s)^2/Hz and (m/s^2)^2/Hz, after
        each of samples (m, 6), rate and force of the same axes."""
        _follow(samples, self._period_s, MEMORY_S, self._sheet, self._memory, densities)
