"""Heading from two antennas or a compass."""

from __future__ import annotations

import math

from drivers.measurements import Heading
from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import HeadingAiding
from fusiond.configuration.si_units import DEG
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def measurements_of(m: Heading, sections: Sections, when: Instants) -> list[AidingMeasurement]:
    """Heading, with the section's sigma where the device states none, and its rounding error."""
    o = sections.of(m.source, HeadingAiding)
    sd_rad = math.hypot((m.sd_rad or o.sd_deg * DEG) * o.sigma_scale, m.rounding_sd_rad)
    # One receiver may send position and heading of the same instant: two names.
    name = m.source if m.source == o.kind else f"{m.source}_heading"
    return [HeadingMeasurement(name, when.t_ns, o.gate_probability, m.yaw_rad, sd_rad)]


KIND = Kind(Heading, measurements_of, {})
