r"""Navigation without an inertial unit: position and velocity by fixes and a constant velocity.

While the unit is absent, or has been silent for longer than navigation can bridge
(`fusiond.navigator.imu_screening`), the same timeline, filters and measurements run on the samples
of a level vehicle that faces north and keeps its velocity:

    w = w_ie + w_en(v^),   f = (2 w_ie + w_en(v^)) x v^ - g

so that only the model's noise and the measurements change the velocity. Attitude is unknown and not
published; of a lever arm only the upward part counts (`AidingMeasurement.without_attitude`). For a
vehicle that does not slide, a heading and a wheel speed together propagate the position between
fixes. Bearings need the attitude of a star tracker or another sensor, or on a road a heading
(`fusiond.aiding.landmark_bearing`). With `[estimator] filter = "federated"` each receiver has a
local filter, as in experiments 3 and 4 of paper 004; any other filter is replaced by the Kalman
filter here.

The first fix, or an operator's position, gives the start, with wide priors, and is then fused as an
ordinary measurement. Inertial navigation takes over once it has aligned.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.attitude import AttitudeMeasurement
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.heading_history import HeadingHistory, KnownHeading
from fusiond.aiding.initialisation_candidates import HeadingCandidate, PositionCandidate
from fusiond.aiding.velocity import CORNER_RAD_S
from fusiond.configuration.constraints import NonHolonomic
from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.models.blocks import Block
from fusiond.models.constant_velocity import constant_velocity
from fusiond.models.model import Model
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity, meridian_radius, transverse_radius
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import Bound, Mode, Solution
from fusiond.navigation.strapdown import HEIGHT, LAT, Q0, VD, VE, VN
from fusiond.navigator.alignment.start import UNKNOWN_HEIGHT_SD_M
from fusiond.navigator.assembly import estimator_without_imu, fitting
from fusiond.navigator.imu_screening import BEARABLE_GAP_S
from fusiond.navigator.mode_reasons import joined, reason
from fusiond.navigator.published_solution import solution_of
from fusiond.navigator.timeline import MOST_WAITING, Entry, Timeline

Array = NDArray[np.float64]

# Spacing of the samples (ns): velocity is linear in between, whatever it is; the tick's rate of a
# slow computer.
STEP_NS = 100_000_000
# No two of them are so far apart (s).
GAP_S = 1.0
# One sigma (m) of the first position before its fix has been told: no receiver errs by so much.
START_SD_M = 1000.0
# Measurements that are remembered for a start: a minute of two receivers once a second.
MOST_REMEMBERED = 128
# Age (ns) of the newest sample below which the inertial unit surely sends.
SENDS_NS = int(BEARABLE_GAP_S * 1e9)


class _Received:
    """Received measurement, with the position from it alone on demand."""

    __slots__ = ("_asked", "_position", "measurement")

    def __init__(self, measurement: AidingMeasurement) -> None:
        self.measurement = measurement
        self._asked = False
        self._position: PositionCandidate | None = None

    @property
    def position(self) -> PositionCandidate | None:
        """Position by this measurement alone; None without one."""
        if not self._asked:
            self._asked = True
            for candidate in self.measurement.candidates():
                if isinstance(candidate, PositionCandidate):
                    self._position = candidate
        return self._position


def _slips_m_s(o: NonHolonomic) -> float:
    """One sigma of the lateral velocity at the antenna; infinite for a vehicle that may slide."""
    forward, right, _ = o.lever_arm_m
    in_corners = CORNER_RAD_S * math.hypot(forward, right)
    return math.hypot(o.sd_m_s, o.drift_sd_m_s, in_corners) if o.enabled else math.inf


class WithoutImu:
    """Navigation without an inertial unit. `on_event(code, text)` receives both changes,
    `on_outcome` each measurement; `last_fused_ns` by source is kept."""

    def __init__(
        self,
        config: Config,
        blocks: Sequence[Block],
        on_event: Callable[[str, str], None],
        last_fused_ns: dict[str, int],
        on_outcome: Callable[[Entry], None] | None,
    ) -> None:
        self._config, self._blocks = config, blocks
        self._event, self._on_outcome = on_event, on_outcome
        self._last_fused_ns = last_fused_ns
        self.estimator: Estimator | None = None
        """Estimator of the published solution while active."""
        self._ended: dict[str, Counter[str]] = {}
        self.arrived: deque[tuple[Sequence[AidingMeasurement], int]] = deque(maxlen=MOST_WAITING)
        """Measurements with the instant (ns) at which they came, until a `tick` needs them."""
        self._recent: deque[_Received] = deque(maxlen=MOST_REMEMBERED)
        self._way = HeadingHistory(_slips_m_s(config.constraints.non_holonomic))
        self._first_ns: int | None = None
        self._silent_ns = 0
        self._located_ns = 0
        self._max_speed_m_s = config.plausibility.max_speed_m_s

    @property
    def model(self) -> Model:
        """Error model of a vehicle without an inertial unit."""
        manoeuvre = self._config.plausibility.manoeuvre
        return fitting(
            self._config, self._blocks, lambda blocks: constant_velocity(manoeuvre, blocks)
        )

    @property
    def active(self) -> bool:
        """True while it navigates."""
        return self.estimator is not None

    def _catch_up(self) -> None:
        """Process what has arrived."""
        while self.arrived:
            self._receive(*self.arrived.popleft())

    def _receive(self, measurements: Sequence[AidingMeasurement], seen_ns: int) -> None:
        """Receive measurements at `seen_ns`."""
        self._recent.extend(map(_Received, measurements))
        if self._first_ns is None and measurements:
            self._first_ns = seen_ns or measurements[0].t_ns
        for one in measurements:
            if isinstance(one, AttitudeMeasurement) and one.orientation is not None:
                self._way.orient(one.orientation)
            for candidate in one.candidates() if self._way.known and not one.locates else ():
                if isinstance(candidate, HeadingCandidate):
                    own = candidate.t_ns, candidate.yaw_rad, candidate.sd_rad
                    self._way.add(KnownHeading(*own, lasts=bool(candidate.shared)))
        if self.estimator is not None:
            for one in measurements:
                self._insert(one)

    def takes_over(self, t_ns: int, imu: ImuBuffer) -> bool:
        """True if inertial navigation is not running at `t_ns` and cannot resume with the next
        sample."""
        return not imu.end or (t_ns - imu.latest_ns) * 1e-9 > BEARABLE_GAP_S

    def take_position(self, fix: AidingMeasurement, t_ns: int) -> str | None:
        """Apply an operator's position at `t_ns`; its outcome, or None if it will be used for a
        start."""
        self._catch_up()
        if self.estimator is None:
            self._receive([fix], t_ns)
            return None
        self._run(self.estimator, t_ns)
        entry = self._insert(replace(fix, t_ns=self._imu.latest_ns))
        self._run(self.estimator, t_ns)
        return None if entry is None or entry.outcome is None else entry.outcome.name

    def tick(self, t_ns: int, imu: ImuBuffer, navigating: bool) -> None:
        """Start, continue or end navigation at `t_ns`. `navigating`: inertial navigation has
        started."""
        self._catch_up()
        since_ns = imu.latest_ns if imu.end else self._first_ns
        if since_ns is None:
            return
        self._silent_ns = t_ns - since_ns
        silent = self._silent_ns * 1e-9 > BEARABLE_GAP_S
        if self.estimator is None:
            if silent:
                self._begin(since_ns if imu.end else 0)
        elif navigating and not silent:
            self._event("with_imu", "the inertial unit has aligned and navigates")
            self.stop()
            return
        if self.estimator is not None:
            self._run(self.estimator, t_ns)

    def stop(self) -> None:
        """End, for a restart or another navigation."""
        self._catch_up()
        self._ended, self.estimator = self.counted(), None
        self._recent.clear()

    def counted(self) -> dict[str, Counter[str]]:
        """Outcomes of measurements here, by source, since the daemon began."""
        found = {name: Counter(counts) for name, counts in self._ended.items()}
        if self.estimator is not None:
            for name, counts in self._timeline.counters.outcomes.items():
                found.setdefault(name, Counter()).update(counts)
        return found

    # ------------------------------------------------------------------ solution

    def solution(self, t_ns: int, why: str, bound: Bound) -> Solution:
        """Solution at `t_ns`; `why`: the reason for the absence of inertial navigation."""
        e = self.estimator
        assert e is not None
        mode, reason = self._mode(t_ns, e, why)
        gap_ns, limits = round(GAP_S * 1e9), self._config.plausibility
        s = solution_of(e, self._imu, t_ns, gap_ns, mode, reason, bound, limits)
        north, east, down = s.sd_ned_m
        # The position is that of the antennas, as far as nobody knows where they point.
        arm = self._arm_m
        return s._replace(
            rpy_rad=(math.nan,) * 3,
            sd_ned_m=(math.hypot(north, arm), math.hypot(east, arm), down),
            gyro_bias_rad_s=(math.nan,) * 3,
            accel_bias_m_s2=(math.nan,) * 3,
        )

    def _mode(self, t_ns: int, e: Estimator, why: str) -> tuple[Mode, str]:
        limits = self._config.estimator
        sigmas = e.sigmas()
        sd_m = math.hypot(float(sigmas[0]), float(sigmas[1]))
        said = joined((why, reason("by_fixes_alone")))
        if not sd_m <= limits.invalid_sd_m:
            lost = reason("sigma", sd=sd_m, limit=limits.invalid_sd_m)
            return Mode.INVALID, joined((lost, said))
        unaided = (t_ns - self._located_ns) * 1e-9
        if unaided > limits.coast_after_s:
            return Mode.COASTING, joined((reason("no_fix", seconds=unaided), said))
        return Mode.NAVIGATING, said

    # ------------------------------------------------------------------ inside

    def _begin(self, since_ns: int) -> None:
        """Start at the newest fix since the samples ended, if any."""
        recent = [h for h in self._recent if h.measurement.t_ns > since_ns]
        newest_first = sorted(recent, key=lambda h: h.measurement.t_ns, reverse=True)
        fix = next((h.position for h in newest_first if h.position is not None), None)
        if fix is None:
            return
        config = self._config
        model = self.model
        estimator = estimator_without_imu(config, model, GAP_S)
        self._imu = ImuBuffer(1e9 / STEP_NS, config.estimator.buffer_s, np.eye(3), 0.0, GAP_S)
        self._timeline = Timeline(
            *(estimator, self._imu, config.estimator.buffer_s, config.estimator.checkpoint_s),
            self._outcome,
        )
        arms = (section.lever_arm_m for section in config.aiding.values())
        self._arm_m = max((math.hypot(x, y) for x, y, _ in arms), default=0.0) / math.sqrt(2.0)
        nav = np.zeros(10)
        nav[LAT], nav[LAT + 1], nav[HEIGHT] = fix.lat_rad, fix.lon_rad, fix.height_m or 0.0
        nav[Q0] = 1.0
        sd = model.initial.copy()
        sd[3:6] = self._max_speed_m_s / math.sqrt(3.0)
        sd[6:8], sd[8] = START_SD_M, UNKNOWN_HEIGHT_SD_M
        self._imu.append(np.array([fix.t_ns], dtype=np.int64), _sensed(nav))
        estimator.initialise(fix.t_ns, 1, nav, np.zeros(model.size), np.diag(sd**2))
        self._timeline.start()
        self.estimator = estimator
        for one in self._recent:
            if one.measurement.t_ns >= fix.t_ns:
                self._insert(one.measurement)
        self._event(
            "without_imu",
            "no inertial unit: position and velocity by fixes and a constant velocity, no attitude",
        )

    def _insert(self, measurement: AidingMeasurement) -> Entry | None:
        level = measurement.without_attitude(self._way)
        if level is None:
            self._ended.setdefault(measurement.source, Counter())["no_attitude"] += 1
            return None
        return self._timeline.insert(level)

    def _run(self, e: Estimator, t_ns: int) -> None:
        """Run samples until now, with all measurements received."""
        count = (t_ns - self._imu.latest_ns) // STEP_NS
        if count > 0:
            times = self._imu.latest_ns + STEP_NS * np.arange(1, count + 1, dtype=np.int64)
            self._imu.append(times, np.repeat(_sensed(e.nav), count, axis=0))
        self._timeline.advance()
        if not (np.isfinite(e.nav).all() and np.isfinite(e.covariance).all()):
            self._event("filter_not_finite", "Without an IMU: starting again")
            self.stop()

    def _outcome(self, entry: Entry) -> None:
        if entry.outcome is not None and entry.outcome.name == "fused":
            source, t_ns = entry.measurement.source, entry.key[0]
            self._last_fused_ns[source] = max(t_ns, self._last_fused_ns.get(source, -1))
            if entry.measurement.locates:
                self._located_ns = max(self._located_ns, t_ns)
        if entry.measurement.screened and entry.outcome is not None:
            entry.measurement.judged(entry.outcome.rows, entry.outcome.whitened)
        if self._on_outcome is not None:
            self._on_outcome(entry)


def counted_together(
    inertial: Mapping[str, Counter[str]], without: Mapping[str, Counter[str]]
) -> dict[str, Counter[str]]:
    """Outcomes by source of both navigations. A measurement that was fused or excluded without an
    inertial unit is not also counted as lost by the inertial navigation."""
    found = {name: Counter(counts) for name, counts in inertial.items()}
    for name, counts in without.items():
        both = found.setdefault(name, Counter())
        counted = counts["fused"] + counts["no_attitude"]
        for lost in ("no_alignment", "no_imu"):
            spared = min(both[lost], counted)
            both[lost], counted = both[lost] - spared, counted - spared
        both.update(counts)
    return found


def _sensed(nav: Array) -> Array:
    """Rate and force (1, 6) of a level vehicle in the state (10,) that faces north at its
    velocity."""
    lat, height = float(nav[LAT]), float(nav[HEIGHT])
    north, east = float(nav[VN]), float(nav[VE])
    earth = np.array([math.cos(lat), 0.0, -math.sin(lat)]) * EARTH_RATE_RAD_S
    radius_n = transverse_radius(lat) + height
    transport = np.array(
        [
            east / radius_n,
            -north / (meridian_radius(lat) + height),
            -east * math.tan(lat) / radius_n,
        ]
    )
    force = np.cross(2.0 * earth + transport, nav[VN : VD + 1])
    force[2] -= gravity(lat, height)
    return np.hstack([earth + transport, force])[None, :]
