r"""Noise of a double-star (RDSS) fix from its geometry.

The centre C interrogates through satellite 1; the terminal U answers at once through both. The
centre measures two path lengths and takes off the legs between itself and the satellites:

    L1 = |C S1| + |S1 U| + |U S1| + |S1 C| - 2 |C S1|           = 2 rho_1
    L2 = |C S1| + |S1 U| + |U S2| + |S2 C| - |C S1| - |C S2|    = rho_1 + rho_2

rho_j = |S_j - U| is the slant range. With the height they give latitude and longitude. Linearised,
l_j = (n_j, e_j, u_j) the unit vector from the terminal to satellite j, north-east-up:

    d rho_j = -(n_j dN + e_j dE + u_j dU)
    A = -[[n_1, e_1], [n_2, e_2]],   G = A^-1,   g = G [u_1, u_2]^T
    [dN, dE]^T = G [d rho_1, d rho_2]^T + g dH
    P = s_rho^2 G G^T + s_H^2 g g^T                             (paper 000, eq. 4, with correlation)

s_rho (m): error of each *one-way* slant range, independent between the satellites. The paths then
have sigma 2 s_rho and sqrt(2) s_rho and correlation 1/sqrt(2), whichever satellite interrogates.
s_H (m): error of the height used. Too great a height shifts the fix away from the equator.
docs/rdss-accuracy.md has the derivation, what belongs into s_rho, and the figures.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import Array, NotApplicable
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M

GEOSTATIONARY_RADIUS_M = 42_164_170.0
LONGITUDES_DEG = (80.0, 140.0)
"""Working satellites; the spare stands at 110.5 deg."""

ELEVATION_MASK_RAD = math.radians(5.0)
"""Customary mask: below it the troposphere is crossed over more than ten zenith thicknesses
(1 / sin 5 deg = 11.5) and no model corrects the range to the figures used here."""
MAX_AMPLIFICATION = 12.0
"""Largest singular value of G, metres of fix for one metre of slant range, of a valid fix. Beyond
it 10 m of height error alone moves the fix by more than 100 m, the coarsest class that the centre
states. With 80 and 140 deg E it is reached within 3.4 deg of the equator midway (4.6 deg at 70 deg
E), so the service area from 5 to 55 deg N lies inside; satellites close together reach it anywhere.
"""


class Sensitivity(NamedTuple):
    """Sensitivities: `ranges` G (2, 2), m of north/east for 1 m in each slant range; `height` g
    (2,), for 1 m of height."""

    ranges: Array
    height: Array


class Covariance(NamedTuple):
    """Error of a fix, (2, 2) in m^2, axes north and east; `total` = `ranging` + `height`."""

    total: Array
    ranging: Array
    height: Array


@immutable()
class RdssGeometry:
    """Two geostationary satellites at `longitudes_deg`, east positive."""

    longitudes_deg: tuple[float, float] = LONGITUDES_DEG

    def sensitivity(
        self, lat_rad: float, lon_rad: float, height_m: float
    ) -> Sensitivity | NotApplicable:
        """Sensitivities G and g at a geodetic position (rad, rad, m above the ellipsoid).

        `satellite_below_horizon`: one of the two satellites is below `ELEVATION_MASK_RAD`.
        `no_geometry`: G exceeds `MAX_AMPLIFICATION`; at the equator both sight lines lie in the
        equatorial plane and nothing measures north.
        """
        if not all(map(math.isfinite, (lat_rad, lon_rad, height_m))):
            raise ValueError("place must be finite")
        n1, e1, u1 = _line_of_sight(lat_rad, lon_rad, height_m, self.longitudes_deg[0])
        n2, e2, u2 = _line_of_sight(lat_rad, lon_rad, height_m, self.longitudes_deg[1])
        if min(u1, u2) < math.sin(ELEVATION_MASK_RAD):
            return NotApplicable("satellite_below_horizon")
        det = n1 * e2 - e1 * n2
        # singular values of A: their product is |det|, the sum of their squares the Frobenius norm
        squares = n1 * n1 + e1 * e1 + n2 * n2 + e2 * e2
        largest = math.sqrt(0.5 * (squares + math.sqrt(max(squares**2 - 4.0 * det * det, 0.0))))
        if largest > MAX_AMPLIFICATION * abs(det):
            return NotApplicable("no_geometry")
        a, b, c, d = -e2 / det, e1 / det, n2 / det, -n1 / det
        return Sensitivity(np.array([[a, b], [c, d]]), np.array([a * u1 + b * u2, c * u1 + d * u2]))

    def covariance(
        self,
        lat_rad: float,
        lon_rad: float,
        height_m: float,
        sd_range_m: float,
        sd_height_m: float,
    ) -> Covariance | NotApplicable:
        """Covariance of a fix at a position (rad, rad, m), and its two parts.

        `sd_range_m` of each one-way slant range, `sd_height_m` of the height used; one sigma, not
        negative (ValueError). Outcomes as in `sensitivity`. Source: paper 000, eq. 4.
        """
        if not (0.0 <= sd_range_m < math.inf and 0.0 <= sd_height_m < math.inf):
            raise ValueError("sigma must be finite and not negative")
        found = self.sensitivity(lat_rad, lon_rad, height_m)
        if isinstance(found, NotApplicable):
            return found
        g, h = found
        ranging = sd_range_m**2 * (g @ g.T)
        height = sd_height_m**2 * np.outer(h, h)
        return Covariance(ranging + height, ranging, height)


def with_floor(total: Array, class_m: float) -> Array:
    """Least covariance (2, 2), m^2, that is bounded below by `total` and by `class_m` squared.

    The terminal's precision class (20 or 100 m) is taken as one sigma of each horizontal axis:
    eigenvalues of `total` below `class_m`^2 are lifted to it and the axes of the ellipse stay, so
    no direction claims better than the class. `total` must be symmetric.
    """
    nn, ee, ne = float(total[0, 0]), float(total[1, 1]), float(total[0, 1])
    floor = class_m * class_m
    middle, radius = 0.5 * (nn + ee), math.hypot(0.5 * (nn - ee), ne)
    least, greatest = middle - radius, middle + radius
    if least >= floor:
        return total.copy()
    if greatest <= floor:
        return np.array([[floor, 0.0], [0.0, floor]])
    # the projector on the axis of the least eigenvalue is (greatest I - total) / (2 radius)
    lift = (floor - least) / (greatest - least)
    cross = ne - lift * ne
    return np.array([[nn + lift * (greatest - nn), cross], [cross, ee + lift * (greatest - ee)]])


def _line_of_sight(
    lat_rad: float, lon_rad: float, height_m: float, satellite_deg: float
) -> tuple[float, float, float]:
    """Unit vector north, east, up from a place to a geostationary satellite."""
    sin_lat, cos_lat = math.sin(lat_rad), math.cos(lat_rad)
    transverse = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat)
    # axes: in the equator through the place's meridian, in the equator eastwards, polar
    away = math.radians(satellite_deg) - lon_rad
    x = GEOSTATIONARY_RADIUS_M * math.cos(away) - (transverse + height_m) * cos_lat
    y = GEOSTATIONARY_RADIUS_M * math.sin(away)
    z = -(transverse * (1.0 - ECCENTRICITY_SQUARED) + height_m) * sin_lat
    slant = math.sqrt(x * x + y * y + z * z)
    return (
        (cos_lat * z - sin_lat * x) / slant,
        y / slant,
        (cos_lat * x + sin_lat * z) / slant,
    )
