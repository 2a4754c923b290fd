r"""What the carriers of a satellite tell from epoch to epoch: its slant delay, and how far it moved.

Two signals a and b of one satellite, P in m with their group delays d taken off, carriers L in m,
gamma = (f_a / f_b)^2; I the ionosphere's delay at f_a:

    P_b - P_a = (gamma - 1) I + code noise            L_a - L_b = (gamma - 1) I + constant
    I_code    = (P_b - P_a) / (gamma - 1),            A = (s_a^2 + s_b^2) / (gamma - 1)^2

so the carriers say to millimetres how I changes, the codes what it is: a filter of one state,

    I <- I + d(L_a - L_b) / (gamma - 1),     K = V / (V + R),  R = A max(1, 2 tau / dt)
    I <- I + K (I_code - I),   V <- (1 - K) V

with tau for how long multipath lasts: codes closer together are not worth more. The first epoch has
V = A: the ionosphere-free pair. I errs with the code of the epoch, by which it is then subtracted
from P_a: V / A of what it knows is of this epoch, so twice (V / A) s_a^2 / (gamma - 1) is added
(exact for the pair: s_a^2 + 2 s_a^2 / (gamma - 1) + A = (gamma^2 s_a^2 + s_b^2) / (gamma - 1)^2).
Neither depends on where the receiver is; what it delays between bands is left in I.

The way from epoch to epoch, as a rate (m/s), and its variance:

    (L_a(t) - L_a(t - dt)) / dt = mean range rate + clock,   2 s_L^2 / dt^2

Refused, of each satellite: `lock_lost` (the receiver says so), `cycle_slip` (the carriers part by
more than the ionosphere can, or the rate is not that of the Dopplers); of all at once: `clock_jump`.

Source: Hatch, Proc. 3rd Int. Geodetic Symposium on Satellite Doppler Positioning (1982); Groves,
2nd edition, 9.2.7 and 9.3.3; van Graas and Soloviev, Navigation 51 (2004), 277-292.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

# What the plan says of each row: slot of the satellite; wavelengths (m); gamma, 0 without a second
# signal; d_b - d_a (m); variance (m^2) of what stays unknown of it, as a delay; number of the pair.
PLAN_COLUMNS = 7
SLOT, LENGTH_A, LENGTH_B, GAMMA, DELAY, DELAY_VARIANCE, PAIR = range(PLAN_COLUMNS)
# What the receiver says: of the first signal, of the second.
FIRST_COLUMNS, SECOND_COLUMNS = 7, 5
P_A, RATE, CNO, SD_A, SD_RATE, CARRIER_A, LOCK_A = range(FIRST_COLUMNS)
P_B, CNO_B, SD_B, CARRIER_B, LOCK_B = range(SECOND_COLUMNS)
# What is kept of a satellite; time 0: nothing.
SLOTS, KEPT_COLUMNS = 3 * 64, 7
_T, _L_A, _L_AB, _PAIR, _DELAY, _V, _RATE = range(KEPT_COLUMNS)
# What comes out; NaN: nothing known.
OUT_COLUMNS = 6
SLANT, SLANT_VARIANCE, WITH_CODE, MOVED, SPAN, MOVED_VARIANCE = range(OUT_COLUMNS)
# Refusals of a satellite's carrier, by what `follow` writes.
FOLLOWED, LOCK_LOST, CYCLE_SLIP = 0, 1, 2

CODE_M, THERMAL_M, REFERENCE_DB_HZ = 0.5, 0.3, 45.0
"""As `fusiond.gnss.ranges.RangeNoise`, which has the elevation beside it."""
PHASE_M, PHASE_THERMAL_M = 0.003, 0.0015
"""Multipath that changes from epoch to epoch, of 48 mm that a reflection can make at most; a loop
of 15 Hz at 45 dB-Hz has 1.2 mm (Groves 9.3.3)."""
MULTIPATH_S = 60.0
"""For how long multipath of code lasts: minutes at rest, seconds on the move."""
LONGEST_S = 2.0
"""Beyond this the way between two epochs says little of the velocity at its end."""
FORGOTTEN_S = 120.0
"""After this the delay begins anew."""
DELAY_RATE_M_S = 0.01
"""How fast a slant delay changes at most by itself: ten times the quiet ionosphere's 1 mm/s
(Klobuchar, in Parkinson and Spilker 1996, vol. 1, chapter 12)."""
SLIP_M = 0.03
"""One cycle lost on both of L1 and L2 parts the carriers by 54 mm, L1 and L5 by 65 mm; noise of
four carriers is 7 mm."""
SLIP_RATE_M_S = 0.5
"""Between the mean of two Dopplers and the carrier's rate. A hand that swings with 3 m/s^2 twice a
second leaves 0.2 m/s over 0.25 s."""
JUMP_M_S = 3.0
"""What all satellites share beyond their Dopplers: three sigma of the filter's `carrier_clock`
(fusiond.navigator.intake.raw). A clock set by a millisecond within 2 s gives 150,000."""


@compiled("f8(f8, f8)", forceinline=True)
def _code_variance(cno: float, stated: float) -> float:
    """Of a pseudorange (m^2), wherever the satellite stands."""
    weak = 1.0
    if not math.isnan(cno):
        weak = 10.0 ** (0.1 * (REFERENCE_DB_HZ - cno))
    found = CODE_M * CODE_M + THERMAL_M * THERMAL_M * weak
    if not math.isnan(stated):
        found += stated * stated
    return found


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8, f8)")
def _delay(
    state: Array, plan: Array, first: Array, second: Array, span: float, change: float
) -> None:
    """The slant delay with this epoch's codes and with the carriers' `change`; NaN: none."""
    more = plan[GAMMA] - 1.0
    code = (second[P_B] - first[P_A] - plan[DELAY]) / more
    noise = _code_variance(first[CNO], first[SD_A]) + _code_variance(second[CNO_B], second[SD_B])
    noise /= more * more
    if state[_PAIR] != plan[PAIR] or span > FORGOTTEN_S:
        state[_DELAY], state[_V] = code, noise
        return
    if math.isnan(change):
        state[_V] += (DELAY_RATE_M_S * span) ** 2
    else:
        state[_DELAY] += change / more
    r = noise * max(1.0, 2.0 * MULTIPATH_S / span)
    gain = state[_V] / (state[_V] + r)
    state[_DELAY] += gain * (code - state[_DELAY])
    state[_V] *= 1.0 - gain


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1])")
def _tell(state: Array, plan: Array, first: Array, out: Array) -> None:
    """The slant delay, its variance, and twice its covariance with the code."""
    if state[_PAIR] == 0.0 or state[_PAIR] != plan[PAIR]:
        return
    more = plan[GAMMA] - 1.0
    own = _code_variance(first[CNO], first[SD_A])
    out[SLANT] = state[_DELAY]
    out[SLANT_VARIANCE] = state[_V] + plan[DELAY_VARIANCE]
    # As if both codes were of one noise: A = 2 own / more^2.
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
    """Take in an epoch at `now` (s); whether the clock jumped. `kept` (SLOTS, 7) is changed; `plan`
    (n, 7), `first` (n, 7), `second` (n, 5); writes `out` (n, 6) and `refused` (n,)."""
    n = plan.shape[0]
    apart = np.empty(n)
    many = 0
    for i in range(n):
        state = kept[int(plan[i, SLOT])]
        refused[i] = FOLLOWED
        for j in range(OUT_COLUMNS):
            out[i, j] = math.nan
        out[i, SPAN] = 0.0
        span = now - state[_T]
        l_a = first[i, CARRIER_A] * plan[i, LENGTH_A]
        weak = 1.0
        if not math.isnan(first[i, CNO]):
            weak = 10.0 ** (0.1 * (REFERENCE_DB_HZ - first[i, CNO]))
        if not (0.0 < span <= LONGEST_S) or math.isnan(l_a) or math.isnan(state[_L_A]):
            continue
        if first[i, LOCK_A] < span:
            refused[i] = LOCK_LOST
            continue
        moved = (l_a - state[_L_A]) / span
        out[i, MOVED], out[i, SPAN] = moved, span
        phase = PHASE_M * PHASE_M + PHASE_THERMAL_M * PHASE_THERMAL_M * weak
        out[i, MOVED_VARIANCE] = 2.0 * phase / (span * span)
        d = moved - 0.5 * (first[i, RATE] + state[_RATE])
        if not math.isnan(d):
            apart[many] = d
            many += 1
    common = 0.0
    if many > 0:
        ordered = np.sort(apart[:many])
        common = ordered[many // 2]
    jumped = abs(common) > JUMP_M_S
    for i in range(n):
        state = kept[int(plan[i, SLOT])]
        span = now - state[_T]
        if span <= 0.0:  # seen already
            _tell(state, plan[i], first[i], out[i])
            continue
        l_a = first[i, CARRIER_A] * plan[i, LENGTH_A]
        pair = plan[i, GAMMA] > 0.0 and not math.isnan(second[i, P_B])
        l_ab = math.nan
        if pair:
            l_ab = l_a - second[i, CARRIER_B] * plan[i, LENGTH_B]
        change = math.nan
        locked = first[i, LOCK_A] >= span and second[i, LOCK_B] >= span
        if pair and state[_PAIR] == plan[i, PAIR] and locked:
            change = l_ab - state[_L_AB]
        slipped = abs(change) > SLIP_M + DELAY_RATE_M_S * span
        if out[i, SPAN] > 0.0:
            d = out[i, MOVED] - 0.5 * (first[i, RATE] + state[_RATE]) - common
            if slipped or abs(d) > SLIP_RATE_M_S:
                refused[i] = CYCLE_SLIP
        if jumped or refused[i] != FOLLOWED:
            out[i, MOVED], out[i, SPAN] = math.nan, 0.0
        if pair:
            _delay(state, plan[i], first[i], second[i], span, math.nan if slipped else change)
        state[_T], state[_L_A], state[_L_AB], state[_RATE] = now, l_a, l_ab, first[i, RATE]
        state[_PAIR] = plan[i, PAIR] if pair else 0.0
        _tell(state, plan[i], first[i], out[i])
    return int(jumped)
