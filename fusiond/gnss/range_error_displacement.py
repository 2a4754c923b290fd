r"""Displacement of the antenna's position by slowly varying range errors.

Errors of orbits, clocks, group delays and the residual ionosphere last for many minutes, different
for each satellite: e_k of variance v_k; others are common to the whole sky, s_k n. A filter that
treats both as new at each epoch solves for position and clock with the weights of an epoch, R + S
S^T, and its solution has the lasting error

    b = G (e + S n),     G = first three rows of (A^T R^-1 A + L)^-1 A^T R^-1,   A = [H  S]
    B = cov(b) = G V G^T + (G S)(G S)^T,      b = K t,  K = B^1/2 symmetric,  t ~ N(0, I)

H = [-u 1_system], u unit vectors to the satellites north, east, down, R the variance of a range
including lasting errors, L the prior information on position (30 m), on common errors (their unit
variance), and none on the clock. Its offset is solved from the same ranges, so that a delay of the
whole sky enters clock and height together. A clock known to 1 m would wrongly cancel half of it:
the longer ranges of low satellites raise the position, a later clock lowers it (10 satellites with
1 m of unknown ionosphere at the zenith: 0.9 m downwards instead of 2.3). So u . K t is the part of
the errors that acts as a displacement: all of them with four satellites, whose geometry amplifies
it, and few with thirty.

If the sky changes, a before and b after, the displacement stays and grows by the unknown part V_k
of the satellites' levels (fusiond.gnss.range_bias_filter),

    K_b t_b = K_a t_a + sum_k (G_b,k - G_a,k) eps_k + (G_b S'_b - G_a S'_a) n,    var(eps_k) = V_k

with the gains G by V_k + (0.2 m)^2, 0 for an absent satellite, and S' = S (V / v)^1/2: levels also
contain the common errors. Here the clock is known, to a metre, from the sky before. This holds if
levels are known. A new satellite, or one whose delay two carriers have just determined, has unknown
errors, and its sky has another displacement: with C = cov(b_b, b_a) of the gains of K,

    C = G_b E G_a^T + (G_b S_b) (G_a S_a)^T,  E the lesser v_k of both,  b_b = C B_a^-1 b_a + w

weighted by the larger of the fresh satellites' share and the mean V / v. With b_b = b_a alone a
position started by four satellites would keep their sigma for half an hour under any later sky. A
filter that lets K grow without added noise would estimate t from the changes of ranges when
satellites disappear, and be too sure of its position.

Source: Groves, 2nd edition, 9.4.1 (G), 3.2.4 (Markov processes), B.2 of Bar-Shalom et al. (2001).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fusiond.gnss import range_kernel as rk
from fusiond.gnss.ranges import Rows
from fusiond.navigation.compiled import compiled

Array = npt.NDArray[np.float64]

PLACE_M, FREE_M, CLOCK_M = 30.0, 1e3, 1.0
"""Sigmas before the epoch of the position (an inertial unit over a minute), of the clock, and of
the clock since the previous sky: a crystal with a random walk of 0.1 m by the root of a second,
over a hundred."""
SHARED = (rk.COMMON, rk.TROPOSPHERE_SIGMA, rk.BEIDOU_2_SIGMA)
"""Rows of S. What a receiver delays BeiDou-2 more has a state that lasts: no displacement is of
it."""
PER_SIGMA = np.array([1.0 / 0.5, 1.0 / 0.5, 1.0 / 1.0])
"""Displacement for the default sigmas `bias_sd_m` and `bias_down_sd_m`: that of a sky of eight
satellites, scaled to the present sky."""
INCONSISTENT_M = 5.0 * 2.0 * PLACE_M
"""Largest difference of two ranges' errors: five sigma of such a position, between opposite
satellites."""
FRESH = 0.7
"""A satellite tells anew where it is known that its errors have so much less variance: a sixth less
of sigma."""
LEAST_M = 1e-3
"""Least K along an axis (m); a sky with less displaces nothing and ends the state."""
FLOOR_M = 0.2
"""Noise of a range over a minute, which bounds a satellite's weight."""
HOLDS_S = 30.0
"""A satellite of a MEO moves by a quarter of a degree."""
FLICKERS_S = 3.0
"""Time within which satellites that disappear and return belong to one sky, with unchanged errors.
"""


@compiled("i8(f8[:, ::1], i8[::1], b1[::1])")
def plausible(values: Array, clock: npt.NDArray[np.int64], marked: npt.NDArray[np.bool_]) -> int:
    """Mark satellites (n,) whose ranges agree with others of their clock; return the number of the
    rest.

    A range disagrees if it differs by `INCONSISTENT_M` from more than half of the others. It will
    be gated, so the displacement is that of the other ranges."""
    n, odd = clock.shape[0], 0
    for k in range(n):
        own = values[rk.CORRECTED, k] - values[rk.RANGE, k]
        unlike = others = 0
        for j in range(n):
            if j != k and clock[j] == clock[k]:
                others += 1
                unlike += abs(values[rk.CORRECTED, j] - values[rk.RANGE, j] - own) > INCONSISTENT_M
        marked[k] = others < 2 or 2 * unlike <= others
        odd += not marked[k]
    return odd


