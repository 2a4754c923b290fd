r"""Present noise of an inertial sensor from engine and road vibration.

With means y_k of n samples, each over tau = n T, the Hadamard variance

    H(tau) = < (y_k - 2 y_{k-1} + y_{k-2})^2 > / 6

is N^2 / tau for white noise of density N^2, independent of bias and drift. Motion, and vibration
that averages out, only add to tau H(tau) at one tau or another, so the smallest over several tau
bounds the density that attitude and velocity integrate; the share that they do is estimated by
predictions (fusiond.navigator.imu_vibration_noise_share). The mean is over past samples of the last
seconds alone: an engine that starts shows at once, and a replay gives the same numbers.

Ten seconds are too slow for a noise that rises tenfold at once: after one second the attitude is
off by four sigma. A faster mean would take each bump for noise, although it is motion that the
sensors measure. White noise is present at all times and all tau: with T a sample's interval, it is
new noise if

    of a second each fifth has T H(T), and all of it 4 T H(4 T), above RISEN times the density
    that was known before it

A bump of less than half a second leaves one fifth unchanged. White noise of the known density never
meets this: second differences are correlated by -2/3 and 1/6, so that n of them have n / 1.9
degrees of freedom; five fifths of ten samples a second are all above ten times their mean once in
10^14, and of fifty far less. Fifty minutes of four recorded vehicles met it twice, on one axis for
a second. The means then restart, at all tau with T H(T) of that second, and the effect of the noise
on attitude and velocity in that second, N^2, is added at once.

Source: Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section 5.2.9.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.sample_noise_factors import FromInstants

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# Means of 1, 4 and 16 samples: 10 to 160 ms at 100 Hz, faster than suspension and steering.
LEVELS, RATIO = 3, 4
# Seconds that the mean looks back: what an engine's speed or a road's surface takes to change.
MEMORY_S = 10.0
# Differences that a level needs before it counts: its estimate is then good to a factor of two.
FEWEST = 10
# The sheet's noise stands while what is seen is below so many times its density: the smallest of
# three estimates over some hundred differences exceeds it once in 10^4.
EXCESS = 1.5

# Parts of a second, and by how much the noise must have risen in each: by an order of magnitude.
PARTS, PART_S, RISEN = 5, 0.2, 10.0

# Of each level and axis: sum and count of the present mean, the two means before, how many there
# were, and tau H.
_SUM, _COUNT, _LAST, _BEFORE, _MEANS, _DENSITY = range(6)
# Of each axis and part, the present one first: sum and number of tau H at the first two levels, and
# the density that was known at its end. One part more than a second has.
_FINE, _OF_FINE, _COARSE, _OF_COARSE, _KNOWN, _PART_SIZE = range(6)


@compiled("f8(f8[:, ::1], f8[:, :])")
def _risen(parts: Array, memory: Array) -> float:
    """New noise density of an axis; 0 if unchanged.

    The density that all of its `parts` (PARTS + 1, 5) show, the first of which has just ended. A
    new density restarts the axis's means, `memory` (LEVELS, 6)."""
    least = RISEN * parts[PARTS, _KNOWN]
    fine = of_fine = coarse = of_coarse = 0.0
    for k in range(PARTS):
        if least == 0.0 or parts[k, _FINE] <= least * parts[k, _OF_FINE]:
            return 0.0
        fine += parts[k, _FINE]
        of_fine += parts[k, _OF_FINE]
        coarse += parts[k, _COARSE]
        of_coarse += parts[k, _OF_COARSE]
    if coarse <= least * of_coarse:
        return 0.0
    density = fine / of_fine
    for level in range(memory.shape[0]):
        memory[level, _DENSITY], memory[level, _MEANS] = density, 2.0 + of_fine
        of_fine //= RATIO
    return density


@compiled("void(f8[:, ::1], f8, f8, f8[::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1])")
def _follow(
    samples: Array,
    period_s: float,
    memory_s: float,
    sheet: Array,
    memory: Array,
    lately: Array,
    out: Array,
) -> None:
    """Write the smallest noise density so far beyond the data sheet's, `out` (m, 6).

    After each of `samples` (m, 6), beyond that of `sheet` (6,); 0 if it does not exceed it by
    EXCESS.

    `memory` (LEVELS, 6, 6) and `lately` (6, PARTS + 1, 5) go on from call to call.
    """
    for i in range(samples.shape[0]):
        for axis in range(6):
            smallest, parts = np.inf, lately[axis]
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
                        if level < 2:
                            parts[0, 2 * level] += found
                            parts[0, 2 * level + 1] += 1.0
                    memory[level, axis, _BEFORE], memory[level, axis, _LAST] = last, mean
                    memory[level, axis, _MEANS] = means + 1.0
                    memory[level, axis, _SUM] = memory[level, axis, _COUNT] = 0.0
                if memory[level, axis, _MEANS] >= FEWEST:
                    smallest = min(smallest, memory[level, axis, _DENSITY])
                wanted *= RATIO
            missed = 0.0
            if parts[0, _OF_FINE] * period_s >= PART_S:
                parts[0, _KNOWN] = max(smallest, sheet[axis]) if smallest < np.inf else 0.0
                risen = _risen(parts, memory[:, axis])
                if risen > 0.0:
                    smallest = risen
                    missed = (risen - parts[PARTS, _KNOWN]) * PARTS * PART_S / period_s
                    parts[:] = 0.0
                for j in range(_PART_SIZE):
                    for k in range(PARTS, 0, -1):
                        parts[k, j] = parts[k - 1, j]
                    parts[0, j] = 0.0
            above = smallest < np.inf and smallest > EXCESS * sheet[axis]
            out[i, axis] = smallest - sheet[axis] + missed if above else 0.0


class Vibration:
    """Noise estimate of each axis. `rate_noise` (rad/s/sqrt(Hz)) and `force_noise` (m/s^2/sqrt(Hz))
    are the data sheet's, `period_s` the interval of the samples."""

    def __init__(self, period_s: float, rate_noise: float, force_noise: float) -> None:
        self._period_s = period_s
        self._sheet = np.repeat([rate_noise**2, force_noise**2], 3)
        self._memory = np.zeros((LEVELS, 6, 6))
        self._lately = np.zeros((6, PARTS + 1, _PART_SIZE))
        self.shares = FromInstants()
        """Share of the density of each axis (6,) that is noise."""
        self.shaken = False
        """True if the last samples have shown more than the sheet's."""

    def follow(self, times: Stamps, samples: Array, densities: Array) -> None:
        """Write to `densities` (m, 6) the noise beyond the sheet's.

        After each of samples (m, 6), rate and force of the same axes, at `times` (m,) ns;
        (rad/s)^2/Hz and (m/s^2)^2/Hz."""
        of_axes = self._sheet, self._memory, self._lately
        _follow(samples, self._period_s, MEMORY_S, *of_axes, densities)
        self.shaken = bool(densities[-1].any())
        for rows, shares in self.shares.rows(times):
            of = densities[rows]
            np.maximum(shares * (of + self._sheet) - self._sheet, 0.0, out=of)
