r"""Preintegrated gyro and accelerometer data from the first of several instants, as a compiled
kernel.

With C' = C [w - b_w]x the attitude's error, a rotation vector in the axes of the begin, is D db_w
with D' = -C, and that of the velocity gained v = int C f dt is

    -int C dt db_f + int [D db_w]x C f dt = D db_f + V db_w,   V' = -[C f]x D

From one instant to the next all of them are made from nothing, l, and then put together:

    V <- V - [C v_l]x D + C V_l,   D <- D + C D_l,   v <- v + C v_l,   C <- C C_l

so that what lies between any two instants can be integrated beside the rest. A sample's turn must
wait for that of the one before, but not for those of other intervals: a processor does eight of
them in the time of one, in its vectors.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.rotation import quaternion_to_dcm

Array = NDArray[np.float64]

LANES = 8
"""Intervals side by side: doubles in the widest vectors."""
# Where the array of the lanes has each of an interval's q (4), v (3), D and V (3, 3), C in the
# middle of the sample that comes (3, 3), the velocity that it adds (3), its time (s), rate and
# force (3): of all lanes one after another.
_Q, _V, _D, _S, _C, _F, _H, _RATE, _FORCE, _END = (
    LANES * row for row in (0, 4, 7, 16, 25, 34, 37, 38, 41, 44)
)
_MADE = _C
# 1 / n!: half of a step turns by less than a radian, of which the first that is left out is 1e-12.
_OF_COS = (1.0 / 2.0, 1.0 / 24.0, 1.0 / 720.0, 1.0 / 40320.0, 1.0 / 3628800.0)
_OF_SIN = (1.0 / 6.0, 1.0 / 120.0, 1.0 / 5040.0, 1.0 / 362880.0, 1.0 / 39916800.0)


@compiled("void(f8[::1])")
def _sense(lanes: Array) -> None:
    """Take in one sample of each lane: no branch, no call and one array, or it is no vector."""
    for i in range(LANES):
        h = lanes[_H + i]
        x, y, z = lanes[_RATE + i], lanes[_RATE + LANES + i], lanes[_RATE + 2 * LANES + i]
        # Half of the turn, then the attitude in the middle, and the other half of it.
        n = (0.25 * h) ** 2 * (x * x + y * y + z * z)
        a, b, c, d, e = _OF_COS
        w = 1.0 - n * (a - n * (b - n * (c - n * (d - n * e))))
        a, b, c, d, e = _OF_SIN
        sine = 0.25 * h * (1.0 - n * (a - n * (b - n * (c - n * (d - n * e)))))
        x, y, z = sine * x, sine * y, sine * z
        q0, q1, q2, q3 = (
            lanes[_Q + i],
            lanes[_Q + LANES + i],
            lanes[_Q + 2 * LANES + i],
            lanes[_Q + 3 * LANES + i],
        )
        q0, q1, q2, q3 = (
            q0 * w - q1 * x - q2 * y - q3 * z,
            q0 * x + q1 * w + q2 * z - q3 * y,
            q0 * y + q2 * w + q3 * x - q1 * z,
            q0 * z + q3 * w + q1 * y - q2 * x,
        )
        lanes[_Q + i] = q0 * w - q1 * x - q2 * y - q3 * z
        lanes[_Q + LANES + i] = q0 * x + q1 * w + q2 * z - q3 * y
        lanes[_Q + 2 * LANES + i] = q0 * y + q2 * w + q3 * x - q1 * z
        lanes[_Q + 3 * LANES + i] = q0 * z + q3 * w + q1 * y - q2 * x
        lanes[_C + i] = q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3
        lanes[_C + LANES + i] = 2.0 * (q1 * q2 - q0 * q3)
        lanes[_C + 2 * LANES + i] = 2.0 * (q1 * q3 + q0 * q2)
        lanes[_C + 3 * LANES + i] = 2.0 * (q1 * q2 + q0 * q3)
        lanes[_C + 4 * LANES + i] = q0 * q0 - q1 * q1 + q2 * q2 - q3 * q3
        lanes[_C + 5 * LANES + i] = 2.0 * (q2 * q3 - q0 * q1)
        lanes[_C + 6 * LANES + i] = 2.0 * (q1 * q3 - q0 * q2)
        lanes[_C + 7 * LANES + i] = 2.0 * (q2 * q3 + q0 * q1)
        lanes[_C + 8 * LANES + i] = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
        for r in range(3):
            at, f = 3 * LANES * r + i, 0.0
            for j in range(3):
                f += lanes[_C + at + LANES * j] * lanes[_FORCE + LANES * j + i]
            lanes[_F + LANES * r + i] = h * f
            lanes[_V + LANES * r + i] += h * f
        for r in range(3):
            ahead, behind = (r + 1) % 3, (r + 2) % 3
            f, g = lanes[_F + LANES * ahead + i], lanes[_F + LANES * behind + i]
            for j in range(3):
                at, after = LANES * (3 * ahead + j) + i, LANES * (3 * behind + j) + i
                mid = lanes[_D + at] - 0.5 * h * lanes[_C + at]
                lanes[_S + LANES * (3 * r + j) + i] -= (
                    f * (lanes[_D + after] - 0.5 * h * lanes[_C + after]) - g * mid
                )
        for j in range(9):
            lanes[_D + LANES * j + i] -= h * lanes[_C + LANES * j + i]


@compiled("void(i8[::1], f8[:, ::1], f8[::1], i8[::1], i8, f8[::1])")
def _side_by_side(
    times: NDArray[np.int64],
    samples: Array,
    biases: Array,
    counts: NDArray[np.int64],
    first: int,
    lanes: Array,
) -> None:
    """Integrate the intervals from `first` on, one in each lane."""
    most, number = 0, min(LANES, counts.shape[0] - first)
    lanes[:] = 0.0
    lanes[_Q : _Q + LANES] = 1.0
    for k in range(first, first + number):
        most = max(most, counts[k] - (counts[k - 1] if k > 0 else 0))
    for row in range(most):
        for i in range(number):
            k = first + i
            at = row + (counts[k - 1] if k > 0 else 0)
            lanes[_H + i] = 0.0  # it has no more
            if at < counts[k]:
                lanes[_H + i] = (times[at + 1] - times[at]) * 1e-9
                for j in range(3):
                    lanes[_RATE + LANES * j + i] = samples[at, j] - biases[3 + j]
                    lanes[_FORCE + LANES * j + i] = samples[at, 3 + j] - biases[j]
        _sense(lanes)


@compiled(
    "void(i8[::1], f8[:, ::1], f8[::1], i8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1])",
    allocates=True,
)
def integrate_sensed(
    times: NDArray[np.int64],
    samples: Array,
    biases: Array,
    counts: NDArray[np.int64],
    gained: Array,
    turned: Array,
    slopes: Array,
) -> None:
    """Integrate samples (m, 6) of rate and force less biases (6,) of force and rate in the axes of
    their start. After `counts` (k,) of them, ascending, write the gained velocity (k, 3), the
    attitude (k, 3, 3), and the derivatives of that velocity by the biases (k, 3, 6).

    `times` (m + 1,) ns holds the begin before the first sample. Over tens of seconds: Earth rate,
    transport and Coriolis and gravity are neglected.
    """
    lanes, made = np.empty(_END), np.empty(_MADE // LANES)
    dcm, own, v, d, s = np.eye(3), np.empty((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    gains, turn = np.empty(3), np.empty((3, 3))
    for k in range(counts.shape[0]):
        lane = k % LANES
        if lane == 0:
            _side_by_side(times, samples, biases, counts, k, lanes)
        for row in range(_MADE // LANES):
            made[row] = lanes[LANES * row + lane]
        q, v_l, d_l, s_l = made[:4], made[4:7], made[7:16], made[16:25]
        norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        for j in range(4):
            q[j] /= norm
        quaternion_to_dcm(q, own)
        for i in range(3):
            gains[i] = dcm[i, 0] * v_l[0] + dcm[i, 1] * v_l[1] + dcm[i, 2] * v_l[2]
            v[i] += gains[i]
        for i in range(3):
            ahead, behind = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                s[i, j] -= gains[ahead] * d[behind, j] - gains[behind] * d[ahead, j]
        for i in range(3):
            for j in range(3):
                turn[i, j] = 0.0
                for n in range(3):
                    s[i, j] += dcm[i, n] * s_l[3 * n + j]
                    d[i, j] += dcm[i, n] * d_l[3 * n + j]
                    turn[i, j] += dcm[i, n] * own[n, j]
        for i in range(3):
            gained[k, i] = v[i]
            for j in range(3):
                dcm[i, j] = turned[k, i, j] = turn[i, j]
                slopes[k, i, j], slopes[k, i, 3 + j] = d[i, j], s[i, j]
