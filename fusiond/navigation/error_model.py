r"""Linear error model of strapdown navigation: one transition for all models.

Errors of the navigation state are *computed minus true*, in north-east-down axes:

    C^ = (I - [phi x]) C,   v^ = v + dv,   position^ = position + dr (metres north, east, down)

Sensor errors are the uncorrected rest: w^ - w = e, f^ - f = a. Then

    phi' = -w_in x phi + dw_in(dv, dr) - C e
    dv'  = f_n x phi + F_vv dv + F_vr dr + C a
    dr'  = dv + F_rr dr

An interval h is crossed in three steps that use each other's results, which includes second-order
terms (velocity from e, position from phi and a) implicitly:

    phi1 = phi + h (...)        dv1 = dv + h (f_n x (phi + phi1) / 2 + ...)
    dr1  = dr + h ((dv + dv1) / 2 + F_rr dr)

`coefficients` writes the numbers of one interval, `apply` multiplies by the transition: 69
multiplications a column instead of the 189 of a dense 9x21 product.

Source: Shin, Accuracy Improvement of Low Cost INS/GPS for Land Applications (2001), eq. 2.42 to
2.53; Groves, 2nd ed., section 14.2.4. Checked numerically against strapdown_step in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import (
    EARTH_RATE_RAD_S,
    ECCENTRICITY_SQUARED,
    GRAVITY_EQUATOR_M_S2,
    SEMI_MAJOR_M,
    SOMIGLIANA_K,
    gravity,
)
from fusiond.navigation.strapdown import HEIGHT, LAT, STEP_DCM, VD, VE, VN

Array = NDArray[np.float64]

# Slots of the error state: attitude, velocity, position, then sensor errors and other parameters.
PHI, DV, DR, CORE_SIZE = 0, 3, 6, 9
# Columns by which a parameter acts on the navigation errors: rate and force error of an axis, and
# the same two in proportion to the rate or force (scale factors).
RATE_ERROR, FORCE_ERROR, RATE_SCALE, FORCE_SCALE, COLUMN_END = 9, 12, 15, 18, 21

COEFFICIENTS = 58
# Row widths of the arrays that `apply` works on: whole vectors of 4 or 8 doubles. A covariance has
# rows of the first of WIDTHS that holds its states (the models of 15 and 17, of 21 and 23, and
# those with more); CORE_STRIDE holds the nine navigation errors.
WIDTHS = (20, 24, 32, 40)
CORE_STRIDE = 16


@compiled("void(f8[::1], f8[::1], f8, f8[::1])", forceinline=True)
def coefficients(nav: Array, step: Array, h: float, c: Array) -> None:
    """Write `c` (58,) for the interval of `h` seconds that ends at `nav` (10,).

    `step` (27,) as strapdown_step leaves it.
    """
    lat, height = nav[LAT], nav[HEIGHT]
    vn, ve, vd = nav[VN], nav[VE], nav[VD]
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    tan_lat = sin_lat / cos_lat
    sec2 = 1.0 + tan_lat * tan_lat
    w2 = 1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat
    root = math.sqrt(w2)
    n = 1.0 / (SEMI_MAJOR_M / root + height)
    m = 1.0 / (SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w2 * root) + height)
    earth_n, earth_d = EARTH_RATE_RAD_S * cos_lat, -EARTH_RATE_RAD_S * sin_lat
    turn_n, turn_e, turn_d = ve * n, -vn * m, -ve * tan_lat * n
    w_n, w_e, w_d = earth_n + turn_n, turn_e, earth_d + turn_d

    # phi from phi: -[w_in x];  from dv and dr: the error of w_in;  from e: -C
    c[0], c[1] = h * w_d, -h * w_e
    c[2], c[3], c[4] = h * n, h * earth_d * m, h * turn_n * n
    c[8], c[9] = -h * w_d, h * w_n
    c[10], c[11] = -h * m, h * turn_e * m
    c[15], c[16] = h * w_e, -h * w_n
    c[17], c[18], c[19] = -h * tan_lat * n, -h * m * (earth_n + turn_n * sec2), h * turn_d * n
    # dv from the mean phi: [f_n x] / 2
    half = 0.5 * h
    c[23], c[24] = -half * step[2], half * step[1]
    c[33], c[34] = half * step[2], -half * step[0]
    c[43], c[44] = -half * step[1], half * step[0]
    # dv from dv: Coriolis;  from dr: Coriolis and gravity
    c[25], c[26], c[27] = h * vd * m, 2.0 * h * (earth_d + turn_d), h * vn * m
    c[28] = -h * ve * m * (2.0 * earth_n + turn_n * sec2)
    c[29] = h * (vn * vd * m * m + ve * n * turn_d)
    c[35] = -h * (2.0 * earth_d + turn_d)
    c[36] = h * (vd + vn * tan_lat) * n
    c[37] = h * (2.0 * earth_n + turn_n)
    c[38] = h * m * (2.0 * (vn * earth_n + vd * earth_d) + vn * turn_n * sec2)
    c[39] = h * turn_n * n * (vd + vn * tan_lat)
    c[45], c[46] = -2.0 * h * vn * m, -2.0 * h * (earth_n + turn_n)
    slope = GRAVITY_EQUATOR_M_S2 * (SOMIGLIANA_K + 0.5 * ECCENTRICITY_SQUARED)
    c[47] = 2.0 * h * m * (slope * sin_lat * cos_lat - ve * earth_d)
    gradient = 2.0 * gravity(lat, height) * math.sqrt(m * n)
    c[48] = h * (gradient - turn_n * turn_n - turn_e * turn_e)
    # dr from the mean dv;  from dr: the axes turn with the position
    c[52] = half
    c[53], c[54] = -h * vd * m, h * vn * m
    c[55], c[56], c[57] = h * ve * tan_lat * n, -h * (vd + vn * tan_lat) * n, h * turn_n
    # sensor errors: -C for rates, C for forces
    for j in range(3):
        x, y, z = h * step[STEP_DCM + j], h * step[STEP_DCM + 3 + j], h * step[STEP_DCM + 6 + j]
        c[5 + j], c[12 + j], c[20 + j] = -x, -y, -z
        c[30 + j], c[40 + j], c[49 + j] = x, y, z


@cache
def apply_for(width: int) -> Callable[[Array, Array, Array, Array], None]:
    """`apply` for rows of `width` doubles: a constant, so that the loop becomes vector code."""

    @compiled("void(f8[::1], f8[::1], f8[::1], f8[::1])", variant=width, forceinline=True)
    def apply(rows: Array, sensor: Array, c: Array, out: Array) -> None:
        """Write out (9 rows) = transition times the nine rows of `rows` and the six of `sensor`.

        All flat, `width` doubles a row. `sensor` holds rate error x y z, force error x y z. In five
        loops, so that the coefficients of each stay in registers: in one loop most would be spilled
        and read back at once.
        """
        for j in range(width):
            p0, p1, p2 = rows[j], rows[width + j], rows[2 * width + j]
            v0, v1 = rows[3 * width + j], rows[4 * width + j]
            r0, r2 = rows[6 * width + j], rows[8 * width + j]
            e0, e1, e2 = sensor[j], sensor[width + j], sensor[2 * width + j]
            s0 = p0 + c[0] * p1 + c[1] * p2 + c[2] * v1 + c[3] * r0 + c[4] * r2
            s1 = p1 + c[8] * p0 + c[9] * p2 + c[10] * v0 + c[11] * r2
            s2 = p2 + c[15] * p0 + c[16] * p1 + c[17] * v1 + c[18] * r0 + c[19] * r2
            out[j] = s0 + (c[5] * e0 + c[6] * e1 + c[7] * e2)
            out[width + j] = s1 + (c[12] * e0 + c[13] * e1 + c[14] * e2)
            out[2 * width + j] = s2 + (c[20] * e0 + c[21] * e1 + c[22] * e2)
        for j in range(width):
            q1, q2 = rows[width + j] + out[width + j], rows[2 * width + j] + out[2 * width + j]
            v0, v1, v2 = rows[3 * width + j], rows[4 * width + j], rows[5 * width + j]
            r0, r2 = rows[6 * width + j], rows[8 * width + j]
            a0, a1, a2 = sensor[3 * width + j], sensor[4 * width + j], sensor[5 * width + j]
            u0 = v0 + c[23] * q1 + c[24] * q2 + c[25] * v0 + c[26] * v1 + c[27] * v2
            u0 += c[28] * r0 + c[29] * r2 + c[30] * a0 + c[31] * a1 + c[32] * a2
            out[3 * width + j] = u0
        for j in range(width):
            q0, q2 = rows[j] + out[j], rows[2 * width + j] + out[2 * width + j]
            v0, v1, v2 = rows[3 * width + j], rows[4 * width + j], rows[5 * width + j]
            r0, r2 = rows[6 * width + j], rows[8 * width + j]
            a0, a1, a2 = sensor[3 * width + j], sensor[4 * width + j], sensor[5 * width + j]
            u1 = v1 + c[33] * q0 + c[34] * q2 + c[35] * v0 + c[36] * v1 + c[37] * v2
            u1 += c[38] * r0 + c[39] * r2 + c[40] * a0 + c[41] * a1 + c[42] * a2
            out[4 * width + j] = u1
        for j in range(width):
            q0, q1 = rows[j] + out[j], rows[width + j] + out[width + j]
            v0, v1, v2 = rows[3 * width + j], rows[4 * width + j], rows[5 * width + j]
            r0, r2 = rows[6 * width + j], rows[8 * width + j]
            a0, a1, a2 = sensor[3 * width + j], sensor[4 * width + j], sensor[5 * width + j]
            u2 = v2 + c[43] * q0 + c[44] * q1 + c[45] * v0 + c[46] * v1
            u2 += c[47] * r0 + c[48] * r2 + c[49] * a0 + c[50] * a1 + c[51] * a2
            out[5 * width + j] = u2
        for j in range(width):
            v0, v1, v2 = rows[3 * width + j], rows[4 * width + j], rows[5 * width + j]
            u0, u1, u2 = out[3 * width + j], out[4 * width + j], out[5 * width + j]
            r0, r1, r2 = rows[6 * width + j], rows[7 * width + j], rows[8 * width + j]
            out[6 * width + j] = r0 + c[52] * (v0 + u0) + c[53] * r0 + c[54] * r2
            out[7 * width + j] = r1 + c[52] * (v1 + u1) + c[55] * r0 + c[56] * r1 + c[57] * r2
            out[8 * width + j] = r2 + c[52] * (v2 + u2)

    return apply


apply_to_core = apply_for(CORE_STRIDE)


def dense_transition(nav: Array, step: Array, h: float) -> Array:
    """Transition (9, 21) of the navigation errors over h; columns 9 to 20 are the sensor errors.

    For analysis and tests; the filter never forms it.
    """
    c = np.zeros(COEFFICIENTS)
    coefficients(nav, step, h, c)
    unit = np.eye(CORE_SIZE + 6, CORE_STRIDE)
    out = np.zeros(CORE_SIZE * CORE_STRIDE)
    apply_to_core(unit[:CORE_SIZE].ravel(), unit[CORE_SIZE:].ravel(), c, out)
    sensor_and_core = out.reshape(CORE_SIZE, CORE_STRIDE)[:, : CORE_SIZE + 6]
    scale = sensor_and_core[:, CORE_SIZE:] * step[3:9]
    return np.hstack([sensor_and_core, scale])
