"""Wheel speed."""

from __future__ import annotations

import math

from drivers.measurements import WheelSpeed
from fusiond.aiding.base import Aid
from fusiond.aiding.body_velocity import WheelSpeedAid
from fusiond.configuration.aiding import WheelAiding
from fusiond.models.blocks import Block
from fusiond.models.vehicle import WHEEL_LATENCY, WHEEL_SCALE, time_offset, wheel_scale
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: WheelSpeed, sections: Sections, when: Instants) -> list[Aid]:
    """The speed, with the section's sigma where the device states none, and what rounding adds.

    Errors that last for T count as one in 2 T: n of them in that time get sqrt(n) times the sigma,
    so that their mean is as good as one of them.
    """
    o = sections.of(m.source, WheelAiding)
    sd_m_s = math.hypot((m.sd_m_s or o.sd_m_s) * o.sigma_scale, m.rounding_sd_m_s)
    spacing_s = sections.spacing_s(m.source, when.t_ns)
    if 0.0 < spacing_s < 2.0 * o.correlation_s:
        sd_m_s *= math.sqrt(2.0 * o.correlation_s / spacing_s)
    return [
        WheelSpeedAid(
            m.source,
            when.t_ns - round(o.latency_s * 1e9),
            o.gate_probability,
            m.speed_m_s / o.scale,
            sd_m_s,
            o.lever_arm_m,
            m.signed,
            m.rounding_sd_m_s,
            sections.own(WHEEL_SCALE, m.source, o),
            sections.own(WHEEL_LATENCY, m.source, o),
        )
    ]


def blocks(source: str, section: WheelAiding, sections: Sections) -> list[Block]:
    """Scale and latency of the wheel's speed."""
    found = []
    if section.scale_sd:
        found.append(wheel_scale(sections.own(WHEEL_SCALE, source, section), section.scale_sd))
    if section.latency_sd_s:
        name = sections.own(WHEEL_LATENCY, source, section)
        found.append(time_offset(name, section.latency_sd_s))
    return found


KIND = Kind(WheelSpeed, aids, {WheelAiding: blocks})
