"""Checks of a start by the first motion: claimed headings, and the mounting of the IMU."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.estimators.base import Estimator
from fusiond.integrity.catalogue import SENSOR
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import wrap_angle
from fusiond.navigation.strapdown import LAT, LON
from fusiond.navigator.alignment.heading_at_rest import CLAIMS
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.state_file import RefusedStateError

if TYPE_CHECKING:
    from fusiond.navigator.restart_from_memory import WarmStart

# Sigmas of heading and course beyond which a claimed heading is contradicted, and for how long: an
# obstacle that the vehicle slides at takes less.
HEADING_SIGMAS = 4.0
CONTRADICTED_NS = 1_000_000_000
# Of the sigma that was claimed: three quarters of what is known of the heading are then measured.
DETERMINED = 0.5
# Measured velocities of so long are averaged to a course.
COURSE_NS = 1_000_000_000


HALF_TURN_SD_RAD = math.pi / 5.0
"""One sigma of a heading that nothing has shown: an error beyond five sigma is a lie, and it may be
off by half a turn."""


class Unshown(NamedTuple):
    """One sigma (rad) of an unconfirmed heading, and the last place (rad), of sigma `sd_m`, that
    does not depend on it."""

    sd_rad: float
    lat_rad: float
    lon_rad: float
    sd_m: float = 0.0

    def way_m(self, lat_rad: float, lon_rad: float) -> float:
        """Distance (m) from the start to a place, minus three sigma of the start."""
        distance_m = horizontal_distance_m(self.lat_rad, self.lon_rad, lat_rad, lon_rad)
        return max(0.0, distance_m - 3.0 * self.sd_m)


def horizontal_distance_m(lat_a: float, lon_a: float, lat_b: float, lon_b: float) -> float:
    """Distance (m) of two places (rad) that are kilometres apart at most."""
    north = (lat_b - lat_a) * meridian_radius(lat_a)
    east = math.remainder(lon_b - lon_a, 2.0 * math.pi) * math.cos(lat_a)
    return math.hypot(north, east * transverse_radius(lat_a))


class StartCheck:
    """Check of a start; `refuted` is the reason why it was wrong."""

    def __init__(self, options: AlignmentOptions, start: Start) -> None:
        self._options, self._start = options, start
        self._claim = start.origin if start.origin in CLAIMS else ""
        self._sd_yaw = math.sqrt(start.covariance[2, 2])
        on_wheels = options.no_slip_m is not None and math.isfinite(options.max_reverse_m_s)
        self._backward = start.backward and on_wheels and not start.confirmed
        self._unproven = bool(self._claim) and not start.confirmed
        self._since_ns: int | None = None
        self.unconfirmed = ""
        """Unproven condition of the heading, as text; empty without one. A configured heading is a
        hypothesis until the first motion, as is one saved without motion; another saved heading was
        measured before the vehicle was parked. Apparent driving backward is driving forward with a
        reversed IMU until the vehicle drives forward, too."""
        self.unshown: Unshown | None = None
        """Doubt that the heading leaves, until something has shown it."""
        self._say()

    def _say(self) -> None:
        if not self._unproven:
            self.unshown = None
        elif self.unshown is None:
            lat, lon = self._start.nav[LAT : LON + 1].tolist()
            self.unshown = Unshown(HALF_TURN_SD_RAD, lat, lon)
        if self._backward:
            self.unconfirmed = reason("backward_or_mounted")
        else:
            self.unconfirmed = reason("not_confirmed_by_motion") if self._unproven else ""

    def located(self, measurement: AidingMeasurement) -> None:
        """Receive a fused position. A path from the start confirmed by positions bounds the heading
        error by their sigma over its length; position uncertainty from the heading restarts
        there."""
        for c in measurement.candidates():
            if self.unshown is None or not isinstance(c, PositionCandidate):
                continue
            start, covariance = self._start.nav, self._start.covariance
            way_m = horizontal_distance_m(start.item(LAT), start.item(LON), c.lat_rad, c.lon_rad)
            variance = max(covariance.item(6, 6), covariance.item(7, 7))
            sd_m = math.sqrt(max(c.sd[:2]) ** 2 + variance)
            doubt = min(self.unshown.sd_rad, sd_m / max(way_m, 1e-9))
            self.unshown = Unshown(doubt, c.lat_rad, c.lon_rad, max(c.sd[:2]))

    @property
    def over(self) -> bool:
        """True if nothing is left to be checked."""
        return not self._claim and not self._backward

    def refuted(
        self,
        e: Estimator,
        axes: tuple[float, ...],
        ahead_m_s: float,
        diagnosis: Diagnosis,
        measured: RestEvidence,
    ) -> tuple[str, str] | None:
        """Code and text of the event, if the solution refutes the start: attitude C_nb, row by row
        (9,), and speed along its first axis."""
        t_ns = e.t_ns
        if self._backward and ahead_m_s > self._options.course_speed_m_s:
            self._backward = False
            self._say()
        if not self._claim:
            return None
        # It has not fitted the measurements since; or some are out of service, which may be right.
        doubted = any(f.kind.of == SENSOR for f in diagnosis.findings)
        left_out = bool(diagnosis.excluded)
        velocity, yaw = measured.velocity(t_ns - COURSE_NS, t_ns), math.atan2(axes[3], axes[0])
        sd_yaw = math.sqrt(e.covariance[2, 2])
        if (
            self._unproven
            and sd_yaw < DETERMINED * self._sd_yaw
            and not (doubted or left_out)
            and (velocity is None or self._along(velocity, yaw, sd_yaw))
        ):
            self._unproven = False
            self._say()
        return velocity and self._heading(t_ns, velocity, yaw, sd_yaw, doubted)

    def _along(self, velocity: tuple[float, float, float], yaw: float, sd_yaw: float) -> bool:
        """True if a measured velocity agrees with the heading, forward or backward."""
        north, east, sd_speed = velocity
        speed = math.hypot(north, east)
        residual = abs(wrap_angle(math.atan2(east, north) - yaw))
        sd = math.hypot(sd_yaw, self._options.course_sd_rad, sd_speed / max(speed, 1e-9))
        return min(residual, math.pi - residual) <= HEADING_SIGMAS * sd

    def _heading(
        self,
        t_ns: int,
        velocity: tuple[float, float, float],
        yaw: float,
        sd_yaw: float,
        doubted: bool,
    ) -> tuple[str, str] | None:
        """Check a configured or saved heading against the measured course, forward or backward: a
        filter with a wrong heading gates the velocities that contradict it; after a doubt of its
        motion it slowly turns towards the course and corrupts correct sensor errors."""
        north, east, sd_speed = velocity
        speed = math.hypot(north, east)
        if speed < self._options.course_speed_m_s + 3.0 * sd_speed:
            self._since_ns = None
            return None
        if doubted:
            return "heading_contradicted", (
                f"The first motion disagrees with the {self._claim}: aligning again by the course"
            )
        if self._along(velocity, yaw, sd_yaw):
            self._claim, self._unproven = "", False
            self._say()
            return None
        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns < CONTRADICTED_NS:
            return None
        residual = abs(wrap_angle(math.atan2(east, north) - yaw))
        return "heading_contradicted", (
            f"The {self._claim} is {math.degrees(residual):.0f} deg from the course: aligning again"
        )


class StartTrial:
    """Trial of each start of a navigator; `on_event(code, text)` receives a refused state."""

    def __init__(self, options: AlignmentOptions, on_event: Callable[[str, str], None]) -> None:
        self._options, self._event = options, on_event
        self.max_reverse_m_s = options.max_reverse_m_s
        self.check: StartCheck | None = None
        """Check of the present start; None once it is over."""
        self.warm: WarmStart | None = None
        """A start to be tried before any alignment, and its trial."""

    def first(self, imu: ImuBuffer) -> Start | None:
        """Start from the state of the last run, at the first sample; tried once."""
        if self.warm is None or not imu.end:
            return None
        try:
            return self.warm.start(imu.oldest_ns)
        except RefusedStateError as error:
            self._event("warm_state_refused", str(error))
            self.warm = None
            return None

    def begin(self, start: Start) -> None:
        """Begin the trial of a start."""
        self.check = StartCheck(self._options, start)
        self.look()

    def look(self) -> None:
        """Drop a check that is over."""
        if self.check is not None and self.check.over:
            self.check = None

    @property
    def on_trial(self) -> bool:
        """True if the start is from the state of the last run and no position has confirmed it
        yet."""
        return self.warm is not None and self.warm.on_trial

    @property
    def unconfirmed(self) -> str:
        """Text on an unconfirmed heading; empty for a confirmed one."""
        if self.warm is not None and self.warm.on_trial:
            return reason("not_confirmed_by_fix")
        return self.check.unconfirmed if self.check else ""
