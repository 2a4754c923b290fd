r"""Compiled kernels: the published state, by the receiver's clock or the filter's own.

Users label a solution with the receiver's time. If a filter estimates the delay tau from stamp to
validity of its fixes, its own instant t is t - tau by the receiver's clock, and the published state
for t is

    p + v tau,   v + a tau,   q (x) exp(w tau)
    var(p_i) = P_rr - 2 v_i P_rt + v_i^2 P_tt,   var(v_i) = P_vv - 2 a_i P_vt + a_i^2 P_tt
    cov(phi) = P_pp + u P_tp + P_pt u^T + u u^T P_tt,   u = C_nb w

P_tt is the variance of tau's error, true minus estimate as for all parameters; errors of p, v and
phi are those of fusiond.navigation.error_model. Fixes measure p and v, so the offset's own sigma
cancels there. The attitude is not measured by the receiver's clock: in a bend w times the sigma of
tau can dominate the heading's sigma. a is smoothed.

A receiver with delayed fixes does not define the time. The published state is then for the filter's
own t, and tau is the error of that clock, the IMU's: not estimated, of sigma `clock_sd_s`,
uncorrelated with the state. The same sums hold with P_tt = clock_sd_s^2 and the rest of P's row
zero: a position has v times that sigma.

Weighted fault hypotheses add variances (9,) that are not part of P
(fusiond.estimators.fault_mixture).

The attitude is that of the nominal axes of the configured inertial unit. C_nb is that of its gyros'
axes, out of square within the data sheet, or of a spare's. Their orientation against the nominal
axes is known to `axes_sd_rad` about each axis, and cov(phi) grows by its square. For a deviation m
of each pair of axes the best rotation has an error of m / sqrt(2); bends add as much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity, meridian_radius, transverse_radius
from fusiond.navigation.rotation import rotate_quaternion
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    LON,
    NAV_SIZE,
    Q0,
    STEP_DCM,
    STEP_RATE_B,
    STEP_RESTS_S,
    STEP_SMOOTH_N,
    VN,
)

Array = NDArray[np.float64]

WIDER = 9
"""Variances of `widen`."""
MOVES_SIGMAS, MOVES_M_S = 5.0, 0.5
"""Thresholds of motion, both of which a speed must exceed."""
ENTRIES, MOVING = 22, 12
"""Numbers of `entries` and of `moving`."""


class Published(NamedTuple):
    """Axes and clock of publication: slot of the receiver's clock offset, or -1 and one sigma (s)
    of the filter's own clock; one sigma (rad) about each axis of the unit in use against the
    published axes."""

    time_slot: int
    clock_sd_s: float = 0.0
    axes_sd_rad: float = 0.0


@compiled("f8(f8[::1], f8[::1], i8)", forceinline=True)
def _acceleration(nav: Array, step: Array, axis: int) -> float:
    """Smoothed, m/s^2, along north, east or down."""
    force: float = step[STEP_SMOOTH_N + axis]
    return force + gravity(nav[LAT], nav[HEIGHT]) if axis == 2 else force


@compiled("f8(f8[::1], i8)", forceinline=True)
def _turning(step: Array, axis: int) -> float:
    """Rate of the body, rad/s, about north, east or down."""
    total = 0.0
    for j in range(3):
        total += step[STEP_DCM + 3 * axis + j] * step[STEP_RATE_B + j]
    return total


@compiled("void(f8[::1], f8[::1], f8[::1], i8, f8[::1])")
def in_fix_time(nav: Array, xi: Array, step: Array, time_slot: int, out: Array) -> None:
    """Write `out` (10,): `nav` by the receiver's clock, whose offset is parameter `time_slot` (-1:
    none)."""
    for j in range(NAV_SIZE):
        out[j] = nav[j]
    if time_slot < 0:
        return
    tau = xi[time_slot]
    lat, height = nav[LAT], nav[HEIGHT]
    out[LAT] += nav[VN] * tau / (meridian_radius(lat) + height)
    out[LON] += nav[VN + 1] * tau / ((transverse_radius(lat) + height) * math.cos(lat))
    out[HEIGHT] -= nav[VN + 2] * tau
    for j in range(3):
        out[VN + j] += _acceleration(nav, step, j) * tau
    rotate_quaternion(
        out[Q0:],
        step[STEP_RATE_B] * tau,
        step[STEP_RATE_B + 1] * tau,
        step[STEP_RATE_B + 2] * tau,
        False,
    )


@compiled("void(f8[::1], i8, i8, f8, f8[::1])", forceinline=True)
def entries(cov: Array, width: int, time_slot: int, clock_sd_s: float, out: Array) -> None:
    """Write `out` (22,): entries of P, flat and of `width` rows, for the sigmas. Variances of
    position and velocity (n, e, d), of phi, its covariances (ne, nd, ed), those of position,
    velocity and phi with the clock of `Published`, and its variance."""
    for i in range(3):
        out[i], out[3 + i] = cov[(6 + i) * (width + 1)], cov[(3 + i) * (width + 1)]
        out[6 + i] = cov[i * (width + 1)]
        for j in range(3):
            row = (6, 3, 0)[j] + i
            out[12 + 3 * j + i] = cov[row * width + time_slot] if time_slot >= 0 else 0.0
    out[9], out[10], out[11] = cov[1], cov[2], cov[width + 2]
    out[21] = cov[time_slot * (width + 1)] if time_slot >= 0 else clock_sd_s * clock_sd_s


@compiled("void(f8[::1], f8[::1], f8[::1])", forceinline=True)
def moving(nav: Array, step: Array, out: Array) -> None:
    """Write `out` (12,): velocity, acceleration and turn (n, e, d) of nav (10,) and its last step
    (28,), sine of the pitch, cosine and sine of the yaw."""
    for i in range(3):
        out[i], out[3 + i], out[6 + i] = nav[VN + i], _acceleration(nav, step, i), _turning(step, i)
    out[9] = -step[STEP_DCM + 6]
    cp = math.sqrt(max(1e-12, 1.0 - out[9] * out[9]))
    out[10], out[11] = step[STEP_DCM] / cp, step[STEP_DCM + 3] / cp


@compiled("void(f8[::1], f8[::1], f8, f8[::1])", forceinline=True)
def sigmas_of(p: Array, motion: Array, axes_sd_rad: float, out: Array) -> None:
    """Write one sigma (9,) as `sigmas`, from `entries` (22,) and the motion `moving` (12,)."""
    tt = p[21]
    for i in range(3):
        v, a = motion[i], motion[3 + i]
        out[i] = math.sqrt(max(0.0, p[i] + v * (v * tt - 2.0 * p[12 + i])))
        out[3 + i] = math.sqrt(max(0.0, p[3 + i] + a * (a * tt - 2.0 * p[15 + i])))
    misalignment = axes_sd_rad * axes_sd_rad
    u0, u1, u2 = motion[6], motion[7], motion[8]
    t0, t1, t2 = p[18], p[19], p[20]
    a = p[6] + misalignment + u0 * (u0 * tt + 2.0 * t0)
    b = p[7] + misalignment + u1 * (u1 * tt + 2.0 * t1)
    c = p[8] + misalignment + u2 * (u2 * tt + 2.0 * t2)
    d = p[9] + u0 * (u1 * tt + t1) + u1 * t0
    e = p[10] + u0 * (u2 * tt + t2) + u2 * t0
    f = p[11] + u1 * (u2 * tt + t2) + u2 * t1
    # Rows of d(rpy)/d(phi) without sign: 1/cos(pitch) [cos yaw, sin yaw, 0], [-sin yaw, cos yaw,
    # 0], and [tan(pitch) cos yaw, tan(pitch) sin yaw, 1].
    sp, cy, sy = motion[9], motion[10], motion[11]
    cp = math.sqrt(max(1e-12, 1.0 - sp * sp))
    along = cy * cy * a + sy * sy * b + 2.0 * cy * sy * d
    cross = sy * sy * a + cy * cy * b - 2.0 * cy * sy * d
    tangent = sp / cp
    out[6] = math.sqrt(max(0.0, along)) / cp
    out[7] = math.sqrt(max(0.0, cross))
    out[8] = math.sqrt(max(0.0, tangent * tangent * along + c + 2.0 * tangent * (cy * e + sy * f)))


@compiled("void(f8[:, ::1], f8[::1], f8[::1], i8, f8, f8, f8[::1])", allocates=True)
def sigmas(
    cov: Array,
    nav: Array,
    step: Array,
    time_slot: int,
    clock_sd_s: float,
    axes_sd_rad: float,
    out: Array,
) -> None:
    """Write one sigma (9,): position n, e, d (m), velocity n, e, d (m/s), roll, pitch, yaw (rad).

    By the clock and the axes of `Published`. Roll, pitch and yaw follow from phi by Euler
    kinematics, with C_nb as `step` (28,) holds it.
    """
    p, motion = np.empty(ENTRIES), np.empty(MOVING)
    entries(cov.reshape(cov.size), cov.shape[1], time_slot, clock_sd_s, p)
    moving(nav, step, motion)
    sigmas_of(p, motion, axes_sd_rad, out)


@compiled("void(f8[::1], f8[::1])", forceinline=True)
def widen(wider: Array, out: Array) -> None:
    """`out` (9,), sigmas as of `sigmas`, with the variances `wider` (9,) added."""
    for i in range(9):
        if wider[i] > 0.0:
            out[i] = math.sqrt(out[i] * out[i] + wider[i])


@compiled("f8(f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1])", allocates=True)
def surely_moves(cov: Array, nav: Array, step: Array, published: Array, wider: Array) -> float:
    """Return 1 if the horizontal velocity proves motion by its sigma, from `published` (3,) and
    `wider` (9,); else 0."""
    speed = math.hypot(nav[VN], nav[VN + 1])
    if step[STEP_RESTS_S] > 0.0 or speed <= MOVES_M_S:
        return 0.0
    out = np.empty(9)
    sigmas(cov, nav, step, int(published[0]), published[1], published[2], out)
    widen(wider, out)
    return 1.0 if speed > MOVES_SIGMAS * math.hypot(out[3], out[4]) else 0.0


@compiled("void(f8[:, ::1], f8[::1], f8[::1])")
def opened_variances(opened: Array, step: Array, out: Array) -> None:
    """Write `out` (9,), variances in the order of `sigmas`, from the added covariance of attitude,
    velocity and position (9, 9), with C_nb from `step` (28,)."""
    for i in range(3):
        out[i], out[3 + i] = opened[6 + i, 6 + i], opened[3 + i, 3 + i]
    sp = -step[STEP_DCM + 6]
    cp = math.sqrt(max(1e-12, 1.0 - sp * sp))
    cy, sy = step[STEP_DCM] / cp, step[STEP_DCM + 3] / cp
    a, b, d = opened[0, 0], opened[1, 1], opened[0, 1]
    along = cy * cy * a + sy * sy * b + 2.0 * cy * sy * d
    tangent = sp / cp
    out[6] = along / (cp * cp)
    out[7] = sy * sy * a + cy * cy * b - 2.0 * cy * sy * d
    across = cy * opened[0, 2] + sy * opened[1, 2]
    out[8] = tangent * tangent * along + opened[2, 2] + 2.0 * tangent * across
