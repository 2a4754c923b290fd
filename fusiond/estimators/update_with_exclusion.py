r"""Compiled kernel: update with many rows of which some may be wrong (pseudoranges).

Each row is judged twice, both times against a chi-square quantile with one degree of freedom:

    before   nu^2 / (h P h^T + r)                      its own gate, independent of the others
    after    v^2 / (r - h P+ h^T),  v = z - h dx+      the residual test of the update

The residual's variance follows from v = (I - H K) nu; its square over that variance is the
statistic of excluding the row (Teunissen, Testing Theory, 2006, section 4.4: the w-test). While the
largest fails, that row is excluded and the update repeated. The order of the rows does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised
from fusiond.models.blocks import CLOCK_OFFSET
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

# What became of a row.
KEPT, GATED, RESIDUAL = 0, 1, 2
# A residual whose variance is this small a part of r tells nothing: the row alone determines a
# state.
_DETERMINED = 1e-6
# Ranges that must fail together before the receiver's clock is to blame, not as many satellites.
FEWEST_JUMPING = 3


@compiled("i8(f8[:, ::1], b1[:, ::1], i8[::1], i8[::1], i8[:, ::1], f8[:, ::1])")
def _grouped(
    h: Array, used: NDArray[np.bool_], begin: Codes, counts: Codes, columns: Codes, values: Array
) -> int:
    """Find groups of successive rows of h (m, n) with nearly the same states; their number.

    Group k has the rows from `begin[k]` to `begin[k + 1]` and measures `counts[k]` states, whose
    slots are `columns[k]` in their order; `values[p]` (m,) are the rows' entries for the p-th state
    of their group. `used` (m + 1, n) is work space. A row starts a new group if more than a quarter
    of its states are new.
    """
    m, n = h.shape
    groups = 0
    marks = used[0]
    for i in range(n):
        marks[i] = False
    for a in range(m):
        row = h[a]
        own = new = 0
        for i in range(n):
            there = row[i] != 0.0
            own += there
            new += there & (not marks[i])
        if a == 0 or 4 * new > own:
            begin[groups] = a
            marks = used[groups]
            groups += 1
            for i in range(n):
                marks[i] = row[i] != 0.0
        elif new > 0:
            for i in range(n):
                marks[i] |= row[i] != 0.0
    begin[groups] = m
    for k in range(groups):
        count = 0
        rows = h[begin[k] : begin[k + 1]]
        for i in range(n):
            if used[k, i]:
                columns[k, count] = i
                of_state = values[count, begin[k] : begin[k + 1]]
                for a in range(of_state.shape[0]):
                    of_state[a] = rows[a, i]
                count += 1
        counts[k] = count
    return groups


@compiled(
    "void(f8[:, ::1], f8[::1], f8[::1], f8[::1], f8, i8, i8[::1], i8[::1], i8[:, ::1], f8[:, ::1],"
    "f8[::1], f8[::1], f8[::1])"
)
def _residuals(
    cov: Array,
    dx: Array,
    z: Array,
    r: Array,
    sign: float,
    groups: int,
    begin: Codes,
    counts: Codes,
    columns: Codes,
    values: Array,
    work: Array,
    residual: Array,
    variance: Array,
) -> None:
    """Write residual and variance of every row (m,): z - h dx and r + h P h^T; r - h P h^T with a
    `sign` of -1."""
    for k in range(groups):
        own, first, last = columns[k], begin[k], begin[k + 1]
        v, s, t = residual[first:last], variance[first:last], work[first:last]
        z_k, r_k = z[first:last], r[first:last]
        for a in range(s.shape[0]):
            v[a], s[a] = z_k[a], r_k[a]
        for p in range(counts[k]):
            i = own[p]
            c = values[p, first:last]
            for a in range(s.shape[0]):
                v[a] -= c[a] * dx[i]
                t[a] = 0.5 * c[a] * cov[i, i]
            for q in range(p):
                common, d = cov[i, own[q]], values[q, first:last]
                for a in range(s.shape[0]):
                    t[a] += d[a] * common
            for a in range(s.shape[0]):
                s[a] += sign * 2.0 * c[a] * t[a]


@compiled("void(f8[:, ::1], i8, f8[:, ::1])", forceinline=True)
def _take_off(cov: Array, i: int, g: Array) -> None:
    """Subtract g^T g, of `g` (k, w), from row `i` of `cov`: four rows in one pass, in their
    order."""
    row, width, fours = cov[i], cov.shape[0], g.shape[0] // 4
    for q in range(fours):
        g0, g1, g2, g3 = g[4 * q], g[4 * q + 1], g[4 * q + 2], g[4 * q + 3]
        c0, c1, c2, c3 = g0[i], g1[i], g2[i], g3[i]
        for j in range(width):
            row[j] = row[j] - c0 * g0[j] - c1 * g1[j] - c2 * g2[j] - c3 * g3[j]
    for b in range(4 * fours, g.shape[0]):
        g0, c0 = g[b], g[b, i]
        for j in range(width):
            row[j] -= c0 * g0[j]


@compiled(
    "f8(f8[::1], f8[::1], i8[::1], i8, i8[::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[:, ::1],"
    "i8[::1], f8[::1], f8[:, ::1], f8[::1])"
)
def _fold_in(
    z: Array,
    r: Array,
    codes: Codes,
    groups: int,
    begin: Codes,
    counts: Codes,
    columns: Codes,
    values: Array,
    g: Array,
    taken: Codes,
    y: Array,
    cov: Array,
    dx: Array,
) -> float:
    """Fold the rows that are KEPT, one after another, into `cov` and `dx`, in place; y and the
    result as in `screened_update`.

    The factors that rows subtract from P go to `g` (m + 1, w) behind a row of zeros; `taken` (n,)
    counts those already subtracted from each row of P: rows of P outside the group wait until a
    group measures them, and the last factor is subtracted in the pass that reads P for the next.
    """
    n, width = dx.shape[0], cov.shape[0]
    nis = 0.0
    last = 0
    for j in range(width):
        g[0, j] = 0.0
    for i in range(n):
        taken[i] = 0
    for k in range(groups):
        own, count = columns[k], counts[k]
        for p in range(count):
            _take_off(cov, own[p], g[taken[own[p]] : last])
        for a in range(begin[k], begin[k + 1]):
            y[a] = 0.0
            if codes[a] != KEPT:
                continue
            u, before = g[last + 1], g[last]
            last += 1
            innovation = z[a]
            for p in range(count):
                innovation -= values[p, a] * dx[own[p]]
            for j in range(width):
                u[j] = 0.0
            for q in range(count // 2):
                i0, i1 = own[2 * q], own[2 * q + 1]
                c0, c1 = values[2 * q, a], values[2 * q + 1, a]
                b0, b1, p0, p1 = before[i0], before[i1], cov[i0], cov[i1]
                for j in range(width):
                    x0, x1 = p0[j] - b0 * before[j], p1[j] - b1 * before[j]
                    p0[j], p1[j] = x0, x1
                    u[j] = u[j] + c0 * x0 + c1 * x1
            if count % 2:
                i0, c0 = own[count - 1], values[count - 1, a]
                b0, p0 = before[i0], cov[i0]
                for j in range(width):
                    x0 = p0[j] - b0 * before[j]
                    p0[j] = x0
                    u[j] += c0 * x0
            s, spread = r[a], 0.0
            for p in range(count):
                common = values[p, a] * u[own[p]]
                s += common
                spread += common
            y[a] = innovation / math.sqrt(s)
            nis += y[a] * y[a]
            gain = innovation / s
            for i in range(n):
                dx[i] += u[i] * gain
            # Joseph form of one row with the gain u / s: what it takes away is
            # (1 + (s - h u - r) / s) u u^T / s, a square of its root.
            root = math.sqrt((1.0 + (s - spread - r[a]) / s) / s)
            for i in range(width):
                u[i] *= root
        for p in range(count):
            taken[own[p]] = last
    for i in range(n):
        _take_off(cov, i, g[taken[i] : last + 1])
    return nis


@compiled(
    "f8(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, i8[::1], f8[::1], f8[:, ::1],"
    "f8[::1])",
    allocates=True,
)
def screened_update(
    cov: Array,
    dx: Array,
    z: Array,
    h: Array,
    r: Array,
    threshold: float,
    codes: Codes,
    y: Array,
    cov_out: Array,
    dx_out: Array,
) -> float:
    """Fold the rows z = h dx + noise (variances r) that pass into `cov_out` and `dx_out`.

    cov and cov_out (w, w) symmetric, dx and dx_out (n,), z, r, y (m,), h (m, n). `codes` (m,)
    receives the outcome of each row; rows not KEPT at the call are excluded from the start. y[a] is
    the whitened innovation of a kept row, 0 otherwise. Returns the sum of their squares, nu^T S^-1
    nu.
    """
    m, n = h.shape
    width = cov.shape[0]
    begin, counts = np.empty(m + 1, dtype=np.int64), np.empty(m, dtype=np.int64)
    columns, used = np.empty((m, n), dtype=np.int64), np.empty((m + 1, n), dtype=np.bool_)
    values, g, taken = np.empty((n, m)), np.empty((m + 1, width)), np.empty(n, dtype=np.int64)
    work, residual, variance = np.empty(m), np.empty(m), np.empty(m)
    groups = _grouped(h, used, begin, counts, columns, values)
    _residuals(
        *(cov, dx, z, r, 1.0, groups, begin, counts, columns, values),
        *(work, residual, variance),
    )
    for a in range(m):
        if codes[a] == KEPT and not residual[a] * residual[a] <= threshold * variance[a]:
            codes[a] = GATED
    while True:
        for i in range(width):
            for j in range(width):
                cov_out[i, j] = cov[i, j]
        for i in range(n):
            dx_out[i] = dx[i]
        nis = _fold_in(
            *(z, r, codes, groups, begin, counts, columns, values),
            *(g, taken, y, cov_out, dx_out),
        )
        _residuals(
            *(cov_out, dx_out, z, r, -1.0, groups, begin, counts, columns, values),
            *(work, residual, variance),
        )
        worst, greatest = -1, threshold
        for a in range(m):
            if (
                codes[a] == KEPT
                and variance[a] > _DETERMINED * r[a]
                and residual[a] * residual[a] > greatest * variance[a]
            ):
                worst, greatest = a, residual[a] * residual[a] / variance[a]
        if worst < 0:
            return nis
        codes[worst] = RESIDUAL


def jumped(codes: Codes, h: Array, offsets: Sequence[int]) -> bool:
    """True if the better half of the ranges fails.

    `codes` (m,) and `h` (m, n) of the rows; `offsets` are the slots of the clock's offsets."""
    if np.count_nonzero(codes) < FEWEST_JUMPING:  # KEPT is 0
        return False
    # One in a range, nothing in a rate: nothing up to the rounding of sigma points.
    ranges = (np.abs(h[:, offsets]) > 0.5).any(axis=1)
    lost = np.count_nonzero(codes[ranges])
    return bool(lost >= FEWEST_JUMPING and 2 * lost > np.count_nonzero(ranges))


