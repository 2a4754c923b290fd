r"""Carrier phase changes between epochs: slant delay and displacement of a satellite.

Of two signals a and b of one satellite, with codes P in m without their group delays d, carriers L
in m, gamma = (f_a / f_b)^2, and I the ionosphere's delay at f_a:

    P_b - P_a = (gamma - 1) I + code noise            L_a - L_b = (gamma - 1) I + constant
    I_code    = (P_b - P_a) / (gamma - 1),            A = (s_a^2 + s_b^2) / (gamma - 1)^2

So the carriers give the change of I to millimetres, the codes its value. A filter of one state
combines them,

    I <- I + d(L_a - L_b) / (gamma - 1),     K = V / (V + R),  R = A max(1, 2 tau / dt)
    I <- I + K (I_code - I),   V <- (1 - K) V

with tau the correlation time of multipath, within which codes are not independent. The first epoch
has V = A: the ionosphere-free pair. I is subtracted from the epoch's code, with whose error its own
is correlated: V / A of its information is from this epoch, so twice (V / A) s_a^2 / (gamma - 1) is
added (exact for the pair: s_a^2 + 2 s_a^2 / (gamma - 1) + A = (gamma^2 s_a^2 + s_b^2) / (gamma -
1)^2). The difference of the codes' delay from the carriers' shows the receiver's noise: with nu =
I_code - I, each with the weight w = min(dt / 2 tau, 1) of an independent one,

    scale^2 = (20 + sum w nu^2 / (A + V)) / (20 + sum w)

multiplies the model's variances of multipath and thermal noise, here and in the ranges.

Both are independent of the receiver's position. The receiver's delay between bands remains in I.

Either carrier shows the path: half a cycle of a data signal (L1 C/A) is open for seconds, while a
pilot is tracked. The joined carrier L grows by that of a, or by that of b over an interval in which
only b is tracked, and begins anew if none is. So a change of carriers opens no ambiguity; it adds

    s_La^2 + s_Lb^2                       at each change: noise of the epoch before, which has both
    ((gamma - 1) dI/dt)^2 T dt            while b serves, advanced by gamma I; T an anchor's age

to the variance of L. For a tracked carrier an epoch has L, its variance s_L^2, and the tracking
time since the satellite's previous epoch; fusiond.aiding.carrier_anchor makes paths from an anchor
epoch of them. s_L comes from a model of C/N0 and a scale, learned in the same way from d(L_a - L_b)
of variance 2 (s_La^2 + s_Lb^2).

The carrier also shows reflections: code minus carrier, d = P_a - L, changes only by 2 dI, (1 +
gamma) dI while b serves, millimetres a second. With D its mean over the last `MEANS_S` of tracking,
m seconds long at first, and s^2 (1 + 1 / m) the variance of d - D, s^2 that of a code by the model
and a scale learned from d (over a slip, which changes D, too, by the Dopplers),

    d - D > 4 s    `multipath`, until d - D < 2 s, two minutes at most
    d - D < -4 s   D was too long

A reflection only makes a code longer: a fall shows that the code was reflected before.

Rejections: of a satellite, `multipath`; of its carrier alone, `lock_lost` (reported by the
receiver) and `cycle_slip` (the carriers diverge by more than the ionosphere explains, or the rate
differs from the Dopplers); of all carriers at once, `clock_jump`.

Source: Hatch, Proc. 3rd Int. Geodetic Symposium on Satellite Doppler Positioning (1982); Groves,
2nd edition, 9.2.7 and 9.3.3; van Graas and Soloviev, Navigation 51 (2004), 277-292.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SIGNAL_VALUES
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

# Columns of the plan: slot of the satellite; wavelengths (m); gamma, 0 without a second signal; d_b
# - d_a (m); variance (m^2) of its error, as a delay; numbers of the pair and of its first signal.
PLAN_COLUMNS = 8
SLOT, LENGTH_A, LENGTH_B, GAMMA, DELAY, DELAY_VARIANCE, PAIR, SIGNAL = range(PLAN_COLUMNS)
# Columns of the receiver's data of a signal, the first or the second
# (drivers.raw.messages.PackedSignals).
P, RATE, CNO, SD, SD_RATE, CYCLES, LOCK = range(SIGNAL_VALUES)
# Columns kept for a satellite, of its first signal and of its pair; a time or number of 0: nothing
# kept. The last: 1 while the second carrier serves.
SLOTS, KEPT_COLUMNS = 3 * 64, 14
(
    _T, _SIGNAL, _L_A, _RATE, _T_PAIR, _PAIR, _L_B, _DELAY, _V, _BESIDE, _MANY, _SINCE, _PATH,
    _SERVES,
) = range(KEPT_COLUMNS)  # fmt: skip
# Slot 0, which no satellite has, holds sums: of w nu^2 / (A + V) and of w; the same for changes of
# two carriers, and for codes minus carriers.
_SUM, _COUNT, _PHASES, _PHASE_COUNT, _CODES, _CODE_COUNT = range(6)
# Columns of the results; NaN: unknown.
OUT_COLUMNS = 7
SLANT, SLANT_VARIANCE, WITH_CODE, CARRIER, SPAN, CARRIER_VARIANCE, GROWN = range(OUT_COLUMNS)
# Refusals of a satellite, or of its carrier, by the number that `follow` writes.
FOLLOWED, LOCK_LOST, CYCLE_SLIP, MULTIPATH = 0, 1, 2, 3
ALL_FOLLOWED, JUMPED, SOME_REFUSED = 0, 1, 2
"""Results of `follow`."""

CODE_M, THERMAL_M, REFERENCE_DB_HZ = 1.2, 0.3, 45.0
"""Constants of `fusiond.gnss.ranges.RangeNoise`. The first is a mean over a uniform sky above 10
deg, where the mean of 1 / sin^2 E is 1 / sin 10 deg."""
PRIOR_COUNT, MOST_COUNT = 20.0, 400.0
"""Weight of that as a number of independent codes, a sky; older than so many are forgotten by
halves: satellites of an hour."""
SCALE_SQUARED = (0.1, 10.0)
"""Limits of the code multipath's scale, squared: antennas from a choke ring to a hand in a street
have 0.15 to 3 m (Groves 9.3.4), the model 0.5."""
PHASE_M, PHASE_THERMAL_M = 0.003, 0.0015
"""Phase noise: multipath that changes from epoch to epoch, of at most 48 mm for a reflection; a
loop of 15 Hz at 45 dB-Hz has 1.2 mm (Groves 9.3.3). A receiver's value is learnt like its codes'
noise, from the difference of two carriers."""
PHASE_LENGTH_M = 0.19
"""Phase noise in wavelengths, by that on L1."""
CLIPPED = 9.0
"""No change of two carriers counts as more than three sigma: a slip is no noise."""
MULTIPATH_S = 60.0
"""Duration of code multipath: minutes at rest, seconds in motion."""
MEANS_S, LEAST_S = 20.0, 5.0
"""Of a code beside its carrier: long against the noise of codes, short against the multipath that
comes and goes with the sky; and what must be known of it."""
MULTIPATH_SIGMAS, BACK_SIGMAS = 4.0, 2.0
"""One in 30,000 sound codes is beyond the first, were codes' noise white."""
LONGEST_S = 2.0
"""Longest interval over which Dopplers detect a slip."""
FORGOTTEN_S = 120.0
"""Interval after which the delay is reset."""
DELAY_RATE_M_S = 0.01
"""Largest rate of a slant delay by itself: ten times the quiet ionosphere's 1 mm/s
(Klobuchar, in Parkinson and Spilker 1996, vol. 1, chapter 12)."""
QUIET_M_S, HELD_S = 0.001, 30.0
"""The quiet ionosphere's own rate, and how long it holds: an anchor's age."""
SLIP_SIGMAS = 4.0
"""Largest difference of two carriers in sigmas of their noise (one in 16,000), beside the
ionosphere's change. A cycle lost on both L1 and L2 changes the difference by 54 mm, on L1 and L5 by
65 mm: detected with noise below 14 mm; smaller changes are left to the filter's innovation."""
SLIP_RATE_M_S = 0.5
"""Largest difference of the mean of two Dopplers and the carrier's rate, or a wavelength over dt if
larger. A hand that swings with 3 m/s^2 twice a second causes 0.2 m/s over 0.25 s."""
JUMP_M_S = 3.0
"""Common part of all satellites beyond their Dopplers: a clock's phase that walks by 0.1 m by the
root of a second makes 0.45 m/s over 50 ms, one set by a millisecond within 2 s 150,000."""


