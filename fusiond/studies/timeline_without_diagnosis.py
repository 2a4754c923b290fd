"""Timeline without diagnosis, for experiments on deliberately wrong filters."""

from __future__ import annotations

from fusiond.aiding.base import AidingMeasurement
from fusiond.estimators.base import Estimator, Outcome
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.fault_correction import Correction
from fusiond.integrity.series_states import Series


class WithoutDiagnosis(Diagnosis):
    """Leaves all to the filter: its gate, and what detects faults in a federated one."""

    def plain(self, measurement: AidingMeasurement) -> Series | None:
        """Each measurement is handed over by itself."""
        return None

    def comes(self, measurement: AidingMeasurement, estimator: Estimator) -> Series:
        """Series of a measurement, always in service."""
        return self.own(measurement)

    def judge(
        self, measurement: AidingMeasurement, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Judge nothing."""
        return None
