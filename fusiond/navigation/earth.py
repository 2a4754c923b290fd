r"""Earth: ellipsoid, radii of curvature, normal gravity, rotation.

    R_M(phi) = a (1 - e^2) / (1 - e^2 sin^2 phi)^(3/2)       meridian (north-south) radius
    R_N(phi) = a / sqrt(1 - e^2 sin^2 phi)                   transverse (east-west) radius
    g(phi, h) = g_e (1 + k sin^2 phi) / sqrt(1 - e^2 sin^2 phi)
                * (1 - 2 h / a (1 + f + m - 2 f sin^2 phi) + 3 h^2 / a^2)

phi geodetic latitude (rad), h ellipsoidal height (m). Gravity points along down; its deflection
with height (under 1e-8 g per km) is left out.

Source: NGA.STND.0036 (WGS 84), tables 3.1 to 3.6 and equations 4-1 and 4-3. CGCS2000 differs in f
by 1.6e-11 relative: 0.1 mm at the pole, so one set of constants serves both.
"""

from __future__ import annotations

import math

from fusiond.navigation.compiled import compiled

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
EARTH_RATE_RAD_S = 7.292115e-5
GRAVITATIONAL_PARAMETER_M3_S2 = 3.986004418e14
GRAVITY_EQUATOR_M_S2 = 9.7803253359
GRAVITY_POLE_M_S2 = 9.8321849378
SOMIGLIANA_K = SEMI_MINOR_M * GRAVITY_POLE_M_S2 / (SEMI_MAJOR_M * GRAVITY_EQUATOR_M_S2) - 1.0
GRAVITY_RATIO_M = (
    EARTH_RATE_RAD_S**2 * SEMI_MAJOR_M**2 * SEMI_MINOR_M / GRAVITATIONAL_PARAMETER_M3_S2
)
STANDARD_GRAVITY_M_S2 = 9.80665


@compiled("f8(f8)")
def meridian_radius(lat_rad: float) -> float:
    """R_M in m at a geodetic latitude in rad."""
    s = math.sin(lat_rad)
    w2 = 1.0 - ECCENTRICITY_SQUARED * s * s
    return SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w2 * math.sqrt(w2))


@compiled("f8(f8)")
def transverse_radius(lat_rad: float) -> float:
    """R_N in m at a geodetic latitude in rad."""
    s = math.sin(lat_rad)
    return SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * s * s)


@compiled("f8(f8, f8)")
def gravity(lat_rad: float, height_m: float) -> float:
    """Normal gravity along down in m/s^2 at geodetic latitude (rad) and ellipsoidal height (m)."""
    s2 = math.sin(lat_rad) ** 2
    on_ellipsoid = (
        GRAVITY_EQUATOR_M_S2
        * (1.0 + SOMIGLIANA_K * s2)
        / math.sqrt(1.0 - ECCENTRICITY_SQUARED * s2)
    )
    h = height_m / SEMI_MAJOR_M
    return on_ellipsoid * (
        1.0 - 2.0 * h * (1.0 + FLATTENING + GRAVITY_RATIO_M - 2.0 * FLATTENING * s2) + 3.0 * h * h
    )
