"""Bearings of known points, as from a radar."""

from __future__ import annotations

from drivers.measurements import Bearing
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.landmark_bearing import SAR_BLOCK, BearingMeasurement
from fusiond.configuration.aiding import SarAiding
from fusiond.configuration.si_units import ARCSEC, DEG
from fusiond.navigator.intake.kind import Instants, Kind, Sections
from fusiond.navigator.intake.misalignment_block import misalignment_block, misalignment_blocks


def measurements_of(
    m: Bearing, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """Bearing; `unknown_target` if neither the measurement nor the configuration has the place."""
    o = sections.of(m.source, SarAiding)
    point = m.point
    if point is None:
        known = o.targets_deg_m.get(m.target)
        if known is None:
            return "unknown_target"
        point = (known[0] * DEG, known[1] * DEG, known[2])
    default = o.sd_arcsec * ARCSEC
    azimuth, elevation = (s * o.sigma_scale for s in m.sd_rad or (default, default))
    if not (azimuth > 0.0 and elevation > 0.0):
        return "no_sigma"
    return [
        BearingMeasurement(
            m.source,
            when.t_ns,
            o.gate_probability,
            m.azimuth_rad,
            m.elevation_rad,
            (azimuth, elevation),
            point,
            o.lever_arm_m,
            o.min_range_m,
            when.sd_time_s,
            misalignment_block(SAR_BLOCK, m.source, o, sections),
        )
    ]


KIND = Kind(Bearing, measurements_of, {SarAiding: misalignment_blocks(SAR_BLOCK)})
