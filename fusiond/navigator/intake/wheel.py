"""Wheel speed."""

from __future__ import annotations

from drivers.measurements import WheelSpeed
from fusiond.aiding.base import Aid
from fusiond.aiding.body_velocity import WheelSpeedAid
from fusiond.configuration.aiding import WheelAiding
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: WheelSpeed, sections: Sections, when: Instants) -> list[Aid]:
    """The speed, with the section's sigma where the device states none."""
    o = sections.of(m.source, WheelAiding)
    sd_m_s = (m.sd_m_s or o.sd_m_s) * o.sigma_scale
    gate = o.gate_probability
    return [WheelSpeedAid(m.source, when.t_ns, gate, m.speed_m_s, sd_m_s, o.lever_arm_m)]


KIND = Kind(WheelSpeed, aids, {})
