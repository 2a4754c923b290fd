"""Attitude, also of a star tracker, which may be misaligned."""

from __future__ import annotations

import math

from drivers.measurements import Attitude
from fusiond.aiding.attitude import STAR_BLOCK, AttitudeMeasurement
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import Aiding, AttitudeAiding, StarTrackerAiding
from fusiond.configuration.si_units import ARCSEC
from fusiond.navigator.intake.kind import Instants, Kind, Sections
from fusiond.navigator.intake.misalignment_block import misalignment_block, misalignment_blocks


def measurements_of(
    m: Attitude, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """The attitude; `no_sigma` where an angle has none."""
    own = sections.aiding.get(m.source)
    tracker = isinstance(own, StarTrackerAiding) or (own is None and m.source == "star_tracker")
    stated, block = m.sd_rpy_rad, ""
    o: Aiding
    if tracker:
        o = star = sections.of(m.source, StarTrackerAiding)
        default = star.sd_arcsec * ARCSEC
        r, p, y = (default if math.isnan(s) else s for s in stated)
        stated, block = (r, p, y), misalignment_block(STAR_BLOCK, m.source, star, sections)
    else:
        o = sections.of(m.source, AttitudeAiding)
    roll, pitch, yaw = (s * o.sigma_scale for s in stated)
    sd = (roll, pitch, yaw)
    if not all(s > 0.0 or math.isnan(a) for s, a in zip(sd, m.rpy_rad, strict=True)):
        return "no_sigma"
    gate = o.gate_probability
    return [AttitudeMeasurement(m.source, when.t_ns, gate, m.rpy_rad, sd, when.sd_time_s, block)]


KIND = Kind(Attitude, measurements_of, {StarTrackerAiding: misalignment_blocks(STAR_BLOCK)})