@compiled("f8(f8[:, ::1])")
def scale_squared(kept: Array) -> float:
    """Factor on the model's variances of codes, learned from the receiver."""
    found: float = (PRIOR_COUNT + kept[0, _SUM]) / (PRIOR_COUNT + kept[0, _COUNT])
    return min(max(found, SCALE_SQUARED[0]), SCALE_SQUARED[1])


@compiled("f8(f8)", forceinline=True)
def _weakness(cno: float) -> float:
    """Thermal variance of a signal by that at `REFERENCE_DB_HZ`; 1 where C/N0 is unknown."""
    if math.isnan(cno):
        return 1.0
    found: float = 10.0 ** (0.1 * (REFERENCE_DB_HZ - cno))
    return found


@compiled("f8(f8, f8)", forceinline=True)
def _phase_variance(weak: float, length: float) -> float:
    """Model variance (m^2) of a carrier of a wavelength (m)."""
    turn = length / PHASE_LENGTH_M
    return turn * turn * (PHASE_M * PHASE_M + PHASE_THERMAL_M * PHASE_THERMAL_M * weak)


@compiled("f8(f8, f8, f8)", forceinline=True)
def _code_variance(weak: float, stated: float, scale: float) -> float:
    """Variance (m^2) of a pseudorange at any elevation: `scale` times the model's."""
    found = scale * (CODE_M * CODE_M + THERMAL_M * THERMAL_M * weak)
    if not math.isnan(stated):
        found += stated * stated
    return found


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8, f8, f8, f8[::1])")
def _delay(
    state: Array,
    plan: Array,
    first: Array,
    second: Array,
    weak_a: float,
    weak_b: float,
    span: float,
    change: float,
    scale: float,
    seen: Array,
) -> None:
    """Write the slant delay by this epoch's codes and the carriers' `change` (NaN: none), and add
    to the sums of `seen` codes."""
    more = plan[GAMMA] - 1.0
    code = (second[P] - first[P] - plan[DELAY]) / more
    noise = _code_variance(weak_a, first[SD], scale)
    noise = (noise + _code_variance(weak_b, second[SD], scale)) / (more * more)
    if state[_PAIR] != plan[PAIR] or span > FORGOTTEN_S:
        state[_DELAY], state[_V] = code, noise
        return
    if math.isnan(change):
        state[_V] += (DELAY_RATE_M_S * span) ** 2
    else:
        state[_DELAY] += change / more
        model = _code_variance(weak_a, first[SD], 1.0)
        model = (model + _code_variance(weak_b, second[SD], 1.0)) / (more * more)
        w = min(0.5 * span / MULTIPATH_S, 1.0)
        seen[_SUM] += w * (code - state[_DELAY]) ** 2 / (model + state[_V])
        seen[_COUNT] += w
    r = noise * max(1.0, 2.0 * MULTIPATH_S / span)
    gain = state[_V] / (state[_V] + r)
    state[_DELAY] += gain * (code - state[_DELAY])
    state[_V] *= 1.0 - gain


