r"""Frame of the tilt covariance, when an update changes the heading without a real rotation.

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

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.estimators.base import AS_STATED, Outcome
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.gyro_error_of_update import gyro_slots
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.propagation import TURN_TILT
from fusiond.estimators.row_kernels import UNDOUBTED, Axes
from fusiond.estimators.tilt_axes_update import (
    ESTIMATE_SIZE,
    carry_over,
    keep_rows,
    may_part,
    remember_estimate,
)
from fusiond.estimators.unknown_lever_arm import antenna_slots
from fusiond.models.model import Model
from fusiond.navigation.error_model import FORCE_ERROR
from fusiond.navigation.strapdown import STEP_RESTS_S

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class TiltAxesFilter(KalmanEstimator):
    """Centralised filter that carries the tilt's axes along with the heading.

    In its P the axes of a tilt turn with the heading, the gyros' part stays with the turn that it
    is known of (fusiond.estimators.gyro_error_of_update), and, where a lever arm is estimated, so
    does the place of an antenna (fusiond.estimators.unknown_lever_arm)."""

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
        self._lever, self._time = antenna_slots(model)
        self._astray = self._lever.size > 0
        self._run_by(Axes(self._biases, self._gyros, self._lever, self._time))
        self.undoubted = True
        if known:
            self.kernel_options |= TURN_TILT

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self.undoubted = True

    def adopt(self, mean: Array, spread: Array) -> None:
        """Take a fault's effect out of the state: its mean (n,), and P grows by `spread` (n, n)."""
        self.undoubted = False
        super().adopt(mean, spread)

    def _correct(self, mean: Array) -> None:
        """Take a fault's effect (n,) out of the state, as an update does: it turns the axes."""
        before = self._estimate()
        super()._correct(mean)
        self._carry_over(before)

    @property
    def undoubted(self) -> bool:
        """True if the gyro errors are still those of the filter's start."""
        return self._knows.item(UNDOUBTED) > 0.0

    @undoubted.setter
    def undoubted(self, true: bool) -> None:
        self._knows[UNDOUBTED] = true

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Fold one measurement in, or name why not."""
        if self.turns and not self._holding:
            return self._turn_in(measurement)
        self.turned = 0.0
        if self._holding or not (self._astray or may_part(self._covariance, self._slots)):
            return super().update(measurement, noise)
        before = self._estimate()
        outcome = self._fold_in(measurement, noise)
        if outcome.name == "fused":
            self._carry_over(before)
        self._leave(measurement, outcome.rows)
        return outcome

    def _turn_in(self, measurement: Linearised) -> Outcome:
        """Update while the heading may be far off."""
        raise NotImplementedError

    def release(self) -> None:
        """Feed back the held estimate."""
        before = self._estimate()
        carries = self._astray or may_part(self._covariance, self._slots)
        super().release()
        if carries:
            self._carry_over(before)

    def _estimate(self) -> Array:
        """Estimate in the form of `remember_estimate`."""
        before = np.empty(ESTIMATE_SIZE)
        remember_estimate(self.nav, self.xi, self._biases, self._gyros, self._lever, before)
        return before

    def _carry_over(self, before: Array) -> None:
        """P after an update of an `_estimate` `before`."""
        of, slots = (self._memory.bank, before, self.nav, self.xi), (self._biases, *self._kept)
        self.turned = carry_over(self._cov, self.model.size, *of, *slots)

    @property
    def _keeps_turn(self) -> bool:
        """True at rest, where a turn of C^ is known and P needs no correction."""
        return self.undoubted and self.step.item(STEP_RESTS_S) == 0.0

    @property
    def _kept(self) -> tuple[Indices, Indices, Indices]:
        gyros = self._gyros if self._keeps_turn else self._gyros[:0]
        return gyros, self._lever, self._time

    def _keep(self, rows: Array, before: Array) -> None:
        """M (n, k) <- T M: what is known of the gyros, and of the antenna's place."""
        keep_rows(rows, before, self.nav, self.xi, self.turned, *self._kept)
