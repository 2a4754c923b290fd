r"""Solution separation in the filter: one estimate from all measurements, and one without each
device.

    x_0   of all measurements                                P_0
    x_k   of all measurements but those of device k          P_k

All are error estimates of one navigation state: a measurement is linearised once, and each subset
applies it with its own gain after its own gate; x_0 is fed back, and x_k <- x_k - x_0. Then, with
the modelled noise and the same measurements accepted,

    cov(x_k - x_0) = P_k - P_0

as the error of an optimal estimate is orthogonal to all estimates from the same data. A subset has
its own gate: measurements that agree with a faulty device are not those that agree without it. With
one device its subset is the IMU with the other measurements (wheels, standstill): it drifts.

The initial estimate is common to all: a start from a wrong fix shows in no separation.

Source: Brenner, Integrated GPS/inertial fault detection availability, NAVIGATION 43 (1996), 111;
Young, McGraw, Fault detection and exclusion using normalized solution separation and residual
monitoring methods, NAVIGATION 50 (2003), 151.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable, Renewal
from fusiond.estimators.base import AS_STATED, Outcome, gate_threshold
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.federated.options import local_of
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.update import fuse, work
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.models.model import Model

Array = NDArray[np.float64]

POSITION = slice(6, 9)


class SeparatedEstimator(KalmanEstimator):
    """The centralised filter with a subset for each of `devices`: sources of position, by the name
    that their measurements begin with. The published state equals, to rounding, that of the filter
    without subsets."""

    packs = False

    def __init__(
        self,
        model: Model,
        gap_s: float,
        devices: tuple[str, ...],
        faults: FaultTable = NO_FAULTS,
    ) -> None:
        if not devices:
            raise ValueError("solution separation needs at least one device")
        super().__init__(model, gap_s, (1.0,) * (1 + len(devices)), faults)
        self.devices = devices
        self._carrying = True
        self._device_of: dict[str, int | None] = {}

    def covariances(self) -> Array:
        """Covariances P (1 + devices, 3, 3), m^2, of the position north, east, down: of all
        measurements, then of the subsets."""
        return self._covs[:, POSITION, POSITION]

    def separations(self) -> Array:
        """(devices, 3), m: position of the solution without each device minus the published one."""
        return self._dxs[0, POSITION] - self._dxs[1:, POSITION]

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection."""
        if measurement.screened and measurement.renewal is not None:
            super()._renew(measurement.renewal)
        innovation = self._linearise(measurement)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        held, self._holding = self._holding, True
        try:
            outcome = super().update(measurement, noise)
        finally:
            self._holding = held
        self._fold_into_subsets(measurement, innovation)
        if not held:
            self._take_out()
        self._leave_all(measurement, outcome.rows)
        return outcome

    def _renew(self, renewal: Renewal) -> None:
        """Do nothing: `update` renews before its linearisation, and after the subsets."""

    def _leave_all(self, measurement: Linearised, codes: tuple[int, ...]) -> None:
        """Clone the state for the next measurement, in the subsets as well."""
        if measurement.screened and (renewal := measurement.leaves(self.state, codes)) is not None:
            super()._renew(renewal)

    def look(self, measurement: Linearised, lasting: Array | None = None) -> Outcome:
        """Innovation of a measurement that is not fused; the measurement is `isolated`, the
        published state does not change. Subsets apply their own gates, as there the measurement may
        be right."""
        outcome = super().look(measurement, lasting)
        innovation = self._linearise(measurement)
        if not isinstance(innovation, NotApplicable):
            self._fold_into_subsets(measurement, innovation)
        self._leave_all(measurement, outcome.rows)
        return outcome

    def adopt(self, mean: Array, spread: Array) -> None:
        """Subtract a fault's effect of mean (n,) from the common state and add its `spread` (n, n)
        to P."""
        super().adopt(mean, spread)
        n = self.model.size
        self._covs[1:, :n, :n] += spread
        self._dxs[1:] -= mean

    def release(self) -> None:
        """Feed back the held estimate."""
        self._holding = False
        self._take_out()

    def _take_out(self) -> None:
        """Feed the published estimate back, and subtract it from the others."""
        if self._dxs[0].any():
            self._feed_back(self._dxs[0])
            self._dxs -= self._dxs[0].copy()

    def _device(self, measurement: Linearised) -> int | None:
        """Device of a measurement; None if it has none."""
        if measurement.source not in self._device_of:
            self._device_of[measurement.source] = local_of(measurement.source, self.devices)
        return self._device_of[measurement.source]

    def _fold_into_subsets(self, measurement: Linearised, i: Innovation) -> None:
        """Fold a measurement into each subset but its own device's, if the subset's gate passes
        it."""
        own = self._device(measurement)
        for k in range(1, 1 + len(self.devices)):
            if k - 1 == own:
                continue
            cov, dx = self._covs[k], self._dxs[k]
            if measurement.screened:
                s = self._screen(measurement, i, cov, dx)
                if (s.codes == KEPT).any():
                    cov[:], dx[:] = s.cov, s.dx
            else:
                threshold = gate_threshold(measurement.gate, i.z.shape[0])
                y, g = work(i.z.shape[0], cov.shape[1])
                fuse(self.nav, self.xi, cov, dx, i.z, i.h, i.r, threshold, True, y, g)
