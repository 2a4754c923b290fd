r"""The noise of an inertial sensor on this vehicle, now: what engine and road shake into it.

With means y_k of n samples over tau = n T each, the Hadamard variance

    H(tau) = < (y_{k+2} - 2 y_{k+1} + y_k)^2 > / 6

is N^2 / tau for white noise of density N^2, whatever the bias and its drift. Motion and vibration
that averages out only add to H(tau) tau at some tau, so the smallest over several tau bounds the
density that is integrated into attitude and velocity. The mean is over the last seconds, past
samples only: an engine that starts is in it at once, and replay gives the same numbers.

Source: IEEE Std 1139-2022, Hadamard variance; Riley, Handbook of Frequency Stability Analysis, NIST
SP 1065 (2008), section 5.2.9.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

# Samples averaged in each level: 10 to 160 ms at 100 Hz, above what suspension and steering do.
AVERAGED = (1, 4, 16)
# Seconds that the mean looks back: what an engine's speed and a road's surface take to change.
MEMORY_S = 10.0
# Chance lets the smallest of three estimates of a few hundred differences reach this above the
# truth: below it the sheet's noise stands.
EXCESS = 1.5


@compiled("void(f8[:, ::1], f8, f8, f8[:, :, ::1], f8[:, ::1])")
def _follow(samples: Array, period_s: float, memory_s: float, memory: Array, out: Array) -> None:
    """Write `out` (m, 6), the density after each of `samples` (m, 6).

    `memory` (levels, 6, 6): of each level and axis the sum, its count, the two means before, how
    many means there were, and H tau.
    """
    for i in range(samples.shape[0]):
        for axis in range(6):
            out[i, axis] = np.inf
        for level in range(memory.shape[0]):
            wanted = 1.0
            for _ in range(level):
                wanted *= 4.0
            tau = wanted * period_s
            for axis in range(6):
                m = memory[level, axis]
                m[0] += samples[i, axis]
                m[1] += 1.0
                if m[1] >= wanted:
                    mean = m[0] / wanted
                    if m[4] >= 2.0:
                        found = (mean - 2.0 * m[3] + m[2]) ** 2 / 6.0 * tau
                        gain = max(1.0 / (m[4] - 1.0), min(1.0, tau / memory_s))
                        m[5] += gain * (found - m[5])
                    m[2], m[3] = m[3], mean
                    m[4] += 1.0
                    m[0], m[1] = 0.0, 0.0
                if m[4] < 10.0:
                    out[i, axis] = min(out[i, axis], 0.0) if level == 0 else out[i, axis]
                else:
                    out[i, axis] = min(out[i, axis], m[5])


class Vibration:
    """Follows the density of each axis's noise; `sheet` (6,) what the data sheet says, (rad/s)^2/Hz
    and (m/s^2)^2/Hz."""

    def __init__(self, period_s: float, sheet: Array) -> None:
        self._period_s, self._sheet = period_s, sheet
        self._memory = np.zeros((len(AVERAGED), 6, 6))

    def follow(self, samples: Array) -> Array:
        """Density (m, 6) beyond the sheet's after each of samples (m, 6)."""
        found = np.empty((len(samples), 6))
        _follow(np.ascontiguousarray(samples), self._period_s, MEMORY_S, self._memory, found)
        excess: Array = np.maximum(found - EXCESS * self._sheet, 0.0)
        return excess