@compiled("b1(f8[::1], f8[::1], f8, f8, f8, f8, f8, f8, f8[::1])")
def _has_multipath(
    state: Array,
    first: Array,
    weak_a: float,
    length: float,
    now: float,
    span: float,
    slipped: float,
    scale: float,
    seen: Array,
) -> bool:
    """True if the code has diverged from its carrier of `length` (m), which has `slipped` (m; NaN:
    unknown). Adds to the sums of `seen` codes minus carriers."""
    beside, model = first[P] - length, _code_variance(weak_a, first[SD], 1.0)
    state[_BESIDE] -= slipped
    if state[_MANY] == 0.0 or math.isnan(beside) or math.isnan(state[_BESIDE]):
        state[_BESIDE], state[_SINCE] = beside, 0.0
        state[_MANY] = 0.0 if math.isnan(beside) else min(span, 1.0)
        return False
    e, wider = beside - state[_BESIDE], 1.0 + 1.0 / max(state[_MANY], 1.0)
    sigma = math.sqrt(scale * model * wider)
    if state[_SINCE] > 0.0 and e < BACK_SIGMAS * sigma:
        state[_SINCE] = 0.0
    if state[_SINCE] == 0.0 and e > MULTIPATH_SIGMAS * sigma and state[_MANY] >= LEAST_S:
        state[_SINCE] = now
    if state[_SINCE] > 0.0 and now - state[_SINCE] < FORGOTTEN_S:
        return True
    if state[_SINCE] > 0.0 or (e < -MULTIPATH_SIGMAS * sigma and state[_MANY] >= LEAST_S):
        state[_BESIDE], state[_MANY], state[_SINCE] = beside, min(span, 1.0), 0.0
        return False
    w = min(span, 1.0)
    seen[_CODES] += w * min(e * e / (model * wider), CLIPPED * scale)
    seen[_CODE_COUNT] += w
    state[_MANY] = min(state[_MANY] + w, MEANS_S)
    state[_BESIDE] += w / state[_MANY] * e
    return False


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8[::1])", forceinline=True)
def _join(
    state: Array, plan: Array, first: Array, second: Array, span: float, scale: float, out: Array
) -> None:
    """Write the joined carrier, its noise, its tracking time and the growth of its variance."""
    l_a, l_b = first[CYCLES] * plan[LENGTH_A], second[CYCLES] * plan[LENGTH_B]
    by_a, by_b = l_a + (state[_PATH] - state[_L_A]), l_b + (state[_PATH] - state[_L_B])
    known = span <= LONGEST_S and state[_SIGNAL] == plan[SIGNAL]
    a = known and not math.isnan(by_a) and not first[LOCK] < span
    b = known and not math.isnan(by_b) and not second[LOCK] < span
    b = b and state[_PAIR] == plan[PAIR] and state[_T_PAIR] == state[_T]
    of_a = scale * _phase_variance(_weakness(first[CNO]), plan[LENGTH_A])
    of_b = scale * _phase_variance(_weakness(second[CNO]), plan[LENGTH_B])
    serves = not a and (b or math.isnan(l_a))
    out[CARRIER] = by_a if a else by_b if b else l_b if serves else l_a
    out[CARRIER_VARIANCE] = of_b if serves else of_a
    out[SPAN] = max(span, 0.0) if a or b else 0.0
    out[GROWN] = 0.0
    if b and serves:
        out[GROWN] = ((plan[GAMMA] - 1.0) * QUIET_M_S) ** 2 * HELD_S * out[SPAN]
    if out[SPAN] > 0.0 and serves != (state[_SERVES] > 0.0):
        out[GROWN] += of_a + of_b
    if span > 0.0:
        state[_SERVES] = 1.0 if serves else 0.0


