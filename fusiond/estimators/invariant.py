r"""The error-state filter in coordinates that a wrong heading does not spoil.

Of a state with attitude C^, velocity v^ and the way p^ from a fixed origin, all computed:

    C = exp(phi x) C^,   v = exp(phi x) (v^ - xi_v),   p = exp(phi x) (p^ - xi_p)

xi = (phi, xi_v, xi_p, parameters) is the right-invariant error of the group SE_2(3); to first order

    dx = T(x^) xi,   dv = xi_v + [v^ x] phi,   dr = xi_p + [p^ x] phi

A heading error turns the whole way about its origin, and the speed along the body is no part of it:
no slip (C^T v) is linear in xi_v whatever the heading, where the plain error has it depend on a
velocity that the next fix may double, and grows sure of the heading for it. Between updates
F is the same in both coordinates, so kernels and aids are those of every filter. An update runs in
xi, about the state it leads to (Gauss-Newton): with P_xi = T^-1 P T^-T at the state before,

    nu_i = z(x_i) + H_i T(x_i) xi_i,   xi_(i+1) = K_i nu_i,   x_(i+1) = x^ less xi_(i+1)

and P comes back by T of the state after it: the covariance transform of an error state that is
reset. Where the model has the IMU's mounting m against the vehicle, C is the vehicle's attitude,
C_nb exp[m x]^T, since it is the vehicle that does not slide; the IMU's own error is then

    phi_nb = phi + C dm

without which each change of the speed would seem to tell m apart from the heading.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE TAC 62
(2017), eq. 8 and section IV; Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton
method, IEEE TAC 38 (1993), eq. 13.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised, NotApplicable, State
from fusiond.estimators.base import Outcome, gate_threshold
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.update import feed_back
from fusiond.models.model import Model
from fusiond.models.vehicle import MOUNTING
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.error_model import DR, DV, PHI
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    rotation_vector_to_quaternion,
    skew,
)
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

Array = NDArray[np.float64]

# Steps of Gauss-Newton at most, and the step, in sigmas, that ends them: what is left is a
# hundredth of the variance.
ITERATIONS, CONVERGED = 5, 0.1
# Below this sigma of the heading both coordinates say the same: at 15 m/s the velocity across is
# known to 0.5 m/s, and a speed that is off by a tenth changes what no slip says by 5 cm/s.
PLAIN_SD_RAD = math.radians(2.0)
# Above this sigma of the heading, as after a doubt of the motion (DOUBTED_ATTITUDE_RAD and a gyro
# that is wrong by DOUBTED_RATE_RAD_S), they do not: a correction of 12 deg in a bend at 20 m/s
# leaves 0.04 m/s^2 in the bias of an accelerometer, three of its sigmas.
LARGE_SD_RAD = 2.0 * PLAIN_SD_RAD


class InvariantFilter(KalmanEstimator):
    """The centralised filter, whose updates run in xi while it has an `origin`.

    One that `settles` gives its origin up when the heading is known to `PLAIN_SD_RAD`, and takes
    the place where it is when it is known no better than `LARGE_SD_RAD`.
    """

    def __init__(self, model: Model, gap_s: float, settles: bool = True) -> None:
        super().__init__(model, gap_s)
        self._settles = settles
        self.origin: Array | None = None
        """Where p^ begins (rad, rad, m). A filter without updates as any other does."""
        self._mounting = model.slots_of(MOUNTING)
        self.log_likelihood = 0.0
        """Of the innovation last looked at, but for a constant that is alike for all filters; one
        that fails its gate counts as one at the gate: it may be the measurement's fault."""

    def way(self, nav: Array) -> Array:
        """North, east, down (3,) in m from the origin."""
        origin = self.origin
        assert origin is not None
        lat, height = float(nav[LAT]), float(nav[HEIGHT])
        east = math.remainder(float(nav[LON] - origin[1]), 2.0 * math.pi)
        return np.array(
            [
                (lat - origin[0]) * (meridian_radius(lat) + height),
                east * (transverse_radius(lat) + height) * math.cos(lat),
                origin[2] - height,
            ]
        )

    def transform(self, nav: Array, xi: Array, sign: float = 1.0) -> Array:
        """T (n, n) of a state, or its inverse with a `sign` of -1."""
        t = np.eye(self.model.size)
        by_turn = np.vstack([skew(nav[VN : VN + 3]), skew(self.way(nav))])
        t[DV : DR + 3, PHI : PHI + 3] = sign * by_turn
        if self._mounting:
            b = self.vehicle(nav, xi)[:, 1:]
            t[PHI : PHI + 3, self._mounting] = sign * b
            if sign < 0.0:
                t[DV : DR + 3, self._mounting] = by_turn @ b
        t[~self.model.active] = 0.0
        return t

    def vehicle(self, nav: Array, xi: Array) -> Array:
        """C_nv (3, 3) of the vehicle, which goes the way it faces."""
        dcm = dcm_from_quaternion(nav[Q0:])
        if not self._mounting:
            return dcm
        pitch, yaw = xi[self._mounting]
        return dcm @ turned_by(np.array([0.0, pitch, yaw])).T

    def without(self, nav: Array, xi: Array, error: Array) -> tuple[Array, Array]:
        """The state (10,) and parameters (n,) less an `error` (n,) in xi."""
        turn = turned_by(error[PHI : PHI + 3])
        d = error.copy()
        v, way = nav[VN : VN + 3], self.way(nav)
        d[DV : DV + 3] = v - turn @ (v - error[DV : DV + 3])
        d[DR : DR + 3] = way - turn @ (way - error[DR : DR + 3])
        if self._mounting:
            b = self.vehicle(nav, xi)[:, 1:]
            d[PHI : PHI + 3] = _rotation_vector(turn @ turned_by(b @ error[self._mounting]))
        d[~self.model.active] = 0.0
        nav, xi = nav.copy(), xi.copy()
        feed_back(nav, xi, d)
        return nav, xi

    def between(self, nav: Array, xi: Array) -> Array:
        """The error (n,) in xi of this filter's state, if another's were true."""
        mine, true = self.vehicle(self.nav, self.xi), self.vehicle(nav, xi)
        error = xi - self.xi
        error[PHI : PHI + 3] = _rotation_vector(true @ mine.T)
        back = turned_by(error[PHI : PHI + 3]).T
        error[DV : DV + 3] = self.nav[VN : VN + 3] - back @ nav[VN : VN + 3]
        error[DR : DR + 3] = self.way(self.nav) - back @ self.way(nav)
        error[~self.model.active] = 0.0
        return error

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n), and without an origin."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self.origin = None

    def update(self, aid: Linearised) -> Outcome:
        """Fold one aid in, or name why not."""
        large = self.covariance[PHI + 2, PHI + 2] > LARGE_SD_RAD**2
        if large and self._settles and self.origin is None:
            self.origin = self.nav[: HEIGHT + 1].copy()
        if self.origin is None or self._holding or aid.screened:
            return super().update(aid)
        outcome = self._update(aid)
        if self._settles and self.covariance[PHI + 2, PHI + 2] < PLAIN_SD_RAD**2:
            self.origin = None
        return outcome

    def _update(self, aid: Linearised) -> Outcome:
        before = self.transform(self.nav, self.xi, -1.0)
        p = before @ self.covariance @ before.T
        sd = np.sqrt(np.maximum(np.diag(p), 1e-30))
        error = np.zeros(self.model.size)
        nav, xi = self.nav, self.xi
        for _ in range(ITERATIONS):
            rows = aid.innovation(State(nav, xi, self.step, self.model, self.covariance))
            if isinstance(rows, NotApplicable):
                return Outcome(rows.outcome)
            z, r = rows.z, np.diag(rows.r)
            h = rows.h @ self.transform(nav, xi)
            nu = z + h @ error
            s = h @ p @ h.T + r
            gain = np.linalg.solve(s, h @ p).T
            last, error = error, gain @ nu
            nav, xi = self.without(self.nav, self.xi, error)
            if np.abs((error - last) / sd).max() < CONVERGED:
                break
        nis = float(nu @ np.linalg.solve(s, nu))
        threshold = gate_threshold(aid.gate, len(z))
        self.log_likelihood = -0.5 * (min(nis, threshold) + float(np.linalg.slogdet(s)[1]))
        if not nis <= threshold:
            return Outcome("gated", nis, len(z))
        kept = np.eye(self.model.size) - gain @ h
        p = kept @ p @ kept.T + gain @ r @ gain.T
        after = self.transform(nav, xi)
        p = after @ p @ after.T
        self.covariance[:] = 0.5 * (p + p.T)
        self.nav[:], self.xi[:] = nav, xi
        y = np.linalg.solve(np.linalg.cholesky(s), nu)
        return Outcome("fused", nis, len(z), tuple(y.tolist()))

    def _own_snapshot(self) -> object:
        return self.origin

    def _own_restore(self, extra: object) -> None:
        assert extra is None or isinstance(extra, np.ndarray)
        self.origin = extra


def turned_by(phi: Array) -> Array:
    """exp(phi x) (3, 3)."""
    x, y, z = (float(v) for v in phi)
    return dcm_from_quaternion(np.array(rotation_vector_to_quaternion(x, y, z)))


def _rotation_vector(dcm: Array) -> Array:
    """The phi (3,) of exp(phi x); of half a turn about down, where no axis is told."""
    axis = 0.5 * np.array([dcm[2, 1] - dcm[1, 2], dcm[0, 2] - dcm[2, 0], dcm[1, 0] - dcm[0, 1]])
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, 0.5 * (float(np.trace(dcm)) - 1.0))
    if sine < 1e-9:
        return np.array([0.0, 0.0, angle])
    return axis * (angle / sine)
