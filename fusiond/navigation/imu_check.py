r"""Screening of inertial samples: each judged by those before it.

    |x_k - x_g| <= n L_j,    L_j = 30 max(a_j, floor_j)       a jump is a `spike`
    r >= ln(1e-9) / ln(p)                                      a value that comes too often

    |x_k - x_g| > 30 max(a_j, least_j) and back to a quarter of it with the next sample: a `spike`

x_g is the last accepted sample, n the number of samples since (three at most), a_j the running mean
of |dx| of axis j. p is the running probability that a sample repeats the one before it bit for bit,
r the present number of repetitions: the limit is exceeded by chance once in 1e9 samples, four
months at 100 Hz. p starts at 1, so that a sensor is rejected only for behaviour that it had not
shown before.

Figures, of four recordings of cars and a walker (MEMS units of 100 to 167 Hz; one with steps of
0.25 deg/s and 0.125 m/s^2; one that sends each third sample twice):

    all six values the same           3 samples in a row at most (of 320,000)
    one axis the same                 101 samples in a row (1.0 s, the coarse unit at rest)
    leap between samples              16 a_j in cars, 28 a_j of a walker
    and back with the next            14 a_j in cars, 23 a_j of a walker, three of 300 a_j and more
    smallest specific force           3.6 m/s^2 in one sample (a shock)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

OUTCOMES = (
    "taken",
    "saturated",
    "repeated",
    "no_gravity",
    "spike",
    "stamp_ahead",
    "axis_dead",
)
"""Outcome of a sample, by code. `stamp_ahead`: stamped later than one that came after it."""
TAKEN, SATURATED, REPEATED, NO_GRAVITY, SPIKE, STAMP_AHEAD, AXIS_DEAD = range(7)

# Twice the largest leap of a car, and more than that of a walker.
LEAP = 30.0
# So many leaps may add up while samples are refused: then the new level must last for DEAD_S, in
# which a sensor that is at its unknown full scale is seen to be dead.
JUMPS_ALLOWED = 3.0
# Mean leaps of a good sensor on a quiet ride; with LEAP they allow what a shock does from rest:
# 0.9 rad/s and 15 m/s^2 from sample to sample. Cars showed 1.7 and 10, shaken long before.
RATE_FLOOR_RAD_S, FORCE_FLOOR_M_S2 = 0.03, 0.5
# The same of a sensor on a stand, for leaps that the next sample takes back: what shakes a vehicle
# lasts for several samples, so that no allowance for shocks is needed.
LEAST_RATE_RAD_S, LEAST_FORCE_M_S2 = 0.003, 0.05
BACK = 0.25
# Samples that the running mean of leaps and the running probability of repetition remember.
JUMPS_KEPT, REPEATS_KEPT = 100.0, 500.0
# The probability of repetition falls no further: after half an hour at 200 Hz it would be no normal
# number, which takes the processor three times as long. A repetition makes the same of both.
LEAST_P = 1e-30
# A repetition as rare as this is none; and at least three times the longest seen.
CHANCE = 1e-9
FEWEST_REPEATS = 10
# An axis that is dead: no change for a second, and rare by chance, while others change. A quarter
# of that would have refused nothing of those recordings.
DEAD_S = 1.0
# A run that ended by a step as small as the sensor has was rest, not a fault: three times as long a
# run is allowed from then on.
SMALLEST_STEPS, RUN_FACTOR = 1.5, 3.0
# Free fall: a wheeled vehicle that leaves the ground is back within 0.1 s (5 cm high). A fifth of
# gravity is below the smallest force that was seen, and above one gravity in units of g.
FREE_FALL_M_S2, FREE_FALL_S = 2.0, 0.1
# Nearer to full scale than the scale factor's tolerance.
FULL = 0.99

# The checker's memory: figures by axis, then single ones.
_GOOD, _RAW, _LEAP, _STEP, _REPEATS, _RUN, _OTHERS, _LONGEST = range(0, 48, 6)
_P_ALL, _RUN_ALL, _LONGEST_ALL, _SEEN, _FREE_S, _REFUSED = range(48, 54)
_MEMORY = 54
_NEVER_NS = -(2**62)


@compiled("f8(f8, f8)", forceinline=True)
def _most(p: float, longest: float) -> float:
    """Largest plausible number of repetitions in a row."""
    by_chance = math.log(CHANCE) / math.log(min(p, 1.0 - 1e-12))
    return max(float(FEWEST_REPEATS), by_chance, RUN_FACTOR * longest)


@compiled("void(f8[::1], f8[:, ::1], i8)")
def _begin(memory: Array, samples: Array, i: int) -> None:
    """Sample i is the first."""
    memory[:] = 0.0
    for j in range(6):
        memory[_GOOD + j] = memory[_RAW + j] = samples[i, j]
        floor = RATE_FLOOR_RAD_S if j < 3 else FORCE_FLOOR_M_S2
        memory[_LEAP + j] = 10.0 * floor
        memory[_STEP + j] = math.inf
        memory[_REPEATS + j] = 1.0
    memory[_P_ALL] = memory[_SEEN] = 1.0


@compiled("void(f8[::1], f8[:, ::1], i8, f8)", forceinline=True)
def _count_repeats(memory: Array, samples: Array, i: int, rate_hz: float) -> None:
    """Count the repetitions of sample i on each axis, and their duration."""
    moved = 0
    small = True
    for j in range(6):
        step = abs(samples[i, j] - memory[_RAW + j])
        if step > 0.0:
            moved += 1
            memory[_STEP + j] = min(memory[_STEP + j], step)
            small = small and step <= SMALLEST_STEPS * memory[_STEP + j]
    if moved:
        if small:
            memory[_LONGEST_ALL] = max(memory[_LONGEST_ALL], memory[_RUN_ALL])
        memory[_RUN_ALL] = 0.0
        memory[_P_ALL] = max(memory[_P_ALL] - memory[_P_ALL] / REPEATS_KEPT, LEAST_P)
    else:
        memory[_RUN_ALL] += 1.0
        if memory[_RUN_ALL] < _most(memory[_P_ALL], memory[_LONGEST_ALL]):
            memory[_P_ALL] += (1.0 - memory[_P_ALL]) / REPEATS_KEPT
    for j in range(6):
        step = abs(samples[i, j] - memory[_RAW + j])
        if step > 0.0:
            if step <= SMALLEST_STEPS * memory[_STEP + j]:
                memory[_LONGEST + j] = max(memory[_LONGEST + j], memory[_RUN + j])
            memory[_RUN + j] = memory[_OTHERS + j] = 0.0
            p = memory[_REPEATS + j]
            memory[_REPEATS + j] = max(p - p / REPEATS_KEPT, LEAST_P)
        elif moved:
            memory[_RUN + j] += 1.0
            memory[_OTHERS + j] += 1.0
            if memory[_RUN + j] < DEAD_S * rate_hz:
                memory[_REPEATS + j] += (1.0 - memory[_REPEATS + j]) / REPEATS_KEPT
        else:
            memory[_RUN + j] += 1.0
        memory[_RAW + j] = samples[i, j]


@compiled("i8(f8[::1], f8[:, ::1], i8, f8, f8[::1])", forceinline=True)
def _judged(memory: Array, samples: Array, i: int, since_s: float, limits: Array) -> int:
    """Code of sample i, `since_s` after the one before it, with counted repetitions."""
    rate_hz = limits[0]
    force = math.sqrt(samples[i, 3] ** 2 + samples[i, 4] ** 2 + samples[i, 5] ** 2)
    memory[_FREE_S] = memory[_FREE_S] + since_s if force < FREE_FALL_M_S2 else 0.0
    for j in range(6):
        if abs(samples[i, j]) >= FULL * (limits[1] if j < 3 else limits[2]):
            return SATURATED
    if force == 0.0 or memory[_FREE_S] > FREE_FALL_S:
        return NO_GRAVITY
    run = memory[_RUN_ALL]
    if run >= FEWEST_REPEATS and run >= _most(memory[_P_ALL], memory[_LONGEST_ALL]):
        return REPEATED
    for j in range(6):
        run = memory[_RUN + j]
        if run < DEAD_S * rate_hz or memory[_OTHERS + j] < 0.5 * run:
            continue
        if run >= _most(memory[_REPEATS + j], memory[_LONGEST + j]):
            return AXIS_DEAD
    if memory[_REFUSED] > DEAD_S * rate_hz:
        return TAKEN
    since = min(memory[_REFUSED] + 1.0, JUMPS_ALLOWED)
    for j in range(6):
        floor = RATE_FLOOR_RAD_S if j < 3 else FORCE_FLOOR_M_S2
        most = LEAP * max(floor, memory[_LEAP + j]) * since
        if abs(samples[i, j] - memory[_GOOD + j]) > most:
            return SPIKE
    return TAKEN


@compiled("b1(f8[::1], f8[:, ::1], i8)", forceinline=True)
def _jumps(memory: Array, samples: Array, i: int) -> bool:
    """True if sample i may be a spike, to be confirmed by the next one."""
    for j in range(6):
        least = LEAST_RATE_RAD_S if j < 3 else LEAST_FORCE_M_S2
        if abs(samples[i, j] - memory[_GOOD + j]) > LEAP * max(least, memory[_LEAP + j]):
            return True
    return False


@compiled("b1(f8[::1], f8[:, ::1], i8, i8)")
def _comes_back(memory: Array, samples: Array, i: int, k: int) -> bool:
    """True if sample k, the next, reverts a jump of sample i."""
    for j in range(6):
        least = LEAST_RATE_RAD_S if j < 3 else LEAST_FORCE_M_S2
        leap = abs(samples[i, j] - memory[_GOOD + j])
        back = abs(samples[k, j] - memory[_GOOD + j])
        if leap > LEAP * max(least, memory[_LEAP + j]) and back < BACK * leap:
            return True
    return False


@compiled("void(f8[::1], f8[:, ::1], i8)", forceinline=True)
def _take(memory: Array, samples: Array, i: int) -> None:
    """Store sample i for the comparison with the next."""
    for j in range(6):
        floor = RATE_FLOOR_RAD_S if j < 3 else FORCE_FLOOR_M_S2
        leap = abs(samples[i, j] - memory[_GOOD + j]) / (memory[_REFUSED] + 1.0)
        usual = memory[_LEAP + j]
        # A single leap weighs no more than eight usual ones.
        memory[_LEAP + j] += (min(leap, 8.0 * max(floor, usual)) - usual) / JUMPS_KEPT
        memory[_GOOD + j] = samples[i, j]
    memory[_REFUSED] = 0.0


@compiled("UniTuple(i8, 3)(i8[::1], f8[:, ::1], i8, i8, f8[::1], f8[::1], i8[::1])")
def _check(
    times: Stamps,
    samples: Array,
    last_ns: int,
    hold_ns: int,
    limits: Array,
    memory: Array,
    codes: Stamps,
) -> tuple[int, int, int]:
    """Write `codes` (m,); return the number of judged samples (the rest waits for more), the last
    stamp, and the number of rejections.

    `limits`: rate in Hz, full scale of rate and force. Samples with stamps that do not advance are
    not judged here.
    """
    i, m, refused = 0, len(times), 0
    while i < m:
        codes[i] = TAKEN
        if memory[_SEEN] == 0.0:
            _begin(memory, samples, i)
            last_ns = times[i]
            i += 1
            continue
        if times[i] <= last_ns:
            i += 1
            continue
        gap = times[i] - last_ns > hold_ns
        jumps = not gap and memory[_REFUSED] == 0.0 and _jumps(memory, samples, i)
        k = i + 1
        if gap or jumps:
            while k < m and times[k] <= last_ns:
                k += 1
            if k == m:
                return i, last_ns, refused
        # A gap is real if the next sample goes on from here; else this stamp was wrong.
        if gap and times[k] <= times[i]:
            codes[i] = STAMP_AHEAD
            refused += 1
            i += 1
            continue
        _count_repeats(memory, samples, i, limits[0])
        since_s = 1.0 / limits[0] if gap else (times[i] - last_ns) * 1e-9
        codes[i] = _judged(memory, samples, i, since_s, limits)
        if codes[i] == TAKEN and jumps and _comes_back(memory, samples, i, k):
            codes[i] = SPIKE
        # After a gap there is nothing to compare with.
        if codes[i] == TAKEN or (codes[i] == SPIKE and gap):
            codes[i] = TAKEN
            _take(memory, samples, i)
        else:
            memory[_REFUSED] += 1.0
            refused += 1
        last_ns = times[i]
        i += 1
    return i, last_ns, refused


class Checked(NamedTuple):
    """Judged samples (m,) ns, (m, 6), and their codes (m,), into OUTCOMES."""

    times: Stamps
    samples: Array
    codes: Stamps


class ImuCheck:
    """Check of samples in sensor axes, in chunks of any size.

    `rate_hz` as configured; `rate_range` (rad/s) and `force_range` (m/s^2) are the sensor's full
    scale, infinite if unknown. A sample after a pause or a jump waits for the next one, which shows
    the wrong stamp, or whether the jump lasts.
    """

    def __init__(self, rate_hz: float, rate_range: float, force_range: float) -> None:
        self._limits = np.array([rate_hz, rate_range, force_range])
        self._memory = np.zeros(_MEMORY)
        self._last_ns = _NEVER_NS
        self._waiting: tuple[Stamps, Array] | None = None
        self.refused = 0
        """Number of rejected samples among those last judged."""

    def restart(self) -> None:
        """Forget all: the next sample may have any stamp."""
        self._memory[:] = 0.0
        self._last_ns = _NEVER_NS
        self._waiting = None

    def feed(self, times: Stamps, samples: Array, hold_ns: int) -> Checked:
        """Samples (m,) ns and (m, 6), finite; a pause beyond `hold_ns` is a gap."""
        if self._waiting is not None:
            times = np.concatenate((self._waiting[0], times))
            samples = np.concatenate((self._waiting[1], samples))
        times, samples = np.ascontiguousarray(times), np.ascontiguousarray(samples)
        codes = np.empty(len(times), dtype=np.int64)
        done, self._last_ns, self.refused = _check(
            times, samples, self._last_ns, hold_ns, self._limits, self._memory, codes
        )
        if done == len(times):
            self._waiting = None
            return Checked(times, samples, codes)
        self._waiting = times[done:].copy(), samples[done:].copy()
        return Checked(times[:done], samples[:done], codes[:done])
