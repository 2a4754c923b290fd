r"""Unscented Kalman filter on the error state, closed loop: sigma points instead of Jacobians.

Measurements: the transform is taken over the states that the measurement depends on (the columns of
its H that are not zero), each point through the measurement's own innovation at the true state that
its error would mean. The result is linear in the error state again
(fusiond.estimators.unscented.sigma_points), so gate, update and feedback are those of the extended
filter. All other states follow through their correlation, as in a full transform. A measurement
that `remembers` uses its Jacobian.

Propagation: the extended filter's covariance, or with `propagation` sigma points through the
strapdown equations and a covariance that turns with a large correction of the attitude
(fusiond.estimators.unscented.propagation). That costs more and helps with large attitude errors.

Source: Julier, Uhlmann, Unscented Filtering and Nonlinear Estimation, Proc. IEEE 92 (2004).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable, State
from fusiond.estimators.base import AS_STATED, Outcome
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.state_array import GAP
from fusiond.estimators.unscented.propagation import propagate_points, turn_attitude
from fusiond.estimators.unscented.sigma_points import factor, linear_form, spread_states
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE

Array = NDArray[np.float64]

SPREAD = math.sqrt(3.0)
"""Sigmas from the mean to a point: the fourth moment of a Gaussian (Julier, Uhlmann, eq. 20)."""


class UnscentedEstimator(KalmanEstimator):
    """The centralised unscented filter (`fusiond.estimators.base.Estimator`).

    `spread`: sigmas from the mean to a sigma point. `propagation`: sigma points there too.
    """

    packs = False

    def __init__(
        self, model: Model, gap_s: float, spread: float = SPREAD, propagation: bool = False
    ) -> None:
        super().__init__(model, gap_s)
        self.spread = spread
        self.propagation = propagation

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection."""
        before = self.nav.copy()
        outcome = super().update(measurement, noise)
        if self.propagation and outcome.name == "fused" and not self._holding:
            turn_attitude(self._covs[0], before, self.nav)
        return outcome

    def release(self) -> None:
        """Feed back the held estimate."""
        before = self.nav.copy()
        super().release()
        if self.propagation:
            turn_attitude(self._covs[0], before, self.nav)

    def _linearise(self, measurement: Linearised) -> Innovation | NotApplicable:
        """The measurement's innovation over the sigma points, linear in the error state.

        If the measurement is undefined at a point, its pair uses the Jacobian at the centre.
        """
        if measurement.remembers:
            return super()._linearise(measurement)
        state = self.state
        central = measurement.innovation(state)
        if isinstance(central, NotApplicable):
            return central
        model = self.model
        rows = central.z.shape[0]
        slots = np.flatnonzero(central.h.any(axis=0) & model.active)
        m = slots.shape[0]
        root = np.empty((m, m))
        factor(self._covs[0], slots, root)
        count = 2 * m + 1
        navs, steps = np.empty((count, NAV_SIZE)), np.empty((count, STEP_SIZE))
        xis = np.empty((count, model.size))
        dx = self._dxs[0]
        terms = model.sensor_terms
        spread_states(
            self.nav, self.xi, self.step, dx, slots, terms, root, self.spread, navs, xis, steps
        )
        points = np.full((count, rows), np.nan)
        for p in range(count):
            found: Innovation | NotApplicable = central
            if p > 0 or self._holding:
                found = measurement.innovation(State(navs[p], xis[p], steps[p], model))
            if isinstance(found, Innovation) and found.z.shape[0] == rows:
                points[p] = found.z
        if not np.isfinite(points[0]).all():
            points[0] = central.z - central.h @ dx
        if math.isfinite(measurement.period):
            points -= measurement.period * np.nan_to_num(
                np.round((points - points[0]) / measurement.period)
            )
        z, h, r = np.empty(rows), np.empty((rows, model.size)), np.empty(rows)
        linear_form(
            points,
            central.h,
            central.r,
            dx,
            slots,
            root,
            self.spread,
            measurement.screened,
            z,
            h,
            r,
        )
        return self._weighed(measurement, Innovation(z, h, r))

    def propagate(
        self, imu: ImuBuffer, target_ns: int, record: bool = False, passing: bool = False
    ) -> None:
        """Propagate to `target_ns`, or to the last sample that the buffer holds before it."""
        if not self.propagation:
            super().propagate(imu, target_ns, record, passing)
            return
        model = self.model
        first, self.t_ns = propagate_points(
            self.nav,
            self.xi,
            self._covs[0],
            self._dxs[0],
            self.step,
            self.spread,
            model.hold_height,
            model.active,
            model.sensor_terms,
            model.rate_terms,
            model.noise,
            *self.published,
            imu.times,
            imu.samples,
            imu.densities,
            self.sample - imu.start,
            imu.end,
            self.t_ns,
            target_ns,
            min(int(self._memory.head[GAP]), imu.hold_ns),
            record,
            imu.nav,
            imu.sigmas,
            self._holding,
            self._memory.work,
        )
        self.sample = first + imu.start
