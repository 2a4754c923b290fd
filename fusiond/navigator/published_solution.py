"""Published status and solution of a running navigation.

The mode follows from the published solution and from the outcomes of the measurements. The first
reason that holds is given, in the order of weight. Meaning of the modes:
`fusiond.navigation.solution`.

The solution is the estimator's state, at its own instant or extrapolated.

If the inertial unit is silent for longer than the extrapolation, the motion is unknown. For each
second of it, one sigma is that the last motion continues or ends, and that the vehicle brakes or
turns by a; 5 a is the hardest manoeuvre of its class (fusiond.configuration.vehicle_class):

    velocity  |a_last| + a      position  |v| + velocity t / 2      yaw  |w_last| + a / |v|

and in a lasting bend the road is banked by (|a_last| + a) / g at most.

An unconfirmed heading may be reversed: half a turn is five sigma, and less once positions have
confirmed the path from the start (fusiond.navigator.alignment.start_check). It turns the velocity,
and the path since the last position. If the bias of the inertial unit is n sigma of its data sheet
and unproven (fusiond.navigator.imu_unit_check), sigma of the attitude is multiplied by n.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fusiond.aiding.base import Vector3
from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.configuration.schema import Config
from fusiond.configuration.vehicle_class import Plausibility
from fusiond.estimators.base import Estimator
from fusiond.estimators.propagation import published_ahead
from fusiond.integrity.consistency_monitors import Verdicts
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.solution import HEIGHT_KNOWN_SD_M, HELD_UNKNOWN_M, Bound, Mode, Solution
from fusiond.navigation.strapdown import NAV_SIZE, Q0, STEP_SMOOTH_N, STEP_SMOOTH_RATE_B, VN
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.alignment.start_check import StartTrial, Unshown
from fusiond.navigator.health_check import FailedMeasurements
from fusiond.navigator.imu_screening import BEARABLE_YAW_RAD, ImuScreening
from fusiond.navigator.imu_unit_check import RateUnits
from fusiond.navigator.mode_reasons import joined, reason
from fusiond.navigator.protection_events import ProtectionWatch
from fusiond.navigator.sensor_white_noise import WhiteNoise
from fusiond.navigator.timeline import JUDGED, Entry

_SIZE = NAV_SIZE + 3
SLOW_M_S = 5.0
"""Speed below which a car's turn rate is limited by its steering: 1.6 m/s^2 are 18 deg/s."""
COURSE_M_S = 3.0
"""A vehicle shows its heading by driving above that, by default of its alignment."""
MOST_SIGMAS = 5.0
"""Sigmas of the hardest manoeuvre: an error beyond them is a lie."""


def solution_of(
    estimator: Estimator,
    imu: ImuBuffer,
    t_ns: int,
    most_ns: int,
    mode: Mode,
    reason: str,
    bound: Bound,
    limits: Plausibility,
    unshown: Unshown | None = None,
    worse: float = 1.0,
) -> Solution:
    """Solution at `t_ns`; after the estimator's instant extrapolated with the rates of the newest
    sample, for `most_ns` at most. `limits`: those of the vehicle's class; `unshown`: uncertainty of
    an unconfirmed heading; `worse`: factor of the inertial unit's errors on its data sheet."""
    ahead_ns = min(t_ns - estimator.t_ns, most_ns)
    ahead_s = ahead_ns * 1e-9 if ahead_ns > 0 and imu.end else 0.0
    e, model, errors, out = estimator, estimator.model, estimator.sensor_errors, np.empty(_SIZE)
    newest, time_slot = imu.end - 1, e.published.time_slot
    published_ahead(
        *(e.nav, e.xi, e.step, imu.samples, newest),
        *(errors, ahead_s, model.hold_height, time_slot, out),
    )
    lat, lon, height, v_n, v_e, v_d, _, _, _, _, roll, pitch, yaw = out.tolist()
    sd, bias = e.sigmas().tolist(), errors.tolist()
    silent_s = (t_ns - e.t_ns) * 1e-9 - ahead_s
    if silent_s > 0.0:
        _widen_by_silence(sd, (v_n, v_e, v_d), e, silent_s, limits)
    if worse > 1.0:
        sd[6:9] = [min(worse * each, math.pi) for each in sd[6:9]]
    if unshown is not None:
        _widen_by_claim(sd, (lat, lon), (v_n, v_e), unshown)
    for k in model.unstated:
        sd[k] = math.nan
    if sd[2] > HEIGHT_KNOWN_SD_M or (model.hold_height and abs(height) < HELD_UNKNOWN_M):
        height = sd[2] = math.nan
    return Solution(
        t_ns,
        mode,
        reason,
        lat,
        (lon + math.pi) % (2.0 * math.pi) - math.pi,
        height,
        (v_n, v_e, v_d),
        (roll, pitch, yaw),
        (sd[0], sd[1], sd[2]),
        (sd[3], sd[4], sd[5]),
        (sd[6], sd[7], sd[8]),
        (bias[0], bias[1], bias[2]),
        (bias[3], bias[4], bias[5]),
        bound,
    )


