"""Wheel speed."""

from __future__ import annotations

import math

from drivers.measurements import WheelSpeed
from fusiond.aiding.base import Aid
from fusiond.aiding.body_velocity import WheelSpeedAid
from fusiond.configuration.aiding import WheelAiding
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: WheelSpeed, sections: Sections, when: Instants) -> list[Aid]:
    """The speed, with the section's sigma where the device states none, and what rounding adds."""
    o = sections.of(m.source, WheelAiding)
    sd_m_s = math.hypot((m.sd_m_s or o.sd_m_s) * o.sigma_scale, m.rounding_sd_m_s)
    return [
        WheelSpeedAid(
            m.source,
            when.t_ns,
            o.gate_probability,
            m.speed_m_s,
            sd_m_s,
            o.lever_arm_m,
            m.signed,
            m.rounding_sd_m_s,
        )
    ]


KIND = Kind(WheelSpeed, aids, {})
