"""Pressure and height in the ICAO standard atmosphere, up to 11 km.

    H = (T0 / L) (1 - (p / p0)^(R L / g0))

T0 = 288.15 K, L = 6.5 K/km, p0 = 1013.25 hPa, g0 = 9.80665 m/s^2, R = 287.05287 J/(kg K).

Source: Manual of the ICAO Standard Atmosphere, Doc 7488, 3rd ed. (1993).
"""

from __future__ import annotations

T0_K, LAPSE_K_M, P0_PA, G0_M_S2, R_J_KG_K = 288.15, 6.5e-3, 101_325.0, 9.80665, 287.05287
SCALE_M = T0_K / LAPSE_K_M
EXPONENT = R_J_KG_K * LAPSE_K_M / G0_M_S2
PRESSURE_PA = (22_632.0, 120_000.0)
"""Range of the formula: from the tropopause at 11 km to beyond the highest pressure at any shore.
"""


def pressure_height_m(pressure_pa: float) -> float:
    """Height (m) of a pressure in the standard atmosphere."""
    height: float = SCALE_M * (1.0 - (pressure_pa / P0_PA) ** EXPONENT)
    return height


def standard_pressure_pa(height_m: float) -> float:
    """Pressure (Pa) of the standard atmosphere at a height."""
    pressure: float = P0_PA * (1.0 - height_m / SCALE_M) ** (1.0 / EXPONENT)
    return pressure


def metres_a_pascal(pressure_pa: float) -> float:
    """Height of a step of pressure: -dH/dp, m/Pa."""
    ratio: float = (pressure_pa / P0_PA) ** EXPONENT
    return SCALE_M * EXPONENT * ratio / pressure_pa
