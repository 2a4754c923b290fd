r"""The axes in which a tilt is known, when a heading turns that nobody has seen turn.

Straight on at one speed, tilt and accelerometer bias are known by their sum alone, which moves the
vehicle: of a computed attitude C with a tilt t (rad, north and east) and a bias error b

    C b - g z x t = 0   to some 1e-3 m/s^2,   g t and b each to 0.1               z down

An update that turns C by psi about the vertical and leaves P's t in its axes says next

    R(psi) C b - g z x t = 0

as well, and both at once are true of b = 0 alone: each of the headings that a vehicle is taken to
have tells some more of b, of which nothing was measured. What an angle known to s_a makes of a bias
known to s_b is an acceleration of s_a s_b, and that counts once the sum is known as well: a heading
known to 0.3 deg does it, if b is large. The error is one in the axes that turn with the heading,

    C = R(psi) exp(t x) C^        (as in fusiond.estimators.invariant)

and its transform, once psi is taken out, is t <- R(psi) t, after which the first sum is the only
one. So with the down axis, which knows (C b)_D: a tilt that is corrected by dt puts dt b_x of
another bias there, and what is left of b_z is taken for what is left of (C b)_D,

    b_z <- ((C b)_D - C+_Dx b_x - C+_Dy b_y) / C+_Dz        C+ after the update

So with what lies between two updates. Where the vehicle turns, C b turns with it and t stays, and
that does tell them apart. A turn r that the yaw gyro's error only pretends turns C b just the same,
and nothing has turned: in the axes of C

    t <- R(r) t,      var(r) = P_psi after an interval - P_psi before it

r and t are independent to the first order, and t's covariance grows by var(r) (z x t)(z x t)^T
(TURN_TILT of fusiond.estimators.propagation); once an update takes r out of the heading, t is
turned by as much, though it had not stayed behind: an error of that very variance. So with a tilt
r that only the gyros' errors have made since the last update: C b turns with the computed C, and
an update that takes r out again leaves (C b)_D where that had put it,

    var((C b)_D) <- var((C b)_D) + var(r_N) var((C b)_E) + var(r_E) var((C b)_N)

without which a straight road told a tilt by its vertical velocities. All are of the second order,
psi b, dt b, r b.

At rest nothing turns but C^, by the gyros' noise, and back as updates take that out again. Both are
turns of the estimate, and both are known: while it is known to rest (STEP_RESTS_S of
fusiond.navigation.strapdown) each interval is followed by the T of an update that has turned C^ as
it has, in place of the two variances (`rest_axes`). As a noise, what moved C^ was worth as much as
what corrected it was taken to tell: each velocity told more of tilt and bias, which at rest nothing
can tell apart. After a doubt a tilt known to 2.8 deg was known to 0.7 after twenty minutes.

So is what an update makes of the estimate itself. With d the third row of C, tilt and biases that
hide each other move the vehicle downward by half of the tilt times the bias: a tilt that is
corrected by dt, and biases by db = g dt, change that by g dt^2 / 2 beside what the update has told,
each time in the same direction. A tilt alone, or a bias, changes nothing that was learned with it.
So it is the biases' change along the mean of the axes before and after that has been told:

    b^_z <- b^_z - (d+ - d) db / (2 d+_z)

After a doubt a roll known to 4 deg, corrected by one to three of them at each of ten fixes of a
bend, had made 0.02 m/s^2 of it, and a vertical velocity eight sigma off.

Twelve cars with accelerometers of 50 mg and gyros of 3 deg/s, each
tilt known by its sum with a bias, after a minute and its one bend: NEES a degree 169 of the tilt
and 95 of the velocity without any of this, 1.2 and 0.5 with it.

Source: Solà, Quaternion kinematics for the error-state Kalman filter (2017), section 6.3, for the
transform of a covariance on reset; Huang, Mourikis, Roumeliotis, IJRR 29 (2010), 502, for what a
filter learns from linearising about headings that differ; Bar-Shalom, Li, Kirubarajan (2001),
section 10.3.2, for the second-order filter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.estimators.antenna_place import antenna_slots, keep_antenna
from fusiond.estimators.base import AS_STATED, Outcome
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.propagation import TURN_TILT
from fusiond.estimators.turn_rate import gyro_slots, keep_turn
from fusiond.estimators.turned_axes import UPRIGHT
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import FORCE_ERROR, PHI
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import NAV_SIZE, Q0, STEP_RESTS_S

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Below this (m/s^2) of s_a s_b it is left: velocities good to 0.1 m/s show an acceleration of 2e-3
# within a minute, and no update of a vehicle that knows its tilt pays for it.
SLIGHT_M_S2 = 1e-4


@compiled("f8(f8[::1], f8[::1])")
def heading_turn(before: Array, after: Array) -> float:
    """By how much (rad) about the vertical an attitude q_nb (4,) was turned to another."""
    w, x, y, z = before[0], before[1], before[2], before[3]
    to_w, to_x, to_y, to_z = after[0], after[1], after[2], after[3]
    along = w * to_w + x * to_x + y * to_y + z * to_z
    about = w * to_z - z * to_w + x * to_y - y * to_x
    psi = 2.0 * math.atan2(about, along)
    return psi - 2.0 * math.pi * round(psi / (2.0 * math.pi))


@compiled("void(f8[:, :], f8[::1], f8[::1], i8[::1], i8[::1])")
def keep_down_rows(m: Array, before: Array, after: Array, slots: Indices, axes: Indices) -> None:
    """M (n, k) <- T M: (C b)_D stays as it was known of the attitude q_nb (4,) `before`, in those
    of the one `after`; `slots` and `axes` as for `turn_rows`."""
    old, new = dcm_elements(before), dcm_elements(after)
    if slots.size == 0 or abs(new[8]) < UPRIGHT:
        return
    for k in range(m.shape[1]):
        left = 0.0
        for j in range(slots.size):
            axis = 6 + axes[j]
            left += (old[axis] - new[axis]) * m[slots[j], k]
        m[slots[0], k] += left / new[8]


@compiled("void(f8[:, :], f8[::1], f8[::1], i8[::1], i8[::1])")
def turn_rows(m: Array, before: Array, after: Array, slots: Indices, axes: Indices) -> None:
    """M (n, k) <- T M: as well as tilt and force biases together were known of the attitude q_nb
    (4,) `before`, they are of the one `after` with T P T^T.

    `slots` (j,) of the force biases and their `axes`, the first of them the one of the vertical
    axis that takes what is left; empty where a model has none.
    """
    psi = heading_turn(before, after)
    c, s = math.cos(psi), math.sin(psi)
    for k in range(m.shape[1]):
        north, east = m[PHI, k], m[PHI + 1, k]
        m[PHI, k] = c * north - s * east
        m[PHI + 1, k] = s * north + c * east
    keep_down_rows(m, before, after, slots, axes)


@compiled("b1(f8[:, :], i8[::1])")
def may_part(p: Array, slots: Indices) -> bool:
    """True if an update may tell tilt and force biases, the `slots` (j,) of P (n, n), apart that
    nothing has told apart."""
    if slots.size == 0:
        return False
    tilt = max(p[PHI, PHI], p[PHI + 1, PHI + 1])
    force = STANDARD_GRAVITY_M_S2**2 * p[PHI + 2, PHI + 2]
    for slot in slots:
        force = max(force, p[slot, slot])
    apart: bool = tilt * force > SLIGHT_M_S2**2
    return apart


@compiled("f8(f8[:, :], f8[::1], f8[::1], i8[:, ::1])")
def carry_over(p: Array, before: Array, after: Array, biases: Indices) -> float:
    """P (n, n) after an update that has turned the attitude q_nb (4,) `before` to `after`, which is
    by so much (rad) about the vertical."""
    turn_rows(p, before, after, biases[0], biases[1])
    turn_rows(p.T, before, after, biases[0], biases[1])
    return heading_turn(before, after)


# An estimate before an update: nav, the gyros' biases, what is left of a lever arm, the force
# biases; behind it what the update has told of the gyros, and the lever then.
_GYROS, _ARM, _FORCES, _TOLD, _ARM_AFTER, ESTIMATE_SIZE = NAV_SIZE, 13, 16, 19, 22, 25


@compiled("void(f8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], f8[::1])")
def remember_estimate(
    nav: Array, xi: Array, biases: Indices, gyros: Indices, lever: Indices, before: Array
) -> None:
    """Write `before` (25,) of nav (10,) and of the slots (0 to 3,) in xi (n,), those of the force
    `biases` with their axes (2, k)."""
    for j in range(NAV_SIZE):
        before[j] = nav[j]
    for j in range(biases.shape[1]):
        before[_FORCES + j] = xi[biases[0, j]]
    for j in range(gyros.size):
        before[_GYROS + j] = xi[gyros[j]]
    for j in range(lever.size):
        before[_ARM + j] = xi[lever[j]]


@compiled("void(f8[:, :], f8[::1], f8[::1], f8[::1], f8, i8[::1], i8[::1], i8[::1])")
def keep_rows(
    m: Array,
    before: Array,
    nav: Array,
    xi: Array,
    turned: float,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> None:
    """M (n, k) <- T M after an update of an estimate `before`, which has `turned` the axes (rad):
    what is known of the gyros, and of the antenna's place."""
    if gyros.size:
        told = before[_TOLD:_ARM_AFTER]
        for j in range(3):
            told[j] = xi[gyros[j]] - before[_GYROS + j]
        keep_turn(m, before[Q0:NAV_SIZE], nav[Q0:], turned, told, gyros)
    if lever.size:
        after = before[_ARM_AFTER:ESTIMATE_SIZE]
        for j in range(3):
            after[j] = xi[lever[j]]
        keep_antenna(m, before[:NAV_SIZE], nav, before[_ARM:_TOLD], after, lever, late)


