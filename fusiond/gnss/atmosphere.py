r"""Delay of a signal in the troposphere and in the ionosphere.

Troposphere, zenith delays by Saastamoinen in the standard atmosphere, mapped by Niell:

    p = 1013.25 (1 - 2.25577e-5 h)^5.25588 hPa,  T = 288.15 - 0.0065 h K
    e = RH 6.108 exp((17.15 T - 4684) / (T - 38.45)) hPa
    Zh = 0.0022768 p / (1 - 0.00266 cos 2phi - 0.00028 h/km)
    Zw = 0.002277 (1255/T + 0.05) e
    delay = Zh mh(E) + Zw mw(E)
    m(E) = (1 + a/(1 + b/(1 + c))) / (sin E + a/(sin E + b/(sin E + c)))     a, b, c by latitude
    mh takes a, b, c with a yearly term (day 28, half a year later in the south) and a height term

Ionosphere, one layer, in m at the frequency f that the coefficients hold for, then (f / f')^2:

    delay = c F (5 ns + A max(0, ...) cos x)        x = 2 pi (t - 50400 s) / P,  t local time at M
    GPS:     M at geomagnetic latitude, F = 1 + 16 (0.53 - E)^3, cosine as 1 - x^2/2 + x^4/24
             within |x| < 1.57, P >= 72000 s
    BeiDou:  M at geographic latitude |phi_M| / pi, layer at 375 km over 6378 km,
             F = 1 / cos z', the cosine itself within a quarter of P, 72000 s <= P <= 172800 s

h height above the ellipsoid, clamped to 0 .. 10 km (above, the wet part has vanished; below 0 the
difference is negligible); phi latitude, E elevation, angles rad. Errors of these models, one sigma
in m:

    troposphere 0.12 m(E), m = 1.001 / sqrt(0.002001 + sin^2 E) ionosphere  half the delay: a
    broadcast Klobuchar model removes at least 50 % RMS

Source: Saastamoinen, Bulletin Geodesique 107 (1973), 13-34, with U.S. Standard Atmosphere 1976;
Niell, J. Geophys. Res. 101 B2 (1996), 3227-3246, tables 3 and 4; IS-GPS-200N 20.3.3.5.2.5 and
figure 20-4; BDS-SIS-ICD-B1I-3.0 5.2.4.7; RTCA DO-229D A.4.2.4 (troposphere's sigma).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SPEED_OF_LIGHT_M_S
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

RELATIVE_HUMIDITY = 0.7
"""Relative humidity of the air near the ground; a change of 0.3 changes the zenith delay by 5 cm at
sea level."""
MAX_HEIGHT_M = 10_000.0
LAYER_M = 375_000.0
BEIDOU_RADIUS_M = 6_378_000.0
MIN_SINE = math.sin(math.radians(2.0))
"""Least sine of an elevation for the models: Niell fitted his functions down to 3 degrees."""
DAY_S = 86400.0
YEAR_D = 365.25

# Niell: latitudes 15, 30, 45, 60, 75 deg; rows a, b, c: hydrostatic mean, its yearly amplitude, wet
_MEAN = np.array(
    [
        [1.2769934e-3, 1.2683230e-3, 1.2465397e-3, 1.2196049e-3, 1.2045996e-3],
        [2.9153695e-3, 2.9152299e-3, 2.9288445e-3, 2.9022565e-3, 2.9024912e-3],
        [62.610505e-3, 62.837393e-3, 63.721774e-3, 63.824265e-3, 64.258455e-3],
    ]
)
_YEARLY = np.array(
    [
        [0.0, 1.2709626e-5, 2.6523662e-5, 3.4000452e-5, 4.1202191e-5],
        [0.0, 2.1414979e-5, 3.0160779e-5, 7.2562722e-5, 11.723375e-5],
        [0.0, 9.0128400e-5, 4.3497037e-5, 84.795348e-5, 170.37206e-5],
    ]
)
_WET = np.array(
    [
        [5.8021897e-4, 5.6794847e-4, 5.8118019e-4, 5.9727542e-4, 6.1641693e-4],
        [1.4275268e-3, 1.5138625e-3, 1.4572752e-3, 1.5007428e-3, 1.7599082e-3],
        [4.3472961e-2, 4.6729510e-2, 4.3908931e-2, 4.4626982e-2, 5.4736038e-2],
    ]
)
_HEIGHT = (2.53e-5, 5.49e-3, 1.14e-3)


@compiled("UniTuple(f8, 2)(f8, f8)")
def zenith_delays(lat_rad: float, height_m: float) -> tuple[float, float]:
    """Hydrostatic and wet zenith delay in m."""
    h = min(max(height_m, 0.0), MAX_HEIGHT_M)
    pressure = 1013.25 * (1.0 - 2.25577e-5 * h) ** 5.25588
    kelvin = 288.15 - 0.0065 * h
    vapour = RELATIVE_HUMIDITY * 6.108 * math.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    gravity = 1.0 - 0.00266 * math.cos(2.0 * lat_rad) - 0.00028 * h * 1e-3
    return 0.0022768 * pressure / gravity, 0.002277 * (1255.0 / kelvin + 0.05) * vapour


@compiled("f8(f8, f8, f8, f8)")
def _fraction(sine: float, a: float, b: float, c: float) -> float:
    """Continued fraction of m(E) in sin E, 1 at the zenith."""
    top = 1.0 + a / (1.0 + b / (1.0 + c))
    return top / (sine + a / (sine + b / (sine + c)))


@compiled("void(f8, f8, f8, f8[::1])")
def mapping_coefficients(lat_rad: float, height_m: float, gps_days: float, out: Array) -> None:
    """Write (7,): hydrostatic a, b, c, wet a, b, c, and height in km for Niell's functions.

    `gps_days` are days since 1980-01-06, day 6 of its year.
    """
    at = (math.degrees(abs(lat_rad)) - 15.0) / 15.0
    k = int(min(max(at, 0.0), 3.0))
    part = min(max(at - k, 0.0), 1.0)
    season = math.cos(2.0 * math.pi * (gps_days + 6.0 - 28.0) / YEAR_D)
    if lat_rad < 0.0:
        season = -season
    for i in range(3):
        mean = _MEAN[i, k] + (_MEAN[i, k + 1] - _MEAN[i, k]) * part
        yearly = _YEARLY[i, k] + (_YEARLY[i, k + 1] - _YEARLY[i, k]) * part
        out[i] = mean - yearly * season
        out[3 + i] = _WET[i, k] + (_WET[i, k + 1] - _WET[i, k]) * part
    out[6] = max(height_m, 0.0) * 1e-3


@compiled("UniTuple(f8, 2)(f8, f8[::1])")
def mapping(sine: float, q: Array) -> tuple[float, float]:
    """Hydrostatic and wet mapping function for the sine of an elevation, from
    `mapping_coefficients`."""
    sine = max(sine, MIN_SINE)
    height_term = 1.0 / sine - _fraction(sine, _HEIGHT[0], _HEIGHT[1], _HEIGHT[2])
    dry = _fraction(sine, q[0], q[1], q[2]) + height_term * q[6]
    return dry, _fraction(sine, q[3], q[4], q[5])


@compiled("f8(f8[::1], f8, f8, f8, f8, f8, f8)")
def klobuchar_gps(
    q: Array,
    tow_s: float,
    lat_rad: float,
    lon_rad: float,
    elevation_rad: float,
    cos_azimuth: float,
    sin_azimuth: float,
) -> float:
    """Delay in m at GPS L1; `q` (8,) alpha, beta; GPS second of week; receiver's position."""
    e = max(elevation_rad, 0.0) / math.pi  # semicircles, like all angles of this model
    arc = 0.0137 / (e + 0.11) - 0.022
    lat = lat_rad / math.pi + arc * cos_azimuth
    lat = min(max(lat, -0.416), 0.416)
    lon = lon_rad / math.pi + arc * sin_azimuth / math.cos(lat * math.pi)
    lat += 0.064 * math.cos((lon - 1.617) * math.pi)
    local = (43200.0 * lon + tow_s) % DAY_S
    slant = 1.0 + 16.0 * (0.53 - e) ** 3
    amplitude = max(q[0] + lat * (q[1] + lat * (q[2] + lat * q[3])), 0.0)
    period = max(q[4] + lat * (q[5] + lat * (q[6] + lat * q[7])), 72000.0)
    x = 2.0 * math.pi * (local - 50400.0) / period
    day = 0.0
    if abs(x) < 1.57:
        day = amplitude * (1.0 + x * x * (-0.5 + x * x / 24.0))
    return SPEED_OF_LIGHT_M_S * slant * (5e-9 + day)