def _widen_by_silence(
    sd: list[float], v: Vector3, e: Estimator, s: float, limits: Plausibility
) -> None:
    """Add the possible motion of `s` seconds to sigma (9,)."""
    step, (north, east, down), (_, vertical, lasts_s) = e.step, v, limits.manoeuvre
    level = limits.hardest_m_s2 / MOST_SIGMAS
    pull = math.hypot(step.item(STEP_SMOOTH_N), step.item(STEP_SMOOTH_N + 1)) + level
    banked = min(s / lasts_s, 1.0) * pull / STANDARD_GRAVITY_M_S2
    turned = abs(step.item(STEP_SMOOTH_RATE_B + 2)) + level / max(math.hypot(north, east), SLOW_M_S)
    for row, (speed, a) in enumerate(((north, pull), (east, pull), (down, vertical))):
        sd[row] = math.hypot(sd[row], (abs(speed) + 0.5 * a * s) * s)
        sd[3 + row] = math.hypot(sd[3 + row], a * s)
    for row, angle in enumerate((banked, banked, turned * s)):
        sd[6 + row] = min(math.hypot(sd[6 + row], angle), math.pi)


def _widen_by_claim(
    sd: list[float], place: tuple[float, float], v: tuple[float, float], unshown: Unshown
) -> None:
    """Add the uncertainty of an unconfirmed heading to sigma (9,), at `place` (rad) with velocity
    `v`, north and east."""
    doubt = unshown.sd_rad
    for row, more in enumerate((unshown.way_m(*place), math.hypot(*v))):
        for axis in (3 * row, 3 * row + 1):
            sd[axis] = math.hypot(sd[axis], doubt * more)
    sd[8] = math.hypot(sd[8], doubt)


def publish_by_own_clock(estimator: Estimator, sd_s: float) -> None:
    """Publish by the filter's own clock, the IMU's, from the next start on, since the receiver's
    clock is unusable.

    Its sigma against the clock of a receiver without delay is the model's prior of the time offset,
    or `sd_s`, one sigma of the fixes' delay, if the model has no time offset.
    """
    slot = estimator.model.time_slot
    clock_sd_s = float(estimator.model.initial[slot]) if slot >= 0 else sd_s
    estimator.publish_by(estimator.published._replace(time_slot=-1, clock_sd_s=clock_sd_s))


class Failure(NamedTuple):
    """Reason why navigation must restart, in words (`why`), with code and text of its event."""

    code: str
    text: str
    why: str


