"""Options of the alignment, from the configuration."""

from __future__ import annotations

from dataclasses import dataclass

from fusiond.configuration.schema import Config
from fusiond.configuration.settings import DEG


@dataclass(frozen=True, slots=True)
class AlignmentOptions:
    """SI units; `heading` the allowed sources in order of preference, `window_s` the length of the
    standstill detector's windows."""

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


def alignment_options(config: Config) -> AlignmentOptions:
    """From `[alignment]` and `[constraints.zero_velocity]`."""
    a, rest = config.alignment, config.constraints.zero_velocity
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
    )
