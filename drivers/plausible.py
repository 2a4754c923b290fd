"""Plausible ranges of measurements on a vehicle.

A sentence or frame with a correct checksum can still hold any number: from a receiver that
restarts, an edited line, or another program. Values outside are refused under a counter's name.
"""

from __future__ import annotations

HEIGHT_M = (-1_000.0, 100_000.0)
"""Ellipsoidal height. The lowest dry land, the shore of the Dead Sea, is at -430 m, and the geoid
down to 106 m below the ellipsoid (EGM96); above 100 km (FAI's limit of space) nothing drives or
flies."""
SPEED_M_S = 1_000.0
"""Speed. A receiver without an export licence stops at 515 m/s (1,000 knots, the CoCom rule) or 600
m/s (Wassenaar Arrangement, 7.A.5); the rest is a margin for licensed ones."""
SIGMA_M = (1e-3, 1e5)
"""One sigma of a position. No phase is measured below a millimetre (GST prints millimetres, and 0
where it has none); a sigma beyond a degree of latitude means no position."""
LEAP_SECONDS = (10, 30)
"""GPS time minus UTC: 18 since 2017, changed by one in years, and not at all from 2035 on (CGPM
2022, resolution 4)."""


def within(value: float, limits: tuple[float, float]) -> bool:
    """True if `value` lies in the range; false for NaN."""
    return limits[0] <= value <= limits[1]
