"""Grade of an inertial unit by its rests: within its class, or worse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import ImuNoise
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.standstill import LONGEST_RUN, Window
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import LEVEL_SD_RAD
from fusiond.navigator.imu_grade import AS_ITS_CLASS, Values, graded_at_rest
from fusiond.navigator.imu_worse_than_class import grades_of, widened, worse_than_said

if TYPE_CHECKING:
    from fusiond.navigator.alignment.evidence import Standstill

Array = NDArray[np.float64]

GRAVITY_SD = 5e-4
"""One sigma of gravity by the ellipsoid: anomalies, and heights that nobody knows."""


class UnitAtRest:
    """`noise` of the inertial unit: its data sheet's, or that of a worse class by its rates at
    rest."""

    def __init__(self, options: AlignmentOptions, sheet: ImuNoise) -> None:
        self._options, self._sheet, self.noise = options, sheet, sheet
        self._ups: list[Array] = []
        """Verticals of the quiet windows of a run, in the body."""
        self._longest_run = 1

    def judge(self, w: Window) -> bool:
        """Grade the unit by the rates about level axes that gravity does not follow
        (fusiond.navigator.imu_worse_than_class). True if it is worse than its data sheet."""
        up = w.mean_force / float(np.linalg.norm(w.mean_force))
        self._ups = [*self._ups[1 - w.run :], up] if w.run > 1 else [up]
        if w.run <= self._longest_run or len(self._ups) < w.run:
            return False
        self._longest_run = min(w.run, LONGEST_RUN - 1)
        n, o = self._sheet, self._options
        seconds = (w.run - 1) * o.window_s
        # A body that turns by w carries the vertical with it, du/dt = u x w.
        across = w.run_rate - (w.run_rate @ up) * up
        across = across + np.cross(up, (up - self._ups[0]) / seconds)
        white = n.rate_noise**2 / (w.run * o.window_s)
        unseen = EARTH_RATE_RAD_S**2 + 2.0 * (LEVEL_SD_RAD / seconds) ** 2 + white
        prior = n.rate_bias_initial**2 + n.rate_bias_instability**2
        size = float(np.linalg.norm(across))
        grade = worse_than_said(np.array([size, 0.0]), prior, unseen)
        self.noise = widened(n, grade)
        return grade > 1.0

    @property
    def judged(self) -> bool:
        """True if rates at rest have confirmed or refuted the data sheet."""
        return self._longest_run > 1

    @property
    def unrested_grades(self) -> Array:
        """Grades (13,) of a unit whose errors were not seen at rest."""
        if self.noise is self._sheet:
            return AS_ITS_CLASS
        return grades_of(self.noise, self._sheet, self._options.misalignment_rad)

    def grades(self, s: Standstill, bias: Array, sd: float, g: float) -> Array:
        """Grades (13,) of the unit (fusiond.navigator.imu_grade) from a rest: rate `bias` (3,) and
        its one sigma."""
        if not self._options.graded:
            return self.unrested_grades
        n = self.noise
        rate = n.rate_bias_initial**2 + n.rate_bias_instability**2
        force = n.force_bias_initial**2 + n.force_bias_instability**2 + (n.force_scale * g) ** 2
        up = np.array([float(np.linalg.norm(s.mean_force)) - g])
        unseen = n.force_noise**2 / s.seconds + (GRAVITY_SD * g) ** 2
        return self.unrested_grades * graded_at_rest(
            Values(bias, np.full(3, rate), np.full(3, sd**2)),
            Values(up, np.array([force]), np.array([unseen])),
        )
