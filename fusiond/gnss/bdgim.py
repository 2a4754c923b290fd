r"""Ionospheric delay by BDGIM, with BeiDou-3's nine coefficients from B-CNAV.

    delay = MF 40.28e16 / f^2 VTEC,    MF = 1 / sqrt(1 - (Re cos E / (Re + H))^2)    m
    VTEC  = sum_i alpha_i A_i + sum_j beta_j B_j                                     TECU
    A, B  = N_nm P_nm(sin phi') (cos m lambda' | sin m lambda')
    N_nm  = sqrt((n - m)! (2 n + 1) (2 - [m = 0]) / (n + m)!)
    beta  = a_0 + sum_k (a_k cos w_k t + b_k sin w_k t),    w_k = 2 pi / T_k

E elevation; H = 400 km, Re = 6378 km; phi', lambda' of the point where the ray crosses the layer,
geomagnetic, longitude from the sun's meridian; n, m are 0 to 2 for alpha, 3 to 5 for beta. t is the
middle of the current two hours (MJD of BDT). VTEC has a floor, a share of alpha_1, as in the
program of the model's authors, because harmonics of degree 5 become negative at night.

Source: BDS-SIS-ICD-B1C-1.0 section 7.8, tables 7-10 to 7-12; floor of VTEC: Z. Li, N. Wang, program
to the model, 2021; accuracy: Yuan, Wang, Li, Huo, Navigation 66 (2019), 55-69: three quarters of
the delay worldwide.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import CARRIER_HZ, Bdgim
from fusiond.gnss.atmosphere import pierced
from fusiond.gnss.orbit import BDT_BEHIND_GPS_S
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

RADIUS_M = 6_378_000.0
LAYER_M = 400_000.0
POLE_LAT_RAD, POLE_LON_RAD = math.radians(80.27), math.radians(-72.58)
"""North geomagnetic pole."""
GPS_EPOCH_MJD = 44_244
SLOT_D = 2.0 / 24.0
TECU_M = 40.28e16 / CARRIER_HZ["C", "1"] ** 2
"""Delay at B1C of 1e16 electrons a square metre."""
FLOORS = ((35.0, 10.0), (20.0, 8.0), (12.0, 6.0), (-math.inf, 4.0))
"""Lower bounds; where alpha_1 is above the first, VTEC is at least alpha_1 over the second."""

_HIGHEST, _ORDERS = 5, 4
_BROADCAST = ((0, 0), (1, 0), (1, 1), (1, -1), (2, 0), (2, 1), (2, -1), (2, 2), (2, -2))
"""Degree and order of alpha_1 to alpha_9 (table 7-10); a negative order is a sine."""
_REST = (
    *((3, 0), (3, 1), (3, -1), (3, 2), (3, -2), (3, 3), (3, -3)),
    *((4, 0), (4, 1), (4, -1), (4, 2), (4, -2), (5, 0), (5, 1), (5, -1), (5, 2), (5, -2)),
)
_PERIODS_D = np.array(
    [1.0, 0.5, 0.33, 14.6, 27.0, 121.6, 182.51, 365.25, 4028.71, 2014.35, 1342.90, 1007.18]
)
# Hundredths of TECU, a row for each of `_REST`: a_0, then a_k and b_k of each period (table 7-12).
_TABLE = """
-61 -51 23 -6 2 1 0 -1 0 0 1 -19 -9 -18 15 109 50 -34 0 -13 5 -6 3 -3 4
-131 -43 -20 -5 -8 -3 -2 0 -2 0 0 -2 7 6 -31 -14 -8 -9 -11 7 3 13 -2 8 -2
-200 34 -31 6 -6 1 -3 1 1 3 0 12 3 -55 13 -21 -38 -122 -22 -37 7 -7 4 -1 -4
-3 -1 16 17 -11 -1 -5 0 0 1 1 -10 6 -2 5 52 36 5 1 5 2 3 -1 4 0
15 17 -3 15 15 5 -1 1 -1 2 0 6 9 9 -9 27 14 15 2 6 -1 2 -3 1 -1
-48 2 2 0 -14 -3 -7 0 1 1 0 0 1 -8 -3 0 4 -29 -3 -11 3 -5 2 -2 0
-40 -6 4 11 1 5 -3 -1 0 0 0 -2 2 0 6 11 0 -17 -1 -7 2 -5 1 -2 1
228 30 18 -5 1 -3 -1 -1 -2 -2 0 -8 0 86 -36 17 25 158 49 46 -4 1 4 -4 7
-16 44 34 -16 4 -1 2 0 0 0 0 -2 -4 -18 8 23 17 -6 -3 0 -1 0 0 0 0
-21 -28 45 2 -14 0 -1 0 0 0 0 -7 -2 -5 5 35 27 -15 -2 -4 -1 0 0 0 0
-10 -31 19 11 -5 -8 3 0 0 0 0 1 -1 -7 6 -5 -3 0 1 1 2 0 0 0 0
-13 -17 -25 4 8 -4 -10 0 0 0 0 3 1 4 -2 2 -3 13 2 7 3 0 0 0 0
21 4 -12 12 8 0 1 0 0 0 0 15 -10 14 -5 -60 -32 28 4 9 2 0 0 0 0
68 39 18 7 -1 -2 5 0 0 0 0 6 0 -3 6 2 -10 -8 -4 -5 -4 0 0 0 0
106 -12 40 2 1 -3 -1 0 0 0 0 -5 -1 37 -20 1 20 62 16 15 -4 0 0 0 0
0 12 -9 -14 11 0 4 0 0 0 0 -3 2 -11 4 27 10 -1 -2 -1 -1 0 0 0 0
-12 0 21 -14 -12 -3 0 0 0 0 0 -10 5 -12 7 32 30 -4 -1 1 0 0 0 0 0
"""
_REST_TECU = 0.01 * np.array([row.split() for row in _TABLE.split("\n") if row], float)
TERMS = 2 * (_HIGHEST + 1) * _ORDERS + 1
"""Cosines' coefficients by degree and order, normalised; sines'; the least VTEC."""


def _norm(n: int, m: int) -> float:
    twice = 1.0 if m == 0 else 2.0
    return math.sqrt(math.factorial(n - m) * (2 * n + 1) * twice / math.factorial(n + m))


def _place(n: int, m: int) -> int:
    return ((_HIGHEST + 1) * _ORDERS if m < 0 else 0) + n * _ORDERS + abs(m)


_NORMS = np.array([_norm(n, abs(m)) for n, m in (*_BROADCAST, *_REST)])
_PLACES = np.array([_place(n, m) for n, m in (*_BROADCAST, *_REST)])


def bdgim_terms(model: Bdgim, week: int, tow_s: float) -> Array:
    """Coefficients (49,) of `bdgim`, valid for the two hours of BDT that contain a GPS time."""
    mjd = GPS_EPOCH_MJD + 7 * week + (tow_s - BDT_BEHIND_GPS_S) / 86_400.0
    middle = (math.floor(mjd / SLOT_D) + 0.5) * SLOT_D
    angles = 2.0 * math.pi / _PERIODS_D * middle
    series = np.empty(1 + 2 * len(angles))
    series[0], series[1::2], series[2::2] = 1.0, np.cos(angles), np.sin(angles)
    out = np.zeros(TERMS)
    out[_PLACES] = _NORMS * np.concatenate((model.alpha, _REST_TECU @ series))
    first = model.alpha[0]
    out[-1] = next(first / part for above, part in FLOORS if first > above)
    return out


@compiled("f8(f8[::1], f8, f8, f8, f8, f8, f8)")
def bdgim(
    q: Array,
    tow_s: float,
    lat_rad: float,
    lon_rad: float,
    sin_elevation: float,
    cos_azimuth: float,
    sin_azimuth: float,
) -> float:
    """Delay in m at B1C; `q` by `bdgim_terms`; BeiDou second of week; receiver's position."""
    sin_arc, cos_arc, z, cosine = pierced(
        RADIUS_M / (RADIUS_M + LAYER_M), lat_rad, sin_elevation, cos_azimuth
    )
    level = math.sqrt(max(1.0 - z * z, 0.0))
    lon = lon_rad + math.atan2(
        sin_arc * sin_azimuth * math.cos(lat_rad), cos_arc - math.sin(lat_rad) * z
    )
    sp, cp = math.sin(POLE_LAT_RAD), math.cos(POLE_LAT_RAD)
    east = lon - POLE_LON_RAD
    x = min(max(sp * z + cp * level * math.cos(east), -1.0), 1.0)
    from_pole = math.atan2(cp * level * math.sin(east), sp * x - z)
    sun = math.pi * (1.0 - 2.0 * (tow_s / 86_400.0 % 1.0)) - POLE_LON_RAD
    from_sun = from_pole - math.atan2(math.sin(sun), sp * math.cos(sun))
    flat = math.sqrt(1.0 - x * x)
    vtec = 0.0
    diagonal = 1.0  # P_mm
    for m in range(_ORDERS):
        c, s = math.cos(m * from_sun), math.sin(m * from_sun)
        before, now = 0.0, diagonal
        for n in range(m, _HIGHEST + 1):
            k = n * _ORDERS + m
            vtec += now * (q[k] * c + q[(_HIGHEST + 1) * _ORDERS + k] * s)
            before, now = now, (x * (2 * n + 1) * now - (n + m) * before) / (n + 1 - m)
        diagonal *= (2 * m + 1) * flat
    delay: float = TECU_M * max(vtec, q[TERMS - 1]) / cosine
    return delay
