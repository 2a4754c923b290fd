r"""Noise of a carriers' anchor: phase noise at the cloning, and walk of the clone.

With H of the satellites (fusiond.aiding.carrier_anchor), W = diag(1 / s_i^2) of their phases,

    G = (H^T W H + I)^-1 H^T W        cov = G diag(v_i) G^T

v = s^2 at the anchor, once; v = q^2 dt for the time dt since the clone last walked. The latter is
the deviation of a satellite's orbit, clock and atmosphere from the broadcast, which drifts at the
same rate for minutes: a way r t, which no walk has at two times. Over an anchor it is that of a
walk of q_a, and over minutes that of q > q_a. Carriers measure the way of the antenna and, in it,
the satellites' drift:

    B <- B + w_a + w,    dr <- dr - E^T w,    v of w_a = q_a^2 dt,  v of w = (q^2 - q_a^2) dt

(E north, east and down in ECEF). w moves the clone and the position together: the way since the
anchor does not contain it, nor does the velocity; the position does, beside ranges and other fixes.
If all of it were the clone's, the stated velocity error would be twice the true one. If it were
added to the clone at the anchor only, the inertial unit, which knows the position across that
instant to millimetres, would accept the carriers' velocity as true: with four satellites of a DOP
of 40, orbits that drift by 0.7 mm/s move the position by 30 mm/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.carrier_anchor import (
    _ALIVE,
    _V,
    _WALKED,
    CARRIER,
    CARRIER_VARIANCE,
    ON_EARTH_M,
    SLOT,
    V_NED,
    antenna,
    go_on,
    invert,
    phase_scale,
    sight,
)
from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import VN

Array = NDArray[np.float64]

FLOOR_M = 1e-3
"""One sigma of a clock at least: a covariance of which a part is another's to the last digit is
none any more after some updates."""
DRIFT_M_SQRT_S = 0.003
"""Walk of orbits and clocks over minutes: 42 mm in 200 s. Of a station with a known place each
satellite's carrier goes from its range at 0.12 to 0.22 mm/s, the same rate for minutes (28 to 44 mm
in 200 s)."""
ANCHOR_M_SQRT_S = 0.0012
"""That walk over an anchor: 6.6 mm in 30 s, of the same station 4.3 to 6.6 mm."""
OF_ANCHOR = (ANCHOR_M_SQRT_S / DRIFT_M_SQRT_S) ** 2
"""Share of the walk that the clone takes without the place."""
WALKS_S = 0.9
"""Between two steps of the walk: those of each second."""


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", forceinline=True)
def _spread(inverted: Array, spread: Array, noise: Array) -> None:
    """Write A S A^T (4, 4)."""
    for i in range(4):
        for j in range(i + 1):
            total = 0.0
            for p in range(4):
                for q in range(4):
                    total += inverted[i, p] * spread[p, q] * inverted[j, q]
            noise[i, j] = noise[j, i] = total


@compiled("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1])", allocates=True)
def phase_noise(values: Array, place: Array, left: Array, noise: Array) -> None:
    """Write the covariance (4, 4) of what an anchor's phases add to B and C.

    To `left` goes the variance of each satellite's constant."""
    information, inverted, row = np.zeros((4, 4)), np.empty((4, 4)), np.empty(4)
    scale = phase_scale(left)
    for k in range(values.shape[1]):
        if math.isfinite(values[CARRIER, k]):
            sight(values, k, place, row)
            for i in range(4):
                for j in range(4):
                    information[i, j] += row[i] * row[j] / (scale * values[CARRIER_VARIANCE, k])
    invert(information, inverted, 1.0)
    for k in range(values.shape[1]):
        if math.isfinite(values[CARRIER, k]):
            sight(values, k, place, row)
            variance = scale * values[CARRIER_VARIANCE, k]
            for i in range(4):
                for j in range(4):
                    variance -= row[i] * inverted[i, j] * row[j]
            left[int(values[SLOT, k]), _V] = max(variance, 0.0)
    _spread(inverted, information, noise)
    for i in range(4):
        noise[i, i] += FLOOR_M * FLOOR_M


@compiled("b1(f8[:, ::1], f8[::1], f8, f8[:, ::1], f8[:, ::1])", allocates=True)
def walk_noise(values: Array, place: Array, t_s: float, left: Array, noise: Array) -> bool:
    """Write the covariance (4, 4) of the walk of B and C until `t_s` since the last one; False if
    too little time has passed."""
    age = t_s - left[0, _WALKED]
    if not age >= WALKS_S:
        return False
    left[0, _WALKED] = t_s
    information, inverted = np.zeros((4, 4)), np.empty((4, 4))
    spread, row = np.zeros((4, 4)), np.empty(4)
    walked = DRIFT_M_SQRT_S * DRIFT_M_SQRT_S * age
    for k in range(values.shape[1]):
        if left[int(values[SLOT, k]), _ALIVE] > 0.0:
            sight(values, k, place, row)
            w = 1.0 / values[CARRIER_VARIANCE, k]
            for i in range(4):
                for j in range(4):
                    information[i, j] += w * row[i] * row[j]
                    spread[i, j] += walked * w * w * row[i] * row[j]
    invert(information, inverted, 1.0)
    _spread(inverted, spread, noise)
    return True


NOTHING, ANCHORED, WALKED = 0, 1, 2
"""Change of the clone after an epoch."""


@compiled(
    "i8(f8[:, ::1], u1[::1], i8, f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1],"
    "f8[:, ::1])",
    allocates=True,
)
def leave(
    values: Array,
    codes: NDArray[np.uint8],
    first: int,
    epoch: Array,
    nav: Array,
    anchor: Array,
    before: Array,
    left: Array,
    of_navigation: Array,
    noise: Array,
) -> int:
    """Write the output of an epoch, and noise if the clone is renewed or walks; which of them.

    `epoch` (6,): its instant (s), the lead of the receiver's clock (s), 1 if that was set, and the
    lever arm; `anchor` (3,) the clone (ECEF, m). `of_navigation` (4, 9), zero before, takes the
    antenna's errors by those of navigation, `noise` (5, 4) the covariance, and the antenna in its
    last row. Other arguments as of `fusiond.aiding.carrier_anchor.go_on`.
    """
    t_s, place = epoch[0], noise[4]
    square = anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2]
    cloned = square > ON_EARTH_M * ON_EARTH_M
    antenna(nav, epoch[3], epoch[4], epoch[5], place[:3], of_navigation[:3])
    place[3] = 0.0
    goes_on = cloned and epoch[2] == 0.0
    if go_on(values, codes, first, t_s, epoch[1], goes_on, place, anchor, before, left):
        for i in range(3):
            left[0, V_NED + i] = nav[VN + i]
        phase_noise(values, place, left, noise[:4])
        return ANCHORED
    if cloned and walk_noise(values, place, t_s, left, noise[:4]):
        return WALKED
    return NOTHING
