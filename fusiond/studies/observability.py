r"""Observability of a linear system over a trajectory: rank, Gramian, and estimable states.

    x_k = Phi_k x_{k-1},   z_k = H_k x_k + v_k,   v_k ~ N(0, diag(r_k)),   Theta_k = Phi_k ... Phi_1
    O = [ R_k^{-1/2} H_k Theta_k D ]_k            one block of rows an epoch, columns scaled
    W = sum_k Theta_k^T H_k^T R_k^{-1} H_k Theta_k = D^-1 O^T O D^-1       the Gramian
    P_0|N = (P_0^-1 + W)^-1 = D (I + O^T O)^-1 D,   P_0 = D^2

x_0 (n,) the state at the start, D its one sigma (diagonal), r variances. With D in it O has no
unit: a singular value s means that along its right singular vector the measurements shrink the
prior sigma by sqrt(1 + s^2). s = 1 is thus the line between what the measurements tell and what was
known before (`INFORMATIVE`); the rank in the strict sense counts s above rounding, as numpy's
matrix_rank does: s > s_max max(m, n) eps.

O is not stored: its triangular factor is updated by QR, epoch by epoch, which keeps all digits of
the singular values (the Gramian itself keeps half). Process noise is left out, as the rank test
does: what the noise takes away again shows in fusiond.studies.covariance_analysis.

Paper 002 prints the Gramians as integrals to infinity, "e^{Ft} H H^T e^{F^T t}". The order is a
slip; right is

    Q = int e^{F^T t} H^T R^-1 H e^{F t} dt,    F^T Q + Q F + H^T R^-1 H = 0

and both hold only where F is constant and all its eigenvalues lie in the left half-plane
(`gramian_stable`). An inertial navigation system has its Schuler and Earth-rate eigenvalues on the
imaginary axis, biases at zero, and an F that changes along the way: the integral grows without end.
Used here is the sum W over the finite trajectory, which always exists.

Source: Gelb, Applied Optimal Estimation (1974), section 3.5; Ham and Brown, Observability,
eigenvalues and Kalman filtering, IEEE Trans. AES 19 (1983); paper 002, section 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_triangular

Array = NDArray[np.float64]

INFORMATIVE = 1.0
"""Singular value at which measurements give as much information as the prior (module's text)."""
KEPT_SIGMA = 0.9
"""Share of the initial sigma above which a state is not estimated: with more than nine tenths left,
measurements have removed less than a fifth of its variance."""
NAMED_SHARE = 0.1
"""Share of a direction's squared length from which a state appears in its name."""
_DOUBLINGS = 60
"""Most doublings of the horizon in `gramian_stable`: 2^60 times the fastest time constant."""


class Epoch(NamedTuple):
    """Epoch: transition (n, n) from the epoch before, then its rows (m, n), variances (m,).

    m may be 0.
    """

    phi: Array
    h: Array
    r: Array


class Direction(NamedTuple):
    """A combination of states: `singular` value of O, its unit vector (n,) in scaled states, and
    `sigma_left`, the share of the prior sigma that the measurements leave along it."""

    singular: float
    vector: Array

    @property
    def sigma_left(self) -> float:
        return 1.0 / math.sqrt(1.0 + self.singular * self.singular)

    def states(self, names: Sequence[str]) -> list[str]:
        """States of the direction, largest first."""
        share = np.square(self.vector)
        order = [int(i) for i in np.argsort(-share)]
        return [names[i] for i in order if share[i] >= NAMED_SHARE]


@dataclass(frozen=True)
class Observability:
    """Information of a trajectory on n states.

    `factor` (n, n) upper triangular with factor^T factor = O^T O; `scale` (n,) the D of the
    module's text; `theta` (n, n) the transition over the whole; `rows` of O.
    """

    factor: Array
    scale: Array
    theta: Array
    rows: int

    @property
    def gramian(self) -> Array:
        """W (n, n) in the states' own units."""
        root = self.factor / self.scale
        return np.asarray(root.T @ root)

    @property
    def directions(self) -> list[Direction]:
        """The n directions, the best observed first."""
        _, s, v = np.linalg.svd(self.factor)
        return [Direction(float(a), b) for a, b in zip(s, v, strict=True)]

    @property
    def rank(self) -> int:
        """Rank of O above rounding."""
        s = np.linalg.svd(self.factor, compute_uv=False)
        floor = s[0] * max(self.rows, len(s)) * np.finfo(np.float64).eps
        return int(np.count_nonzero(s > floor))

    @property
    def informative(self) -> int:
        """Number of directions with more information from measurements than from the prior."""
        s = np.linalg.svd(self.factor, compute_uv=False)
        return int(np.count_nonzero(s > INFORMATIVE))

    @property
    def start(self) -> Array:
        """P_0|N (n, n): the state at the start, from prior and all measurements."""
        # (I + O^T O)^-1 = T^-1 T^-T, T the triangle of [O; I]: no digits are lost to a square.
        n = len(self.scale)
        triangle = np.linalg.qr(np.vstack([self.factor, np.eye(n)]), mode="r")
        half = self.scale[:, None] * solve_triangular(triangle, np.eye(n))
        return np.asarray(half @ half.T)

    @property
    def sigma_left(self) -> Array:
        """Share (n,) of each state's initial sigma that remains at the start; 1: no information."""
        return np.sqrt(np.diag(self.start)) / self.scale

    @property
    def sigma_end(self) -> tuple[Array, Array]:
        """One sigma (n,) at the end with and without the measurements, both without process
        noise."""
        with_them = self.theta @ self.start @ self.theta.T
        without = self.theta * self.scale
        return np.sqrt(np.diag(with_them)), np.sqrt(np.square(without).sum(axis=1))

    def not_estimated(self, names: Sequence[str], kept: float = KEPT_SIGMA) -> list[str]:
        """States that the measurements cannot estimate: candidates to go, in paper 002's sense.

        Omitting such a state can still harm the others; the covariance analysis shows its effect.
        """
        return [name for name, left in zip(names, self.sigma_left, strict=True) if left > kept]


def observability(epochs: Iterable[Epoch], sigma: Array) -> Observability:
    """Rank, Gramian and all that follows, for prior `sigma` (n,), all positive. ValueError if not.

    The transition of the first epoch leads from the start to it.
    """
    if np.any(sigma <= 0.0):
        raise ValueError("initial sigma must be positive in every state")
    n = len(sigma)
    theta, factor, rows = np.eye(n), np.zeros((n, n)), 0
    for phi, h, r in epochs:
        theta = phi @ theta
        if len(r) == 0:
            continue
        block = (h @ theta) * sigma / np.sqrt(r)[:, None]
        factor = np.asarray(np.linalg.qr(np.vstack([factor, block]), mode="r"))
        rows += len(r)
    return Observability(factor, sigma.copy(), theta, rows)


def gramian_over(f: Array, h: Array, r: Array, seconds: float) -> tuple[Array, Array]:
    """Gramian (n, n) of x' = F x, z = H x over `seconds`, and the transition over them.

    int_0^T e^{F^T t} H^T R^-1 H e^{F t} dt, by Van Loan's exponential of the block matrix
    [[-F^T, H^T R^-1 H], [0, F]] (IEEE Trans. AC 23, 1978).
    """
    n = len(f)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[n:, n:] = -f.T, f
    block[:n, n:] = h.T @ (h / r[:, None])
    whole = expm(block * seconds)
    phi = whole[n:, n:]
    return np.asarray(phi.T @ whole[:n, n:]), np.asarray(phi)


def gramian_stable(f: Array, h: Array, r: Array) -> Array:
    """Solution (n, n) of F^T Q + Q F + H^T R^-1 H = 0: the Gramian of paper 002, to infinity.

    By doubling: Q(2T) = Q(T) + Phi(T)^T Q(T) Phi(T). ValueError unless every eigenvalue of F has a
    negative real part.
    """
    real = np.linalg.eigvals(f).real
    if real.max() >= 0.0:
        raise ValueError("the Gramian to infinity needs a stable F: an eigenvalue has no decay")
    gramian, phi = gramian_over(f, h, r, 1.0 / float(np.linalg.norm(f, 2)))
    for _ in range(_DOUBLINGS):
        more = phi.T @ gramian @ phi
        gramian = gramian + more
        if np.abs(more).max() <= np.finfo(np.float64).eps * np.abs(gramian).max():
            break
        phi = phi @ phi
    return 0.5 * (gramian + gramian.T)
