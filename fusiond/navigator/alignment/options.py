"""Options of the alignment, from the configuration."""

from __future__ import annotations

import math

from drivers.immutable import immutable
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG

# Faster (m/s) than a road vehicle reverses: a reverse gear ends at 10 to 25 km/h in a car.
# A train drives either way.
MAX_REVERSE_M_S = 8.0


@immutable()
class AlignmentOptions:
    """SI units; `heading` the allowed sources in order of preference, `window_s` the length of the
    standstill detector's windows, `rate_sd_rad_s` the rate that a vehicle at rest may have,
    `no_slip_m` the lever arm to the point that does not slide, if known, `quiet_rad_s` and
    `quiet_m_s2` the standard deviations below which the sensor is quiet, `misalignment_rad` the
    axes' deviation from square, `graded` true if the unit is configured by its class."""

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
    window_s: float
    rate_sd_rad_s: float
    no_slip_m: tuple[float, float, float] | None
    max_reverse_m_s: float
    gap_s: float
    rate_hz: float
    quiet_rad_s: float
    quiet_m_s2: float
    misalignment_rad: float
    graded: bool


def alignment_options(config: Config) -> AlignmentOptions:
    """Options of alignment from `[alignment]` and `[constraints.zero_velocity]`."""
    a, rest = config.alignment, config.constraints.zero_velocity
    no_slip = config.constraints.non_holonomic
    position = a.position_deg_m
    return AlignmentOptions(
        heading=a.heading,
        heading_rad=None if a.heading_deg is None else a.heading_deg * DEG,
        heading_sd_rad=a.heading_sd_deg * DEG,
        position=position and (position[0] * DEG, position[1] * DEG, position[2]),
        position_sd_m=a.position_sd_m,
        levelling_s=a.levelling_s,
        rest_speed_m_s=rest.max_speed_m_s,
        course_speed_m_s=a.course_speed_m_s,
        course_sd_rad=a.course_sd_deg * DEG,
        gyrocompass_s=a.gyrocompass_s,
        gyrocompass_max_sd_rad=a.gyrocompass_max_sd_deg * DEG,
        window_s=rest.window_s,
        rate_sd_rad_s=rest.rate_sd_deg_s * DEG,
        no_slip_m=no_slip.lever_arm_m if no_slip.enabled else None,
        gap_s=config.imu.gap_s,
        rate_hz=config.imu.rate_hz,
        quiet_rad_s=rest.gyro_sd_deg_s * DEG,
        quiet_m_s2=rest.accel_sd_m_s2,
        misalignment_rad=config.imu.misalignment_deg * DEG,
        graded=config.imu.sensor_class is not None and config.imu.misalignment_deg > 0.0,
        max_reverse_m_s=math.inf if config.vehicle_class == "rail" else MAX_REVERSE_M_S,
    )