class NavigationStatus:
    """Mode of one navigator's solution, from its parts."""

    def __init__(
        self,
        config: Config,
        estimator: Estimator,
        imu: ImuBuffer,
        screening: ImuScreening,
        units: RateUnits,
        trial: StartTrial,
        outcomes: OutcomeWatch,
    ) -> None:
        self._gap_s = config.imu.gap_s
        self._limits = config.estimator
        self._max_speed_m_s = config.plausibility.max_speed_m_s
        self._estimator = estimator
        self._imu = imu
        self._screening = screening
        self._units, self._trial, self._outcomes = units, trial, outcomes

    def of(self, t_ns: int, started: bool, aligning: str) -> tuple[Mode, str]:
        """Mode at `t_ns`; `aligning`: what the alignment waits for, if there is no navigation."""
        if not self._imu.end:
            return Mode.WAITING, self._screening.silence(None)
        if self._units.wrong is not None:
            return Mode.INVALID, self._units.wrong
        silent = (t_ns - self._imu.latest_ns) * 1e-9
        if silent > self._gap_s:
            mode = Mode.INVALID if started else Mode.WAITING
            return mode, self._screening.silence(silent)
        if not started:
            return Mode.ALIGNING, aligning
        sd = self._estimator.sigmas()
        sd_m = math.hypot(sd.item(0), sd.item(1))
        if not sd_m <= self._limits.invalid_sd_m:
            limit = self._limits.invalid_sd_m
            return Mode.INVALID, reason("sigma", sd=sd_m, limit=limit)
        trial, known = self._trial, self._outcomes
        tried = trial.check is not None or trial.warm is not None
        if tried and (unconfirmed := trial.unconfirmed):
            return Mode.COASTING, joined((known.basis, unconfirmed))
        if not self._units.fits and (why := self._units.unproven(self._estimator)[0]) is not None:
            return Mode.COASTING, why
        unaided = (t_ns - known.position_ns) * 1e-9
        if unaided > self._limits.coast_after_s:
            return Mode.COASTING, reason("no_fix", seconds=unaided)
        return Mode.NAVIGATING, known.basis

    def failure(self, diagnosis: Diagnosis, measured: RestEvidence) -> Failure | None:
        """Failure of the navigation; None without one."""
        e, trial = self._estimator, self._trial
        axes, (v_n, v_e, v_d) = dcm_elements(e.nav[Q0:]), e.nav[VN : VN + 3].tolist()
        backward, most = -(axes[0] * v_n + axes[3] * v_e + axes[6] * v_d), trial.max_reverse_m_s
        if backward > most:
            ahead = np.array(axes[::3])
            sd = math.sqrt(max(float(ahead @ e.covariance[3:6, 3:6] @ ahead), 0.0))
            if backward - 3.0 * sd > most:
                why = reason("imu_backwards", speed=backward)
                return Failure("imu_backwards", why, why)
        if trial.check is not None:
            if wrong := trial.check.refuted(e, axes, -backward, diagnosis, measured):
                return Failure(*wrong, wrong[1])
            trial.look()
        speed, variance, why = math.hypot(v_n, v_e), e.covariance.item(2, 2), ""
        if speed > self._max_speed_m_s:
            why = reason("too_fast", speed=speed)
        # Two sigma of what an error state bears: what was felt meanwhile lies on an arc.
        elif 4.0 * variance > BEARABLE_YAW_RAD**2 and speed > COURSE_M_S and e.heading_known:
            why = reason("heading_lost", sd=math.degrees(math.sqrt(variance)))
        elif diagnosis.positions_out:
            why = self._unaided(diagnosis)
        if why:
            return Failure("diverged", f"{why}: aligning again", why)
        if trial.warm is not None and trial.warm.refused_by is not None:
            why = reason("warm_start_wrong", source=trial.warm.refused_by)
            return Failure("warm_start_refused", f"{why}: aligning again", why)
        return None

    def _unaided(self, diagnosis: Diagnosis) -> str:
        """Reason why a solution without positions in service must end, or empty."""
        if (device := diagnosis.contradicts) is not None:
            return reason("filter_disagrees", device=device)
        sd = self._estimator.sigmas()
        if not math.hypot(sd.item(0), sd.item(1)) <= self._limits.invalid_sd_m:
            return reason("nothing_in_service")
        return ""


class OutcomeWatch:
    """Record of each applied entry of a timeline, repeated after a rewind.

    `coast_after_ns`: after a longer time without a position the next one is a new `basis` of
    navigation."""

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
        """Record a start of the filter and its reason."""
        self.position_ns = max(start.t_ns, self.position_ns)
        self.basis = reason("heading_from", how=start.how)
        return self.basis

    def receive(self, entry: Entry) -> None:
        """Receive an applied entry."""
        outcome, measurement = entry.outcome, entry.measurement
        if outcome is None:
            return
        name, source = outcome.name, measurement.source
        if source in self._white.series:
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
