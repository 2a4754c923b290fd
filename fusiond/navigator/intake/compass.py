"""Heading of a compass, with the declination from the World Magnetic Model.

Place and date are those of the last admitted fix. The model is evaluated for a cell of `CELL_DEG`
and a month, so that the order of two fixes does not matter: over a cell the declination changes by
some 0.05 deg where compasses work, in a month by 0.02 deg, and the model itself is off by 0.3 deg
and more (WMM2025, technical report, section 3), which is part of the deviation: a constant while
the vehicle stays in one country.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from functools import lru_cache

from drivers.measurements import MagneticHeading
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.compass import (
    DEVIATION,
    DISTURBANCE,
    CompassMeasurement,
    deviation,
    disturbance,
)
from fusiond.configuration.aiding import CompassAiding
from fusiond.configuration.si_units import DEG
from fusiond.models.blocks import Block
from fusiond.navigator.intake.kind import Instants, Kind, Sections

CELL_DEG = 0.1
LEAST_FIELD_NT = 6000.0
"""Least horizontal field: the caution zone of the World Magnetic Model around its poles, where
compasses are unreliable, lies below it."""
_MODEL = "wmm/WMM_2025.COF"


def measurements_of(
    m: MagneticHeading, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """The heading with the declination. Rejections: `place_unknown` and `date_unknown` before a
    fix, `near_magnetic_pole`, `beyond_magnetic_model` (its five years), `no_magnetic_model` without
    the package; none with a configured declination."""
    o = sections.of(m.source, CompassAiding)
    found = _declination(o, sections)
    if isinstance(found, str):
        return found
    own_rad, rounding_rad = o.sd_deg * DEG * o.sigma_scale, m.rounding_sd_rad
    counted = m.source, when.t_ns, own_rad, o.disturbance_s, rounding_rad
    sd_rad = math.hypot(own_rad * sections.white_counts(*counted), rounding_rad)
    names = _names(m.source, o, sections)
    counts = sections.drift_counts(names[1], when.t_ns)
    lasting = math.hypot(o.deviation_sd_deg, o.disturbance_sd_deg * counts) * DEG
    yaw = math.remainder(m.yaw_rad + found, math.tau)
    own = m.source, when.t_ns, o.gate_probability, yaw, sd_rad
    return [CompassMeasurement(*own, *names, lasting, counts)]


def _declination(o: CompassAiding, sections: Sections) -> float | str:
    if o.declination_deg is not None:
        return o.declination_deg * DEG
    if sections.place is None:
        return "place_unknown"
    if sections.utc_ns is None:
        return "date_unknown"
    lat, lon = (round(math.degrees(angle) / CELL_DEG) for angle in sections.place)
    day = datetime.fromtimestamp(sections.utc_ns * 1e-9, UTC)
    return declination(lat, lon, day.year, day.month)


@lru_cache(maxsize=64)
def declination(lat: int, lon: int, year: int, month: int) -> float | str:
    """Declination east of true north (rad) in the middle of a month, at a cell of `CELL_DEG`
    counted from the equator and Greenwich."""
    try:
        from pygeomag.geomag import GeoMag  # noqa: PLC0415  (extra `[compass]`)
    except ImportError:
        return "no_magnetic_model"
    model = GeoMag(coefficients_file=_MODEL)
    time = year + (month - 0.5) / 12.0
    try:
        field = model.calculate(glat=lat * CELL_DEG, glon=lon * CELL_DEG, alt=0.0, time=time)
    except ValueError:
        return "beyond_magnetic_model"
    if field.h < LEAST_FIELD_NT:
        return "near_magnetic_pole"
    return math.radians(field.d)


def blocks(source: str, section: CompassAiding, sections: Sections) -> list[Block]:
    """Blocks of the deviation, and of disturbances that last for seconds."""
    of_vehicle, passing = _names(source, section, sections)
    sd_rad = section.disturbance_sd_deg * DEG
    return [
        deviation(of_vehicle, section.deviation_sd_deg * DEG),
        disturbance(passing, sd_rad, section.disturbance_s),
    ]


def _names(source: str, section: CompassAiding, sections: Sections) -> tuple[str, str]:
    own = sections.own
    return own(DEVIATION, source, section), own(DISTURBANCE, source, section)


KIND = Kind(MagneticHeading, measurements_of, {CompassAiding: blocks})
