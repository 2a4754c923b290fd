r"""Covariance analysis of a suboptimal filter: its true error covariance and its own.

The truth has the full state x (n,), the filter a reduced estimate x^ (m,) of some of it; S (m, n)
selects those states, so S^T x^ is the estimate in full size, zero where there is no state for it.

    truth    x <- Phi x + w,          w ~ Q          z = H x + v,   v ~ N(0, diag(r))
    filter   x^ <- Phi_r x^           P_r <- Phi_r P_r Phi_r^T + Q_r
             K = P_r H_r^T (H_r P_r H_r^T + R_r)^-1    x^ <- x^ + K (z - H_r x^)

Error of the estimate in full space, e = x - S^T x^ (a state left out is in e with all of itself).
Put x = e + S^T x^ in:

    e  <- Phi e + N x^ + w                           N = Phi S^T - S^T Phi_r
    nu  = H e + M x^ + v                             M = H S^T - H_r
    e  <- e - S^T K nu,   x^ <- x^ + K nu

so the pair y = [e; x^] is linear, and its covariance Y follows exactly:

    Y <- A Y A^T + diag(Q, 0),      A = [[Phi, N], [0, Phi_r]]
    Y <- B Y B^T + G R G^T,         G = [-S^T K; K],   B = I + G [H, M]

N and M are what the reduced model gets wrong about its own states. N = 0 if the states left out are
not driven by those kept and the kept ones move in the filter as in truth; then e needs no x^:
P <- Phi P Phi^T + Q, P <- (I - S^T K H) P (I - S^T K H)^T + S^T K R K^T S. The 17 of paper 002's 23
states are such a case: constant biases drive, and nothing drives them.

Feedback: an estimate taken out of the navigation state leaves e as it is and makes those entries of
x^ zero; from then on they propagate as truth does. `fed_back` names them.

The filter's P_r is not its error: Sigma of a reduced filter is sqrt(diag(S P S^T)), P of e.

Source: Gelb, Applied Optimal Estimation (1974), section 7.2; Maybeck, Stochastic Models 1 (1979),
section 6.8; derived here, checked by Monte Carlo in the tests.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class System(NamedTuple):
    """Step of a linear model: transition (n, n), noise (n, n), rows (m, n), variances (m,)."""

    phi: Array
    q: Array
    h: Array
    r: Array


class Result(NamedTuple):
    """Result after an epoch: covariance of the true error `e` (n, n), all states of the truth; and
    the filter's own P_r (m, m)."""

    true: Array
    believed: Array


def optimal_gain(p: Array, h: Array, r: Array) -> Array:
    """Gain K (n, m) of the Kalman filter for P (n, n), H (m, n), variances r (m,)."""
    ph = p @ h.T
    return np.asarray(np.linalg.solve(h @ ph + np.diag(r), ph.T).T)


def joseph(p: Array, k: Array, h: Array, r: Array) -> Array:
    """Covariance (I - K H) P (I - K H)^T + K R K^T for any gain K."""
    a = np.eye(len(p)) - k @ h
    p = a @ p @ a.T + (k * r) @ k.T
    return np.asarray(0.5 * (p + p.T))


def analyse(
    steps: Iterable[tuple[System, System]],
    kept: Indices,
    true_initial: Array,
    believed_initial: Array,
    fed_back: Indices | None = None,
) -> Iterator[Result]:
    """Analyse each step (truth, filter): the true error and the filter's covariance after its
    update.

    `kept` (m,) are the truth's states that the filter has, in the filter's order; `fed_back` those
    of the filter's states that are taken out of the navigation state after every update. The
    estimate is zero at the start, so `true_initial` (n, n) is the error's covariance as well;
    `believed_initial` (m, m) is the filter's.

    Both must have the same measurements: as many rows in each step.
    """
    n, m = len(true_initial), len(kept)
    up = np.zeros((n, m))
    up[kept, np.arange(m)] = 1.0
    y = np.zeros((n + m, n + m))
    y[:n, :n] = true_initial
    p_r = believed_initial.copy()
    a = np.zeros((n + m, n + m))
    for truth, reduced in steps:
        a[:n, :n], a[:n, n:], a[n:, n:] = (
            truth.phi,
            truth.phi @ up - up @ reduced.phi,
            reduced.phi,
        )
        y = a @ y @ a.T
        y[:n, :n] += truth.q
        p_r = reduced.phi @ p_r @ reduced.phi.T + reduced.q
        if len(truth.r):
            k = optimal_gain(p_r, reduced.h, reduced.r)
            p_r = joseph(p_r, k, reduced.h, reduced.r)
            g = np.vstack([-up @ k, k])
            seen = np.hstack([truth.h, truth.h @ up - reduced.h])
            y = joseph(y, -g, seen, truth.r)
            if fed_back is not None:
                y[n + fed_back, :] = 0.0
                y[:, n + fed_back] = 0.0
        y = 0.5 * (y + y.T)
        yield Result(y[:n, :n].copy(), p_r)
