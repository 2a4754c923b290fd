"""Navigation status: the mode of a running solution, from what is published of it, and what has
become of the measurements.

The first reason that holds is given; the order is that of their weight. What each mode means to who
reads it: `fusiond.navigation.solution`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.source_monitors import Verdicts
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import Mode
from fusiond.navigation.strapdown import VE, VN
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.alignment.start_check import StartTrial
from fusiond.navigator.health_check import FailedMeasurements
from fusiond.navigator.imu_screening import BEARABLE_YAW_RAD, ImuScreening
from fusiond.navigator.imu_unit_check import RateUnits
from fusiond.navigator.mode_reasons import joined, reason
from fusiond.navigator.protection_events import ProtectionWatch
from fusiond.navigator.sensor_white_noise import WhiteNoise
from fusiond.navigator.timeline import JUDGED, Entry

COURSE_M_S = 3.0
"""A vehicle shows its heading by driving above that, by default of its alignment."""


class StartedNavigation(NamedTuple):
    """Navigation since its start.

    `basis`: why it navigates, in words: how its heading came about, or which fixes ended the last
    coasting. `unconfirmed`: condition of the heading that nothing has shown yet, else empty.
    `position_ns`: instant of the last position fused.
    """

    basis: str
    unconfirmed: str
    position_ns: int


class NavigationStatus:
    """Judge of one navigator's solution; reads its parts and changes nothing."""

    def __init__(
        self,
        config: Config,
        estimator: Estimator,
        imu: ImuBuffer,
        screening: ImuScreening,
        units: RateUnits,
    ) -> None:
        self._gap_s = config.imu.gap_s
        self._limits = config.estimator
        self._max_speed_m_s = config.plausibility.max_speed_m_s
        self._estimator = estimator
        self._imu = imu
        self._screening = screening
        self._units = units

    def of(self, t_ns: int, started: StartedNavigation | None, aligning: str) -> tuple[Mode, str]:
        """The mode at `t_ns`; without a navigation `aligning` is what the alignment waits for."""
        if not self._imu.end:
            return Mode.WAITING, self._screening.silence(None)
        if self._units.wrong is not None:
            return Mode.INVALID, self._units.wrong
        silent = (t_ns - self._imu.latest_ns) * 1e-9
        if silent > self._gap_s:
            return Mode.WAITING if started is None else Mode.INVALID, self._screening.silence(
                silent
            )
        if started is None:
            return Mode.ALIGNING, aligning
        sd = self._estimator.sigmas()
        sd_m = math.hypot(sd.item(0), sd.item(1))
        if not sd_m <= self._limits.invalid_sd_m:
            limit = self._limits.invalid_sd_m
            return Mode.INVALID, reason("sigma", sd=sd_m, limit=limit)
        if started.unconfirmed:
            return Mode.COASTING, joined((started.basis, started.unconfirmed))
        if not self._units.fits and (why := self._units.unproven(self._estimator)[0]) is not None:
            return Mode.COASTING, why
        unaided = (t_ns - started.position_ns) * 1e-9
        if unaided > self._limits.coast_after_s:
            return Mode.COASTING, reason("no_fix", seconds=unaided)
        return Mode.NAVIGATING, started.basis

    def failure(self, diagnosis: Diagnosis) -> str | None:
        """Reason why navigation must restart; None while it need not."""
        e = self._estimator
        speed = math.hypot(e.nav.item(VN), e.nav.item(VE))
        if speed > self._max_speed_m_s:
            return reason("too_fast", speed=speed)
        # Two sigma of what an error state bears: what was felt meanwhile lies on an arc.
        variance = e.covariance.item(2, 2)
        if 4.0 * variance > BEARABLE_YAW_RAD**2 and speed > COURSE_M_S and e.heading_known:
            return reason("heading_lost", sd=math.degrees(math.sqrt(variance)))
        if not diagnosis.positions_out:
            return None
        if (device := diagnosis.contradicts) is not None:
            return reason("filter_disagrees", device=device)
        sd = e.sigmas()
        if not math.hypot(sd.item(0), sd.item(1)) <= self._limits.invalid_sd_m:
            return reason("nothing_in_service")
        return None


class OutcomeWatch:
    """Hears of each entry of a timeline that has been applied, again after a rewind.

    `coast_after_ns`: without a position for longer the next one is the `basis` of navigation."""

    def __init__(
        self,
        coast_after_ns: int,
        trial: StartTrial,
        protection: ProtectionWatch,
        failed: FailedMeasurements,
        verdicts: Verdicts,
        white: WhiteNoise,
        on_outcome: Callable[[Entry], None] | None,
    ) -> None:
        self._coast_after_ns, self._trial, self._protection = coast_after_ns, trial, protection
        self._failed, self.verdicts, self._on_outcome = failed, verdicts, on_outcome
        self._white = white
        self.refused: dict[str, Counter[str]] = {}
        """Refusals at the door by source and name."""
        self.fused_ns: dict[str, int] = {}
        """By source the last instant that was fused."""
        self.position_ns = 0
        self.basis = ""
        """Reason of the mode `navigating`: the origin of its heading, or the fixes that ended the
        last coasting."""

    def refuse(self, source: str, name: str) -> str:
        """Count a refusal; its name."""
        self.refused.setdefault(source, Counter())[name] += 1
        return name

    def begin(self, start: Start) -> str:
        """A filter has been started so; why it navigates."""
        self.position_ns = max(start.t_ns, self.position_ns)
        self.basis = reason("heading_from", how=start.how)
        return self.basis

    def receive(self, entry: Entry) -> None:
        """An entry has been applied."""
        outcome, measurement = entry.outcome, entry.measurement
        if outcome is None:
            return
        name, source = outcome.name, measurement.source
        self._white.receive(source, entry.key[0], outcome.first)
        if self._trial.warm is not None and measurement.locates:
            self._trial.warm.judge(source, name)
        if name == "fused":
            if not entry.judged and outcome.whitened:
                entry.judged = True
                self.verdicts.waiting.append((measurement, outcome))
            t_ns = entry.key[0]
            if t_ns > self.fused_ns.get(source, -1):
                self.fused_ns[source] = t_ns
            check = self._trial.check
            if measurement.locates and check is not None and check.unshown is not None:
                check.located(measurement)
            if measurement.locates and t_ns > self.position_ns:
                if t_ns - self.position_ns > self._coast_after_ns:
                    self.basis = reason("fixes_back", source=source)
                self.position_ns = t_ns
        if measurement.screened:
            measurement.judged(outcome.rows, outcome.whitened)
            if name in JUDGED:
                self._protection.look(measurement)
        if entry.error:
            self._failed.report(source, entry.error)
        if self._on_outcome is not None:
            self._on_outcome(entry)
