r"""Error-state filter in invariant coordinates, consistent under a large heading error.

A heading error turns the preintegrated motion: a vehicle that has driven off in an unknown
direction is somewhere on an arc. In dx that distribution is curved; in xi it is normal. For a
computed state with attitude C^, velocity v^ and position p^:

    C = E C^                               E = R(psi) exp(t x), R a turn about the vertical
    v = v^ - v_t + E v_t - R eta_v
    p = p^ - p_t + E p_t - R eta_p

xi = (t_n, t_e, psi, eta_v, eta_p, parameters), psi of any size. v_t and p_t are the parts of
velocity and position that turn with the heading, from P by regression on psi,

    cov(dv, psi) / var(psi) = v_t x z,   cov(dr, psi) / var(psi) = p_t x z        z down

because a solution of the equations of motion, turned about the vertical, is a solution again
(gravity is down; apart from the Earth's rate), which F accumulates in P. From rest v_t = v^ and p_t
is the path since, and xi is the right-invariant error of the group SE_2(3) about the place of
departure, in which the distribution stays exactly normal. Measured north and east components do not
turn: their v_t and p_t are 0, and no fix at rest shows a heading. (The invariant error proper turns
everything, the noise of the fixes, too; a Gauss-Newton step then finds a heading in it.)

Once the heading is known to `WIDE_SD_RAD`, v_t is v^: the vehicle moves forward, and its speed
turns, v = E (v^ - eta_v) with eta_v of any size. The no-slip constraint (C^T v) is then linear in
eta_v at any speed and heading. In the plain error it depends on a speed that the next fix may
double, and makes heading and pitch too certain. To first order, at the state of xi_i,

    dx = J_i xi,   dv = R eta_v + [E v_t x] R phi,   dr = R eta_p + [E p_t x] R phi

with E (v_t - eta_v) in place of E v_t, and E eta_v, if v_t is the speed. Parts that do not turn
keep the axes of the estimate: R in R eta is that of xi_i and has no slope by psi. Between updates P
is that of dx, so kernels and measurements are those of every filter. An update runs in xi about the
prior state and is linearised about the resulting one (Gauss-Newton): with P_xi = J_0^-1 P J_0^-T

    nu_i = z(x_i) + H_i J_i xi_i,   xi_(i+1) = K_i nu_i,   P = J_i P_xi J_i^T  after it

the covariance transform of an error that is reset, without which tilt and velocity errors would,
after a correction of 90 deg, be correlated with the sensor errors of the wrong axes (the downward
effect of force biases does not change, either: fusiond.estimators.tilt_frame_after_heading_update).
Gauss-Newton finds a heading error of up to 150 deg; for a larger sigma it starts at four headings,
and the likeliest result is used.

If the model has the IMU's mounting m against the vehicle, C is the vehicle's attitude, C_nb exp[m
x]^T, as the vehicle does not slide; the IMU's own error is then

    phi_nb = phi + C dm

without which each change of speed would seem to distinguish m from the heading.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE TAC 62
(2017), eq. 8 and section IV; Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton
method, IEEE TAC 38 (1993), eq. 13.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable, State
from fusiond.estimators.base import AS_STATED, Outcome, gate_threshold
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.invariant_error import (
    about_down,
    mount,
    rotation_vector,
    solve,
    take_out,
    turn_step,
    vehicle_axes,
    write_jacobian,
)
from fusiond.estimators.measurement_loop_kernel import KNOWN, LARGE, PLAIN, SETTLES, UNDOUBTED
from fusiond.estimators.robust import reweighted
from fusiond.estimators.tilt_axes_rotation_after_update import keep_down_rows, keep_downward
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.models.blocks import CARRIER_ANCHOR
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import MOUNTING
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.error_model import DR, DV, PHI
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

Array = NDArray[np.float64]

# Steps of Gauss-Newton at most, and the step, in sigmas, that ends them: what is left is a
# hundredth of the variance. A heading that is off by d comes back by sin d in one: from 150 deg
# in six.
ITERATIONS, CONVERGED = 8, 0.1
# Beyond this sigma of the heading 150 deg are less than five sigma.
WIDE_SD_RAD = math.radians(30.0)
# Where else it is begun then, if the heading's variance falls by more than a hundredth.
BEGINNINGS_RAD = (0.5 * math.pi, -0.5 * math.pi, math.pi)
PROBABILITY = 0.99
# What was felt is motion beyond so many sigmas of what does not turn.
SENSED_SIGMAS = 1.0
# Below this sigma of the heading both coordinates say the same: at 15 m/s the velocity across is
# known to 0.5 m/s, and a speed that is off by a tenth changes what no slip says by 5 cm/s.
PLAIN_SD_RAD = math.radians(2.0)
# Above this sigma of the heading, as after a unit that has turned in its mount, they do not: a
# correction of 12 deg in a bend at 20 m/s leaves 0.04 m/s^2 in the bias of an accelerometer.
LARGE_SD_RAD = 2.0 * PLAIN_SD_RAD
_OF_STATE = [KNOWN, UNDOUBTED]  # part of `_knows` in a snapshot


class Turning(NamedTuple):
    """Parts of velocity and position that turn with the heading; `speeds`: the velocity part is the
    speed, changed by an error of the velocity."""

    velocity: Array
    place: Array
    speeds: bool


class Sought(NamedTuple):
    """Result of an update: the error xi (n,), P_xi (n, n) after it, the innovation and its gate;
    the outcome of each row of a screened measurement."""

    error: Array
    covariance: Array
    nis: float
    passed: bool
    log_likelihood: float
    whitened: tuple[float, ...]
    rows: tuple[int, ...] = ()

    @property
    def degrees(self) -> int:
        """Number of rows that count."""
        return self.rows.count(KEPT) if self.rows else len(self.whitened)

    def likelier(self, other: Sought) -> bool:
        """True if more rows fit, or the same number with a better fit."""
        return (-self.degrees, self.nis) < (-other.degrees, other.nis)


class InvariantFilter(TiltAxesFilter):
    """Centralised filter whose updates run in xi while it `turns`.

    A filter that `settles` stops turning once the heading is known to `PLAIN_SD_RAD`, and turns
    again if sigma later exceeds `LARGE_SD_RAD`, as after the removal of a fault or a bend with a
    silent inertial unit.
    """

    def __init__(
        self, model: Model, gap_s: float, settles: bool = True, faults: FaultTable = NO_FAULTS
    ) -> None:
        super().__init__(model, gap_s, faults)
        self._settles = settles
        self._mounts = model.indices[MOUNTING]
        self._clone = model.indices[CARRIER_ANCHOR]
        self._knows[[SETTLES, PLAIN, LARGE]] = settles, PLAIN_SD_RAD**2, LARGE_SD_RAD**2
        self._bent = False
        """True if the bank has missed updates: of a heading so wide that no effect is linear."""
        self.log_likelihood = 0.0
        """Log likelihood of the last innovation, without a constant common to all filters. A gated
        one counts as at the gate, since the measurement may be wrong."""

    @property
    def heading_known(self) -> bool:
        """True if the heading has been known since the start, to `PLAIN_SD_RAD`."""
        return self._knows.item(KNOWN) > 0.0

    @heading_known.setter
    def heading_known(self, true: bool) -> None:
        self._knows[KNOWN] = true

    def of_vehicle(self, nav: Array, xi: Array, sign: float = 1.0) -> Array:
        """M (n, n): conversion from dx with the vehicle's attitude error to the IMU's; with -1 the
        inverse."""
        m = np.eye(self.model.size)
        mount(m, nav, xi, self._mounts, self.model.active, sign)
        return m

    def turning(self, nav: Array, p: Array) -> Turning:
        """Turning part for a state (10,) and P (n, n) whose attitude error is the vehicle's."""
        variance = float(p[PHI + 2, PHI + 2])
        n, e, _, y, x, _ = p[DV : DR + 3, PHI + 2] / max(variance, 1e-12)
        place = np.array([-x, y, 0.0])
        if variance > WIDE_SD_RAD**2:
            return Turning(np.array([-e, n, 0.0]), place, False)
        return Turning(nav[VN : VN + 3].copy(), place, True)

    def jacobian(self, error: Array, turning: Turning) -> Array:
        """J (n, n) at the state that an error (n,) leads to; attitude errors are the vehicle's."""
        j = np.empty((self.model.size, self.model.size))
        write_jacobian(error, *turning, j)
        return j

    def straight(self, turning: Turning) -> Array:
        """J^-1 (n, n) at no error."""
        nothing = np.zeros(self.model.size)
        return 2.0 * np.eye(self.model.size) - self.jacobian(nothing, turning)

    def without(self, nav: Array, xi: Array, error: Array, turning: Turning) -> tuple[Array, Array]:
        """State (10,) and parameters (n,) minus an `error` (n,) in xi."""
        nav, xi = nav.copy(), xi.copy()
        take_out(nav, xi, error, *turning, self._mounts, self.model.active)
        return nav, xi

    def _to_dx(self, nav: Array, xi: Array, error: Array, turning: Turning) -> Array:
        """Matrix M J (n, n) at the state that an error (n,) leads to."""
        j = self.jacobian(error, turning)
        mount(j, nav, xi, self._mounts, self.model.active, 1.0)
        return j

    def between(self, nav: Array, xi: Array, turning: Turning) -> Array:
        """Error (n,) in xi of this filter's state relative to another's."""
        mine, true = np.empty((3, 3)), np.empty((3, 3))
        vehicle_axes(self.nav, self.xi, self._mounts, mine)
        vehicle_axes(nav, xi, self._mounts, true)
        error, turn = xi - self.xi, true @ mine.T
        psi = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        back, tilt = np.empty((3, 3)), np.empty(3)
        about_down(-psi, back)
        rotation_vector(back @ turn, tilt)
        error[PHI : PHI + 2], error[PHI + 2] = tilt[:2], psi
        differences = self.nav[VN : VN + 3] - nav[VN : VN + 3], _way(nav, self.nav)
        for first, d, part in zip((DV, DR), differences, turning[:2], strict=True):
            axes = turn.T if turning.speeds and first == DV else back
            error[first : first + 3] = axes @ (d - part + turn @ part)
        error[~self.model.active] = 0.0
        return error

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Initialise at `t_ns` with nav (10,), parameters (n,), P (n, n), in dx."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self.turns = self.heading_known = self._bent = False

    def adopt(self, mean: Array, spread: Array) -> None:
        """Take a fault's effect out of the state: its mean (n,), and P grows by `spread` (n, n)."""
        super().adopt(mean, spread)
        self.turns |= self._settles and bool(self.covariance[PHI + 2, PHI + 2] > LARGE_SD_RAD**2)

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection."""
        if self._settles and not self.turns:
            variance = self.covariance[PHI + 2, PHI + 2]
            self.turns = self.heading_known and bool(variance > LARGE_SD_RAD**2)
            self.heading_known |= bool(variance < PLAIN_SD_RAD**2)
        return super().update(measurement, noise)

    def _turn_in(self, measurement: Linearised) -> Outcome:
        """Update by one measurement in xi, or return its rejection."""
        self.turned = 0.0
        # A way that turns with the heading leaves no clone behind where it was.
        self.xi[self._clone] = 0.0
        outcome = self._update(measurement)
        if self._settles and self.covariance[PHI + 2, PHI + 2] < PLAIN_SD_RAD**2:
            self.turns = False
        return outcome

    def _update(self, measurement: Linearised) -> Outcome:
        if measurement.screened and measurement.renewal is not None:
            self._renew(measurement.renewal)
        rows = measurement.innovation(self.state)
        if isinstance(rows, NotApplicable):
            return Outcome(rows.outcome)
        own = Innovation(rows.z.copy(), rows.h.copy(), rows.r.copy())
        before = self.of_vehicle(self.nav, self.xi, -1.0)
        p = before @ self.covariance @ before.T
        prior = float(p[PHI + 2, PHI + 2])
        if prior > WIDE_SD_RAD**2:
            self._unfelt(p)
        turning = self.turning(self.nav, p)
        straight = self.straight(turning)
        p = straight @ p @ straight.T
        found = self._seek(measurement, p, turning, rows)
        if isinstance(found, NotApplicable):
            return Outcome(found.outcome)
        if prior > WIDE_SD_RAD**2 and found.covariance[PHI + 2, PHI + 2] < PROBABILITY * prior:
            for beginning in BEGINNINGS_RAD:
                other = self._seek(measurement, p, turning, None, beginning)
                if not isinstance(other, NotApplicable) and other.likelier(found):
                    found = other
        self.log_likelihood = found.log_likelihood
        if not math.isfinite(found.nis):
            return Outcome("not_finite", found.nis, found.degrees)
        self._hypothesise(measurement, own, found, prior)
        if not found.passed:
            return Outcome("gated", found.nis, found.degrees, (), found.rows)
        nav, xi = self.without(self.nav, self.xi, found.error, turning)
        after = self._to_dx(nav, xi, found.error, turning)
        p = after @ found.covariance @ after.T
        before = self._estimate()
        keep_downward(before, nav, xi, self._biases)
        for both in (p, p.T):
            keep_down_rows(both, self.nav[Q0:], nav[Q0:], *self._biases)
        self.covariance[:] = 0.5 * (p + p.T)
        if self.hypotheses is not None:
            fed_back = np.zeros(self.model.size)
            fed_back[DV : DV + 3] = self.nav[VN : VN + 3] - nav[VN : VN + 3]
            self.hypotheses.keep_fed_back(fed_back)
        self.nav[:], self.xi[:], self.turned = nav, xi, float(found.error[PHI + 2])
        turn_step(self.step, self.turned)
        return Outcome("fused", found.nis, found.degrees, found.whitened, found.rows)

    def _hypothesise(
        self, measurement: Linearised, rows: Innovation, found: Sought, prior: float
    ) -> None:
        """Update the bank by an update that equals that of dx to first order while the prior
        heading variance is small; otherwise restart its hypotheses afterwards."""
        bank = self.hypotheses
        if bank is None or prior > WIDE_SD_RAD**2:
            self._bent = True
            return
        if self._bent:
            self._bent = False
            bank.conclude()
            bank.begin(self.t_ns, self.nav, self.step)
        kept = np.array(found.rows) == KEPT if found.rows else np.ones(len(rows.z), dtype=np.bool_)
        if kept.any():
            before = self._cov, self._dx
            self._account_for(measurement, rows, before, kept, found.passed)

    def _unfelt(self, p: Array) -> None:
        """Remove the heading coupling of a velocity within its noise from P (n, n): F would treat
        noise at rest as motion that turns, and show a false heading of a parked vehicle."""
        turned = p[DV : DV + 2, PHI + 2] / p[PHI + 2, PHI + 2]
        own = p[DV : DV + 2, DV : DV + 2] - np.outer(turned, turned) * p[PHI + 2, PHI + 2]
        if float(turned @ turned) < SENSED_SIGMAS**2 * float(np.trace(own)):
            for axis in (0, 1):
                p[DV + axis] -= turned[axis] * p[PHI + 2]
                p[:, DV + axis] -= turned[axis] * p[:, PHI + 2]

    def _seek(
        self,
        measurement: Linearised,
        p: Array,
        turning: Turning,
        rows: Innovation | None,
        psi: float = 0.0,
    ) -> Sought | NotApplicable:
        """Iterate by Gauss-Newton with P_xi (n, n), from a heading offset `psi` (rad), or from
        `rows` at this filter's state."""
        error, nav, xi = np.zeros(self.model.size), self.nav, self.xi
        error[PHI + 2] = psi
        for _ in range(ITERATIONS):
            if rows is None:
                nav, xi = self.without(self.nav, self.xi, error, turning)
                step = self.step.copy()
                turn_step(step, float(error[PHI + 2]))
                found = measurement.innovation(State(nav, xi, step, self.model, self.covariance))
                if isinstance(found, NotApplicable):
                    return found
                rows = found
            to_dx = self._to_dx(nav, xi, error, turning)
            h = np.ascontiguousarray(rows.h @ to_dx)
            sought = self._solved(measurement, Innovation(rows.z + h @ error, h, rows.r), p)
            last, error, rows = error, sought.error, None
            sd = np.sqrt(np.maximum(np.diag(sought.covariance), 1e-30))
            if not np.abs((error - last) / sd).max() > CONVERGED:
                break
        return sought

    def _solved(self, measurement: Linearised, rows: Innovation, p: Array) -> Sought:
        """Solution of the update from xi = 0 with P_xi (n, n), for rows linear in it."""
        nothing = np.zeros(self.model.size)
        if measurement.robust:
            rows = reweighted(rows, self.model, p, nothing)
        nu, h, r = rows
        if measurement.screened:
            by_rows = self._screen(measurement, rows, p, nothing)
            codes, passed = tuple(by_rows.codes.tolist()), bool((by_rows.codes == KEPT).any())
            y = tuple(by_rows.y.tolist())
            return Sought(by_rows.dx, by_rows.cov, by_rows.nis, passed, 0.0, y, codes)
        white, across = np.zeros(len(nu)), np.empty(h.shape)
        nis, log = solve(nu, h, r, p, white, across)
        threshold = gate_threshold(measurement.gate, len(nu))
        log = -0.5 * (min(nis, threshold) + log)
        gain, whitened = across.T, tuple(white.tolist())
        if not math.isfinite(nis):
            return Sought(nothing, p, nis, False, log, whitened)
        kept = np.eye(self.model.size) - gain @ h
        after = kept @ p @ kept.T + (gain * r) @ across
        return Sought(gain @ nu, after, nis, nis <= threshold, log, whitened)

    def _own_snapshot(self) -> object:
        return self.turns, self._bent, *self._knows[_OF_STATE].tolist()

    def _own_restore(self, extra: object) -> None:
        assert isinstance(extra, tuple)
        self.turns, self._bent, *self._knows[_OF_STATE] = extra


def _way(a: Array, b: Array) -> Array:
    """Vector north, east, down (3,) in m from the position of one state (10,) to another's."""
    lat, height = float(b[LAT]), float(b[HEIGHT])
    east = math.remainder(float(b[LON] - a[LON]), 2.0 * math.pi)
    return np.array(
        [
            (lat - a[LAT]) * (meridian_radius(lat) + height),
            east * (transverse_radius(lat) + height) * math.cos(lat),
            a[HEIGHT] - height,
        ]
    )