@compiled("f8(f8[:, ::1], i8)", forceinline=True)
def _shown(kept: Array, of: int) -> float:
    """Factor by the sums in slot 0 from index `of` on; old sums are halved."""
    if kept[0, of + 1] > MOST_COUNT:
        kept[0, of] *= 0.5
        kept[0, of + 1] *= 0.5
    found: float = (PRIOR_COUNT + kept[0, of]) / (PRIOR_COUNT + kept[0, of + 1])
    return min(max(found, SCALE_SQUARED[0]), SCALE_SQUARED[1])


@compiled("void(f8[::1], f8[::1], f8[::1], f8, f8, f8[::1])")
def _write_rates(
    state: Array, plan: Array, first: Array, weak_a: float, scale: float, out: Array
) -> None:
    """Write the slant delay, its variance, and twice its covariance with the code."""
    if plan[GAMMA] == 0.0 or state[_PAIR] != plan[PAIR] or state[_T] - state[_T_PAIR] > 0.0:
        return
    more = plan[GAMMA] - 1.0
    own = _code_variance(weak_a, first[SD], scale)
    out[SLANT] = state[_DELAY]
    out[SLANT_VARIANCE] = state[_V] + plan[DELAY_VARIANCE]
    # Assumes equal noise of both codes: A = 2 own / more^2.
    part = min(0.5 * state[_V] * more * more / own, 1.0)
    out[WITH_CODE] = 2.0 * part * own / more


