"""Ellipsoidal height."""

from __future__ import annotations

import math

from drivers.measurements import Height
from fusiond.aiding.base import Aid
from fusiond.aiding.height import HeightAid
from fusiond.configuration.aiding import HeightAiding
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: Height, sections: Sections, when: Instants) -> list[Aid] | str:
    """The height, with the section's sigma where the device states none, and what rounding adds.

    `weather_unknown`: a barometer's height is off by the weather, 100 m and more, for hours alike;
    without a state for that error its sigma would be a lie.
    """
    if m.barometric:
        return "weather_unknown"
    o = sections.of(m.source, HeightAiding)
    sd_m = math.hypot((m.sd_m or o.sd_m) * o.sigma_scale, m.rounding_sd_m)
    return [HeightAid(m.source, when.t_ns, o.gate_probability, m.height_m, sd_m)]


KIND = Kind(Height, aids, {})
