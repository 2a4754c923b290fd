r"""Range and range rate equations of one epoch, for all satellites at once.

    rho = |s - r|,  l = (s - r) / rho,   s = Rz(we tau) s_t,  tau = rho / c,  v = Rz(we tau) v_t
    P + c (dt - d) - T - I = rho + b_system + noise
    D (1 + l . v_i / c) + c ddt = l . (v - v_r) + d + noise,    v_i = v + we x s

s_t, v_t satellite position and velocity at transmission, turned into the ECEF frame of the instant
of reception; r, v_r the receiver's; P pseudorange, D pseudorange rate (m, m/s; positive while the
distance grows); dt, ddt the satellite's clock offset and drift, d the signal's group delay; T, I
troposphere and ionosphere (m); b the receiver's clock offset (m), d its drift (m/s). The factor at
D: transmission time runs 1 - rhodot/c as fast as reception time, up to 2 mm/s.

r is taken at the time that the receiver's clock shows: with a clock 1 ms off and 30 m/s it is 3 cm.

Variances: see `fusiond.gnss.ranges`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SPEED_OF_LIGHT_M_S
from fusiond.gnss.atmosphere import (
    klobuchar_beidou,
    klobuchar_gps,
    mapping,
    mapping_coefficients,
    slant,
    zenith_delays,
)
from fusiond.gnss.bdgim import bdgim
from fusiond.gnss.ecef import to_geodetic
from fusiond.gnss.orbit import BDT_BEHIND_GPS_S, satellite_states
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

EARTH_RATE_RAD_S = 7.2921151467e-5
LOWEST_RADIUS_M = 6.3e6
"""A receiver nearer to the earth's centre is a starting value: no elevation, no atmosphere."""

_NEPERS = 0.1 * math.log(10.0)
"""A decibel of power as an exponent of e."""

# What the plan says of each row.
SIGNAL_COLUMNS = 4
GROUP_DELAY_M, IONO_MODEL, IONO_SCALE, FIXED_VARIANCE = range(SIGNAL_COLUMNS)
NO_MODEL, GPS_MODEL, BEIDOU_MODEL, BDGIM_MODEL = 0.0, 1.0, 2.0, 3.0
# What the receiver says of each row; NaN where it does not.
MEASURED_COLUMNS = 5
PSEUDORANGE, RATE, CNO, SD_PSEUDORANGE, SD_RATE = range(MEASURED_COLUMNS)
# Results; the first ten are what an aid takes (fusiond.aiding.pseudorange).
ROW_COLUMNS = 21
AID_ROWS = 10
(
    X, Y, Z, VX, VY, VZ, CORRECTED, CORRECTED_RATE, TOTAL_VARIANCE, RATE_VARIANCE,
    LX, LY, LZ, RANGE, ELEVATION, NORTH, EAST, VARIANCE, TROPOSPHERE, IONOSPHERE, COMMON,
) = range(ROW_COLUMNS)  # fmt: skip
# Noise.
NOISE_VALUES = 8
(
    CODE_ZENITH, CODE_CNO, CNO_REFERENCE, TROPO_ZENITH, IONO_SHARE, IONO_UNMODELLED, IONO_LOCAL,
    RATE_ZENITH,
) = range(NOISE_VALUES)  # fmt: skip


