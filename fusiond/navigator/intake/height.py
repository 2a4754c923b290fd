"""Ellipsoidal height."""

from __future__ import annotations

from drivers.measurements import Height
from fusiond.aiding.base import Aid
from fusiond.aiding.height import HeightAid
from fusiond.configuration.aiding import HeightAiding
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: Height, sections: Sections, when: Instants) -> list[Aid]:
    """The height, with the section's sigma where the device states none."""
    o = sections.of(m.source, HeightAiding)
    sd_m = (m.sd_m or o.sd_m) * o.sigma_scale
    return [HeightAid(m.source, when.t_ns, o.gate_probability, m.height_m, sd_m)]


KIND = Kind(Height, aids, {})
