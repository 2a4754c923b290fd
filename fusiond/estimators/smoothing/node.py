r"""Node: a filter's state at an instant, for the smoother.

A node is an instant t_j at which measurements were fused, or one between them if they are far
apart:

    Phi_j   transition of the error state from node j - 1 to node j
    rows    of each scalar measurement at t_j in their order: h, k, s, nu
            u = P h^T,  s = h u + r,  k = u / s,  nu = z - h dx
    P_j     after them, of what is published: the navigation errors and the receiver's offset in
            time; all columns
    dx_j    the error estimate that is kept (zero unless feedback is held back)
    f_j     what was fed back into the navigation state at t_j

and the navigation state, offset and last step, for publication. Process noise and any other growth
of P are in P alone. Of Phi the nine rows of the navigation errors, the diagonal of the parameters'
rows, and `links` are stored; the rest is exactly zero.

All lies in one row of doubles, `body`; the measurements in rows of 2 n + 2, `ops`.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.gyro_error_after_rate_update import gyro_slots
from fusiond.models.blocks import CARRIER_ANCHOR
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, DR, FORCE_ERROR, PHI
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# The navigation errors and the offset in time.
PUBLISHED = CORE_SIZE + 1


class Nodes(NamedTuple):
    """Successive nodes (m): `t_ns` (m,), `bodies` (m, body_size), `counts` (m,) of their rows in
    `ops` (sum of counts, 2 n + 2)."""

    t_ns: Indices
    bodies: Array
    counts: Indices
    ops: Array

    def first(self, count: int) -> Nodes:
        """First `count` nodes."""
        rows = int(self.counts[:count].sum())
        return Nodes(self.t_ns[:count], self.bodies[:count], self.counts[:count], self.ops[:rows])


def links(model: Model) -> Indices:
    """(2, k): rows and columns of what Phi has beside the navigation errors' rows and its diagonal:
    offsets by their rates, a clone by what it is of, and where the axes of a tilt were turned
    (fusiond.estimators.tilt_frame_after_heading_update) a vertical accelerometer's bias by those of
    the others, and each gyro's by the tilt and by those of the others
    (fusiond.estimators.gyro_error_after_rate_update)."""
    down, *others = [model.parameters(FORCE_ERROR + axis) for axis in (2, 0, 1)]
    cloned = (*range(PHI, PHI + 3), *range(DR, DR + 3))
    pairs = [(to, of) for to in model.slots_of(CARRIER_ANCHOR) for of in cloned]
    if down:
        pairs += [(down[0], slot) for slot in (*down[1:], *itertools.chain(*others))]
        gyros = gyro_slots(model).tolist()
        pairs += [(to, of) for to in gyros for of in (PHI, PHI + 1, *gyros) if of != to]
    told = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return np.ascontiguousarray(np.hstack([model.rate_terms, told.T]))


def body_size(size: int, linked: int) -> int:
    """Doubles of a body, for `size` states and so many `links`."""
    of_covariance, of_transition = PUBLISHED * size, CORE_SIZE * size + size + linked
    return of_covariance + of_transition + 2 * PUBLISHED + NAV_SIZE + 1 + STEP_SIZE


@compiled(
    "void(f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i8[:, ::1], i8,"
    "f8[::1])"
)
def write_body(
    cov: Array,
    phi: Array,
    dx: Array,
    fed_back: Array,
    nav: Array,
    xi: Array,
    step: Array,
    pairs: Indices,
    time_slot: int,
    body: Array,
) -> None:
    """Write `body` of P and Phi (width, width), dx and the fed back estimate (n,), nav (10,),
    parameters (n,), step (28,); then reset Phi to the identity and the fed back estimate to zero.
    """
    n = xi.shape[0]
    at = 0
    for i in range(PUBLISHED):
        slot = i if i < CORE_SIZE else time_slot
        for j in range(n):
            body[at + j] = cov[slot, j] if slot >= 0 else 0.0
        at += n
    for i in range(CORE_SIZE):
        for j in range(n):
            body[at + j] = phi[i, j]
        at += n
    for i in range(n):
        body[at + i] = phi[i, i]
    at += n
    for k in range(pairs.shape[1]):
        body[at + k] = phi[pairs[0, k], pairs[1, k]]
    at += pairs.shape[1]
    for i in range(PUBLISHED):
        slot = i if i < CORE_SIZE else time_slot
        body[at + i] = dx[slot] if slot >= 0 else 0.0
        body[at + PUBLISHED + i] = fed_back[slot] if slot >= 0 else 0.0
    at += 2 * PUBLISHED
    for i in range(NAV_SIZE):
        body[at + i] = nav[i]
    at += NAV_SIZE
    body[at] = xi[time_slot] if time_slot >= 0 else 0.0
    for i in range(STEP_SIZE):
        body[at + 1 + i] = step[i]
    for i in range(phi.shape[0]):
        for j in range(phi.shape[0]):
            phi[i, j] = 0.0
        phi[i, i] = 1.0
    for i in range(n):
        fed_back[i] = 0.0


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def write_rows(cov: Array, dx: Array, z: Array, h: Array, r: Array, ops: Array) -> None:
    """Record an update as rows `ops` (m, 2 n + 2), and apply it to `dx` (n,).

    Of P (width, width) by rows z = h dx + noise: h (m, n), z, r (m,).

    Gains without P of each row: with P_a = P - sum_b k_b u_b^T,  P_a h_a^T = P h_a^T
    - sum_b k_b (u_b h_a^T), and u_b = s_b k_b.
    """
    n = dx.shape[0]
    for a in range(z.shape[0]):
        gain = ops[a, n : 2 * n]
        for i in range(n):
            gain[i] = 0.0
        nu = z[a]
        for i in range(n):
            c = h[a, i]
            ops[a, i] = c
            if c != 0.0:
                nu -= c * dx[i]
                for j in range(n):
                    gain[j] += c * cov[i, j]
        for b in range(a):
            c = 0.0
            for i in range(n):
                c += ops[b, n + i] * h[a, i]
            c *= ops[b, 2 * n]
            for j in range(n):
                gain[j] -= c * ops[b, n + j]
        s = r[a]
        for i in range(n):
            s += h[a, i] * gain[i]
        for j in range(n):
            gain[j] /= s
            dx[j] += gain[j] * nu
        ops[a, 2 * n], ops[a, 2 * n + 1] = s, nu