@compiled(
    "i8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8, f8, f8[::1], f8[::1], f8, f8,"
    "f8[:, ::1])",
    allocates=True,
)
def range_rows(
    elements: Array,
    signals: Array,
    measured: Array,
    ionosphere: Array,
    week: float,
    tow: float,
    receiver: Array,
    noise: Array,
    least_elevation: float,
    least_cno: float,
    out: Array,
) -> int:
    """Write (21, n) values for a receiver (3,) ECEF m at GPS time `week`, `tow` of its clock; how
    many satellites are lower than `least_elevation` (rad) or weaker than `least_cno` (dB Hz).

    `elements` (n, 33), `signals` (n, 4), `measured` (n, 5), `ionosphere` (3, 49): GPS's and
    BeiDou's eight coefficients, and the terms of BDGIM; `noise` (8,).
    """
    n = elements.shape[0]
    refused = 0
    sent = np.empty(n)
    for k in range(n):
        sent[k] = tow - measured[k, PSEUDORANGE] / SPEED_OF_LIGHT_M_S
    states = np.empty((n, 8))
    satellite_states(elements, week, sent, True, states)
    rx, ry, rz = receiver[0], receiver[1], receiver[2]
    on_earth = rx * rx + ry * ry + rz * rz > LOWEST_RADIUS_M * LOWEST_RADIUS_M
    lat, lon, height = 0.0, 0.0, 0.0
    dry, wet = 0.0, 0.0
    q = np.empty(7)
    if on_earth:
        lat, lon, height = to_geodetic(rx, ry, rz)
        dry, wet = zenith_delays(lat, height)
        mapping_coefficients(lat, height, week * 7.0 + tow / 86400.0, q)
    sp, cp, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    for k in range(n):
        xt, yt, z = states[k, 0], states[k, 1], states[k, 2]
        x, y = xt, yt
        c, s = 1.0, 0.0
        distance = 0.0
        for _ in range(2):  # unturned 27 m off, then 0.2 mm, then less than a nanometre
            dx, dy, dz = x - rx, y - ry, z - rz
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            angle = EARTH_RATE_RAD_S * distance / SPEED_OF_LIGHT_M_S
            c, s = 1.0 - 0.5 * angle * angle, angle  # 1e-5 rad: off by its cube over six, 1e-16
            x, y = c * xt + s * yt, c * yt - s * xt
        dx, dy, dz = x - rx, y - ry, z - rz
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        vx = c * states[k, 3] + s * states[k, 4]
        vy = c * states[k, 4] - s * states[k, 3]
        vz = states[k, 5]
        lx, ly, lz = dx / distance, dy / distance, dz / distance
        elevation, north, east, up = 0.5 * math.pi, 0.0, 0.0, 1.0
        tropo, iono = 0.0, 0.0
        iono_sigma = 0.0
        if on_earth:
            east = -sl * lx + cl * ly
            north = -sp * cl * lx - sp * sl * ly + cp * lz
            up = cp * cl * lx + cp * sl * ly + sp * lz
            up = min(max(up, -1.0), 1.0)
            elevation = math.asin(up)
            level = math.hypot(north, east)
            cos_azimuth, sin_azimuth = (north / level, east / level) if level > 0.0 else (1.0, 0.0)
            dry_map, wet_map = mapping(up, q)
            tropo = dry * dry_map + wet * wet_map
            model = signals[k, IONO_MODEL]
            if model == GPS_MODEL:
                iono = klobuchar_gps(
                    ionosphere[0], tow, lat, lon, elevation, cos_azimuth, sin_azimuth
                )
            elif model == BEIDOU_MODEL:
                bdt = tow - BDT_BEHIND_GPS_S
                iono = klobuchar_beidou(ionosphere[1], bdt, lat, lon, up, cos_azimuth, sin_azimuth)
            elif model == BDGIM_MODEL:
                bdt = tow - BDT_BEHIND_GPS_S
                iono = bdgim(ionosphere[2], bdt, lat, lon, up, cos_azimuth, sin_azimuth)
            iono *= signals[k, IONO_SCALE]
            iono_sigma = noise[IONO_SHARE] * iono
            if model == NO_MODEL:
                iono_sigma = noise[IONO_UNMODELLED] * slant(up) * signals[k, IONO_SCALE]
        out[X, k], out[Y, k], out[Z, k] = x, y, z
        out[VX, k], out[VY, k], out[VZ, k] = vx, vy, vz
        out[LX, k], out[LY, k], out[LZ, k] = lx, ly, lz
        out[RANGE, k] = distance
        out[ELEVATION, k], out[NORTH, k], out[EAST, k] = elevation, north, east
        out[TROPOSPHERE, k], out[IONOSPHERE, k], out[COMMON, k] = tropo, iono, iono_sigma
        clock = SPEED_OF_LIGHT_M_S * states[k, 6] - signals[k, GROUP_DELAY_M]
        out[CORRECTED, k] = measured[k, PSEUDORANGE] + clock - tropo - iono
        inertial = (
            lx * (vx - EARTH_RATE_RAD_S * y) + ly * (vy + EARTH_RATE_RAD_S * x) + lz * vz
        ) / SPEED_OF_LIGHT_M_S
        drift = SPEED_OF_LIGHT_M_S * states[k, 7]
        out[CORRECTED_RATE, k] = measured[k, RATE] * (1.0 + inertial) + drift
        thin = slant(up)
        code = noise[CODE_ZENITH] * thin
        cno = measured[k, CNO]
        refused += elevation < least_elevation or cno < least_cno
        weak = 0.0 if math.isnan(cno) else math.exp(_NEPERS * (noise[CNO_REFERENCE] - cno))
        stated = measured[k, SD_PSEUDORANGE]
        if math.isnan(stated):
            stated = 0.0
        out[VARIANCE, k] = (
            code * code
            + noise[CODE_CNO] * noise[CODE_CNO] * weak
            + stated * stated
            + (noise[TROPO_ZENITH] * thin) ** 2
            + (noise[IONO_LOCAL] * iono_sigma) ** 2
            + signals[k, FIXED_VARIANCE]
        )
        out[TOTAL_VARIANCE, k] = out[VARIANCE, k] + iono_sigma * iono_sigma
        stated = measured[k, SD_RATE]
        if math.isnan(stated):
            stated = 0.0
        out[RATE_VARIANCE, k] = (
            noise[RATE_ZENITH] * noise[RATE_ZENITH] * thin * thin + stated * stated
        )
    return refused
