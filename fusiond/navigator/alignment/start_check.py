"""Checks of a start by the first motion: claimed headings, and the mounting of the IMU."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.navigation.rotation import dcm_elements, wrap_angle
from fusiond.navigation.strapdown import Q0, VN
from fusiond.navigator.alignment.headings import CLAIMS
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.reasons import reason

Array = NDArray[np.float64]

# Sigmas of heading and course beyond which a claimed heading is contradicted, and for how long: an
# obstacle that the vehicle slides at takes less.
HEADING_SIGMAS = 4.0
CONTRADICTED_NS = 1_000_000_000
# Of the sigma that was claimed: three quarters of what is known of the heading are then measured.
DETERMINED = 0.5
# Measured velocities of so long are averaged to a course.
COURSE_NS = 1_000_000_000


class StartCheck:
    """Check of a start; `refuted` is the reason why it was wrong."""

    def __init__(self, options: AlignmentOptions, start: Start) -> None:
        self._options = options
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
        self._say()

    def _say(self) -> None:
        if self._backward:
            self.unconfirmed = reason("backward_or_mounted")
        else:
            self.unconfirmed = reason("not_confirmed_by_motion") if self._unproven else ""

    def refuted(
        self, t_ns: int, nav: Array, covariance: Array, measured: RestEvidence, doubted: bool
    ) -> tuple[str, str] | None:
        """Code and text of the event if the solution nav (10,) with P (n, n) at `t_ns` refutes the
        start. `doubted`: it has not fitted the measurements since."""
        axes = dcm_elements(nav[Q0:])
        v_n, v_e, v_d = nav[VN : VN + 3].tolist()
        backward = -(axes[0] * v_n + axes[3] * v_e + axes[6] * v_d)
        if backward > self._options.max_reverse_m_s:
            ahead = np.array(axes[::3])
            sd = math.sqrt(max(float(ahead @ covariance[3:6, 3:6] @ ahead), 0.0))
            if backward - 3.0 * sd > self._options.max_reverse_m_s:
                return "imu_backwards", reason("imu_backwards", speed=backward)
        if self._backward and -backward > self._options.course_speed_m_s:
            self._backward = False
            self._say()
        if not self._claim:
            return None
        if math.sqrt(covariance[2, 2]) < DETERMINED * self._sd_yaw and not doubted:
            self._unproven = False
            self._say()
        velocity = measured.velocity(t_ns - COURSE_NS, t_ns)
        return velocity and self._heading(
            t_ns, velocity, math.atan2(axes[3], axes[0]), math.sqrt(covariance[2, 2]), doubted
        )

    def _heading(
        self,
        t_ns: int,
        velocity: tuple[float, float, float],
        yaw: float,
        sd_yaw: float,
        doubted: bool,
    ) -> tuple[str, str] | None:
        """Check a configured or saved heading against the measured course, forward or backward: a
        filter with a wrong heading gates the velocities that contradict it. Once it has doubted its
        motion, it slowly turns towards the course and corrupts correct sensor errors."""
        north, east, sd_speed = velocity
        speed = math.hypot(north, east)
        if speed < self._options.course_speed_m_s + 3.0 * sd_speed:
            self._since_ns = None
            return None
        residual = abs(wrap_angle(math.atan2(east, north) - yaw))
        sd = math.hypot(sd_yaw, self._options.course_sd_rad, sd_speed / speed)
        if doubted:
            return "heading_contradicted", (
                f"The first motion disagrees with the {self._claim}: aligning again by the course"
            )
        if min(residual, math.pi - residual) <= HEADING_SIGMAS * sd:
            self._claim, self._unproven = "", False
            self._say()
            return None
        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns < CONTRADICTED_NS:
            return None
        return "heading_contradicted", (
            f"The {self._claim} is {math.degrees(residual):.0f} deg from the course: aligning again"
        )
