"""Protection levels of the solution.

Each level bounds the error: that of solution separation in the filter
(fusiond.integrity.protection), and that of each raw receiver's epochs
(fusiond.navigator.raw_araim). The least is published. Each is computed at an equal part of the
integrity risk, so that any of them may be chosen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.integrity.protection import IntegrityRisk, filter_protection
from fusiond.navigator.raw_araim import EpochProtection
from fusiond.navigator.raw_gnss import RawEpochMeasurement


class Level(NamedTuple):
    """Horizontal and vertical level (m; vertical None if the model holds the height), and text on
    contradicting sources."""

    hpl_m: float
    vpl_m: float | None
    blamed: list[str]


class Levels:
    """Levels of an estimator's present state."""

    def __init__(self, config: Config, estimator: SeparatedEstimator) -> None:
        options = config.integrity
        self._estimator = estimator
        self._raw = [name for name, s in config.aiding.items() if isinstance(s, RawAiding)]
        risk = options.integrity_risk_per_hour / (1 + len(self._raw))
        self._epochs = EpochProtection(risk, options.false_alarm_per_hour)
        self._risk = IntegrityRisk(
            risk,
            options.false_alarm_per_hour,
            options.priors(estimator.devices),
        )
        if not self._risk.monitored > 0.0:
            raise ConfigError(
                "integrity: two devices at fault in one hour are likelier than"
                " integrity_risk_per_hour: no protection level can be stated"
            )

    @property
    def t_ns(self) -> int:
        """The state's instant."""
        return self._estimator.t_ns

    def look(self, measurement: AidingMeasurement) -> None:
        """Update the levels after a processed measurement, from the estimator's state."""
        if isinstance(measurement, RawEpochMeasurement):
            self._epochs.look(measurement, self._estimator.state)

    def restart(self) -> None:
        """Restart with the solution, without earlier data."""
        self._epochs.clear()

    def now(self) -> Level:
        """Levels of the present state."""
        e = self._estimator
        vertical = not e.model.hold_height
        # What is not told yet may be the IMU's fault, which no mode stands for.
        covariances = e.covariances() + np.diag(e.wider[:3])
        of_filter = filter_protection(covariances, e.separations(), self._risk, vertical=vertical)
        names = zip(e.devices, of_filter.apart.tolist(), strict=True)
        blamed = [f"the solution without {name} is apart" for name, apart in names if apart]
        hpl, vpl = [of_filter.hpl_m], [math.inf if of_filter.vpl_m is None else of_filter.vpl_m]
        for source in self._raw:
            level = self._epochs.level(source, e)
            hpl.append(level.hpl_m)
            vpl.append(level.vpl_m)
            if level.left_out:
                blamed.append(f"{source} fits without {', '.join(level.left_out)}")
        return Level(min(hpl), min(vpl) if vertical else None, blamed)
