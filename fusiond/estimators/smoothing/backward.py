r"""Fixed-interval smoothing: back over a filter's nodes (modified Bryson-Frazier form).

From the last node, where lambda = 0 and Lambda = 0, back to the first; over the rows of a node in
reverse order, and over the transition to it:

    lambda <- lambda + h^T (nu / s - k^T lambda)
    Lambda <- (I - k h)^T Lambda (I - k h) + h^T h / s
            = Lambda + h^T w + w^T h,   w = (1 / s + k^T Lambda k) h / 2 - k^T Lambda
    lambda <- Phi^T lambda,   Lambda <- Phi^T Lambda Phi

Before the rows of a node are gone back over, the smoothed error of the state after them and its
covariance are

    dx_s = dx + P lambda,   P_s = P - P Lambda P

It is the smoother of Rauch, Tung and Striebel in another form (a test holds them against each
other). The form needs no inverse of P, so states that are held or known exactly cause no problem.
It does not depend on the reason why P grew, so a gap of the IMU or a doubt needs no special case.
It uses the filter's own innovations, so feedback needs none, either: lambda gives the error
relative to the filter's navigation state at that time, and if that state jumps by a fed back
estimate f, dx_s jumps by f, too.

The published state is by the receiver's clock (fusiond.estimators.published_state): with d = dx_s,
the navigation state v, C, acceleration a and rate w, and tau the offset,

    D_p = d_r + tau d_v - v d_tau + d_v d_tau,   D_v = d_v - a d_tau,   D_phi = d_phi + C w d_tau

Between nodes D and the variances are interpolated linearly
(fusiond.estimators.smoothing.node_recorder). As an update lowers every variance and process noise
is never negative, a smoothed sigma is at most the filter's, apart from the interpolation: the
smaller of the two is used.

Source: Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 18 (1973), 65;
Bryson, Frazier, Smoothing for linear and nonlinear dynamic systems, ASD-TDR-63-119 (1963);
Rauch, Tung, Striebel, AIAA Journal 3 (1965), 1445.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.published_state import Published, sigmas
from fusiond.estimators.smoothing.node import PUBLISHED, Nodes, links
from fusiond.estimators.update import feed_back
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    NAV_SIZE,
    STEP_DCM,
    STEP_RATE_B,
    STEP_SMOOTH_N,
    VN,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Smoothed(NamedTuple):
    """Smoothed nodes (m): `error` (m, 10) after the node's rows, navigation errors and offset in
    time, and its `covariance` (m, 10, 10); the correction of the published solution `before` and
    `after` the node's feedback (m, 9) and its `variance` (m, 9): position, velocity, roll, pitch,
    yaw."""

    t_ns: Indices
    error: Array
    covariance: Array
    before: Array
    after: Array
    variance: Array

    @property
    def corrections(self) -> Corrections:
        """Corrections of solutions between the nodes."""
        return Corrections(self.t_ns, self.before, self.after, self.variance)


class Corrections(NamedTuple):
    """Corrections from `Smoothed`, by the same names."""

    t_ns: Indices
    before: Array
    after: Array
    variance: Array


def joined(parts: Sequence[Corrections]) -> Corrections:
    """Successive ones as one."""
    return Corrections(
        np.concatenate([part.t_ns for part in parts]),
        np.concatenate([part.before for part in parts]),
        np.concatenate([part.after for part in parts]),
        np.concatenate([part.variance for part in parts]),
    )


@compiled("void(f8[::1], f8[::1], f8, f8[::1], f8[::1])", forceinline=True)
def _published(d: Array, nav: Array, tau: float, step: Array, out: Array) -> None:
    """Write the correction `out` (9,) of the published solution for the error `d` (10,)."""
    late = d[CORE_SIZE]
    for i in range(3):
        a = step[STEP_SMOOTH_N + i]
        if i == 2:
            a += gravity(nav[LAT], nav[HEIGHT])
        v = nav[VN + i]
        turn = 0.0
        for j in range(3):
            turn += step[STEP_DCM + 3 * i + j] * step[STEP_RATE_B + j]
        out[i] = d[i] + turn * late
        out[3 + i] = d[3 + i] - a * late
        out[6 + i] = d[6 + i] + tau * d[3 + i] - v * late + d[3 + i] * late


@compiled(
    "void(f8[:, ::1], f8[:, ::1], i8[::1], i8[:, ::1], i8, f8, f8, f8[::1], f8[:, ::1], f8[:, ::1],"
    "f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def _back(
    bodies: Array,
    ops: Array,
    counts: Indices,
    pairs: Indices,
    time_slot: int,
    clock_sd_s: float,
    axes_sd_rad: float,
    lam: Array,
    big: Array,
    error: Array,
    covariance: Array,
    before: Array,
    after: Array,
    variance: Array,
) -> None:
    """Run backward over nodes with `lam` (n,) and `big` (n, n), lambda and Lambda, in place; write
    the arrays of `Smoothed`. fusiond.estimators.smoothing.node defines a body's layout."""
    n, count = lam.shape[0], pairs.shape[1]
    g, turned = np.empty(n), np.empty((n, n))
    half = np.empty((PUBLISHED, n))
    nav, sd, d = np.empty(NAV_SIZE), np.empty(9), np.empty(PUBLISHED)
    row = ops.shape[0]
    for m in range(bodies.shape[0] - 1, -1, -1):
        body = bodies[m]
        p = body[: PUBLISHED * n].reshape(PUBLISHED, n)
        rest = body[PUBLISHED * n :]
        phi = rest[: CORE_SIZE * n].reshape(CORE_SIZE, n)
        rest = rest[CORE_SIZE * n :]
        diagonal, linked, rest = rest[:n], rest[n : n + count], rest[n + count :]
        kept, fed_back = rest[:PUBLISHED], rest[PUBLISHED : 2 * PUBLISHED]
        rest = rest[2 * PUBLISHED :]
        nav[:] = rest[:NAV_SIZE]
        tau, step = rest[NAV_SIZE], rest[NAV_SIZE + 1 :]
        # What is known here of all there is.
        for i in range(PUBLISHED):
            total = kept[i]
            for j in range(n):
                half[i, j] = 0.0
            for k in range(n):
                c = p[i, k]
                if c != 0.0:
                    total += c * lam[k]
                    for j in range(n):
                        half[i, j] += c * big[k, j]
            d[i] = total
            error[m, i] = total
        for i in range(PUBLISHED):
            for j in range(i + 1):
                total = p[i, j if j < CORE_SIZE else max(time_slot, 0)]
                for k in range(n):
                    total -= half[i, k] * p[j, k]
                covariance[m, i, j] = total
                covariance[m, j, i] = total
            covariance[m, i, i] = max(0.0, covariance[m, i, i])
        _published(d, nav, tau, step, after[m])
        slot = CORE_SIZE if time_slot >= 0 else -1
        sigmas(covariance[m], nav, step, slot, clock_sd_s, axes_sd_rad, sd)
        for i in range(9):
            variance[m, i] = sd[i] * sd[i]
        # As it was before the feedback f: nav + f, tau - f, dx_s + f.
        for i in range(PUBLISHED):
            d[i] += fed_back[i]
        for i in range(3):
            nav[VN + i] += fed_back[3 + i]
        _published(d, nav, tau - fed_back[CORE_SIZE], step, before[m])
        # Back over the measurements.
        for _ in range(counts[m]):
            row -= 1
            h, gain = ops[row, :n], ops[row, n : 2 * n]
            s, nu = ops[row, 2 * n], ops[row, 2 * n + 1]
            along, bent = 0.0, 1.0 / s
            for i in range(n):
                g[i] = 0.0
                along += gain[i] * lam[i]
            for i in range(n):
                c = gain[i]
                for j in range(n):
                    g[j] += c * big[i, j]
            for i in range(n):
                bent += gain[i] * g[i]
            # Lambda - h^T g - g^T h + bent h^T h, symmetric, as h^T w + w^T h.
            for i in range(n):
                g[i] = 0.5 * bent * h[i] - g[i]
            for i in range(n):
                c = h[i]
                if c == 0.0:
                    continue
                lam[i] += c * (nu / s - along)
                for j in range(n):
                    big[i, j] += c * g[j]
                for j in range(n):
                    big[j, i] += c * g[j]
        # And over the transition: turned = Lambda Phi, then Phi^T times that.
        for i in range(n):
            for j in range(n):
                turned[i, j] = big[i, j] * diagonal[j]
            for j in range(CORE_SIZE):
                turned[i, j] = 0.0
            for k in range(CORE_SIZE):
                c = big[i, k]
                for j in range(n):
                    turned[i, j] += c * phi[k, j]
            for k in range(count):
                turned[i, pairs[1, k]] += big[i, pairs[0, k]] * linked[k]
        for i in range(n):
            c = diagonal[i] if i >= CORE_SIZE else 0.0
            g[i] = c * lam[i]
            for j in range(n):
                big[i, j] = c * turned[i, j]
        for k in range(CORE_SIZE):
            for i in range(n):
                c = phi[k, i]
                if c != 0.0:
                    g[i] += c * lam[k]
                    for j in range(n):
                        big[i, j] += c * turned[k, j]
        for k in range(count):
            to, of, c = pairs[0, k], pairs[1, k], linked[k]
            g[of] += c * lam[to]
            for j in range(n):
                big[of, j] += c * turned[to, j]
        for i in range(n):
            lam[i] = g[i]
            for j in range(i):
                mean = 0.5 * (big[i, j] + big[j, i])
                big[i, j] = mean
                big[j, i] = mean


