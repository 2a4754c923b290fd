"""Height above the ellipsoid, or by the pressure of the air."""

from __future__ import annotations

import math

from drivers.measurements import Height
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.height import BarometerMeasurement, HeightMeasurement
from fusiond.configuration.aiding import BarometerAiding, HeightAiding
from fusiond.models.blocks import Block
from fusiond.models.vehicle_parameter_blocks import (
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    barometer_airflow_block,
    barometer_offset_block,
    barometer_scale_block,
)
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def measurements_of(m: Height, sections: Sections, when: Instants) -> list[AidingMeasurement] | str:
    """Height, with the section's sigma where the device states none, and its rounding error.

    `weather_unknown`: weather shifts a barometer's height by 100 m and more for hours; without a
    section of kind `barometer`, whose states model that error, its sigma would be too small.
    """
    if not m.barometric:
        o = sections.of(m.source, HeightAiding)
        return [HeightMeasurement(m.source, when.t_ns, o.gate_probability, m.height_m, _sd_m(m, o))]
    b = sections.of(m.source, BarometerAiding)
    if not any(b is section for section in sections.aiding.values()):
        return "weather_unknown"
    names = _names(m.source, b, sections)
    sd_m = _sd_m(m, b)
    return [BarometerMeasurement(m.source, when.t_ns, b.gate_probability, m.height_m, sd_m, *names)]


def _sd_m(m: Height, o: HeightAiding | BarometerAiding) -> float:
    return math.hypot((m.sd_m or o.sd_m) * o.sigma_scale, m.rounding_sd_m)


def blocks(source: str, section: BarometerAiding, sections: Sections) -> list[Block]:
    """Offset, scale and airflow of a barometer's height."""
    offset, scale, airflow = _names(source, section, sections)
    return [
        barometer_offset_block(offset, section.weather_sd_m, section.weather_walk_m_sqrt_s),
        barometer_scale_block(scale, section.temperature_sd),
        barometer_airflow_block(airflow, section.airflow_sd),
    ]


def _names(source: str, section: BarometerAiding, sections: Sections) -> tuple[str, str, str]:
    """Names of the source's blocks, in order."""
    return (
        sections.own(BAROMETER_OFFSET, source, section),
        sections.own(BAROMETER_SCALE, source, section),
        sections.own(BAROMETER_AIRFLOW, source, section),
    )


KIND = Kind(Height, measurements_of, {BarometerAiding: blocks})
