"""Data for alignment: rest detected by the IMU, and initial values from measurements."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import (
    HeadingCandidate,
    HeightCandidate,
    PositionCandidate,
    VelocityCandidate,
)
from fusiond.aiding.rest_evidence import LEAST_SD_M_S, RestEvidence
from fusiond.models.blocks import ImuNoise
from fusiond.navigation.earth import EARTH_RATE_RAD_S, STANDARD_GRAVITY_M_S2
from fusiond.navigation.standstill import BIAS_SIGMAS, FEWEST_SAMPLES, Window
from fusiond.navigator.alignment.imu_grade_at_rest import UnitAtRest
from fusiond.navigator.alignment.innovation_trend import NO_TREND, Offset
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import (
    SLOPE_SD,
    UNKNOWN_HEIGHT_SD_M,
    Place,
    as_geodetic,
    velocity_of,
)
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.saved_state import SavedState

Array = NDArray[np.float64]
ANY_TIME_NS = 1 << 62

# Fixes that a course may be taken from: of the last twenty seconds, the longest that changes of
# velocity are taken over, of a receiver of 20 Hz.
MOST_FIXES, FIXES_NS = 400, 20_000_000_000
# Positions that may contradict a standstill: a minute's, of a receiver of 1 Hz.
MOST_POSITIONS = 60
OPERATOR = "operator"
"""Source of positions that somebody types."""
# A vehicle that drives for long drives faster (m/s).
SLOWEST_M_S = 3.0
# Sigmas at which position and velocity of a receiver do not confirm each other: of two axes, one
# time in three thousand by chance, and a start looks up to two hundred times.
CONTRADICTION_SIGMAS = 4.0
# Those at which it is no chance (one time in a million): the velocities until then are suspect even
# when they have come to agree again.
SUSPECT_SIGMAS = 5.3
# Of the way by velocity (scale): what the trapezoids between fixes leave out.
WAY_SCALE = 0.05
# One sigma (s) of the delay of a receiver's velocity against its position, which smoothing makes.
LAG_SD_S = 0.1
# Velocities that positions have contradicted so often have to agree with them for so long before
# they tell a course: who is off by a metre a second then shows it by four sigma of fixes of a
# metre. One or two are a fix that strays.
CONTRADICTED, CONFIRMED_AGAIN_NS = 3, 5_000_000_000
# Positions of two devices within so long are of one instant, but for the way between.
TOGETHER_NS = 1_500_000_000
# After so long positions that are too coarse to confirm a velocity need not.
CONFIRMED_S = 15.0


class Fix(NamedTuple):
    """Position and velocity of one measurement, and its source."""

    velocity: VelocityCandidate
    position: PositionCandidate
    source: str = ""


def _moved_m(lat_rad: float, lon_rad: float, last: PositionCandidate) -> tuple[float, float]:
    """Displacement north and east (m) from a place to a position."""
    north, east = last.lat_rad - lat_rad, math.remainder(last.lon_rad - lon_rad, 2.0 * math.pi)
    per_metre_n, per_metre_e, _ = as_geodetic(np.ones(3), lat_rad).tolist()
    return north / per_metre_n, east / per_metre_e


@dataclass(slots=True)
class Standstill:
    """Sums over the quiet windows since the vehicle came to rest."""

    start_ns: int
    end_ns: int
    seconds: float = 0.0
    rate_sum: Array = field(default_factory=lambda: np.zeros(3))
    force_sum: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def mean_rate(self) -> Array:
        return self.rate_sum / self.seconds

    @property
    def mean_force(self) -> Array:
        return self.force_sum / self.seconds


class AlignmentEvidence:
    """Standstill windows and initialisation candidates since the start of the alignment."""

    def __init__(
        self,
        options: AlignmentOptions,
        noise: ImuNoise,
        saved: SavedState | None,
        on_event: Callable[[str, str], None],
    ) -> None:
        self._options, self._saved = options, saved
        self.unit = UnitAtRest(options, noise)
        self._event = on_event
        self.why = ""
        """Reason to wait, beyond those that the aligner finds itself."""
        self.poor_claims: dict[str, str] = {}
        """Reason why a claimed heading, by its origin, cannot start navigation."""
        self.reported: set[str] = set()
        """Events already reported."""
        self.upside_down = False
        self.tried_ns = 0
        """Instant of the last fix that a course was tried with."""
        self.moving_since_ns = 0
        """First fix since which every speed was high enough for a course."""
        self.rest_evidence = RestEvidence()
        self.standstill: Standstill | None = None
        """The last standstill, also when the vehicle has moved off since."""
        self.left: Standstill | None = None
        """Last finished standstill that was long enough for levelling."""
        self.ever_moved = False
        self.unexplained = np.zeros(3)
        """Largest rates (3,) of quiet windows beyond the data sheet's bias: a turn, or a gyro
        outside its data sheet."""
        self.heading: HeadingCandidate | None = None
        self.compass: HeadingCandidate | None = None
        self.fixes: list[Fix] = []
        """The last measurements that offered both, velocity and position."""
        self.contradicted_ns: dict[str, int] = {}
        """By source the last fix at which positions had moved otherwise than the velocities of
        their receiver, and not by chance: which of those before it were wrong nobody knows."""
        self._contradictions: Counter[str] = Counter()
        """Number of such fixes by source."""
        self._at_rest = False
        self._pending: Window | None = None
        self._speed = 0.0
        self._positions: list[PositionCandidate] = []
        """The last positions in order of validity."""
        self._by_source: dict[str, PositionCandidate] = {}
        """The last position of each source."""

    def window(self, latest: Window) -> None:
        """Receive an ended window of the standstill detector.

        A window counts as rest only once the next one is quiet, too: the last one before the
        vehicle moves may include the start of the acceleration. A window with too few samples (the
        first after a start or a gap) shows neither rest nor motion.
        """
        if latest.samples < FEWEST_SAMPLES:
            self._at_rest = False
            self._pending = None
            return
        self._gravity_points_up(latest)
        still = latest.quiet and self._speed <= self._options.rest_speed_m_s
        if still and self.unit.judge(latest):
            bias = BIAS_SIGMAS * self.unit.noise.rate_bias_initial
            self.unexplained[self.unexplained < bias] = 0.0
        turning = latest.quiet and self._turns(latest)
        if turning:
            self.unexplained = np.maximum(self.unexplained, np.abs(latest.mean_rate))
        if turning or not still:
            self.left = self.levelled() or self.left
            self._at_rest = False
            self.ever_moved = True
            self._pending = None
            return
        w, self._pending = self._pending, latest
        if w is None:
            return
        if not self._at_rest or self.standstill is None:
            start = w.end_ns - round(self._options.window_s * 1e9)
            self.standstill = Standstill(start, w.end_ns)
            self._at_rest = True
        s = self.standstill
        s.end_ns = w.end_ns
        s.seconds += self._options.window_s
        s.rate_sum += w.mean_rate * self._options.window_s
        s.force_sum += w.mean_force * self._options.window_s

    def receive(self, measurements: Sequence[AidingMeasurement]) -> None:
        """Receive the aiding measurements of one device measurement."""
        self.rest_evidence.receive(measurements)
        candidates = [candidate for each in measurements for candidate in each.candidates()]
        height = next((o for o in candidates if isinstance(o, HeightCandidate)), None)
        position: PositionCandidate | None = None
        velocity: VelocityCandidate | None = None
        for candidate in candidates:
            match candidate:
                case PositionCandidate(height_m=None, sd=(n, e, _)) if height is not None:
                    sd = n, e, height.sd_m
                    position = candidate._replace(height_m=height.height_m, sd=sd)
                case PositionCandidate():
                    position = candidate
                case VelocityCandidate():
                    velocity = candidate
                case HeadingCandidate(how="compass"):
                    self.compass = candidate
                case HeadingCandidate():
                    self.heading = candidate
        if position is not None:
            source = measurements[0].source
            if source == OPERATOR:  # one who corrects what he typed has not moved
                before = self._by_source.get(source)
                self._positions = [p for p in self._positions if p is not before]
            self._by_source[source] = position
            insort(self._positions, position, key=lambda p: p.t_ns)
            del self._positions[:-MOST_POSITIONS]
        if velocity is not None:
            self._speed = math.hypot(*velocity.v_ned[:2])
            if position is not None:
                self._keep(Fix(velocity, position, measurements[0].source))

    @property
    def resting(self) -> bool:
        """True if the last windows were quiet."""
        return self._at_rest

    def levelled(self) -> Standstill | None:
        """Present standstill, if long enough for levelling."""
        s = self.standstill
        if s is None or not self._at_rest or s.seconds < self._options.levelling_s:
            return None
        return s if self.rested(s, ANY_TIME_NS) else None

    def rested(self, s: Standstill, until_ns: int = 0) -> bool:
        """True if no measured speed until the end of a standstill contradicts it, nor, without
        speeds, a displacement of positions."""
        end_ns = max(s.end_ns, until_ns)
        seen = self.rest_evidence.measured(s.start_ns, end_ns)
        if math.isfinite(seen.sd):
            return not seen.contradicts
        slope, sd = self._way(s.start_ns, end_ns)
        return slope <= max(self._options.rest_speed_m_s, CONTRADICTION_SIGMAS * sd)

    def confirmed_rest(self, s: Standstill) -> bool:
        """True if speeds confirm an uncontradicted standstill."""
        span = s.start_ns, s.end_ns
        return self.seen_at_rest(s) or CONTRADICTION_SIGMAS * self._way(*span)[1] < SLOWEST_M_S

    def _way(self, begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Slope (m/s) of a line through the positions of a span, and its sigma."""
        trend = NO_TREND
        within = [p for p in self._positions if begin_ns <= p.t_ns <= end_ns]
        for p in within:
            n, e = _moved_m(within[0].lat_rad, within[0].lon_rad, p)
            trend = trend.with_one(Offset(n, e, max(p.sd[:2])), (p.t_ns - begin_ns) * 1e-9)
        return trend.slope

    def seen_at_rest(self, s: Standstill) -> bool:
        """True if speeds were measured in a standstill, and were zero."""
        seen = self.rest_evidence.measured(s.start_ns, s.end_ns)
        return math.isfinite(seen.sd) and not seen.contradicts

    def doubted(self, why: str) -> str:
        """Set and return the reason why there is no start yet."""
        self.why = why
        return why

    def report(self, code: str, text: str) -> str:
        """Set the reason; report an event the first time."""
        if code not in self.reported:
            self.reported.add(code)
            self._event(code, text)
        return self.doubted(text)

    def position_confirms(self, latest: Fix) -> bool:
        """True if the positions confirm the direction of the velocities over a distance that would
        expose the opposite one."""
        source = latest.source
        fixes = [fix for fix in self.fixes if fix.source == source]
        if fixes[0] is latest:
            return False
        way, before, trend = np.zeros(2), fixes[0], NO_TREND
        first = before.position
        moved, count = np.zeros(2), 0
        for fix in fixes:
            position = fix.position
            if position.t_ns > latest.position.t_ns:
                break
            since_s = (position.t_ns - first.t_ns) * 1e-9
            v = np.add(fix.velocity.v_ned[:2], before.velocity.v_ned[:2])
            way += 0.5 * (position.t_ns - before.position.t_ns) * 1e-9 * v
            moved = np.array(_moved_m(first.lat_rad, first.lon_rad, position))
            north_m, east_m = (moved - way).tolist()
            trend = trend.with_one(Offset(north_m, east_m, max(position.sd[:2])), since_s)
            before, count = fix, count + 1
        span_s = (latest.position.t_ns - first.t_ns) * 1e-9
        size, sd_v = math.hypot(*way), max(latest.velocity.sd[:2])
        sd = math.hypot(max(first.sd[:2]), max(latest.position.sd[:2]), WAY_SCALE * size)
        sd = math.hypot(sd, sd_v * span_s)
        slope, sd_slope = trend.slope
        lag = LAG_SD_S * math.hypot(*latest.velocity.v_ned[:2]) / max(span_s, 1.0)
        sd_slope = math.hypot(sd_slope, max(sd_v / math.sqrt(count), LEAST_SD_M_S), lag)
        sigmas = max(math.hypot(*(moved - way)) / sd, slope / sd_slope)
        if sigmas > SUSPECT_SIGMAS:
            self.contradicted_ns[source] = latest.velocity.t_ns
            self._contradictions[source] += 1
        agreed_ns = latest.velocity.t_ns - self.contradicted_ns.get(source, -ANY_TIME_NS)
        again = self._contradictions[source] >= CONTRADICTED and agreed_ns < CONFIRMED_AGAIN_NS
        if sigmas > CONTRADICTION_SIGMAS or again:
            return False
        return 2.0 * size > CONTRADICTION_SIGMAS * sd or span_s >= CONFIRMED_S

    def _keep(self, fix: Fix) -> None:
        """Insert a fix in order of validity."""
        oldest = max(fix.velocity.t_ns, self.fixes[-1].velocity.t_ns if self.fixes else 0)
        kept = self.fixes[
            bisect_left(self.fixes, oldest - FIXES_NS, key=lambda each: each.velocity.t_ns) :
        ]
        insort(kept, fix, key=lambda each: each.velocity.t_ns)
        self.fixes = kept[-MOST_FIXES:]
        if self._speed < self._options.course_speed_m_s:
            self.moving_since_ns = 0
        elif not self.moving_since_ns:
            self.moving_since_ns = fix.velocity.t_ns

    def _gravity_points_up(self, w: Window) -> None:
        self.upside_down = bool(w.mean_force[2] > 0.5 * STANDARD_GRAVITY_M_S2)
        if self.upside_down:
            self.report("imu_upside_down", reason("imu_upside_down"))

    def _turns(self, w: Window) -> bool:
        """True if the rate of quiet windows exceeds any bias of the data sheet."""
        n = self.unit.noise
        prior = n.rate_bias_initial**2 + n.rate_bias_instability**2
        free = n.rate_noise**2 / self._options.window_s + self._options.rate_sd_rad_s**2
        for rate, count in ((w.mean_rate, 1), (w.run_rate, w.run)):
            most = EARTH_RATE_RAD_S + BIAS_SIGMAS * math.sqrt(prior + free / count)
            largest = float(np.abs(rate).max())
            if largest > most:
                self.doubted(reason("turning", rate=math.degrees(largest)))
                return True
        return False

    def place(self) -> Place | None:
        """Position (rad, rad, m) to start at, its fix, and its sigmas."""
        return self.place_of(self._positions[-1]) if self._positions else self._reported()

    def place_of(self, p: PositionCandidate, velocity: VelocityCandidate | None = None) -> Place:
        """A fix's place; with a velocity, moved to the velocity's instant."""
        height, sd_height = self._height_at(p)
        where = np.array([p.lat_rad, p.lon_rad, height])
        if velocity is not None:
            moved = velocity_of(velocity)[0] * ((velocity.t_ns - p.t_ns) * 1e-9)
            where += as_geodetic(moved, p.lat_rad)
        return Place(p, where, math.hypot(max(p.sd[:2]), self._contradicts(p)), sd_height)

    def _contradicts(self, p: PositionCandidate) -> float:
        """Distance (m) of a position from another source's of that time, if it exceeds the sigmas
        of both; which of them is wrong is unknown."""
        largest = 0.0
        for source, other in self._by_source.items():
            interval_s = abs(other.t_ns - p.t_ns) * 1e-9
            suspect = other.t_ns - self.contradicted_ns.get(source, -ANY_TIME_NS) < FIXES_NS
            if other is p or suspect or interval_s > TOGETHER_NS * 1e-9:
                continue
            away = math.hypot(*_moved_m(p.lat_rad, p.lon_rad, other))
            sd = math.hypot(max(p.sd[:2]), max(other.sd[:2]))
            if away - self._speed * interval_s > CONTRADICTION_SIGMAS * sd:
                largest = max(largest, away)
        return largest

    def _reported(self) -> Place | None:
        """Position by the configuration or the saved state."""
        height: float | None
        if self._options.position is not None:
            (lat, lon, height), sd = self._options.position, self._options.position_sd_m
        elif self._saved is not None:
            (lat, lon, height), sd = self._saved.position, self._saved.sd_position_m
        else:
            return None
        if height is None:
            return Place(None, np.array([lat, lon, 0.0]), sd, UNKNOWN_HEIGHT_SD_M)
        return Place(None, np.array([lat, lon, height]), sd, sd)

    def _height_at(self, p: PositionCandidate) -> tuple[float, float]:
        """Height (m) of a fix and one sigma. Without one: height of the known place, with sigma for
        a road's climb from there; 0 without a known place."""
        if p.height_m is not None:
            return p.height_m, p.sd[2]
        if (reported := self._reported()) is not None:
            lat, lon, height = reported.where.tolist()
            sd = math.hypot(reported.sd_height, SLOPE_SD * math.hypot(*_moved_m(lat, lon, p)))
            if sd < UNKNOWN_HEIGHT_SD_M:
                return height, sd
        return 0.0, UNKNOWN_HEIGHT_SD_M
