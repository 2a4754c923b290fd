"""What the solution is worth, and why: the mode, judged by whoever of the navigator's parts knows.

The first reason that holds is told; the order is that of their weight. What each mode means to who
reads it: `fusiond.navigation.solution`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import Mode
from fusiond.navigator.alignment.lateness import Lateness
from fusiond.navigator.imu_door import ImuDoor
from fusiond.navigator.imu_units import RateUnits
from fusiond.navigator.standing import Standing
from fusiond.navigator.timeline import Timeline


class Begun(NamedTuple):
    """How the navigation began: `how` its heading came about; `unconfirmed`: what the heading hangs
    on and nothing has shown, empty where it does not; `position_ns`: of the last position fused."""

    how: str
    unconfirmed: str
    position_ns: int


class Worth:
    """Judges the solution of one navigator, whose parts it looks at and changes nothing of."""

    def __init__(
        self,
        config: Config,
        estimator: Estimator,
        imu: ImuBuffer,
        timeline: Timeline,
        door: ImuDoor,
        units: RateUnits,
        standing: Standing,
        lateness: Lateness,
    ) -> None:
        self._gap_s = config.imu.gap_s
        self._limits = config.estimator
        self._estimator = estimator
        self._imu = imu
        self._timeline = timeline
        self._door = door
        self._units = units
        self._standing = standing
        self._lateness = lateness

    def of(self, t_ns: int, begun: Begun | None, aligning: str) -> tuple[Mode, str]:
        """The mode at `t_ns`; without a navigation `aligning` is what the alignment waits for."""
        if not self._imu.end:
            return Mode.WAITING, self._door.silence(None)
        if self._units.wrong is not None:
            return Mode.INVALID, self._units.wrong
        silent = (t_ns - self._imu.latest_ns) * 1e-9
        if silent > self._gap_s:
            return Mode.WAITING if begun is None else Mode.INVALID, self._door.silence(silent)
        if begun is None:
            return Mode.ALIGNING, aligning
        e, p = self._estimator, self._estimator.covariance.item
        if not 0.0 <= (variance := p(6, 6) + p(7, 7)) <= self._limits.invalid_sd_m**2:
            return Mode.INVALID, f"horizontal sigma {math.sqrt(variance):.0f} m"
        if begun.unconfirmed:
            return Mode.COASTING, f"heading from {begun.how}; {begun.unconfirmed}"
        if (why := self._standing.unproven(e.t_ns)) is not None:
            return Mode.INVALID, why
        shaken = self._standing.shaken(e, self._timeline.isolation) or self._lateness.suspects
        if (why := shaken or self._units.unproven(e)) is not None:
            return Mode.COASTING, why
        unaided = (t_ns - begun.position_ns) * 1e-9
        if unaided > self._limits.coast_after_s:
            return Mode.COASTING, f"no position fused for {unaided:.0f} s"
        return Mode.NAVIGATING, f"heading from {begun.how}"
