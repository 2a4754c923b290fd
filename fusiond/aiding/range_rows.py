"""Compiled kernels of `fusiond.aiding.pseudorange`: Jacobian, measured values, clock sums."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.carrier_anchor import (
    AHEAD,
    CARRIER_VARIANCE,
    ON_EARTH_M,
    RANGE,
    RANGE_VARIANCE,
    RATE,
    RATE_VARIANCE,
    SHARED,
    SPAN,
    V_NED,
    VX,
    X,
    anchored,
    phase_scale,
    since_anchor,
)
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, STEP_RATE_B, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNUSED_VARIANCE = 1e6
"""Variance (m/s)^2 of an unmeasured rate or of a carrier without an anchor."""


@compiled("void(b1[::1], f8[::1])", forceinline=True)
def _hold(active: NDArray[np.bool_], g: Array) -> None:
    """Zero the row `g` (n,) for navigation errors that are not estimated."""
    for j in range(CORE_SIZE):
        if not active[j]:
            g[j] = 0.0


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], b1[::1], f8[:, ::1], i8[::1], i8[::1], i8[::1],"
    "i8[::1], i8[::1], i8[::1], i8[::1], f8[:, ::1], f8, f8, f8, i8, f8, f8[:, ::1], f8[::1],"
    "f8[::1], f8[:, ::1])"
)
def range_rows(
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    active: NDArray[np.bool_],
    values: Array,
    clock: Indices,
    offsets: Indices,
    drifts: Indices,
    displacement: Indices,
    shared: Indices,
    anchor: Indices,
    carrier: Indices,
    shape: Array,
    l0: float,
    l1: float,
    l2: float,
    rate_row: int,
    ahead_s: float,
    before: Array,
    r: Array,
    z: Array,
    h: Array,
) -> None:
    """Write z (m,), r (m,) and H (m, n), zero before: rows of the finite ranges, then of rates and
    carriers, of which `rate_row` is the first.

    Slots of the clocks' offsets, of their drift, of the displacement, of other shared errors, of
    the carriers' anchor and of their clock; empty if the model has no such state. `before` (SLOTS,
    9): output of the last epoch; `ahead_s`: lead of the epoch's assumed instant on the receiver's
    clock (fusiond.aiding.carrier_anchor). `shape` (3, 3): displacement by a unit of each of its
    states.
    """
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = dcm_elements(nav[Q0:])
    a0 = c00 * l0 + c01 * l1 + c02 * l2
    a1 = c10 * l0 + c11 * l1 + c12 * l2
    a2 = c20 * l0 + c21 * l1 + c22 * l2
    w0, w1, w2 = step[STEP_RATE_B], step[STEP_RATE_B + 1], step[STEP_RATE_B + 2]
    t0, t1, t2 = w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0
    b0 = c00 * t0 + c01 * t1 + c02 * t2
    b1 = c10 * t0 + c11 * t1 + c12 * t2
    b2 = c20 * t0 + c21 * t1 + c22 * t2
    v0, v1, v2 = nav[VN] + b0, nav[VN + 1] + b1, nav[VN + 2] + b2
    sl, cl = math.sin(nav[LAT]), math.cos(nav[LAT])
    so, co = math.sin(nav[LON]), math.cos(nav[LON])
    root = math.sqrt(1.0 - ECCENTRICITY_SQUARED * sl * sl)
    transverse, height = SEMI_MAJOR_M / root, nav[HEIGHT]
    radius_n = transverse + height
    radius_m = transverse * (1.0 - ECCENTRICITY_SQUARED) / (root * root) + height
    x, y = radius_n * cl * co, radius_n * cl * so
    zed = (transverse * (1.0 - ECCENTRICITY_SQUARED) + height) * sl

    begin = end = CORE_SIZE
    for slot in range(column_of.shape[0] - 1, CORE_SIZE - 1, -1):
        if 0 <= column_of[slot] - RATE_ERROR < 3:
            begin, end = slot, max(end, slot + 1)

    ax, ay, az = 0.0, 0.0, 0.0
    cloned = anchor.shape[0] == 3 and carrier.shape[0] == 1
    if cloned:
        ax, ay, az = xi[anchor[0]], xi[anchor[1]], xi[anchor[2]]
        cloned = ax * ax + ay * ay + az * az > ON_EARTH_M * ON_EARTH_M
    scale, late = phase_scale(before), ahead_s - before[0, AHEAD]

    range_row = 0
    for i in range(clock.shape[0]):
        # From the antenna to the satellite, north, east, down.
        e0, e1, e2 = values[X, i] - x, values[X + 1, i] - y, values[X + 2, i] - zed
        m0 = -sl * co * e0 - sl * so * e1 + cl * e2 - a0
        m1 = -so * e0 + co * e1 - a1
        m2 = -cl * co * e0 - cl * so * e1 - sl * e2 - a2
        distance = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        u0, u1, u2 = m0 / distance, m1 / distance, m2 / distance
        if math.isfinite(values[RANGE, i]):
            g = h[range_row]
            innovation = distance - values[RANGE, i]
            g[0], g[1], g[2] = a1 * u2 - a2 * u1, a2 * u0 - a0 * u2, a0 * u1 - a1 * u0
            g[6], g[7], g[8] = -u0, -u1, -u2
            if clock[i] >= 0:
                slot = offsets[clock[i]]
                innovation += xi[slot]
                g[slot] = -1.0
            _hold(active, g)
            for axis in range(displacement.shape[0]):
                along = g[6] * shape[0, axis] + g[7] * shape[1, axis] + g[8] * shape[2, axis]
                g[displacement[axis]] = -along
                innovation += along * xi[displacement[axis]]
            r[range_row] = values[RANGE_VARIANCE, i]
            for k in range(3):
                one = values[SHARED + k, i]
                if shared.shape[0] == 3:
                    g[shared[k]] = -one
                    innovation += one * xi[shared[k]]
                else:
                    r[range_row] += one * one
            z[range_row] = innovation
            range_row += 1
        if cloned and anchored(values, i, before):
            g = h[rate_row]
            there, grown, r[rate_row] = since_anchor(values, i, before, ax, ay, az, scale)
            z[rate_row] = (distance - there) + xi[carrier[0]] - grown
            was = before[0, V_NED:]
            z[rate_row] += late * (u0 * was[0] + u1 * was[1] + u2 * was[2])
            g[0], g[1], g[2] = a1 * u2 - a2 * u1, a2 * u0 - a0 * u2, a0 * u1 - a1 * u0
            g[6], g[7], g[8] = -u0, -u1, -u2
            _hold(active, g)
            g[anchor[0]] = sl * co * u0 + so * u1 + cl * co * u2
            g[anchor[1]] = sl * so * u0 - co * u1 + cl * so * u2
            g[anchor[2]] = sl * u2 - cl * u0
            g[carrier[0]] = -1.0
            rate_row += 1
        elif math.isfinite(values[RATE, i]) or values[SPAN, i] > 0.0:
            g = h[rate_row]
            e0, e1, e2 = values[VX, i], values[VX + 1, i], values[VX + 2, i]
            e0n = -sl * co * e0 - sl * so * e1 + cl * e2
            e1n = -so * e0 + co * e1
            e2n = -cl * co * e0 - cl * so * e1 - sl * e2
            q0, q1, q2 = e0n - v0, e1n - v1, e2n - v2
            along = u0 * q0 + u1 * q1 + u2 * q2
            innovation, r[rate_row] = 0.0, UNUSED_VARIANCE
            if math.isfinite(values[RATE, i]):
                innovation, r[rate_row] = along - values[RATE, i], values[RATE_VARIANCE, i]
            k0 = (along * u0 - q0) / distance
            k1 = (along * u1 - q1) / distance
            k2 = (along * u2 - q2) / distance
            g[0] = b1 * u2 - b2 * u1 + k1 * a2 - k2 * a1
            g[1] = b2 * u0 - b0 * u2 + k2 * a0 - k0 * a2
            g[2] = b0 * u1 - b1 * u0 + k0 * a1 - k1 * a0
            g[3], g[4], g[5] = -u0, -u1, -u2
            # The axes turn by [dr_e, -dr_n R_N / R_M, -dr_e tan(lat)] / R_N.
            p0, p1, p2 = v1 * u2 - v2 * u1, v2 * u0 - v0 * u2, v0 * u1 - v1 * u0
            g[6] = k0 + p1 / radius_m
            g[7] = k1 + (p2 * sl / cl - p0) / radius_n
            g[8] = k2
            # C^T u x l, by axis.
            n0 = c00 * u0 + c10 * u1 + c20 * u2
            n1 = c01 * u0 + c11 * u1 + c21 * u2
            n2 = c02 * u0 + c12 * u1 + c22 * u2
            for slot in range(begin, end):
                axis = column_of[slot] - RATE_ERROR
                if axis == 0:
                    g[slot] = n1 * l2 - n2 * l1
                elif axis == 1:
                    g[slot] = n2 * l0 - n0 * l2
                elif axis == 2:
                    g[slot] = n0 * l1 - n1 * l0
            if clock[i] >= 0:
                innovation += xi[drifts[0]]
                g[drifts[0]] = -1.0
            _hold(active, g)
            z[rate_row] = innovation
            rate_row += 1


# What is wrong with the values of an epoch.
SOUND, VARIANCES, CLOCKS = 0, 1, 2
WRONG = {
    VARIANCES: "variances must be positive and finite",
    CLOCKS: "rates of satellites with and without a clock in one epoch",
}


@compiled("UniTuple(i8, 4)(f8[:, ::1], i8[::1], f8[::1])")
def measured(values: Array, clock: Indices, r: Array) -> tuple[int, int, int, int]:
    """Write the variances r (2 n,) of the finite ranges, then of the finite rates.

    Returns the numbers of ranges, rates and clocks, and an error code."""
    n = clock.shape[0]
    row = finite = timed = clocks = 0
    wrong = SOUND
    for i in range(n):
        clocks = max(clocks, clock[i] + 1)
        if math.isfinite(values[RANGE, i]):
            r[row] = values[RANGE_VARIANCE, i]
            row += 1
    finite = row
    for i in range(n):
        if math.isfinite(values[RATE, i]) or values[SPAN, i] > 0.0:
            r[row] = values[RATE_VARIANCE, i]
            if values[SPAN, i] > 0.0:
                r[row] = values[CARRIER_VARIANCE, i]
            row += 1
            timed += clock[i] >= 0
    if 0 < timed < row - finite:
        wrong = CLOCKS
    for a in range(row):
        if not 0.0 < r[a] < math.inf:
            wrong = VARIANCES
    return finite, row - finite, clocks, wrong


@compiled("i8(f8[:, ::1], i8[::1], u1[::1], f8[::1], f8[:, ::1], i8[::1])")
def by_clock(
    values: Array,
    clock: Indices,
    codes: NDArray[np.uint8],
    whitened: Array,
    sums: Array,
    first: Indices,
) -> int:
    """Sum the innovations of each receiver clock; the number of clocks.

    `sums` (k, 2) takes, for each clock that has both, the sums of its ranges and of its rates of
    `whitened` (m,) whose `codes` (m,) are 0, each over the root of its number; `first` (k,) the
    clocks' first satellites, by which they are ordered."""
    found = 0
    for i in range(clock.shape[0]):
        new = clock[i] >= 0
        for k in range(i):
            new &= clock[k] != clock[i]
        if not new:
            continue
        row, whole = 0, True
        for kind in range(2):
            total, count = 0.0, 0
            for k in range(clock.shape[0]):
                if math.isfinite(values[RANGE + kind, k]) or (kind == 1 and values[SPAN, k] > 0.0):
                    if codes[row] == 0 and clock[k] == clock[i]:
                        total += whitened[row]
                        count += 1
                    row += 1
            sums[found, kind] = total / math.sqrt(max(count, 1))
            whole &= count > 0
        first[found] = i
        found += whole
    return found
