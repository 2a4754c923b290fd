"""Timeline without diagnosis, for experiments on deliberately wrong filters."""

from __future__ import annotations

from fusiond.aiding.base import AidingMeasurement
from fusiond.estimators.base import Estimator, Outcome
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.fault_correction import Correction
from fusiond.integrity.series_states import Series


class WithoutDiagnosis(Diagnosis):
    """Replacement of the diagnosis that accepts everything: the filter's gate and, in a federated
    one, its fault detection remain."""

    def plain(self, measurement: AidingMeasurement) -> Series | None:
        """Hand over each measurement by itself."""
        return None

    def comes(self, measurement: AidingMeasurement, estimator: Estimator) -> Series:
        """Series of a measurement, always in service."""
        return self.own(measurement)

    def judge(
        self, measurement: AidingMeasurement, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Judge nothing."""
        return None