class Screened(NamedTuple):
    """An update by rows: `codes` (m,), whitened `y` (m,), nu^T S^-1 nu, and P and dx after it."""

    codes: Codes
    y: Array
    nis: float
    cov: Array
    dx: Array


def screened(
    measurement: Linearised, rows: Innovation, model: Model, threshold: float, cov: Array, dx: Array
) -> Screened:
    """Update by rows of a screened measurement, without changing `cov` and `dx`.

    A receiver that resets its clock moves all ranges at once. If it reports that, or if the better
    half of the ranges fails while the rates pass, the clock offset restarts, in `cov` too, and the
    rows are judged again.
    """
    z, h, r = rows
    offsets = model.slots_of(CLOCK_OFFSET)
    renew = bool(offsets) and bool(getattr(measurement, "clock_reset", False))
    while True:
        if renew:
            cov[offsets] = 0.0
            cov[:, offsets] = 0.0
            cov[offsets, offsets] = model.initial[offsets] ** 2
        codes, y = np.zeros(z.shape[0], dtype=np.int64), np.empty(z.shape[0])
        cov_out, dx_out = np.empty_like(cov), np.empty_like(dx)
        nis = screened_update(cov, dx, z, h, r, threshold, codes, y, cov_out, dx_out)
        if renew or not offsets or not jumped(codes, h, offsets):
            return Screened(codes, y, nis, cov_out, dx_out)
        renew = True
