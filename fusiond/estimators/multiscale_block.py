r"""Blocks of M successive states: how one follows from the last, and what was measured in it.

    x_(j+1) = Phi_j x_j + w_j,  var w_j = Q_j;      X = (x_1 ... x_M) the last block,
                                                    x_(M+1) ... x_(2M) the next

Each element of the next block follows from every element i of the last one. Their average,

    x_(M+l) = 1/M sum_i Phi(i -> M+l) x_i + sum_(j<M) j/M Phi(j+1 -> M+l) w_j
              + sum_(j>=M) Phi(j+1 -> M+l) w_j

is an identity (w_j enters from the elements 1 ... j). All rows pass through one mean at element M,

    m = G X,   G = 1/M [Phi(1 -> M) ... Phi(M-1 -> M)  I],
    C = G P G^T + sum_(j<M) (j/M)^2 Phi(j+1 -> M) Q_j Phi(j+1 -> M)^T

and from there on each element follows from the one before. C takes the w_j inside the last block
for independent of the errors of X. They are not: the estimate of x_(j+1) errs by the very w_j that
has not been measured yet. That is the paper's approximation, kept here as it stands: C is too
small.

Mean and covariance are kept in the wavelet domain, W X and W P W^T (W for W kron I_n); a row h on
element l becomes [W_1l h ... W_Ml h].

Source: paper 001, eq. 6 to 10 and 19 to 27.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.update import update

Array = NDArray[np.float64]


class Epoch(NamedTuple):
    """An instant with measurements z = h x + v (m,), (m, n), variances r (m,).

    `phi` and `q` (n, n): transition and noise from the epoch before. `u` (n,): what feedback has
    taken out of the state until here, carried along by the transitions. None of it is ever changed.
    """

    phi: Array
    q: Array
    u: Array
    z: Array
    h: Array
    r: Array


class Block(NamedTuple):
    """Mean (M n,) and covariance (M n, M n) of M successive states, in the wavelet domain."""

    mean: Array
    cov: Array


def transformed(w: Array, rows: Array) -> Array:
    """(W kron I) rows, for `rows` (M n,) or (M n, k); by W^T it is the inverse."""
    return (w @ rows.reshape(len(w), -1)).reshape(rows.shape)


def begin(w: Array, mean: Array, cov: Array, following: Sequence[Epoch]) -> Block:
    """The block whose first element has `mean` (n,) and `cov` (n, n); the others follow from it.

    Paper 001, eq. 21 and 22.
    """
    n, size = len(mean), len(w) * len(mean)
    means, p = np.empty(size), np.empty((size, size))
    means[:n], p[:n, :n] = mean, cov
    for end, epoch in zip(range(n, size, n), following, strict=True):
        here, before = slice(end, end + n), slice(end - n, end)
        means[here] = epoch.phi @ means[before]
        p[here, :end] = epoch.phi @ p[before, :end]
        p[:end, here] = p[here, :end].T
        p[here, here] = p[here, before] @ epoch.phi.T + epoch.q
    if size == n:
        return Block(means, p)
    return Block(transformed(w, means), _symmetric(transformed(w, transformed(w, p).T)))


def predict(w: Array, last: Block, epochs: Sequence[Epoch]) -> Block:
    """The block after `last`; `epochs` (2M - 1): elements 2 to M of the last one, then the new.

    Paper 001, eq. 8, 9, 24 and 25.
    """
    m = len(w)
    n = len(last.mean) // m
    inner, first, rest = epochs[: m - 1], epochs[m - 1], epochs[m:]
    g = np.empty((m * n, n))  # G^T
    g[-n:] = np.eye(n) / m
    for end in range((m - 1) * n, 0, -n):
        g[end - n : end] = inner[end // n - 1].phi.T @ g[end : end + n]
    noise = np.zeros((n, n))
    for j, epoch in enumerate(inner, 1):
        noise = epoch.phi @ noise @ epoch.phi.T + (j / m) ** 2 * epoch.q
    g = transformed(w, g)
    mean, cov = last.mean @ g, g.T @ last.cov @ g + noise
    cov = first.phi @ cov @ first.phi.T + first.q
    return begin(w, first.phi @ mean, _symmetric(cov), rest)


def rows_on(w: Array, element: int, h: Array) -> Array:
    """Rows h (m, n) on an element (from 0) as rows (m, M n) on the transformed block."""
    if len(w) == 1:
        return h
    return (w[:, element, None] * h[:, None, :]).reshape(len(h), -1)


def fold(w: Array, block: Block, first: int, epochs: Sequence[Epoch]) -> None:
    """Update a block in place with what was measured in its elements from `first` on.

    Paper 001, eq. 23, 26 and 27, one row after another.
    """
    for element, epoch in enumerate(epochs, first):
        update(block.cov, block.mean, epoch.z, rows_on(w, element, epoch.h), epoch.r)


def newest(w: Array, block: Block) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the last element, out of the wavelet domain."""
    m = len(w)
    n = len(block.mean) // m
    if m == 1:
        return block.mean.copy(), block.cov.copy()
    weight = w[:, -1]
    across = np.tensordot(weight, block.cov.reshape(m, n, m, n), (0, 0))
    return weight @ block.mean.reshape(m, n), _symmetric(np.tensordot(weight, across, (0, 1)))


def rebased(
    w: Array, window: Sequence[Epoch], blocks: Sequence[Block]
) -> tuple[list[Epoch], list[Block]]:
    """The same estimates with the oldest epoch's `u` taken off everywhere.

    t_(j+1) = Phi_j t_j solves the states' own equation, so t may be taken off states, measurements
    and `u` alike; from u of the oldest epoch it leaves only the window's own corrections, and no
    number grows with time. `blocks` cover window[0:M], window[1:M+1] and so on.
    """
    t = [window[0].u]
    for epoch in window[1:]:
        t.append(epoch.phi @ t[-1])
    epochs = [
        e._replace(u=e.u - off, z=e.z - e.h @ off) for e, off in zip(window, t, strict=True)
    ]
    along = np.array(t)
    moved = [
        Block(b.mean - transformed(w, along[i : i + len(w)].ravel()), b.cov)
        for i, b in enumerate(blocks)
    ]
    return epochs, moved


def _symmetric(p: Array) -> Array:
    return 0.5 * (p + p.T)
