r"""Strapdown navigation over one IMU interval, in north-east-down axes.

    C_nb' = C_nb [w_ib x] - [w_in x] C_nb            w_in = w_ie + w_en
    v'    = C_nb f_b + g - (2 w_ie + w_en) x v
    phi'  = v_N / (R_M + h)   lambda' = v_E / ((R_N + h) cos phi)   h' = -v_D

One interval of length h (s) with mean rate w and mean specific force f (body), their slopes wd, fd:

    rotation vector   s = w h + h^3/12 (w x wd)                                  coning
    velocity change   u = f h + 1/2 (w h) x (f h) + h^3/12 (w x fd + f x wd)     rotation, sculling

which for equal intervals and wd = (w - w_before) / h are the two-sample terms 1/12 ds' x ds and
1/12 (ds' x du + du' x ds). Gravity and Coriolis are taken at the middle of the interval. Written
with slopes, an interval may be split at the instant of a measurement.

Source: Savage, Strapdown Inertial Navigation Integration Algorithm Design, J. Guidance 21 (1998),
parts 1 (eq. 34, 38) and 2 (eq. 36, 46); Groves, 2nd ed., section 5.4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import EARTH_RATE_RAD_S, ECCENTRICITY_SQUARED, SEMI_MAJOR_M, gravity
from fusiond.navigation.rotation import dcm_elements, rotate_quaternion

Array = NDArray[np.float64]

# Navigation state (10,): the order in which every array of this package holds it.
LAT, LON, HEIGHT, VN, VE, VD, Q0 = 0, 1, 2, 3, 4, 5, 6
NAV_SIZE = 10
# What a step leaves for the error model (STEP_SIZE,): mean specific force in NED (m/s^2), mean
# compensated rate and specific force in body axes, C_nb in the middle of the interval by rows, the
# specific force in NED and the rate in body axes, each smoothed over the steps, the variance of the
# noise that the latter has left, and for how long (s) the vehicle is known to rest.
STEP_FORCE_N, STEP_RATE_B, STEP_FORCE_B, STEP_DCM, STEP_SMOOTH_N = 0, 3, 6, 9, 18
STEP_SMOOTH_RATE_B, STEP_NOISE_B, STEP_RESTS_S = 21, 24, 27
STEP_SIZE = 28
# Time constant (s) of both: a car's acceleration changes in a second, an engine shakes in 50 ms.
SMOOTH_S = 0.25
# Seconds that the variance looks back, as fusiond.navigation.vibration does. Samples that differ
# from the smoothed rate before by d have d^2 (1 - g / 2) of noise each, if it is white, and what is
# smoothed with gain g has g / (2 - g) of that; a rate that changes adds to it.
NOISE_S = 10.0
# A vehicle that accelerates by so much rests no more: one that does by less gains 0.15 m/s until
# that is noticed otherwise. An engine that idles shakes by less once it is smoothed.
PULLS_M_S2 = 0.1


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, b1, f8[::1])", forceinline=True)
def strapdown_step(
    nav: Array,
    rate: Array,
    force: Array,
    rate_slope: Array,
    force_slope: Array,
    h: float,
    hold_height: bool,
    step: Array,
) -> None:
    """Advance `nav` (10,) in place by `h` seconds; write `step` (28,) for the error model.

    `rate` (rad/s) and `force` (m/s^2) are the interval's means in body axes after compensation,
    the slopes their time derivatives. `hold_height` keeps height and v_D = 0 (planar models).
    """
    q = nav[Q0:]
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = dcm_elements(q)
    w0, w1, w2 = rate[0], rate[1], rate[2]
    f0, f1, f2 = force[0], force[1], force[2]
    a0, a1, a2 = rate_slope[0], rate_slope[1], rate_slope[2]
    b0, b1, b2 = force_slope[0], force_slope[1], force_slope[2]
    k3 = h * h * h / 12.0
    k2 = 0.5 * h * h
    s0 = w0 * h + k3 * (w1 * a2 - w2 * a1)
    s1 = w1 * h + k3 * (w2 * a0 - w0 * a2)
    s2 = w2 * h + k3 * (w0 * a1 - w1 * a0)
    u0 = f0 * h + k2 * (w1 * f2 - w2 * f1) + k3 * (w1 * b2 - w2 * b1 + f1 * a2 - f2 * a1)
    u1 = f1 * h + k2 * (w2 * f0 - w0 * f2) + k3 * (w2 * b0 - w0 * b2 + f2 * a0 - f0 * a2)
    u2 = f2 * h + k2 * (w0 * f1 - w1 * f0) + k3 * (w0 * b1 - w1 * b0 + f0 * a1 - f1 * a0)

    lat, height = nav[LAT], nav[HEIGHT]
    vn, ve, vd = nav[VN], nav[VE], nav[VD]
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    w2e = 1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat
    root = math.sqrt(w2e)
    radius_n = SEMI_MAJOR_M / root + height
    radius_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w2e * root) + height
    tan_lat = sin_lat / cos_lat
    earth_n, earth_d = EARTH_RATE_RAD_S * cos_lat, -EARTH_RATE_RAD_S * sin_lat

    # Specific force in navigation axes, with half the interval's frame rotation taken off.
    transport_n, transport_e = ve / radius_n, -vn / radius_m
    transport_d = -ve * tan_lat / radius_n
    z0 = 0.5 * h * (earth_n + transport_n)
    z1 = 0.5 * h * transport_e
    z2 = 0.5 * h * (earth_d + transport_d)
    p0 = c00 * u0 + c01 * u1 + c02 * u2
    p1 = c10 * u0 + c11 * u1 + c12 * u2
    p2 = c20 * u0 + c21 * u1 + c22 * u2
    d0 = p0 - (z1 * p2 - z2 * p1)
    d1 = p1 - (z2 * p0 - z0 * p2)
    d2 = p2 - (z0 * p1 - z1 * p0)

    # Velocity in the middle of the interval, from this interval's own force and gravity.
    g = gravity(lat, height - 0.5 * h * vd)
    mn = vn + 0.5 * d0
    me = ve + 0.5 * d1
    md = vd + 0.5 * (d2 + g * h)
    if hold_height:
        md = 0.0
    transport_n, transport_e, transport_d = me / radius_n, -mn / radius_m, -me * tan_lat / radius_n
    c0 = 2.0 * earth_n + transport_n
    c1 = transport_e
    c2 = 2.0 * earth_d + transport_d
    new_vn = vn + d0 - h * (c1 * md - c2 * me)
    new_ve = ve + d1 - h * (c2 * mn - c0 * md)
    new_vd = vd + d2 + h * (g - (c0 * me - c1 * mn))
    if hold_height:
        new_vd = 0.0

    # Position: trapezoid, then the middle latitude and height for the longitude.
    mid_vn, mid_ve, mid_vd = 0.5 * (vn + new_vn), 0.5 * (ve + new_ve), 0.5 * (vd + new_vd)
    mid_height = -0.5 * h * mid_vd
    mid_lat = lat + 0.5 * h * mid_vn / (radius_m + mid_height)
    nav[LAT] = lat + h * mid_vn / (radius_m + mid_height)
    cos_mid = cos_lat - (mid_lat - lat) * sin_lat
    nav[LON] += h * mid_ve / ((radius_n + mid_height) * cos_mid)
    nav[HEIGHT] = height - h * mid_vd
    nav[VN], nav[VE], nav[VD] = new_vn, new_ve, new_vd

    # Attitude: body rotation on the right, frame rotation (at mid-interval) on the left.
    rotate_quaternion(q, s0, s1, s2, False)
    rotate_quaternion(
        q,
        -h * (earth_n + mid_ve / radius_n),
        h * mid_vn / radius_m,
        -h * (earth_d - mid_ve * tan_lat / radius_n),
        True,
    )

    inverse = 1.0 / h
    step[0], step[1], step[2] = d0 * inverse, d1 * inverse, d2 * inverse
    # Nothing before: what is smoothed begins with this interval.
    b = STEP_FORCE_B
    started = step[b] != 0.0 or step[b + 1] != 0.0 or step[b + 2] != 0.0
    gain = h / (h + SMOOTH_S) if started else 1.0
    for j in range(3):
        step[STEP_SMOOTH_N + j] += gain * (step[j] - step[STEP_SMOOTH_N + j])
        d = rate[j] - step[STEP_SMOOTH_RATE_B + j]
        step[STEP_SMOOTH_RATE_B + j] += gain * d
        forgotten = h / (h + NOISE_S) if started else 1.0
        step[STEP_NOISE_B + j] += forgotten * (0.5 * gain * d * d - step[STEP_NOISE_B + j])
        step[STEP_RATE_B + j] = rate[j]
        step[STEP_FORCE_B + j] = force[j]
    n00, n01, n02, n10, n11, n12, n20, n21, n22 = dcm_elements(q)
    step[STEP_DCM], step[STEP_DCM + 1] = 0.5 * (c00 + n00), 0.5 * (c01 + n01)
    step[STEP_DCM + 2], step[STEP_DCM + 3] = 0.5 * (c02 + n02), 0.5 * (c10 + n10)
    step[STEP_DCM + 4], step[STEP_DCM + 5] = 0.5 * (c11 + n11), 0.5 * (c12 + n12)
    step[STEP_DCM + 6], step[STEP_DCM + 7] = 0.5 * (c20 + n20), 0.5 * (c21 + n21)
    step[STEP_DCM + 8] = 0.5 * (c22 + n22)
    pulls = max(abs(step[STEP_SMOOTH_N]), abs(step[STEP_SMOOTH_N + 1]))
    step[STEP_RESTS_S] = max(step[STEP_RESTS_S] - h, 0.0) if pulls < PULLS_M_S2 else 0.0


def step_before(nav: Array) -> Array:
    """Step (STEP_SIZE,) of a state (10,) before its first interval, in uniform motion. Without
    force the vehicle would fall, which would affect offsets in time."""
    step = np.zeros(STEP_SIZE)
    g = gravity(float(nav[LAT]), float(nav[HEIGHT]))
    step[STEP_FORCE_N + 2] = step[STEP_SMOOTH_N + 2] = -g
    step[STEP_DCM:STEP_SMOOTH_N] = dcm_elements(nav[Q0:])
    return step
