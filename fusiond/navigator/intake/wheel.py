"""Wheel speed."""

from __future__ import annotations

import math

from drivers.measurements import WheelSpeed
from drivers.quantization import SHARED_SD
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.body_velocity import WheelSpeedMeasurement
from fusiond.configuration.aiding import WheelAiding
from fusiond.models.blocks import Block
from fusiond.models.vehicle_parameter_blocks import (
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
    drift_block,
    time_offset_block,
    wheel_rounding_block,
    wheel_scale_block,
)
from fusiond.navigator.intake.kind import Instants, Kind, Sections

# What a wheel errs by, in the order of `WheelSpeedMeasurement`.
_ERRORS = WHEEL_DRIFT, WHEEL_SCALE, WHEEL_LATENCY, WHEEL_ROUNDING


def measurements_of(m: WheelSpeed, sections: Sections, when: Instants) -> list[AidingMeasurement]:
    """Speed, with the section's sigma where the device states none, and its rounding error."""
    o = sections.of(m.source, WheelAiding)
    drift, scale, latency, rounding = sections.each_own(_ERRORS, m.source, o)
    t_ns = when.t_ns - round(o.latency_s * 1e9)
    counts = sections.drift_counts(drift, t_ns)
    sd_m_s = (m.sd_m_s or o.sd_m_s) * o.sigma_scale
    sd_m_s *= sections.white_counts(m.source, t_ns, sd_m_s, o.drift_s, m.rounding_sd_m_s)
    sd_m_s = math.hypot(sd_m_s, m.rounding_sd_m_s)
    return [
        WheelSpeedMeasurement(
            m.source,
            t_ns,
            o.gate_probability,
            m.speed_m_s / o.scale,
            sd_m_s,
            o.lever_arm_m,
            m.signed,
            m.rounding_sd_m_s,
            drift,
            scale,
            latency,
            rounding,
            m.shared_step_m_s,
            (o.drift_sd_m_s * counts, o.drift_s),
            counts,
        )
    ]


def blocks(source: str, section: WheelAiding, sections: Sections) -> list[Block]:
    """Drift, scale, latency and rounding of the wheel's speed."""
    found = [wheel_rounding_block(sections.own(WHEEL_ROUNDING, source, section), SHARED_SD)]
    if section.drift_sd_m_s:
        name = sections.own(WHEEL_DRIFT, source, section)
        found.append(drift_block(name, section.drift_sd_m_s, section.drift_s))
    if section.scale_sd:
        found.append(
            wheel_scale_block(sections.own(WHEEL_SCALE, source, section), section.scale_sd)
        )
    if section.latency_sd_s:
        name = sections.own(WHEEL_LATENCY, source, section)
        found.append(time_offset_block(name, section.latency_sd_s))
    return found


KIND = Kind(WheelSpeed, measurements_of, {WheelAiding: blocks})
