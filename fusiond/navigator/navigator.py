"""The navigator: samples and measurements in, solution out. A function of its arrivals alone.

It holds no clock and does no I/O. `add_imu` and `add` take what has arrived, `advance` runs the
filter as far as the IMU reaches, `solution` reads the state at an instant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import Measurement
from drivers.raw.messages import NavigationMessage, RawGnssEpoch
from fusiond.configuration.schema import Config
from fusiond.configuration.settings import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.finite_check import first_not_finite
from fusiond.estimators.invariant import InvariantFilter
from fusiond.integrity.catalogue import SENSOR, Kind
from fusiond.models.model import Model
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.alignment.aligner import Aligner
from fusiond.navigator.alignment.latency import LatencySearch
from fusiond.navigator.alignment.options import alignment_options
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.alignment.start_check import StartCheck
from fusiond.navigator.assembly import (
    estimator_of,
    imu_buffer_of,
    kinds_of_config,
    model_of,
    verdicts_of,
)
from fusiond.navigator.calibration import CalibrationWatch
from fusiond.navigator.drift_levels import DriftLevels
from fusiond.navigator.health_check import RAISED_BY_NUMBERS, FailedMeasurements, broken
from fusiond.navigator.imu_change import hand_over, publish_by_axes
from fusiond.navigator.imu_noise import ImuNoise
from fusiond.navigator.imu_screening import ImuScreening
from fusiond.navigator.imu_unit_check import RateUnits
from fusiond.navigator.intake import Intake
from fusiond.navigator.intake.gnss import operator_position
from fusiond.navigator.motion_constraints import ConstraintMaker, vehicle_blocks
from fusiond.navigator.protection import NO_BOUND, ProtectionWatch
from fusiond.navigator.published_solution import publish_by_own_clock, solution_of
from fusiond.navigator.reasons import reason
from fusiond.navigator.saved_noise import SavedNoise
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.service_events import ServiceEvents
from fusiond.navigator.source_status import SourceService
from fusiond.navigator.state_file import RefusedStateError
from fusiond.navigator.status import NavigationStatus, StartedNavigation
from fusiond.navigator.timeline import JUDGED, Entry, Timeline
from fusiond.navigator.without_imu import WithoutImu, counted_together

if TYPE_CHECKING:
    from fusiond.navigator.saved_calibration import SavedCalibration
    from fusiond.navigator.warm_start import WarmStart

Array = NDArray[np.float64]

# A measurement may be valid this far ahead of the arrivals around it (clock mapping, jitter).
AHEAD_NS = 200_000_000
# Verdicts on a sigma, of windows of minutes, are made of all that has come within this.
VERDICTS_NS = 1_000_000_000
# An instant that may be off by a second or more has the error of a jump of UTC, alike in all
# measurements until it ends: no filter's white noise. The clock says 0.5 s where it knows no UTC.
UNKNOWN_TIME_S = 0.9


class Navigator:
    """Navigation of one vehicle. `on_event(code, text)` hears what an operator should know;
    `estimator` makes the filter of the configuration and its model."""

    keeps_solutions = False
    """At each sample in `imu`, as by `advance(record=True)`."""

    def __init__(
        self,
        config: Config,
        saved: SavedState | None = None,
        on_event: Callable[[str, str], None] | None = None,
        on_outcome: Callable[[Entry], None] | None = None,
        estimator: Callable[[Config, Model, Sequence[Kind]], Estimator] = estimator_of,
    ) -> None:
        self.config = config
        self._saved = saved
        self._event = on_event or (lambda code, text: None)
        e, imu = config.estimator, config.imu
        self._noise = imu_noise(imu)
        self._intake = Intake(config.aiding, config.plausibility, self._event)
        self._manoeuvre = config.plausibility.manoeuvre
        self.raw = self._intake.receivers
        of_vehicle = vehicle_blocks(config.constraints.non_holonomic)
        shared_blocks = self._intake.extra_blocks()
        self.model = model_of(config, *of_vehicle, *shared_blocks)
        self.imu = imu_buffer_of(config, self.model)
        self._screening = ImuScreening(imu, e.buffer_s, self._event)
        self._units = RateUnits(self._noise.rate_bias_initial, self._event)
        kinds = kinds_of_config(config, self.model)
        self.estimator = estimator(config, self.model, kinds)
        publish_by_axes(self.estimator, imu)
        self.verdicts = verdicts_of(config, self.model, self._event)
        self.timeline = Timeline(
            *(self.estimator, self.imu, e.buffer_s, e.checkpoint_s, self._outcome),
            kinds if self.estimator.hypotheses is not None else (),
        )
        self._on_outcome = on_outcome
        self._drifts = DriftLevels(self.model)
        self._intake.count_drifts(self._drifts)
        self._constraints = ConstraintMaker(config.constraints, self._noise, self._drifts)
        names = e.federated.sources or tuple(config.aiding)
        self._failed = FailedMeasurements(self._event)
        self._service_events = ServiceEvents(self.timeline, self._event)
        self.service = SourceService(self.timeline, names)
        self._protection = ProtectionWatch(config, self.estimator, self._event)
        self._imu_noise = ImuNoise(self.model, imu, self._drifts)
        self.refused: dict[str, Counter[str]] = {}
        self.last_fused_ns: dict[str, int] = {}
        self.without_imu = WithoutImu(
            config, shared_blocks, self._event, self.last_fused_ns, self._on_outcome
        )
        self._last_position_ns = self._verdicts_ns = 0
        self._basis = ""
        self.started: Start | None = None
        self._start_check: StartCheck | None = None
        self.warm: WarmStart | None = None
        """A start to be tried before any alignment, and its trial."""
        self._calibration: SavedCalibration | None = None
        self.calibrating = CalibrationWatch(self.model, self._event, imu.misalignment_deg * DEG)
        self._latency = LatencySearch(
            alignment_options(config), self._noise, self.model, self._event
        )
        self._status = NavigationStatus(
            config, self.estimator, self.imu, self._screening, self._units
        )
        self._aligner = self._new_aligner()

    def _new_aligner(self) -> Aligner:
        options = alignment_options(self.config)
        return Aligner(options, self._noise, self.model, self._saved, self._event)

    # ------------------------------------------------------------------ arrivals

    @property
    def calibration(self) -> SavedCalibration | None:
        """Calibration of an earlier drive, taken up by each alignment until it is refuted."""
        return self._calibration

    @calibration.setter
    def calibration(self, saved: SavedCalibration | None) -> None:
        self._calibration = saved
        if saved is not None and (noise := saved.noise) is not None:
            self._intake.take_up(noise.fixes)
            self._imu_noise.take_up(self.imu, noise.predictions, noise.shares)
            self._drifts.take_up(noise.drifts)

    def shown_noise(self, utc_s: float | None) -> SavedNoise:
        """Noise of receivers, inertial unit and vehicle as shown until that time (POSIX)."""
        of_samples = self._imu_noise.shown
        return SavedNoise(utc_s, self._intake.fixes_shown, *of_samples, self._drifts.shown)

    def set_gates(self, gates: Mapping[str, float]) -> None:
        """`gate_probability` by section of `aiding`; verdicts, which hold for one, begin anew."""
        self._intake.set_gates(gates)
        self.verdicts = verdicts_of(self.config, self.model, self._event)

    def add_imu(self, times: NDArray[np.int64], samples: Array) -> int:
        """IMU samples (m,) ns of validity, (m, 6) rate and force in sensor axes; how many count.

        What cannot be true is refused by name; what leaves too much unknown ends the navigation:
        alignment begins anew (fusiond.navigator.imu_screening).
        """
        taken = 0
        for run in self._screening.admit(times, samples, self.imu, self.started is not None):
            if run.ends:
                self._restart(run.ends)
            if appended := self.imu.append(run.times, run.samples):
                self._sense(appended)
            taken += appended
        if self._screening.restarts(self.imu):
            self._restart(reason("imu_stamps_back"))
        return taken

    def change_imu(self) -> None:
        """The samples from now on are the spare's (fusiond.navigator.imu_change)."""
        self._screening.change()
        self._units.change()
        self._imu_noise.change()
        self.calibrating.restart()  # of the first unit
        publish_by_axes(self.estimator, self.config.imu, spare=True)
        if self.started is not None:
            return hand_over(self.estimator, self.timeline, self.config.imu)
        return self._restart(reason("imu_spare"))

    def _restart(self, why: str) -> None:
        """Nothing that the samples so far have told counts any more."""
        saved = self._saved if self.started is None else None
        self.imu.restart()
        self.reset(why, saved)

    def _sense(self, taken: int) -> None:
        """The newest samples have come: what they say by themselves."""
        new = max(0, self.imu.end - taken)
        sensed = self._constraints.feed(self.imu, new)
        self._units.samples(self.imu, new)
        if self.started is None:
            self._aligner.sensed(sensed.windows, sensed.measurements)
        for measurement in sensed.measurements:
            self.timeline.insert(measurement)

    def learn(self, message: NavigationMessage) -> None:
        """Store a broadcast message, for the raw epochs of the same source."""
        if message.source in self.raw:
            self.raw[message.source].learn(message)

    def add(
        self, m: Measurement | RawGnssEpoch, t_ns: int, sd_time_s: float = 0.0, seen_ns: int = 0
    ) -> str:
        """A measurement valid at `t_ns`; returns `accepted` or the name of its refusal."""
        if seen_ns and t_ns > seen_ns + AHEAD_NS:
            return self._refuse(m.source, "from_future")
        if sd_time_s > UNKNOWN_TIME_S:
            return self._refuse(m.source, "time_unknown")
        try:
            measurements = self._intake.measurements_of(m, t_ns, sd_time_s, seen_ns)
        except RAISED_BY_NUMBERS as error:
            self._failed.report(m.source, repr(error))
            return self._refuse(m.source, "failed")
        if isinstance(measurements, str):
            return self._refuse(m.source, measurements)
        self.without_imu.receive(measurements, seen_ns)
        if self.started is not None and m.source in self._latency.on_time:
            self._latency.waiting.append((m.source, measurements))
        else:
            measurements = self._latency.receive(m.source, measurements)
        if self.started is None:
            self._aligner.receive(measurements)
        if t_ns >= self._units.due_ns.get(m.source, 0):
            self._units.fix(m, t_ns, self.imu, measurements)
        self._constraints.rest_evidence.waiting.extend(measurements)
        for measurement in measurements:
            self.timeline.insert(measurement)
        return "accepted"

    def reset(self, why: str, saved: SavedState | None = None) -> None:
        """Forget the solution and align anew, with a saved state if it still holds."""
        self._latency.stop()
        self.timeline.clear()
        self._protection.restart()
        self._imu_noise.restart()
        self.started, self._saved, self.warm = None, saved, None
        self._aligner = self._new_aligner()
        self._aligner.reason = why

    def set_position(
        self, lat_rad: float, lon_rad: float, height_m: float, sd_m: float, t_ns: int
    ) -> str:
        """An operator's position at `t_ns`, which is now: the fix to align by (`aligning`), or to
        begin by where there is no inertial unit (`beginning`), or a fix like any other, whose
        outcome is returned."""
        where, without = (lat_rad, lon_rad, height_m), self.without_imu
        if without.takes_over(t_ns, self.imu):
            return without.take_position(operator_position(t_ns, where, sd_m), t_ns) or "beginning"
        if without.active:
            without.take_position(operator_position(t_ns, where, sd_m), t_ns)
        measurement = operator_position(self.imu.latest_ns, where, sd_m)
        if self.started is None:
            self._aligner.receive([measurement])
        entry = self.timeline.insert(measurement)
        self.advance()
        return "aligning" if entry.outcome is None else entry.outcome.name

    # ------------------------------------------------------------------ running

    def tick(self, t_ns: int) -> None:
        """It is `t_ns`: `advance`, and navigate by what there is where no inertial unit says
        anything."""
        self.advance()
        self.without_imu.tick(t_ns, self.imu, self.started is not None)

    def advance(self, record: bool = False) -> None:
        """Run as far as the IMU reaches. `record` keeps the solution at each sample in `imu`."""
        if self.started is None:
            start = self._warm_start() or self._aligner.attempt(self.imu)
            if (
                start is None
                or self._start_is_too_old()
                or self._aligner.waits(start, self._latency)
            ):
                return
            if self.calibration is not None and not self.on_trial:
                start = self.calibration.taken_up(start, self.model)
            self.calibrating.restart()
            first = self.imu.index_after(start.t_ns) + self.imu.start
            self.estimator.initialise(start.t_ns, first, start.nav, start.xi, start.covariance)
            if isinstance(self.estimator, InvariantFilter):
                self.estimator.turns = start.turns
            self.timeline.start(start.used)
            self.verdicts.reset()
            self.started = start
            self._start_check = StartCheck(alignment_options(self.config), start)
            self._last_position_ns = max(start.t_ns, self._last_position_ns)
            self._basis = reason("heading_from", how=start.how)
            self._event("aligned", self._basis)
        self.timeline.advance(record or self.keeps_solutions)
        e = self.estimator
        if not 0 <= e.t_ns - self._verdicts_ns < VERDICTS_NS:
            self._verdicts_ns = e.t_ns
            self.verdicts.report()
        if first_not_finite(e.nav, e.xi, e.covariance) >= 0:
            what = broken(e)
            self._event("filter_not_finite", f"{what}: aligning again")
            self.reset(what)
            return
        if self.timeline.decided:
            self.timeline.decided = False
            if self._service_events.report():
                self.calibrating.corrected()
                self._imu_noise.corrected(e)
        if self._refuted():  # before it is a failure, of which it would be the reason
            return
        failure = self._status.failure(self.timeline.diagnosis)
        if failure is not None:
            self._event("diverged", f"{failure}: aligning again")
            self.reset(failure)
            return
        if self.warm is not None and self.warm.refused_by is not None:
            why = reason("warm_start_wrong", source=self.warm.refused_by)
            self._event("warm_start_refused", f"{why}: aligning again")
            self.reset(why)
            return
        if self._protection.watches:
            self._protection.report()
        self._imu_noise.look(self.timeline, self.imu)
        if e.t_ns >= self.calibrating.due_ns or self.calibrating.turned:
            self._calibrate()

    def _calibrate(self) -> None:
        """Look at the calibration; one that was taken up and proves wrong is given up."""
        e, watch = self.estimator, self.calibrating
        if not (watch.look(e.t_ns, e.xi, e.covariance) or watch.turned) or not self.calibration:
            return
        if wrong := watch.turned or self.calibration.refuted(watch.parameters):
            self._event("calibration_refused", f"{wrong}: not used, aligning again")
            self.calibration = None
            self.reset(reason("calibration_wrong", what=wrong))

    def _refuted(self) -> bool:
        """True if the start has shown to be a wrong one; alignment then begins anew."""
        e, start = self.estimator, self._start_check
        if start is None:
            return False
        doubted = any(f.kind.of == SENSOR for f in self.timeline.diagnosis.findings)
        wrong = start.refuted(e.t_ns, e.nav, e.covariance, self._constraints.rest_evidence, doubted)
        if wrong is None:
            return False
        self._event(*wrong)
        self.reset(wrong[1])
        self._aligner.known.reported.add(wrong[0])
        return True

    def _start_is_too_old(self) -> bool:
        """True if a receiver is found to be late; alignment then begins anew, by its last fixes at
        the instants at which they were true."""
        found = self._latency.look(self.imu)
        if found is None:
            return False
        publish_by_own_clock(self.estimator, found.sd_s)  # it has said when the fixes were
        self.reset(found.why)
        self._aligner.receive(self._latency.kept())
        return True

    def _warm_start(self) -> Start | None:
        """The start from the state of the last run, at the first sample; there is one attempt."""
        if self.warm is None or not self.imu.end:
            return None
        try:
            return self.warm.start(self.imu.oldest_ns)
        except RefusedStateError as error:
            self._event("warm_state_refused", str(error))
            self.warm = None
            return None

    @property
    def on_trial(self) -> bool:
        """Started from the state of the last run, and no position measurement has confirmed it
        yet."""
        return self.warm is not None and self.warm.on_trial

    @property
    def unconfirmed(self) -> str:
        """Condition of the heading that nothing has shown, in words; empty where it does not."""
        if self.warm is not None and self.warm.on_trial:
            return reason("not_confirmed_by_fix")
        return self._start_check.unconfirmed if self._start_check else ""

    def solution(self, t_ns: int) -> Solution:
        """The solution at `t_ns`, of all that has been run by `advance`.

        Later than the newest sample it is carried ahead by holding that sample's rates, at most for
        `gap_s`: beyond it the mode says that the IMU is silent. Earlier it is the filter's state of
        that very instant, by the measurements valid until then; before what is kept of it
        (`buffer_s`, and the start) nothing is known. The mode is always that of now.
        """
        if self.without_imu.estimator is not None:
            return self.without_imu.solution(t_ns, self.mode(t_ns)[1], self._protection.unknown())
        if self.started is None or t_ns >= self.estimator.t_ns:
            return self._present(t_ns)
        if t_ns < self.timeline.oldest_ns:
            return Solution(t_ns, Mode.INVALID, reason("before_history"))
        with self.timeline.past(t_ns):
            return self._present(t_ns)

    def _present(self, t_ns: int) -> Solution:
        mode, reason = self.mode(t_ns)
        if self.started is None:
            return Solution(t_ns, mode, reason, bound=self._protection.unknown())
        gap_ns = round(self.config.imu.gap_s * 1e9)
        bound = self._protection.bound() if self._protection.watches else NO_BOUND
        return solution_of(
            self.estimator, self.imu, t_ns, gap_ns, mode, reason, bound, self._manoeuvre
        )

    def mode(self, t_ns: int) -> tuple[Mode, str]:
        """Mode at `t_ns`, and why."""
        started = None
        if self.started is not None:
            started = StartedNavigation(self._basis, self.unconfirmed, self._last_position_ns)
        return self._status.of(t_ns, started, self._aligner.reason)

    @property
    def active_filter(self) -> Estimator:
        """The estimator of which the solution is."""
        return self.without_imu.estimator or self.estimator

    def outcomes(self) -> dict[str, Counter[str]]:
        """Outcomes of measurements, by source, with an inertial unit or without."""
        return counted_together(self.timeline.counters.outcomes, self.without_imu.counted())

    # ------------------------------------------------------------------ inside

    def _refuse(self, source: str, name: str) -> str:
        self.refused.setdefault(source, Counter())[name] += 1
        return name

    def _outcome(self, entry: Entry) -> None:
        outcome, measurement = entry.outcome, entry.measurement
        if outcome is None:
            return
        name, source = outcome.name, measurement.source
        if self.warm is not None and measurement.locates:
            self.warm.judge(source, name)
        if name == "fused":
            if not entry.judged and outcome.whitened:
                entry.judged = True
                self.verdicts.waiting.append((measurement, outcome))
            t_ns = entry.key[0]
            if t_ns > self.last_fused_ns.get(source, -1):
                self.last_fused_ns[source] = t_ns
            if measurement.locates and t_ns > self._last_position_ns:
                unaided_s = (t_ns - self._last_position_ns) * 1e-9
                if unaided_s > self.config.estimator.coast_after_s:
                    self._basis = reason("fixes_back", source=source)
                self._last_position_ns = t_ns
        if measurement.screened:
            measurement.judged(outcome.rows, outcome.whitened)
            if name in JUDGED:
                self._protection.look(measurement)
        if entry.error:
            self._failed.report(source, entry.error)
        if self._on_outcome is not None:
            self._on_outcome(entry)
