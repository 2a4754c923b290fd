r"""Compiled kernels: sigmas at the samples inside a block of the covariance's propagation.

A solution recorded at each sample needs sigmas at each, while the covariance is propagated from
crossing to crossing (fusiond.estimators.multi_sample_covariance). Their `entries`
(fusiond.estimators.published_state) are known at both, and in between, s seconds of H after the
first,

    p(s) = p(0) + L(s) + (s / H)^2 (p(H) - p(0) - L(H))

with L the first-order effect of the motion until then: by the velocity gained u, the mean attitude
C and the noise densities N,

    d phi = -s C e,   dv = u x phi + s C a,   dr = s dv of the first;   d var = 2 cov(d, .) + s N

The rest is of second order and grows with the square of the time, apart from changes of rate and
force within H: 2e-5 of the sigmas of recorded drives at 99 of 100 samples, 6e-4 at most for a
velocity with engine vibration. At each crossing the result is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance_propagation import weights
from fusiond.estimators.multi_sample_covariance import DENSITIES, SPAN, STEPS
from fusiond.estimators.published_state import ENTRIES, MOVING, entries, sigmas_of, widen
from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import STEP_DCM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROWS = 32
"""Samples that may wait for a crossing."""
ROW = ENTRIES + MOVING + 1
# P(0) where L takes it from: of both parameters of each axis error (6) with phi and v of the axes,
# and with the clock; of the axes before and after with the velocity of each; of v with r.
_SENSORS, _CLOCK, _BEHIND, _AHEAD, _WAY = 0, 36, 48, 51, 54
_TAKEN = 57
WAITING = 3 * ENTRIES + _TAKEN + 30
SIZE = WAITING + ROWS * ROW
"""Doubles of the waiting state: p(0), p(H), L(H), the part of P(0) that it needs, work space; for
each sample L, its motion and s."""


@compiled("void(f8[::1], i8, i8[::1], i8, f8, f8[::1])", forceinline=True)
def begin(
    cov: Array, width: int, sensor_terms: Indices, time_slot: int, clock_sd_s: float, between: Array
) -> None:
    """Write the entries of P(0) = `cov`, flat and of `width` rows, to `between` (SIZE,)."""
    entries(cov, width, time_slot, clock_sd_s, between[:ENTRIES])
    taken = between[3 * ENTRIES :]
    for a in range(12):
        slot, at = sensor_terms[a], _SENSORS + 3 * a
        for i in range(3):
            taken[at + i] = cov[(i if a < 6 else 3 + i) * width + slot]
        taken[_CLOCK + a] = cov[slot * width + time_slot] if time_slot >= 0 else 0.0
    for i in range(3):
        v = 3 + i
        taken[_BEHIND + i] = cov[(i + 2) % 3 * width + v]
        taken[_AHEAD + i] = cov[(i + 1) % 3 * width + v]
        taken[_WAY + i] = cov[v * width + 6 + i]


@compiled("void(f8[::1], f8, f8[::1], f8[::1], i8[::1], i8, f8[::1])", forceinline=True)
def first_order(
    between: Array,
    q: float,
    sums: Array,
    noise: Array,
    sensor_terms: Indices,
    time_slot: int,
    out: Array,
) -> None:
    """Write L (22,) of `sums` (25,) since `begin`, with all noise scaled by q; `noise` (3 n,) and
    `sensor_terms` are the model's."""
    s, n = sums[SPAN], noise.shape[0] // 3
    mean, shaken = sums[STEPS:DENSITIES], sums[DENSITIES:]
    first, taken = between[:ENTRIES], between[3 * ENTRIES :]
    weight, cross = taken[_TAKEN : _TAKEN + 12], taken[_TAKEN + 12 : _TAKEN + 30]
    weights(mean, sensor_terms, weight)
    for k in range(6):
        for i in range(3):
            at = _SENSORS + 6 * k + i
            cross[3 * k + i] = weight[2 * k] * taken[at] + weight[2 * k + 1] * taken[at + 3]
    for i in range(3):
        c0, c1, c2 = mean[STEP_DCM + 3 * i], mean[STEP_DCM + 3 * i + 1], mean[STEP_DCM + 3 * i + 2]
        u, w = s * mean[(i + 1) % 3], s * mean[(i + 2) % 3]
        gained = u * taken[_BEHIND + i] - w * taken[_AHEAD + i]
        gained += s * (c0 * cross[9 + i] + c1 * cross[12 + i] + c2 * cross[15 + i])
        turned = s * (c0 * cross[i] + c1 * cross[3 + i] + c2 * cross[6 + i])
        white = c0 * c0 * shaken[0] + c1 * c1 * shaken[1] + c2 * c2 * shaken[2]
        force = c0 * c0 * shaken[3] + c1 * c1 * shaken[4] + c2 * c2 * shaken[5]
        out[i] = 2.0 * s * taken[_WAY + i] + q * s * noise[n + 6 + i]
        out[3 + i] = 2.0 * gained + q * s * (noise[n + 3 + i] + force)
        out[6 + i] = q * s * (noise[n + i] + white) - 2.0 * turned
        one, other = (0, 0, 1)[i], (1, 2, 2)[i]
        both, white = 0.0, 0.0
        for k in range(3):
            c, d = mean[STEP_DCM + 3 * one + k], mean[STEP_DCM + 3 * other + k]
            both += c * cross[3 * k + other] + d * cross[3 * k + one]
            white += c * d * shaken[k]
        out[9 + i] = s * (q * white - both)
    for j in range(12, ENTRIES):
        out[j] = 0.0
    if time_slot < 0:
        return
    for a in range(12):
        cross[a] = weight[a] * taken[_CLOCK + a]
    for i in range(3):
        u, w = s * mean[(i + 1) % 3], s * mean[(i + 2) % 3]
        gained, turned = u * first[18 + (i + 2) % 3] - w * first[18 + (i + 1) % 3], 0.0
        for k in range(3):
            c = s * mean[STEP_DCM + 3 * i + k]
            turned += c * (cross[2 * k] + cross[2 * k + 1])
            gained += c * (cross[6 + 2 * k] + cross[7 + 2 * k])
        out[12 + i], out[15 + i], out[18 + i] = s * first[15 + i], gained, -turned
    out[21] = q * s * noise[n + time_slot]


@compiled("void(f8[::1], i8, f8, f8, f8[::1], f8[::1], i8)", forceinline=True)
def fill(
    between: Array, count: int, h: float, axes_sd_rad: float, wider: Array, sigma_out: Array, i: int
) -> None:
    """Write sigmas (9,) of the `count` samples before row i of `sigma_out` (9 m,), h = H."""
    first, now, whole = between[:ENTRIES], between[ENTRIES:], between[2 * ENTRIES :]
    for row in range(count):
        kept = between[WAITING + ROW * row : WAITING + ROW * (row + 1)]
        share = (kept[ROW - 1] / h) ** 2
        for j in range(ENTRIES):
            kept[j] += first[j] + share * (now[j] - first[j] - whole[j])
        at = 9 * (i - count + row)
        out = sigma_out[at : at + 9]
        sigmas_of(kept, kept[ENTRIES:], axes_sd_rad, out)
        widen(wider, out)
