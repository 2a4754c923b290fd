"""The navigator: samples and measurements in, solution out. A function of its arrivals alone.

It has no clock and no I/O. `add_imu` and `add` receive arrivals, `advance` runs the filter up to
the last IMU sample, `solution` reads the state at an instant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import Measurement
from drivers.raw.messages import NavigationMessage, RawGnssEpoch
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.finite_check import first_not_finite
from fusiond.estimators.invariant import InvariantFilter
from fusiond.integrity.catalogue import Kind
from fusiond.models.model import Model
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels
from fusiond.navigator.alignment.aligner import Aligner
from fusiond.navigator.alignment.latency import LatencySearch
from fusiond.navigator.alignment.options import alignment_options
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.alignment.start_check import StartTrial
from fusiond.navigator.assembly import (
    estimator_of,
    imu_buffer_of,
    kinds_of_config,
    model_of,
    verdicts_of,
)
from fusiond.navigator.calibration import CalibrationWatch
from fusiond.navigator.fault_events import ServiceEvents
from fusiond.navigator.health_check import RAISED_BY_NUMBERS, FailedMeasurements, broken
from fusiond.navigator.imu_handover import hand_over, publish_by_axes
from fusiond.navigator.imu_noise import ImuNoise
from fusiond.navigator.imu_screening import AHEAD_NS, ImuScreening
from fusiond.navigator.imu_unit_check import RateUnits
from fusiond.navigator.intake import Intake
from fusiond.navigator.intake.gnss import operator_position
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.motion_constraints import ConstraintMaker, vehicle_blocks
from fusiond.navigator.protection_events import NO_BOUND, ProtectionWatch
from fusiond.navigator.published_solution import (
    NavigationStatus,
    OutcomeWatch,
    publish_by_own_clock,
    solution_of,
)
from fusiond.navigator.saved_noise import SavedNoise
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.source_status import SourceService
from fusiond.navigator.timeline import Entry, Timeline
from fusiond.navigator.without_imu import MOST_REMEMBERED, SENDS_NS, WithoutImu, counted_together

if TYPE_CHECKING:
    from fusiond.navigator.saved_calibration import SavedCalibration

Array = NDArray[np.float64]

# Verdicts on a sigma, of windows of minutes, are made of all that has come within this.
VERDICTS_NS = 1_000_000_000
# An instant that may be off by a second or more has the error of a jump of UTC, alike in all
# measurements until it ends: no filter's white noise. The clock says 0.5 s where it knows no UTC.
UNKNOWN_TIME_S = 0.9


class Navigator:
    """Navigation of one vehicle. `on_event(code, text)` receives what an operator should know;
    `estimator` makes the filter of the configuration and its model."""

    keeps_solutions = False
    """True if `imu` keeps the solution at each sample, as by `advance(record=True)`."""

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
        self._noise, self._options = imu_noise(imu), alignment_options(config)
        self._limits, self._gap_ns = config.plausibility, round(imu.gap_s * 1e9)
        self._intake = Intake(config.aiding, self._limits, self._event)
        self.raw = self._intake.receivers
        shared_blocks = self._intake.extra_blocks()
        of_vehicle = vehicle_blocks(config.constraints.non_holonomic)
        self.model = model_of(config, *of_vehicle, *shared_blocks)
        self.imu = imu_buffer_of(config, self.model)
        self._screening = ImuScreening(imu, e.buffer_s, self._event)
        self._units = RateUnits(self._noise.rate_bias_initial, self._event)
        kinds = kinds_of_config(config, self.model)
        self.estimator = estimator(config, self.model, kinds)
        publish_by_axes(self.estimator, imu)
        self.verdicts = verdicts_of(config, self.model, self._event)
        self._failed = FailedMeasurements(self._event)
        self._protection = ProtectionWatch(config, self.estimator, self._event)
        self._drifts = DriftLevels(self.model)
        self.trial = StartTrial(self._options, self._event)
        self.outcome_watch = OutcomeWatch(
            *(round(e.coast_after_s * 1e9), self.trial, self._protection, self._failed),
            *(self.verdicts, self._drifts.white, on_outcome),
        )
        self.timeline = Timeline(
            *(self.estimator, self.imu, e.buffer_s, e.checkpoint_s, self.outcome_watch.receive),
            kinds if self.estimator.hypotheses is not None else (),
        )
        self._intake.count_drifts(self._drifts)
        self._constraints = ConstraintMaker(config.constraints, self._noise, self._drifts)
        self._service_events = ServiceEvents(self.timeline, self._event)
        self.service = SourceService(self.timeline, e.federated.sources or tuple(config.aiding))
        self._imu_noise = ImuNoise(self.model, imu, self._drifts)
        fused_ns = self.outcome_watch.fused_ns
        self.without_imu = WithoutImu(config, shared_blocks, self._event, fused_ns, on_outcome)
        self._verdicts_ns = 0
        self.started: Start | None = None
        self._calibration: SavedCalibration | None = None
        self.calibrating = CalibrationWatch(self.model, self._event, imu.misalignment_deg * DEG)
        self._latency = LatencySearch(self._options, self._noise, self.model, self._event)
        of_navigation = self.estimator, self.imu, self._screening, self._units
        self._status = NavigationStatus(config, *of_navigation, self.trial, self.outcome_watch)
        self._aligner = self._new_aligner()

    def _new_aligner(self) -> Aligner:
        return Aligner(self._options, self._noise, self.model, self._saved, self._event)

    # ------------------------------------------------------------------ arrivals

    @property
    def calibration(self) -> SavedCalibration | None:
        """Calibration of an earlier drive, restored by each alignment until refuted."""
        return self._calibration

    @calibration.setter
    def calibration(self, saved: SavedCalibration | None) -> None:
        self._calibration = saved
        if saved is not None and (noise := saved.noise) is not None:
            self._intake.take_up(noise.fixes)
            self._imu_noise.take_up(self.imu, noise.predictions, noise.shares)
            self._drifts.take_up(noise.drifts)
            self._drifts.white.take_up(noise.whites)

    def shown_noise(self, utc_s: float | None) -> SavedNoise:
        """Observed noise of receivers, inertial unit and vehicle until that time (POSIX)."""
        of_samples = self._imu_noise.shown
        of_vehicle = self._drifts.shown, self._drifts.white.shown
        return SavedNoise(utc_s, self._intake.fixes_shown, *of_samples, *of_vehicle)

    def set_gates(self, gates: Mapping[str, float]) -> None:
        """Set `gate_probability` by section of `aiding`; verdicts restart, as they depend on it."""
        self._intake.set_gates(gates)
        self.verdicts = verdicts_of(self.config, self.model, self._event)
        self.outcome_watch.verdicts = self.verdicts

    def add_imu(self, times: NDArray[np.int64], samples: Array) -> int:
        """Add IMU samples (m,) ns of validity, (m, 6) rate and force in sensor axes; returns the
        number used.

        Invalid samples are rejected by name; after too long a gap alignment restarts
        (fusiond.navigator.imu_screening).
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
        """Change to the spare inertial unit (fusiond.navigator.imu_handover)."""
        self._screening.change()
        self._units.change()
        self._imu_noise.change()
        self.calibrating.restart()  # of the first unit
        publish_by_axes(self.estimator, self.config.imu, spare=True)
        if self.started is not None:
            return hand_over(self.estimator, self.timeline, self.config.imu)
        return self._restart(reason("imu_spare"))

    def _restart(self, why: str) -> None:
        """Discard the evidence of all earlier samples."""
        saved = self._saved if self.started is None else None
        self.imu.restart()
        self.reset(why, saved)

    def _sense(self, taken: int) -> None:
        """Derive constraints and standstill from the newest samples."""
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
        """Add a measurement valid at `t_ns`; returns `accepted` or the name of its rejection."""
        if seen_ns and t_ns > seen_ns + AHEAD_NS:
            return self.outcome_watch.refuse(m.source, "from_future")
        if sd_time_s > UNKNOWN_TIME_S:
            return self.outcome_watch.refuse(m.source, "time_unknown")
        if seen_ns and self._screening.arrived(seen_ns, self.imu):
            self._restart(reason("imu_stamps_ahead"))
        try:
            measurements = self._intake.measurements_of(m, t_ns, sd_time_s, seen_ns)
        except RAISED_BY_NUMBERS as error:
            self._failed.report(m.source, repr(error))
            return self.outcome_watch.refuse(m.source, "failed")
        if isinstance(measurements, str):
            return self.outcome_watch.refuse(m.source, measurements)
        self.without_imu.arrived.append((measurements, seen_ns))
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
        """Discard the solution and align again, with a saved state if still valid."""
        self._latency.stop()
        self.timeline.clear()
        self._protection.restart()
        self._imu_noise.restart()
        self.started, self._saved, self.trial.warm = None, saved, None
        self._aligner = self._new_aligner()
        self._aligner.reason = why

    def set_position(
        self, lat_rad: float, lon_rad: float, height_m: float, sd_m: float, t_ns: int
    ) -> str:
        """Apply an operator's position at the present `t_ns`: as the fix for alignment
        (`aligning`), as the start without an inertial unit (`beginning`), or as an ordinary fix,
        whose outcome is returned."""
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
        """Advance to `t_ns`, without an inertial unit if none delivers samples."""
        self.advance()
        without, imu = self.without_imu, self.imu
        sends = imu.end and t_ns - imu.latest_ns < SENDS_NS
        if not sends or without.estimator is not None or len(without.arrived) > MOST_REMEMBERED:
            without.tick(t_ns, imu, self.started is not None)

    def advance(self, record: bool = False) -> None:
        """Run up to the last IMU sample. `record` stores the solution at each sample in `imu`."""
        if self._units.wrong is not None:  # nothing that was made of such rates is worth anything
            if self.started is not None:
                self.reset(self._units.wrong)
            return
        if self.started is None and not self._begin():
            return
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
        diagnosis, rest = self.timeline.diagnosis, self._constraints.rest_evidence
        if (failed := self._status.failure(diagnosis, rest)) is not None:
            self._event(failed.code, failed.text)
            self.reset(failed.why)
            self._aligner.known.reported.add(failed.code)
            return
        if self._protection.watches:
            self._protection.report()
        if e.t_ns >= self._imu_noise.due_ns:
            self._imu_noise.look(self.timeline, self.imu)
        if e.t_ns >= self.calibrating.due_ns or self.calibrating.turned:
            self._calibrate()

    def _begin(self) -> bool:
        """Start the filter if the alignment is ready; False otherwise."""
        if self._screening.look_behind(self.imu):
            return False
        start = self.trial.first(self.imu) or self._aligner.attempt(self.imu)
        too_old = start is None or self._start_is_too_old()
        if start is None or too_old or self._aligner.waits(start, self._latency):
            return False
        if self.calibration is not None and not self.trial.on_trial:
            start = self.calibration.taken_up(start, self.model)
        self.calibrating.restart()
        first = self.imu.index_after(start.t_ns) + self.imu.start
        self.estimator.initialise(start.t_ns, first, start.nav, start.xi, start.covariance)
        if isinstance(self.estimator, InvariantFilter):
            self.estimator.turns = start.turns
        self.timeline.start(start.used)
        self._imu_noise.started(start, self.estimator, self.imu)
        self.verdicts.reset()
        self.started = start
        self.trial.begin(start)
        self._event("aligned", self.outcome_watch.begin(start))
        return True

    def _calibrate(self) -> None:
        """Update the calibration; drop a restored one that proves wrong."""
        e, watch = self.estimator, self.calibrating
        if not (watch.look(e.t_ns, e.xi, e.covariance) or watch.turned) or not self.calibration:
            return
        if wrong := watch.turned or self.calibration.refuted(watch.parameters):
            self._event("calibration_refused", f"{wrong}: not used, aligning again")
            self.calibration = None
            self.reset(reason("calibration_wrong", what=wrong))

    def _start_is_too_old(self) -> bool:
        """True if a receiver is found to be delayed; alignment then restarts with its last fixes at
        their corrected instants."""
        found = self._latency.look(self.imu)
        if found is None:
            return False
        publish_by_own_clock(self.estimator, found.sd_s)  # it has said when the fixes were
        self.reset(found.why)
        self._aligner.receive(self._latency.kept())
        return True

    def solution(self, t_ns: int) -> Solution:
        """Solution at `t_ns`, after the last `advance`.

        After the newest sample the state is extrapolated with that sample's rates, for `gap_s` at
        most; beyond, the mode reports a silent IMU. Before it the result is the filter's state of
        that instant, by the measurements valid until then; before the stored history (`buffer_s`,
        or the start) there is none. The mode is always the present one.
        """
        if self.without_imu.estimator is not None:
            return self.without_imu.solution(t_ns, self.mode(t_ns)[1], self._protection.unknown())
        if self.started is None:
            return Solution(t_ns, *self.mode(t_ns), bound=self._protection.unknown())
        earlier = t_ns < self.estimator.t_ns
        if earlier and t_ns < self.timeline.oldest_ns:
            return Solution(t_ns, Mode.INVALID, reason("before_history"))
        with self.timeline.past(t_ns) if earlier else nullcontext():
            mode, why = self._status.of(t_ns, True, "")
            bound = self._protection.bound() if self._protection.watches else NO_BOUND
            worse = 1.0 if self._units.fits else self._units.unproven(self.estimator)[1]
            unshown = None if (check := self.trial.check) is None else check.unshown
            return solution_of(
                *(self.estimator, self.imu, t_ns, self._gap_ns, mode, why, bound),
                *(self._limits, unshown, worse),
            )

    def mode(self, t_ns: int) -> tuple[Mode, str]:
        """Mode at `t_ns`, and why."""
        return self._status.of(t_ns, self.started is not None, self._aligner.reason)

    @property
    def active_filter(self) -> Estimator:
        """Estimator of the solution."""
        return self.without_imu.estimator or self.estimator

    def outcomes(self) -> dict[str, Counter[str]]:
        """Outcomes of measurements, by source, with an inertial unit or without."""
        return counted_together(self.timeline.counters.outcomes, self.without_imu.counted())