@compiled("UniTuple(f8, 4)(f8, f8, f8, f8)")
def pierced(
    ratio: float, lat_rad: float, sin_elevation: float, cos_azimuth: float
) -> tuple[float, float, float, float]:
    """Pierce point of a ray in a layer: sine and cosine of the arc from the receiver, sine of its
    latitude, cosine of the ray's angle from the vertical. `ratio`: earth's radius over the
    layer's."""
    se = max(sin_elevation, 0.0)
    ce = math.sqrt(1.0 - se * se)
    # The arc to the pierce point is pi/2 less the angle at the layer and the elevation.
    sine = ratio * ce
    cosine = math.sqrt(1.0 - sine * sine)
    sin_arc, cos_arc = ce * cosine - se * sine, se * cosine + ce * sine
    north = math.sin(lat_rad) * cos_arc + math.cos(lat_rad) * sin_arc * cos_azimuth
    return sin_arc, cos_arc, north, cosine


@compiled("f8(f8[::1], f8, f8, f8, f8, f8, f8)")
def klobuchar_beidou(
    q: Array,
    tow_s: float,
    lat_rad: float,
    lon_rad: float,
    sin_elevation: float,
    cos_azimuth: float,
    sin_azimuth: float,
) -> float:
    """Delay in m at B1I; `q` (8,) alpha, beta; BeiDou second of week; receiver's position."""
    ratio = BEIDOU_RADIUS_M / (BEIDOU_RADIUS_M + LAYER_M)
    sin_arc, _, north, cosine = pierced(ratio, lat_rad, sin_elevation, cos_azimuth)
    lat = math.asin(north)
    lon = lon_rad + math.asin(sin_arc * sin_azimuth / math.sqrt(1.0 - north * north))
    local = (tow_s + 43200.0 * lon / math.pi) % DAY_S
    s = abs(lat) / math.pi
    amplitude = max(q[0] + s * (q[1] + s * (q[2] + s * q[3])), 0.0)
    period = min(max(q[4] + s * (q[5] + s * (q[6] + s * q[7])), 72000.0), 172800.0)
    day = 0.0
    if abs(local - 50400.0) < 0.25 * period:
        day = amplitude * math.cos(2.0 * math.pi * (local - 50400.0) / period)
    return SPEED_OF_LIGHT_M_S * (5e-9 + day) / cosine


@compiled("f8(f8)")
def slant(sine: float) -> float:
    """Mapping of the troposphere's sigma: 1.001 / sqrt(0.002001 + sin^2 E)."""
    s = max(sine, 0.0)
    return 1.001 / math.sqrt(0.002001 + s * s)