@compiled("void(f8[:, ::1], i8)", forceinline=True)
def _invert(a: Array, m: int) -> None:
    """Invert a positive definite matrix (m, m) in place by Gauss-Jordan elimination."""
    for p in range(m):
        pivot = 1.0 / a[p, p]
        a[p, p] = 1.0
        for j in range(m):
            a[p, j] *= pivot
        for i in range(m):
            if i != p:
                f = a[i, p]
                a[i, p] = 0.0
                for j in range(m):
                    a[i, j] -= f * a[p, j]


@compiled("void(f8[:, ::1], f8[:, ::1])", allocates=True)
def roots(b: Array, out: Array) -> None:
    """Write (6, 3): the symmetric root of B (3, 3) and its inverse, in directions in which B is not
    nearly 0."""
    a, v = b.copy(), np.eye(3)
    for _ in range(12):  # Jacobi's rotations, exact to rounding after the third round
        if a[0, 1] == 0.0 and a[0, 2] == 0.0 and a[1, 2] == 0.0:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                half = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(half) + math.sqrt(1.0 + half * half))
                if half < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
    for i in range(3):
        for j in range(3):
            out[i, j] = out[3 + i, j] = 0.0
            for k in range(3):
                root = math.sqrt(max(a[k, k], 0.0))
                out[i, j] += v[i, k] * root * v[j, k]
                if root > LEAST_M:
                    out[3 + i, j] += v[i, k] / root * v[j, k]


@compiled(
    "void(f8[:, ::1], i8[::1], i8, f8[::1], f8[::1], f8, f8[:, ::1], f8[:, ::1])", allocates=True
)
def displace(
    values: Array,
    clock: npt.NDArray[np.int64],
    clocks: int,
    noise: Array,
    variance: Array,
    clock_m: float,
    effect: Array,
    out: Array,
) -> None:
    """Write the displacement by errors of `variance` (n,) of ranges with weights by `noise` (n,),
    and its roots.

    `effect` (3, n + 2): G and G S by rows' `values`; `out` (6, 3): K and its inverse.

    `clock` (n,): index of each range's clock offset, below `clocks`; each offset is known to
    `clock_m`.
    """
    n, shared = clock.shape[0], 3 + clocks
    m = shared + len(SHARED)
    normal, rows = np.zeros((m, m)), np.zeros((n, m))
    for i in range(m):
        known = PLACE_M if i < 3 else clock_m if i < shared else 1.0
        normal[i, i] = 1.0 / (known * known)
    for k in range(n):
        row = rows[k]
        row[0], row[1] = -values[rk.NORTH, k], -values[rk.EAST, k]
        row[2], row[3 + clock[k]] = math.sin(values[rk.ELEVATION, k]), 1.0
        for j in range(len(SHARED)):
            row[shared + j] = values[SHARED[j], k]
        w = 1.0 / noise[k]
        for i in range(m):
            for j in range(m):
                normal[i, j] += w * row[i] * row[j]
    _invert(normal, m)
    b = np.zeros((3, 3))
    for i in range(3):
        effect[i, n] = effect[i, n + 1] = 0.0
        for k in range(n):
            g = 0.0
            for j in range(m):
                g += normal[i, j] * rows[k, j]
            effect[i, k] = g / noise[k]
            effect[i, n] += effect[i, k] * values[rk.COMMON, k]
            effect[i, n + 1] += effect[i, k] * values[rk.TROPOSPHERE_SIGMA, k]
    for i in range(3):
        for j in range(3):
            for k in range(n):
                b[i, j] += effect[i, k] * effect[j, k] * variance[k]
            for k in (n, n + 1):
                b[i, j] += effect[i, k] * effect[j, k]
    roots(b, out)


