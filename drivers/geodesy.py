r"""Earth-centred positions and velocities as geodetic ones on WGS 84.

    lat = atan2(z + e'^2 b sin^3 theta, p - e^2 a cos^3 theta),  tan theta = z a / (p b)
    height = p cos lat + z sin lat - a^2 / N

p distance from the axis, N = a / sqrt(1 - e^2 sin^2 lat). Within 1e-5 m below 100 km.
Source: Bowring, Survey Review 23 (1976), 323-327.
"""

from __future__ import annotations

import math

from drivers.measurements import Vector3

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_B = SEMI_MAJOR_M * (1.0 - FLATTENING)
_E2 = FLATTENING * (2.0 - FLATTENING)


def geodetic(x: float, y: float, z: float) -> Vector3:
    """Latitude, longitude (rad) and ellipsoidal height (m) of ECEF (m)."""
    p = math.hypot(x, y)
    theta = math.atan2(z * SEMI_MAJOR_M, p * _B)
    second = _E2 / (1.0 - _E2) * _B
    sine, cosine = math.sin(theta), math.cos(theta)
    lat = math.atan2(z + second * sine**3, p - _E2 * SEMI_MAJOR_M * cosine**3)
    sine = math.sin(lat)
    root = SEMI_MAJOR_M * math.sqrt(1.0 - _E2 * sine * sine)
    return lat, math.atan2(y, x), p * math.cos(lat) + z * sine - root


def north_east_down(v: Vector3, lat: float, lon: float) -> Vector3:
    """Rotate a vector from ECEF axes to NED axes at a position (rad)."""
    x, y, z = v
    sin_lat, cos_lat, sin_lon, cos_lon = (
        math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon),
    )  # fmt: skip
    outwards = x * cos_lon + y * sin_lon
    return (
        z * cos_lat - outwards * sin_lat,
        y * cos_lon - x * sin_lon,
        -(outwards * cos_lat + z * sin_lat),
    )
