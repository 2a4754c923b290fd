"""Heading from the course over ground: moving off from a standstill, or on the move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.offers import VelocityOffer
from fusiond.navigation.alignment import integrate_from_rest, level, level_in_motion
from fusiond.navigation.earth import gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    quaternion_from_rpy,
    rpy_from_dcm,
    wrap_angle,
)
from fusiond.navigator.alignment.basis import Basis, rest_bias
from fusiond.navigator.alignment.collected import Standing, place_of
from fusiond.navigator.alignment.start import Place, Start, build_start, velocity_of

Array = NDArray[np.float64]

# Course and integrated motion must agree this well (rad), forward or backward, or the vehicle slid
# or the integration is poor: the next fix decides.
COURSE_AGREEMENT_RAD = math.radians(45.0)
# Turn rate (rad/s) above which levelling in motion is not tried.
MOTION_MAX_RATE_RAD_S = math.radians(5.0)
MOTION_INTERVAL_NS = (800_000_000, 3_500_000_000)


def from_course(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Heading from the course over ground, forward or backward as the IMU felt it move off."""
    for velocity, position in reversed(by.known.fixes):
        speed = math.hypot(*velocity.v_ned[:2])
        if speed < by.options.course_speed_m_s or velocity.t_ns > imu.latest_ns:
            continue
        course = math.atan2(velocity.v_ned[1], velocity.v_ned[0])
        sd_course = math.hypot(by.options.course_sd_rad, max(velocity.sd[:2]) / speed)
        here = place_of(position, velocity)
        s = by.known.standing
        if s is not None and s.seconds >= 1.0 and imu.oldest_ns <= s.end_ns < velocity.t_ns:
            return _moved_off(by, imu, s, velocity, course, sd_course, here)
        return _on_the_move(by, imu, velocity, course, sd_course, here)
    return None


def _moved_off(
    by: Basis,
    imu: ImuBuffer,
    standing: Standing,
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
        return None
    yaw = course + (math.pi if backward else 0.0)
    at_rest = dcm_from_rpy(*level(standing.mean_force), yaw - turned)
    return build_start(
        by.model,
        velocity.t_ns,
        place,
        dcm_from_rpy(roll, pitch, yaw),
        sd,
        *velocity_of(velocity),
        "GNSS course" + (", backward" if backward else ""),
        bias=rest_bias(by.noise, standing, at_rest, lat),
        levelled=True,
    )


def _on_the_move(
    by: Basis,
    imu: ImuBuffer,
    velocity: VelocityOffer,
    course: float,
    sd: float,
    place: Place,
) -> Start | None:
    shortest, longest = MOTION_INTERVAL_NS
    for earlier, _ in reversed(by.known.fixes):
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
            by.model,
            velocity.t_ns,
            place,
            dcm_from_rpy(roll, pitch, course),
            sd,
            *velocity_of(velocity),
            "GNSS course, on the move",
        )
    return None
