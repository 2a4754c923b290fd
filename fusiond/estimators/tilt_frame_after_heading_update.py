r"""Frame of the tilt covariance, when an update changes the heading without a real rotation.

Straight on at one speed, only the sum of tilt and accelerometer bias is known, as it moves the
vehicle. For a computed attitude C with a tilt t (rad, north and east) and a bias error b

    C b - g z x t = 0   to some 1e-3 m/s^2,   g t and b each to 0.1               z down

After an update that turns C by psi about the vertical and leaves t of P in its axes, the next
measurements imply

    R(psi) C b - g z x t = 0

as well. Both hold together only for b = 0: each new heading estimate adds false information on b,
which nothing has measured. An angle of sigma s_a and a bias of sigma s_b make an acceleration of
s_a s_b, which matters once the sum is known as well: for a large b even a heading known to 0.3 deg
does. The error is therefore written in axes that turn with the heading,

    C = R(psi) exp(t x) C^        (as in fusiond.estimators.invariant)

and its transform, once psi is corrected, is t <- R(psi) t, after which only the first sum holds.
The same applies to the down axis, which measures (C b)_D: a tilt correction dt adds dt b_x of
another bias, so the error of b_z is replaced by that of (C b)_D,

    b_z <- ((C b)_D - C+_Dx b_x - C+_Dy b_y) / C+_Dz        C+ after the update

The same applies between two updates. In a real turn C b turns and t does not, which distinguishes
them. A false turn r by the yaw gyro's error turns C b as well, although nothing has turned: in the
axes of C

    t <- R(r) t,      var(r) = P_psi after an interval - P_psi before it

r and t are independent to the first order, and t's covariance grows by var(r) (z x t)(z x t)^T
(TURN_TILT of fusiond.estimators.propagation); once an update removes r from the heading, t is
turned by r, an error of that variance. The same applies to a tilt r that the gyros' errors have
made since the last update: C b turns with the computed C, and an update that removes r leaves (C
b)_D in error,

    var((C b)_D) <- var((C b)_D) + var(r_N) var((C b)_E) + var(r_E) var((C b)_N)

without which vertical velocities on a straight road would show a false tilt. All terms are of
second order: psi b, dt b, r b.

At rest only the estimate C^ turns, by the gyros' noise and by its corrections. Both turns are
known: while the vehicle is known to rest (STEP_RESTS_S of fusiond.navigation.strapdown), each
interval is followed by the T of its turn of C^, in place of the two variances (`rest_axes`). As
noise instead, each velocity added false information on tilt and bias, which cannot be distinguished
at rest: after a doubt, sigma of a tilt fell from 2.8 to 0.7 deg in twenty minutes.

The effect of an update on the estimate itself is of second order, too. With d the third row of C,
tilt and biases of which only the sum is known move the vehicle downward by half of the tilt times
the bias. A correction of the tilt by dt and of the biases by db = g dt changes that by g dt^2 / 2,
always in the same direction, although nothing was measured. So the vertical bias takes the
difference from the change of the biases along the mean of the axes before and after:

    b^_z <- b^_z - (d+ - d) db / (2 d+_z)

Without it, a roll known to 4 deg, corrected by 1 to 3 deg at each of ten fixes of a bend, gave 0.02
m/s^2 and a vertical velocity eight sigma off.

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
from fusiond.estimators.antenna_position_after_attitude_update import antenna_slots
from fusiond.estimators.base import AS_STATED, Outcome
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.gyro_error_after_rate_update import gyro_slots
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.measurement_loop_kernel import UNDOUBTED, Axes
from fusiond.estimators.propagation import TURN_TILT
from fusiond.estimators.tilt_axes_rotation_after_update import (
    ESTIMATE_SIZE,
    carry_over,
    keep_rows,
    may_part,
    remember_estimate,
)
from fusiond.models.model import Model
from fusiond.navigation.error_model import FORCE_ERROR
from fusiond.navigation.strapdown import STEP_RESTS_S

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class TiltAxesFilter(KalmanEstimator):
    """Centralised filter whose tilt axes turn with the heading.

    P keeps three quantities over an update: the tilt in axes that turn with the heading, the gyro
    errors relative to the turn (fusiond.estimators.gyro_error_after_rate_update), and, with an
    estimated lever arm, the antenna's position
    (fusiond.estimators.antenna_position_after_attitude_update)."""

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
        """Subtract a fault's effect of mean (n,) from the state and add its `spread` (n, n) to
        P."""
        self.undoubted = False
        super().adopt(mean, spread)

    def _correct(self, mean: Array) -> None:
        """Subtract a fault's effect (n,) from the state, as an update does, which turns the
        axes."""
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
        """Update by one measurement, or return the reason for its rejection."""
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
        """M (n, k) <- T M for gyro errors and antenna position."""
        keep_rows(rows, before, self.nav, self.xi, self.turned, *self._kept)
