"""Geoid height above the ellipsoid for receivers that do not state it.

    h = H + N      h above the ellipsoid, H above the sea (GGA's altitude), N the geoid's height

N lies between -107 and 85 m; an unknown N is taken as uniform in +-107 m. A printed N beyond that
counts as unknown (999.9 of a receiver without a model). So does exactly 0, which shows that the
receiver has no model (the true N is 0 at one place in a thousand): its altitude may be above the
sea or above the ellipsoid. An N printed before is used further, with an error that grows by the
geoid's slope along the way since. Source: Lemoine et al., The development of EGM96,
NASA/TP-1998-206861.
"""

from __future__ import annotations

import math

from drivers.plausible import HEIGHT_M, within

BOUND_M = 107.0
GEOID_SD_M = BOUND_M / math.sqrt(3.0)
MOST_M = 110.0
"""Most that is taken for a geoid height: the bound, and what models differ by."""
SLOPE_SD = 5e-5
"""One sigma of the slope of the geoid: deflections of the vertical are 5 to 10 arc seconds outside
high mountains."""
EARTH_M = 6_371_000.0


def states_geoid(separation_m: float | None) -> bool:
    """True if a printed separation can be the geoid's height."""
    return bool(separation_m) and abs(separation_m or 0.0) <= MOST_M


class Geoid:
    """Geoid separation of one receiver."""

    def __init__(self) -> None:
        self._known: tuple[float, float, float] | None = None

    def height(
        self, altitude_m: float, separation_m: float | None, lat_deg: float, lon_deg: float
    ) -> tuple[float, float]:
        """Height above the ellipsoid (m), and one sigma (m) of its geoid height, 0 if printed. If
        the geoid height is unknown, the height is above the sea."""
        if states_geoid(separation_m):
            assert separation_m is not None
            self._known = separation_m, lat_deg, lon_deg
            return altitude_m + separation_m, 0.0
        if self._known is None:
            return altitude_m, GEOID_SD_M
        separation_m, lat, lon = self._known
        north = math.radians(lat_deg - lat)
        east = math.radians(math.remainder(lon_deg - lon, 360.0)) * math.cos(math.radians(lat))
        sd_m = SLOPE_SD * EARTH_M * math.hypot(north, east)
        if sd_m > GEOID_SD_M or not within(altitude_m + separation_m, HEIGHT_M):
            return altitude_m, GEOID_SD_M
        return altitude_m + separation_m, sd_m