@compiled("void(f8[::1], f8[::1], f8[::1], i8[:, ::1])")
def keep_downward(before: Array, nav: Array, xi: Array, biases: Indices) -> None:
    """Share of an update in xi's force `biases` downward, along the mean of the axes before and
    after: the vertical bias takes the difference."""
    if biases.shape[1] == 0:
        return
    old, new = dcm_elements(before[Q0:NAV_SIZE]), dcm_elements(nav[Q0:])
    if abs(new[8]) < UPRIGHT:
        return
    beyond = 0.0
    for j in range(biases.shape[1]):
        axis = 6 + biases[1, j]
        beyond += 0.5 * (new[axis] - old[axis]) * (xi[biases[0, j]] - before[_FORCES + j])
    xi[biases[0, 0]] -= beyond / new[8]


@compiled("f8(f8[:, :], f8[::1], f8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1])")
def carry_over_all(
    p: Array,
    before: Array,
    nav: Array,
    xi: Array,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> float:
    """`carry_over` of P (n, n), and `keep_rows` of it; `keep_downward` of xi (n,)."""
    keep_downward(before, nav, xi, biases)
    turned = carry_over(p, before[Q0:NAV_SIZE], nav[Q0:], biases)
    keep_rows(p, before, nav, xi, turned, gyros, lever, late)
    keep_rows(p.T, before, nav, xi, turned, gyros, lever, late)
    return turned


@compiled("void(f8[:, :], f8[::1], f8[::1], f8[::1], f8, i8[:, ::1], i8[::1], i8[::1], i8[::1])")
def carry_over_rows(
    m: Array,
    before: Array,
    nav: Array,
    xi: Array,
    turned: float,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> None:
    """V <- T V for sensitivities (n, k), as `carry_over_all` does P."""
    turn_rows(m, before[Q0:NAV_SIZE], nav[Q0:], biases[0], biases[1])
    keep_rows(m, before, nav, xi, turned, gyros, lever, late)


class TiltAxesFilter(KalmanEstimator):
    """The centralised filter, in whose P the axes of a tilt turn with the heading, what is known of
    the gyros stays with the turn that it is known of (fusiond.estimators.turn_rate), and the place
    of an antenna where a lever arm is estimated (fusiond.estimators.antenna_place)."""

    def __init__(self, model: Model, gap_s: float, faults: FaultTable = NO_FAULTS) -> None:
        super().__init__(model, gap_s, faults=faults)
        # Slots and axes, the vertical one first: without it there is none to take what is left.
        found = [
            (slot, axis) for axis in (2, 0, 1) for slot in model.parameters(FORCE_ERROR + axis)
        ]
        known = found if found and found[0][1] == 2 else []
        self._biases = np.array(known, dtype=np.int64).reshape(-1, 2).T.copy()
        self._slots = self._biases[0]
        self._gyros = gyro_slots(model) if known else self._slots
        self._lever, self._late = antenna_slots(model)
        self._astray = self._lever.size > 0
        self.turns = False
        """True if the heading may be far off, and updates are another kind's."""
        self.undoubted = True
        """True if what gyros are wrong by is what they were wrong by when the filter started."""
        if known:
            self._options |= TURN_TILT

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self.undoubted = True

    def adopt(self, mean: Array, spread: Array) -> None:
        """Take a fault's effect out of the state: its mean (n,), and P grows by `spread` (n, n)."""
        super().adopt(mean, spread)
        self.undoubted = False

    def update(self, aid: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Fold one aid in, or name why not."""
        if self.turns and not self._holding:
            return self._turn_in(aid)
        self.turned = 0.0
        if self._holding or not (self._astray or may_part(self._covariance, self._slots)):
            return self._fold_in(aid, noise)
        before = self._estimate()
        outcome = self._fold_in(aid, noise)
        if outcome.name == "fused":
            self._carry_over(before)
        return outcome

    def _turn_in(self, aid: Linearised) -> Outcome:
        """The same while the heading may be far off."""
        raise NotImplementedError

    def release(self) -> None:
        """Feed back what was carried."""
        before = self._estimate()
        apart = self._astray or may_part(self._covariance, self._slots)
        super().release()
        if apart:
            self._carry_over(before)

    def _estimate(self) -> Array:
        """As `remember_estimate` writes it."""
        before = np.empty(ESTIMATE_SIZE)
        remember_estimate(self.nav, self.xi, self._biases, self._gyros, self._lever, before)
        return before

    def _carry_over(self, before: Array) -> None:
        """P after an update of an `_estimate` `before`."""
        slots = self._biases, *self._kept
        self.turned = carry_over_all(self._covariance, before, self.nav, self.xi, *slots)
        if self.hypotheses is not None:
            v = self.hypotheses.sensitivities
            carry_over_rows(v, before, self.nav, self.xi, self.turned, *slots)

    @property
    def _keeps_turn(self) -> bool:
        """At rest a turn of C^ is a known one, of which updates need tell P nothing."""
        return self.undoubted and self.step.item(STEP_RESTS_S) == 0.0

    @property
    def _kept(self) -> tuple[Indices, Indices, Indices]:
        gyros = self._gyros if self._keeps_turn else self._gyros[:0]
        return gyros, self._lever, self._late

    def _keep(self, rows: Array, before: Array) -> None:
        """M (n, k) <- T M: what is known of the gyros, and of the antenna's place."""
        keep_rows(rows, before, self.nav, self.xi, self.turned, *self._kept)
