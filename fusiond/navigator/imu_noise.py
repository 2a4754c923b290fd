"""Noise of an inertial unit as observed in navigation.

Two estimates: the share of the samples' variation that is noise
(fusiond.navigator.imu_vibration_noise_share), and the unit's grade within its class
(fusiond.navigator.imu_grade). Both use the filter's state of `SETTLES_NS` ago, on a time grid, and
apply to samples `COUNTS_NS` later. So neither the order of measurements nor the number of samples
at once matters.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.fix_error_correlation import SETTLES_NS
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG
from fusiond.estimators.base import Estimator
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.imu_grade import UnitGrade
from fusiond.navigator.imu_vibration_noise_share import COUNTS_NS, EVERY_NS, NoiseShares
from fusiond.navigator.timeline import Timeline

STEP_NS = 1_000_000_000
"""Step of a prediction's propagation, so that no tick carries all of it."""


class ImuNoise:
    """Estimator of the IMU's noise from the filter's state; evaluates the vehicle's `drifts` at the
    same instants."""

    def __init__(self, model: Model, imu: Imu, drifts: DriftLevels) -> None:
        self._drifts = drifts
        self._shares = NoiseShares(model, imu.gap_s)
        of_class = imu.sensor_class is not None and imu.misalignment_deg > 0.0
        self._unit = UnitGrade(model) if of_class else None
        self._grade = self._unit
        """Grade of the unit; None without evidence of its quality."""
        self._square_rad2 = self._sheet_rad2 = (imu.misalignment_deg * DEG) ** 2
        """Variance of the angles by which axes of its class are out of square, and its sheet's."""
        self._at_ns = -1
        self.due_ns = 0
        """Instant of the filter from which `look` has something to do."""

    @property
    def shown(self) -> tuple[float, tuple[float, ...]]:
        """Observed noise, for the next start."""
        return self._shares.shown

    def take_up(
        self, imu: ImuBuffer, predictions: float, log_likelihoods: tuple[float, ...]
    ) -> None:
        """Resume with the observed noise of another drive, before any sample."""
        shares = self._shares.take_up(predictions, log_likelihoods)
        if imu.vibration is not None:
            imu.vibration.shares.add(0, shares)

    def restart(self) -> None:
        """Restart with the filter."""
        self._shares.restart()
        self._at_ns, self.due_ns = -1, 0
        self._grade = self._unit

    def started(self, start: Start, estimator: Estimator, imu: ImuBuffer) -> None:
        """Start with the filter: the unit has the grade that it showed at rest."""
        if self._grade is None:
            return
        self._grade.begin(start.grades)
        axes = float(start.grades[-1])
        self._square_rad2 = max(axes, 1.0) * self._sheet_rad2
        self._count(estimator, imu, start.t_ns, min(axes, 1.0))

    def change(self) -> None:
        """Change to the spare: nothing is known of either unit's grade."""
        self._unit = None
        self.restart()

    def corrected(self, estimator: Estimator) -> None:
        """Record the removal of a fault: the unit's axes have the class's errors until the next
        alignment."""
        if self._grade is not None and isinstance(estimator, KalmanEstimator):
            estimator.axes_known(math.sqrt(self._square_rad2))
        self._grade = None

    def look(self, timeline: Timeline, imu: ImuBuffer) -> None:
        """Evaluate the filter, which has reached `due_ns` or later."""
        settled_ns, vibration = timeline.estimator.t_ns - SETTLES_NS, imu.vibration
        cell = settled_ns // STEP_NS
        self.due_ns = (cell + 1) * STEP_NS + SETTLES_NS
        if vibration is None:
            return
        at_ns = settled_ns // EVERY_NS * EVERY_NS
        self._shares.carry(imu, at_ns if at_ns > self._at_ns else cell * STEP_NS)
        if at_ns == self._at_ns:
            return
        self._at_ns = at_ns
        if at_ns < timeline.oldest_ns:
            self._shares.restart()
            return
        with timeline.past(at_ns):
            e = timeline.estimator
            shares = self._shares.end(e)
            self._drifts.look(e)
            grade = 1.0 if self._grade is None else self._grade.of(e.xi, e.covariance)
            if vibration.shaken:
                self._shares.begin(e)
        if shares is not None:
            vibration.shares.add(at_ns + COUNTS_NS, shares)
        if self._grade is not None:
            self._count(timeline.estimator, imu, at_ns, grade)

    def _count(self, estimator: Estimator, imu: ImuBuffer, at_ns: int, grade: float) -> None:
        """Apply the grade estimated at `at_ns`."""
        square = grade * self._square_rad2
        if imu.crosstalk is not None:
            imu.crosstalk.squares.add(at_ns + COUNTS_NS, np.array([square / self._sheet_rad2]))
        if isinstance(estimator, KalmanEstimator):
            estimator.axes_known(math.sqrt(square))