class Displacement(NamedTuple):
    """Displacement by a sky at `t_s` (GPS time): `effect` (3, n + 2) of its satellites and of the
    two common errors, `variance` (n,) m^2 of unknown lasting errors, `root` (3, 3) K and `back` (3,
    3) its inverse, m, `shape` (3, 3) K by the sigmas of the filter's states; `gain` (3, n + 2) as
    `effect`, with the weights of K, `lasting` (n,) m^2 of all lasting errors; by satellite the
    lasting (m^2) and common (m) errors used for its position, and `fresh` ones."""

    t_s: float
    satellites: tuple[str, ...]
    effect: Array
    variance: Array
    root: Array
    back: Array
    shape: Array
    gain: Array
    lasting: Array
    counted: dict[str, tuple[float, float]]
    fresh: tuple[str, ...]

    @classmethod
    def of(
        cls, rows: Rows, t_s: float, variance: Array, before: Displacement | None = None
    ) -> Displacement:
        """Displacement for an epoch's rows, with residual `variance` (n,) m^2 of lasting errors,
        after the sky `before`."""
        n = len(rows.satellites)
        gain, effect = np.empty((3, n + 2)), np.empty((3, n + 2))
        out, left = np.empty((6, 3)), np.empty((6, 3))
        clocks = int(rows.clock.max(initial=0)) + 1
        lasting, of = rows.values[rk.LASTING].copy(), (rows.values, rows.clock, clocks)
        noise = rows.values[rk.VARIANCE] - variance + lasting
        # With fewer satellites than unknowns the clock keeps its prior: a free clock would use up a
        # direction of the position that the previous sky's displacement covers.
        free = FREE_M if n >= 3 + clocks else CLOCK_M
        displace(*of, noise, lasting, free, gain, out)
        unknown = variance + FLOOR_M**2
        displace(*of, unknown, unknown, CLOCK_M, effect, left)
        known = np.sqrt(variance / rows.values[rk.LASTING])
        for j, row in enumerate((rk.COMMON, rk.TROPOSPHERE_SIGMA)):
            effect[:, n + j] = (effect[:, :n] * (known * rows.values[row])).sum(axis=1)
        root, counted = out[:3], {} if before is None else before.counted.copy()
        fresh: list[str] = []
        common = rows.values[rk.COMMON].tolist()
        for name, *errors in zip(rows.satellites, lasting.tolist(), common, strict=True):
            was = counted.get(name)
            if was is None or errors[0] + errors[1] ** 2 < FRESH * (was[0] + was[1] ** 2):
                counted[name] = errors[0], errors[1]
                fresh.append(name)
        return cls(
            *(t_s, rows.satellites, effect, variance, root, out[3:], root * PER_SIGMA),
            *(gain, lasting, counted, tuple(fresh)),
        )

    def holds(self, rows: Rows, t_s: float) -> bool:
        """True if the rows have the same satellites within its validity."""
        same = rows.satellites == self.satellites
        return 0.0 <= t_s - self.t_s < (HOLDS_S if same else FLICKERS_S)

    def carried(self, before: Displacement) -> tuple[Array, Array]:
        """Transition R (3, 3) and noise covariance cov(w) (3, 3) from the sky `before`."""
        n, last = len(self.satellites), len(before.satellites)
        moved: dict[str, Array] = {}
        left: dict[str, float] = {}
        for k, name in enumerate(self.satellites):
            moved[name], left[name] = self.effect[:, k].copy(), float(self.variance[k])
        for k, name in enumerate(before.satellites):
            moved[name] = moved.get(name, 0.0) - before.effect[:, k]
            left.setdefault(name, float(before.variance[k]))
        new = np.zeros((3, 3))
        for name, g in moved.items():
            new += left[name] * np.multiply.outer(g, g)
        for k in range(2):
            g = self.effect[:, n + k] - before.effect[:, last + k]
            new += np.multiply.outer(g, g)
        kept: Array = _times(self.back, before.root)
        new = _times(_times(self.back, new), self.back)
        if not self.fresh:
            return kept, new
        # Covariance of the previous sky's displacement, and its covariance with this one.
        own, both = np.zeros((3, 3)), np.zeros((3, 3))
        shared = before.gain[:, last:].copy()
        shared[:, 0] = 0.0
        at = {name: k for k, name in enumerate(self.satellites)}
        unknown: list[float] = []
        for j, name in enumerate(before.satellites):
            lasting, common = before.counted[name]
            own += lasting * np.multiply.outer(before.gain[:, j], before.gain[:, j])
            shared[:, 0] += common * before.gain[:, j]
            if name in at:
                k = at[name]
                same = min(float(self.lasting[k]), lasting)
                both += same * np.multiply.outer(self.gain[:, k], before.gain[:, j])
                unknown.append(float(self.variance[k] / self.lasting[k]))
        for k in range(2):
            own += np.multiply.outer(shared[:, k], shared[:, k])
            both += np.multiply.outer(self.gain[:, n + k], shared[:, k])
        out = np.empty((6, 3))
        roots(own, out)
        correlation = _times(_times(self.back, both), out[3:])
        drawn = np.eye(3) - _times(correlation, correlation.T)
        regression = _times(_times(correlation, out[3:]), before.root)
        part = max(len(self.fresh) / n, sum(unknown) / max(len(unknown), 1))
        return kept + part * (regression - kept), new + part * (drawn - new)


def _times(a: Array, b: Array) -> Array:
    """A B (3, 3), in one order of operations on all machines."""
    found: Array = (a[:, :, None] * b[None, :, :]).sum(axis=1)
    return found