@compiled(
    "i8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], i8[::1])", allocates=True
)
def follow(
    kept: Array,
    plan: Array,
    first: Array,
    second: Array,
    now: float,
    out: Array,
    refused: npt.NDArray[np.int64],
) -> int:
    """Process an epoch at `now` (s); returns `ALL_FOLLOWED` or a sum of others.

    `kept` (SLOTS, 14) is changed; `plan` (n, 8), `first` and `second` (n, 7); writes `out` (n, 7)
    and `refused` (n,)."""
    n = plan.shape[0]
    scale, phases, codes = _shown(kept, _SUM), _shown(kept, _PHASES), _shown(kept, _CODES)
    residuals, moved, weak = np.empty(n), np.empty(n), np.empty(n)
    many = 0
    for i in range(n):
        state = kept[int(plan[i, SLOT])]
        refused[i] = FOLLOWED
        for j in range(OUT_COLUMNS):
            out[i, j] = math.nan
        span = now - state[_T]
        weak[i] = _weakness(first[i, CNO])
        _join(state, plan[i], first[i], second[i], span, phases, out[i])
        if out[i, SPAN] == 0.0:
            known = 0.0 < span <= LONGEST_S and state[_SIGNAL] == plan[i, SIGNAL]
            if known and first[i, LOCK] < span and not math.isnan(first[i, CYCLES] * state[_L_A]):
                refused[i] = LOCK_LOST
            continue
        moved[i] = (out[i, CARRIER] - state[_PATH]) / span
        d = moved[i] - 0.5 * (first[i, RATE] + state[_RATE])
        if not math.isnan(d):
            residuals[many] = d
            many += 1
    common = 0.0
    if many > 0:
        ordered = np.sort(residuals[:many])
        common = ordered[many // 2]
    jumped = abs(common) > JUMP_M_S
    for i in range(n):
        state, weak_a = kept[int(plan[i, SLOT])], weak[i]
        span = now - state[_T]
        if span <= 0.0:  # the epoch was processed before
            if state[_SINCE] > 0.0:
                refused[i] = MULTIPATH
            _write_rates(state, plan[i], first[i], weak_a, scale, out[i])
            continue
        path, l_a = out[i, CARRIER], first[i, CYCLES] * plan[i, LENGTH_A]
        pair = plan[i, GAMMA] > 0.0 and not math.isnan(second[i, P])
        l_b = second[i, CYCLES] * plan[i, LENGTH_B]
        change = math.nan
        locked = first[i, LOCK] >= span and second[i, LOCK] >= span
        if pair and locked and state[_PAIR] == plan[i, PAIR] and state[_T_PAIR] == state[_T]:
            change = l_a - l_b - (state[_L_A] - state[_L_B])
        weak_b = _weakness(second[i, CNO])
        noise = _phase_variance(weak_a, plan[i, LENGTH_A])
        noise = 2.0 * (noise + _phase_variance(weak_b, plan[i, LENGTH_B]))
        slipped = abs(change) > SLIP_SIGMAS * math.sqrt(phases * noise) + DELAY_RATE_M_S * span
        if 0.0 < span <= LONGEST_S and not math.isnan(change):
            w = min(span, 1.0)
            kept[0, _PHASES] += w * min(change * change / noise, CLIPPED * phases)
            kept[0, _PHASE_COUNT] += w
        if out[i, SPAN] > 0.0:
            d = moved[i] - 0.5 * (first[i, RATE] + state[_RATE]) - common
            wave = plan[i, LENGTH_B if state[_SERVES] > 0.0 else LENGTH_A]
            if slipped or abs(d) > max(SLIP_RATE_M_S, wave / span):
                refused[i] = CYCLE_SLIP
        lost = 0.0
        if jumped or span > LONGEST_S or state[_SIGNAL] != plan[i, SIGNAL]:
            lost = math.nan
        elif out[i, SPAN] == 0.0 or refused[i] != FOLLOWED:
            rate = 0.5 * (first[i, RATE] + state[_RATE]) + common
            lost = path - state[_PATH] - rate * span
        if _has_multipath(state, first[i], weak_a, path, now, span, lost, codes, kept[0]):
            refused[i] = MULTIPATH
        if jumped or refused[i] != FOLLOWED:
            out[i, SPAN] = 0.0
        if pair:
            if slipped:
                change = math.nan
            since = now - state[_T_PAIR]
            of = weak_a, weak_b, since, change, scale
            _delay(state, plan[i], first[i], second[i], *of, kept[0])
            state[_T_PAIR], state[_PAIR], state[_L_B] = now, plan[i, PAIR], l_b
        state[_T], state[_SIGNAL], state[_L_A] = now, plan[i, SIGNAL], l_a
        state[_RATE], state[_PATH] = first[i, RATE], path
        _write_rates(state, plan[i], first[i], weak_a, scale, out[i])
    found = int(jumped) * JUMPED
    for i in range(n):
        found |= int(refused[i] != FOLLOWED) * SOME_REFUSED
    return found
