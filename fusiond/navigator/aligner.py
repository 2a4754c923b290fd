"""Initial alignment: waits for level, heading and position, and starts the filter when it has all.

Level comes from a standstill (or from motion known by two velocity fixes), heading from the first
of the allowed sources that can give it, position from a fix, the configuration or the saved state.
No heading, no navigation: `reason` says what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.aiding.offers import HeadingOffer, HeightOffer, PositionOffer, VelocityOffer
from fusiond.models.model import ImuNoise, Model
from fusiond.navigation.alignment import (
    gyrocompass,
    gyrocompass_sd,
    integrate_from_rest,
    level,
    level_in_motion,
)
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    quaternion_from_rpy,
    rpy_from_dcm,
    wrap_angle,
)
from fusiond.navigation.standstill import FEWEST_SAMPLES, Window
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.start import Place, Start, as_geodetic, build_start, velocity_of

Array = NDArray[np.float64]

# A heading that came this long ago no longer describes a body at rest that may have been moved.
HEADING_AGE_NS = 2_000_000_000
# Course and integrated motion must agree this well (rad), forward or backward, or the vehicle slid
# or the integration is poor: the next fix decides.
COURSE_AGREEMENT_RAD = math.radians(45.0)
# Turn rate (rad/s) above which levelling in motion is not tried.
MOTION_MAX_RATE_RAD_S = math.radians(5.0)
MOTION_INTERVAL_NS = (800_000_000, 3_500_000_000)
# One sigma of velocity (m/s) of a vehicle that stands.
REST_VELOCITY_SD = np.full(3, 0.1)


@dataclass(frozen=True, slots=True)
class AlignmentOptions:
    """SI units; `heading` the allowed sources in order of preference."""

    heading: tuple[str, ...]
    heading_rad: float | None
    heading_sd_rad: float
    position: tuple[float, float, float] | None
    position_sd_m: float
    levelling_s: float
    rest_speed_m_s: float
    course_speed_m_s: float
    course_sd_rad: float
    gyrocompass_s: float
    gyrocompass_max_sd_rad: float


@dataclass(slots=True)
class _Standing:
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


class Aligner:
    """Collects windows and aids until a start is possible."""

    def __init__(
        self,
        options: AlignmentOptions,
        noise: ImuNoise,
        model: Model,
        window_s: float,
        saved: SavedState | None,
    ) -> None:
        self.options, self.noise, self.model = options, noise, model
        self.reason = "waiting for IMU data"
        self._window_s = window_s
        self._saved = saved
        self._standing: _Standing | None = None
        self._at_rest = False
        self._ever_moved = False
        self._pending: Window | None = None
        self._speed = 0.0
        self._position: PositionOffer | None = None
        self._heading: HeadingOffer | None = None
        self._fixes: list[tuple[VelocityOffer, PositionOffer]] = []

    def window(self, latest: Window) -> None:
        """A window of the standstill detector has ended.

        It counts as rest only once the next one is quiet too: the last before the start may hold
        the first of the acceleration. One with too few samples (the first after a start or a gap)
        tells neither rest nor motion.
        """
        if latest.samples < FEWEST_SAMPLES:
            self._at_rest = False
            self._pending = None
            return
        if not latest.quiet or self._speed > self.options.rest_speed_m_s:
            self._at_rest = False
            self._ever_moved = True
            self._pending = None
            return
        w, self._pending = self._pending, latest
        if w is None:
            return
        if not self._at_rest or self._standing is None:
            start = w.end_ns - round(self._window_s * 1e9)
            self._standing = _Standing(start, w.end_ns)
            self._at_rest = True
        s = self._standing
        s.end_ns = w.end_ns
        s.seconds += self._window_s
        s.rate_sum += w.mean_rate * self._window_s
        s.force_sum += w.mean_force * self._window_s

    def aids(self, aids: Sequence[Aid]) -> None:
        """A measurement has arrived, as the aids it stands for."""
        offers = [offer for aid in aids for offer in aid.offers()]
        height = next((o for o in offers if isinstance(o, HeightOffer)), None)
        position: PositionOffer | None = None
        velocity: VelocityOffer | None = None
        for offer in offers:
            match offer:
                case PositionOffer(height_m=None, sd=(n, e, _)) if height is not None:
                    sd = n, e, height.sd_m
                    position = offer._replace(height_m=height.height_m, sd=sd)
                case PositionOffer():
                    position = offer
                case VelocityOffer():
                    velocity = offer
                case HeadingOffer():
                    self._heading = offer
        if position is not None and (
            self._position is None or position.t_ns >= self._position.t_ns
        ):
            self._position = position
        if velocity is not None:
            self._speed = math.hypot(*velocity.v_ned[:2])
            if position is not None:
                self._fixes = [*self._fixes, (velocity, position)][-40:]

    def attempt(self, imu: ImuBuffer) -> Start | None:
        """A start, if all is known by now; else None, and `reason` says what is missing."""
        if not imu.end:
            self.reason = "waiting for IMU data"
            return None
        place = self._place()
        if place is None:
            self.reason = "no position yet: no fix, none configured"
            return None
        for source in self.options.heading:
            start = {
                "saved": self._from_saved,
                "config": self._from_config,
                "dual_antenna": self._from_dual_antenna,
                "gyrocompass": self._from_gyrocompass,
                "gnss_course": self._from_course,
            }[source](imu, place)
            if start is not None:
                return start
        if not self._levelled() and not self._fixes:
            self.reason = "not at rest: no level yet"
        else:
            self.reason = f"no heading yet (allowed: {', '.join(self.options.heading)})"
        return None

    # ------------------------------------------------------------------ heading sources

    def _levelled(self) -> _Standing | None:
        s = self._standing
        if s is None or not self._at_rest or s.seconds < self.options.levelling_s:
            return None
        return s

    def _at_standstill(self, place: Place, yaw: float, sd: float, how: str) -> Start | None:
        standing = self._levelled()
        if standing is None:
            return None
        roll, pitch = level(standing.mean_force)
        dcm = dcm_from_rpy(roll, pitch, yaw)
        return build_start(
            self.model,
            standing.end_ns,
            place,
            dcm,
            sd,
            np.zeros(3),
            REST_VELOCITY_SD,
            how,
            bias=self._rest_bias(standing, dcm, place[1][0]),
            levelled=True,
        )

    def _from_saved(self, imu: ImuBuffer, place: Place) -> Start | None:
        if self._saved is None or self._ever_moved:
            return None
        return self._at_standstill(
            place, self._saved.yaw_rad, self._saved.sd_yaw_rad, "saved state"
        )

    def _from_config(self, imu: ImuBuffer, place: Place) -> Start | None:
        if self.options.heading_rad is None or self._ever_moved:
            return None
        return self._at_standstill(
            place, self.options.heading_rad, self.options.heading_sd_rad, "configured heading"
        )

    def _from_dual_antenna(self, imu: ImuBuffer, place: Place) -> Start | None:
        if self._heading is None or imu.latest_ns - self._heading.t_ns > HEADING_AGE_NS:
            return None
        return self._at_standstill(
            place, self._heading.yaw_rad, self._heading.sd_rad, "dual antenna"
        )

    def _from_gyrocompass(self, imu: ImuBuffer, place: Place) -> Start | None:
        standing = self._levelled()
        if standing is None or standing.seconds < self.options.gyrocompass_s:
            return None
        lat = float(place[1][0])
        bias = math.hypot(self.noise.rate_bias_initial, self.noise.rate_bias_instability)
        sd = gyrocompass_sd(lat, bias, self.noise.rate_noise, standing.seconds)
        if sd > self.options.gyrocompass_max_sd_rad:
            return None
        roll, pitch = level(standing.mean_force)
        yaw = gyrocompass(standing.mean_rate, roll, pitch)
        white = self.noise.rate_noise / math.sqrt(standing.seconds)
        return build_start(
            self.model,
            standing.end_ns,
            place,
            dcm_from_rpy(roll, pitch, yaw),
            white / (EARTH_RATE_RAD_S * math.cos(lat)),
            np.zeros(3),
            REST_VELOCITY_SD,
            "gyrocompass",
            levelled=True,
            compassed=True,
        )

    def _from_course(self, imu: ImuBuffer, place: Place) -> Start | None:
        """Heading from the course over ground, forward or backward as the IMU felt it move off."""
        for velocity, position in reversed(self._fixes):
            speed = math.hypot(*velocity.v_ned[:2])
            if speed < self.options.course_speed_m_s or velocity.t_ns > imu.latest_ns:
                continue
            course = math.atan2(velocity.v_ned[1], velocity.v_ned[0])
            sd_course = math.hypot(self.options.course_sd_rad, max(velocity.sd[:2]) / speed)
            here = self._place_of(position, velocity)
            s = self._standing
            if s is not None and s.seconds >= 1.0 and imu.oldest_ns <= s.end_ns < velocity.t_ns:
                return self._moved_off(imu, s, velocity, course, sd_course, here)
            return self._on_the_move(imu, velocity, course, sd_course, here)
        return None

    def _moved_off(
        self,
        imu: ImuBuffer,
        standing: _Standing,
        velocity: VelocityOffer,
        course: float,
        sd: float,
        place: Place,
    ) -> Start | None:
        lat, _, height = (float(v) for v in place[1])
        q = quaternion_from_rpy(*level(standing.mean_force), 0.0)
        first, end = imu.index_after(standing.end_ns), imu.index_after(velocity.t_ns)
        gained = np.zeros(3)
        integrate_from_rest(
            np.concatenate(([standing.end_ns], imu.times[first:end])),
            np.ascontiguousarray(imu.samples[first:end]),
            standing.mean_rate,
            q,
            gravity(lat, height),
            gained,
        )
        roll, pitch, turned = rpy_from_dcm(dcm_from_quaternion(q))
        # Course seen from the body, by integration: near 0 when it drove forward, near pi backward.
        slip = wrap_angle(math.atan2(gained[1], gained[0]) - turned)
        backward = abs(slip) > math.pi / 2.0
        if abs(wrap_angle(slip - (math.pi if backward else 0.0))) > COURSE_AGREEMENT_RAD:
            self.reason = "course and felt motion disagree: waiting for a clearer start"
            return None
        yaw = course + (math.pi if backward else 0.0)
        at_rest = dcm_from_rpy(*level(standing.mean_force), yaw - turned)
        return build_start(
            self.model,
            velocity.t_ns,
            place,
            dcm_from_rpy(roll, pitch, yaw),
            sd,
            *velocity_of(velocity),
            "GNSS course" + (", backward" if backward else ""),
            bias=self._rest_bias(standing, at_rest, lat),
            levelled=True,
        )

    def _on_the_move(
        self,
        imu: ImuBuffer,
        velocity: VelocityOffer,
        course: float,
        sd: float,
        place: Place,
    ) -> Start | None:
        shortest, longest = MOTION_INTERVAL_NS
        for earlier, _ in reversed(self._fixes):
            interval = velocity.t_ns - earlier.t_ns
            if not shortest <= interval <= longest or imu.oldest_ns > earlier.t_ns:
                continue
            first, end = imu.index_after(earlier.t_ns), imu.index_after(velocity.t_ns)
            mean = imu.samples[first:end].mean(axis=0)
            if np.abs(mean[:3]).max() > MOTION_MAX_RATE_RAD_S:
                return None
            lat, _, height = (float(v) for v in place[1])
            change = velocity_of(velocity)[0] - velocity_of(earlier)[0]
            roll, pitch = level_in_motion(
                mean[3:], change / (interval * 1e-9), course, gravity(lat, height)
            )
            return build_start(
                self.model,
                velocity.t_ns,
                place,
                dcm_from_rpy(roll, pitch, course),
                sd,
                *velocity_of(velocity),
                "GNSS course, on the move",
            )
        return None

    # ------------------------------------------------------------------ building the start

    def _place_of(self, p: PositionOffer, velocity: VelocityOffer | None = None) -> Place:
        """A fix's place; with a velocity, moved to the velocity's instant."""
        where = np.array([p.lat_rad, p.lon_rad, p.height_m or 0.0])
        if velocity is not None:
            moved = velocity_of(velocity)[0] * ((velocity.t_ns - p.t_ns) * 1e-9)
            where += as_geodetic(moved, p.lat_rad)
        return p, where, max(p.sd[:2])

    def _place(self) -> Place | None:
        """Position (rad, rad, m) to start at, the fix it came from, and its sigma."""
        if self._position is not None:
            fix, where, sd = self._place_of(self._position)
            if self._position.height_m is None:
                known = self.options.position or (self._saved.position if self._saved else None)
                where[2] = known[2] if known else 0.0
            return fix, where, sd
        if self.options.position is not None:
            return None, np.array(self.options.position), self.options.position_sd_m
        if self._saved is not None:
            return None, np.array(self._saved.position), self._saved.sd_position_m
        return None

    def _rest_bias(self, standing: _Standing, dcm: Array, lat: float) -> tuple[Array, float]:
        """Rate bias (3,) seen at rest and its sigma."""
        earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
        return standing.mean_rate - dcm.T @ earth, self.noise.rate_noise / math.sqrt(
            standing.seconds
        )