class Smoother:
    """Smoother that runs backward over the nodes of one start, block by block.

    Clock and axes are those by which the start was `published`.
    """

    def __init__(self, model: Model, published: Published) -> None:
        self._links, self._published = links(model), published
        self._lambda, self._capital = np.zeros(model.size), np.zeros((model.size, model.size))

    def back(self, nodes: Nodes) -> Smoothed:
        """Smoothed errors at `nodes`, which precede those of the call before."""
        count = len(nodes.t_ns)
        smoothed = Smoothed(
            nodes.t_ns,
            np.empty((count, PUBLISHED)),
            np.empty((count, PUBLISHED, PUBLISHED)),
            np.empty((count, CORE_SIZE)),
            np.empty((count, CORE_SIZE)),
            np.empty((count, 9)),
        )
        _back(
            *(nodes.bodies, nodes.ops, nodes.counts, self._links, *self._published),
            *(self._lambda, self._capital),
            *smoothed[1:],
        )
        return smoothed


@compiled(
    "i8(i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def correct(
    t_ns: Indices,
    before: Array,
    after: Array,
    variance: Array,
    times: Indices,
    nav: Array,
    sigma: Array,
) -> int:
    """Correct recorded solutions `nav` (r, 10) and `sigma` (r, 9) at `times` (r,) ns, ascending, in
    place, by smoothed nodes (m,); the number corrected: those not later than the last node. A
    solution at a node's instant is the one before the node."""
    done, node, empty, d = 0, 1, np.empty(0), np.empty(CORE_SIZE)
    for row in range(times.shape[0]):
        while node < t_ns.shape[0] and t_ns[node] < times[row]:
            node += 1
        if node >= t_ns.shape[0]:
            break
        w = (times[row] - t_ns[node - 1]) / (t_ns[node] - t_ns[node - 1])
        for i in range(CORE_SIZE):
            d[i] = (1.0 - w) * after[node - 1, i] + w * before[node, i]
        feed_back(nav[row], empty, d)
        for i in range(9):
            v = (1.0 - w) * variance[node - 1, i] + w * variance[node, i]
            sigma[row, i] = min(sigma[row, i], math.sqrt(v))
        done = row + 1
    return done
