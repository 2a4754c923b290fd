r"""Earth-centred coordinates: geodetic position, ECEF, north-east-down.

    x = (R_N + h) cos phi cos lambda,  y = (R_N + h) cos phi sin lambda,
    z = (R_N (1 - e^2) + h) sin phi
    C_en = Rz(-lambda) Ry(phi + pi/2): columns are north, east and down in ECEF

phi geodetic latitude, lambda longitude (rad), h ellipsoidal height (m), R_N transverse radius. The
inverse applies Bowring's formula twice: 1e-11 rad from the sea floor to satellite heights.

Source: Groves, Principles of GNSS, Inertial and Multisensor Integrated Navigation Systems, 2nd
edition, 2.4.3 (2.112, C.18) and 2.5.3 (2.150); Bowring, Survey Review 23 (1976), 323-327.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M, SEMI_MINOR_M

Array = npt.NDArray[np.float64]

_SECOND_ECCENTRICITY_SQUARED = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)


@compiled("UniTuple(f8, 3)(f8, f8, f8)")
def to_geodetic(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Latitude rad, longitude rad, height m of an ECEF position in m.

    On the axis the longitude is 0; within 1 km of the earth's centre the result means nothing.
    """
    p = math.hypot(x, y)
    # reduced latitude of the point below, by that of the point itself
    beta = math.atan2(SEMI_MAJOR_M * z, SEMI_MINOR_M * p)
    lat = 0.0
    for _ in range(2):
        sb, cb = math.sin(beta), math.cos(beta)
        lat = math.atan2(
            z + _SECOND_ECCENTRICITY_SQUARED * SEMI_MINOR_M * sb * sb * sb,
            p - ECCENTRICITY_SQUARED * SEMI_MAJOR_M * cb * cb * cb,
        )
        beta = math.atan2(SEMI_MINOR_M * math.sin(lat), SEMI_MAJOR_M * math.cos(lat))
    s, c = math.sin(lat), math.cos(lat)
    w = math.sqrt(1.0 - ECCENTRICITY_SQUARED * s * s)
    return lat, math.atan2(y, x), p * c + z * s - SEMI_MAJOR_M * w


@compiled("UniTuple(f8, 3)(f8, f8, f8)")
def to_ecef(lat_rad: float, lon_rad: float, height_m: float) -> tuple[float, float, float]:
    """ECEF position in m of geodetic latitude and longitude (rad) and ellipsoidal height (m)."""
    s, c = math.sin(lat_rad), math.cos(lat_rad)
    radius = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * s * s)
    out = (radius + height_m) * c
    return (
        out * math.cos(lon_rad),
        out * math.sin(lon_rad),
        (radius * (1.0 - ECCENTRICITY_SQUARED) + height_m) * s,
    )


def ned_axes(lat_rad: float, lon_rad: float) -> Array:
    """C_en (3, 3): columns are the unit vectors north, east, down in ECEF."""
    sp, cp = math.sin(lat_rad), math.cos(lat_rad)
    sl, cl = math.sin(lon_rad), math.cos(lon_rad)
    return np.array([[-sp * cl, -sl, -cp * cl], [-sp * sl, cl, -cp * sl], [cp, 0.0, -sp]])
