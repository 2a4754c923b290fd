r"""Preintegrated IMU data of a measurement: acceleration, with accelerometer errors, and rotation.

    a = C f + g,   d a = [f x] phi + C e,   e = db + ds f       (computed minus true, body axes)

A time offset multiplies a. The sum of tilt and force bias is known long before each of them
(fusiond.estimators.tilt_frame_after_heading_update): a measurement with the first term alone would
separate them, a little each time, without any evidence.

A rate multiplies the error of a lever arm. In that slope the rate's noise n counts as a turn: each
velocity of variance r brings the false information E[n^2] / r under any motion, and pulls the
estimate to its start or to the attitude that the same noise has turned (errors in both variables).
So the slope uses the rate w_s smoothed by one pole, reduced by its noise,

    w_s (1 - k^2 s^2 / w_s^2),  0 if that is negative

with s^2 the remaining variance of its noise and k = CLEAR (James and Stein's estimator, with the
share of noise that passes at one in 370). Though w_s lags behind w, the lever stays unbiased: E[w_s
w] = E[w_s^2], for the real part of 1 / (1 + i f) is its square. The velocity itself uses the rate
of the sample, so that a known lever arm makes no transients.

Source: Fuller, Measurement Error Models (1987), section 1.1; James and Stein, Estimation with
quadratic loss, Proc. 4th Berkeley Symp. 1 (1961), positive part.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, FORCE_ERROR, FORCE_SCALE
from fusiond.navigation.strapdown import STEP_NOISE_B, STEP_SMOOTH_N, STEP_SMOOTH_RATE_B

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
CLEAR = 3.0
"""Sigmas of noise beyond which a smoothed rate is a turn."""


@compiled("f8(f8[::1], i8)", forceinline=True)
def turning(step: Array, axis: int) -> float:
    """Smoothed rate (rad/s) about a body axis of a `step` (28,); zero within its noise."""
    rate: float = step[STEP_SMOOTH_RATE_B + axis]
    left = rate * rate - CLEAR * CLEAR * step[STEP_NOISE_B + axis]
    return left / rate if left > 0.0 else 0.0


@compiled("void(f8[::1], i8[::1], UniTuple(f8, 9), f8, f8, f8, f8[::1])", forceinline=True)
def add_of_force(
    step: Array, column_of: Indices, c: Matrix, r0: float, r1: float, r2: float, h: Array
) -> None:
    """Add to h (n,) the slopes by e of (r0, r1, r2) . f_body, by the force that `step` (28,) holds,
    smoothed; `c` C_nb by rows."""
    row = (r0, r1, r2)
    for slot in range(CORE_SIZE, column_of.shape[0]):
        axis = column_of[slot] - FORCE_ERROR
        if 0 <= axis < 3:
            h[slot] += row[axis]
        axis = column_of[slot] - FORCE_SCALE
        if 0 <= axis < 3:
            force = 0.0
            for k in range(3):
                force += c[3 * k + axis] * step[STEP_SMOOTH_N + k]
            h[slot] += row[axis] * force
