r"""Extended Kalman filter on the error state, closed loop.

The error state is estimated, taken out of the navigation state at once and is zero again, so only
its covariance is propagated. Parameters keep their estimates in `xi`.

Gate: with S = H P H^T + R, nu^T S^-1 nu is chi-square with m degrees of freedom while filter and
measurement agree; beyond the quantile of the aid's gate probability the measurement is left out.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1; Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from fusiond.aiding.base import Linearised, NotApplicable, State
from fusiond.estimators.model import Model
from fusiond.estimators.propagation import SCRATCH_SIZE, propagate, sensor_estimates, sigmas
from fusiond.estimators.update import feed_back, fuse
from fusiond.imu_buffer import ImuBuffer
from fusiond.navigation.error_model import STRIDE
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import NAV_SIZE, Q0, STEP_DCM, STEP_SIZE

Array = NDArray[np.float64]

# One sigma (rad) added to the attitude when a filter that rejects everything is opened again: what
# a bad alignment on the move can be wrong by.
DOUBTED_ATTITUDE_RAD = math.radians(3.0)


@lru_cache(maxsize=256)
def gate_threshold(probability: float, degrees: int) -> float:
    """Chi-square quantile for a gate probability."""
    return float(chdtri(degrees, 1.0 - probability))


class Outcome(NamedTuple):
    """How an aid ended: its name, and the innovation that led to it (NIS, dimension, and L^-1 nu
    with
    S = L L^T)."""

    name: str
    nis: float = float("nan")
    degrees: int = 0
    whitened: tuple[float, ...] = ()


class Snapshot(NamedTuple):
    """All that a later restore needs."""

    t_ns: int
    sample: int
    nav: Array
    xi: Array
    cov: Array
    step: Array
    dx: Array
    holding: bool


class KalmanEstimator:
    """State at `t_ns` (ns) after samples of the buffer up to, not including, `sample`
    (absolute)."""

    def __init__(self, model: Model, gap_s: float) -> None:
        self.model = model
        self.gap_ns = round(gap_s * 1e9)
        self.t_ns = 0
        self.sample = 0
        self.nav: Array = np.zeros(NAV_SIZE)
        self.xi: Array = np.zeros(model.size)
        self._cov: Array = np.zeros((STRIDE, STRIDE))
        self.step: Array = np.zeros(STEP_SIZE)
        self._dx: Array = np.zeros(model.size)
        self._holding = False
        self._scratch: Array = np.zeros(SCRATCH_SIZE)
        self._fixed = (
            self.nav,
            self.xi,
            self._cov,
            model.hold_height,
            model.active,
            model.sensor_terms,
            model.noise,
        )

    @property
    def covariance(self) -> Array:
        """P (n, n) of the error state, a view."""
        return self._cov[: self.model.size, : self.model.size]

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        self.t_ns, self.sample = t_ns, sample
        self.nav[:], self.xi[:] = nav, xi
        self._cov[:] = 0.0
        self.covariance[:] = covariance
        self.covariance[~self.model.active] = 0.0
        self.covariance[:, ~self.model.active] = 0.0
        self._dx[:], self._holding = 0.0, False
        self.step[:] = 0.0
        self.step[STEP_DCM:] = dcm_from_quaternion(self.nav[Q0:]).ravel()

    def propagate(self, imu: ImuBuffer, target_ns: int, record: bool = False) -> None:
        """Propagate to `target_ns`, or to the last sample that the buffer holds before it."""
        first, self.t_ns = propagate(
            *self._fixed,
            imu.times,
            imu.samples,
            self.sample - imu.start,
            imu.end,
            self.t_ns,
            target_ns,
            self.gap_ns,
            record,
            imu.nav,
            imu.sigmas,
            self.step,
            self._dx,
            self._holding,
            self._scratch,
        )
        self.sample = first + imu.start

    def update(self, aid: Linearised, inflate: bool = False) -> Outcome:
        """Fold one aid in, or name why not. With `inflate`, a failed gate widens P and passes."""
        state = State(self.nav, self.xi, self.step, self.model)
        innovation = aid.innovation(state)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        z, h, r = innovation
        degrees = z.shape[0]
        state_arrays = self.nav, self.xi, self._cov, self._dx
        threshold = gate_threshold(aid.gate, degrees)
        y = np.zeros(degrees)
        nis = fuse(*state_arrays, z, h, r, threshold, self._holding, y)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        if not inflate:
            return Outcome("gated", nis, degrees)
        self._widen(z - h @ self._dx, h)
        fuse(*state_arrays, z, h, r, math.inf, self._holding, y)
        return Outcome("fused", nis, degrees)

    def hold(self) -> None:
        """From now on estimate without feedback: errors are carried along with the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back what was carried."""
        self._holding = False
        self._feed_back()

    def _feed_back(self) -> None:
        feed_back(self.nav, self.xi, self._dx)
        self._dx[:] = 0.0

    def _widen(self, z: Array, h: Array) -> None:
        """Add the innovation's own square to the states that it measures directly, and doubt the
        attitude: a filter that was this wrong about position was wrong about more."""
        for slot in range(3):
            self._cov[slot, slot] += DOUBTED_ATTITUDE_RAD**2
        for row, value in zip(h, z, strict=True):
            # Position or velocity before the attitude that turns a lever arm.
            group = next(g for g in (slice(3, 9), slice(0, 3), slice(0, len(row))) if row[g].any())
            slot = group.start + int(np.argmax(np.abs(row[group])))
            if self.model.active[slot]:
                self._cov[slot, slot] += value * value

    @property
    def sensor_errors(self) -> Array:
        """Estimates (12,): rate bias (rad/s), force bias (m/s^2), rate and force scale (1)."""
        estimate = np.empty(12)
        slot, kind = self.model.sensor_terms
        sensor_estimates(self.xi, slot, kind, estimate)
        return estimate

    def sigmas(self) -> Array:
        """One sigma (9,): position, velocity (n, e, d), roll, pitch, yaw."""
        out = np.empty(9)
        sigmas(self._cov, self.step, out)
        return out

    def snapshot(self) -> Snapshot:
        """A copy of everything."""
        return Snapshot(
            self.t_ns,
            self.sample,
            self.nav.copy(),
            self.xi.copy(),
            self._cov.copy(),
            self.step.copy(),
            self._dx.copy(),
            self._holding,
        )

    def restore(self, s: Snapshot) -> None:
        """Back to a snapshot, bit for bit."""
        self.t_ns, self.sample = s.t_ns, s.sample
        self.nav[:], self.xi[:], self._cov[:], self.step[:] = s.nav, s.xi, s.cov, s.step
        self._dx[:], self._holding = s.dx, s.holding
