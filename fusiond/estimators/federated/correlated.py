r"""Federated filter with cross-covariances of its local filters: correlated fusion.

Each local filter uses its own source, with the whole initial uncertainty and the whole process
noise: no sharing factors, no bound. Cross-covariances are propagated for each pair i, j:

    P_ij <- Phi P_ij Phi^T + Q                                   in between
    P_ij <- (I - K_i H) P_ij                                     a measurement of i alone
    P_ij <- (I - K_i H) P_ij (I - K_j H)^T + K_i R K_j^T         a measurement that is common to all

and the master is the best linear combination of them, for any number of filters:

    d_k = x_k - x_0,   S = cov(d),   C = cov(e_0, d)
    x_g = x_0 - C S^+ d,   P_g = P_00 - C S^+ C^T

which for two is the paper's P_g = P_11 - (P_11 - P_12) (P_11 - P_12 - P_21 + P_22)^-1 (P_11 -
P_12)^T. If two estimates are equal, as at the start and in states that neither source observes, S
is singular; S^+ omits these directions, where any combination is the same.

P_g is a covariance and no bound, but larger than the centralised filter's: each local filter has
chosen its gain without the others (Bar-Shalom and Campo: 7 % in the worst case of two alike).

Source: paper 004, section 3; Bar-Shalom and Campo, IEEE Trans. AES 22 (1986), 803; for more than
two: Kim, IEEE Trans. AC 39 (1994), 1921 (fusion of track estimates, maximum likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation
from fusiond.estimators.federated.continuing_base import CarriedFilter

Array = NDArray[np.float64]

# Of the variances of an estimate: differences below 1e-4 sigma are rounding, not information.
SAME = 1e-8


class Fused(NamedTuple):
    """Weights (k, n, n) of k estimates and the covariance (n, n) of their combination."""

    weights: Array
    covariance: Array


def best_combination(joint: Array) -> Fused:
    """Combination of least covariance of estimates with the joint covariance (k, k, n, n)."""
    k, n = joint.shape[0], joint.shape[2]
    first = joint[0, 0]
    weights = np.zeros((k, n, n))
    weights[0] = np.eye(n)
    if k == 1:
        return Fused(weights, first)
    scale = np.sqrt(np.diag(first))
    unit = np.outer(scale, scale)
    m = (k - 1) * n
    s, c = np.empty((k - 1, n, k - 1, n)), np.empty((n, k - 1, n))
    for i in range(1, k):
        c[:, i - 1] = (joint[0, i] - first) / unit
        for j in range(1, k):
            s[i - 1, :, j - 1] = (joint[i, j] - joint[i, 0] - joint[0, j] + first) / unit
    square = s.reshape(m, m)
    values, vectors = np.linalg.eigh(0.5 * (square + square.T))
    kept = values > SAME
    root = c.reshape(n, m) @ vectors[:, kept] / np.sqrt(values[kept])
    gain = (root / np.sqrt(values[kept])) @ vectors[:, kept].T
    for i in range(1, k):
        weights[i] = -gain[:, (i - 1) * n : i * n] * scale[:, None] / scale
        weights[0] -= weights[i]
    fused = first - root @ root.T * unit
    return Fused(weights, 0.5 * (fused + fused.T))


class CorrelatedFilter(CarriedFilter):
    """`no_reset` with the covariances between the local filters
    (`fusiond.estimators.base.Estimator`)."""

    @property
    def _estimates(self) -> int:
        return 0

    def _arrange(self, used: NDArray[np.bool_]) -> None:
        super()._arrange(used)
        width, count = self.model.width, len(self.names)
        self._joint: Array = np.zeros((count, count, width, width))
        self._bank_dxs = np.zeros((count, self.model.size))
        self._members: list[int] = []
        self._combination = Fused(np.zeros((0, 0, 0)), np.zeros((0, 0)))

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n): the same for all."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self._joint[:] = self._covs[0]
        self._bank_dxs[:] = 0.0
        self._mark()

    def local(self, name: str) -> tuple[Array, Array]:
        """Copies of a local filter's error estimate (n,) and covariance (n, n), relative to the
        common navigation state."""
        n, i = self.model.size, self.names.index(name)
        phi = self._phi
        cov = phi @ (self._joint[i, i] - self._before) @ phi.T + self._covs[0]
        return phi[:n, :n] @ self._bank_dxs[i], cov[:n, :n]

    # ------------------------------------------------------------------ in time

    def _bring_up(self) -> None:
        """Bring all to the present; the noise of the interval is that of the published estimate."""
        n, phi = self.model.size, self._phi
        self._joint[:] = phi @ (self._joint - self._before) @ phi.T + self._covs[0]
        self._bank_dxs[:] = self._bank_dxs @ phi[:n, :n].T
        self._mark()

    # ------------------------------------------------------------------ update

    def _judge(self, local: int | None) -> tuple[Array, Array]:
        if local is None:
            return self._covs[0], self._dxs[0]
        return self._joint[local, local], self._bank_dxs[local]

    def _kept(self) -> list[tuple[Array, float]]:
        own = [(self._joint[k, k], 1.0) for k in range(len(self.names))]
        return [(self._covs[0], 1.0), *own]

    def _forget_clock(self, offsets: list[int]) -> None:
        super()._forget_clock(offsets)
        for i in range(len(self.names)):
            for j in range(len(self.names)):
                if i != j:
                    self._joint[i, j, offsets] = 0.0
                    self._joint[i, j, :, offsets] = 0.0

    def _fold(self, local: int | None, i: Innovation) -> str:
        """Update one filter, or all, by an innovation."""
        members = self._believed() if local is None else [local]
        n = self.model.size
        gains, lefts = {}, {}
        for k in members:
            p = self._joint[k, k]
            ph = p[:, :n] @ i.h.T
            gains[k] = np.linalg.solve(i.h @ ph[:n] + np.diag(i.r), ph.T).T
            lefts[k] = self._unit.copy()
            lefts[k][:, :n] -= gains[k] @ i.h
            self._bank_dxs[k] += gains[k][:n] @ (i.z - i.h @ self._bank_dxs[k])
        for k in members:
            for other in range(len(self.names)):
                if other not in lefts:
                    self._joint[k, other] = lefts[k] @ self._joint[k, other]
                    self._joint[other, k] = self._joint[k, other].T
                elif other >= k:
                    new = lefts[k] @ self._joint[k, other] @ lefts[other].T
                    new += gains[k] * i.r @ gains[other].T
                    self._joint[k, other] = new
                    self._joint[other, k] = new.T
        if local is not None:
            self._faults.received(local, self.t_ns)
        return self._fuse_all(local)

    def _of(self, members: Sequence[int]) -> Array:
        """The joint covariance (k, k, a, a) of members' used states."""
        rows = np.array(members)
        joint: Array = self._joint[
            rows[:, None, None, None],
            rows[None, :, None, None],
            self._order[None, None, :, None],
            self._order[None, None, None, :],
        ]
        return joint

    def _fuse(self) -> bool:
        self._members = self._believed()
        self._combination = best_combination(self._of(self._members))
        return bool((np.diag(self._combination.covariance) > 0.0).all())

    def _take_over(self, updated: int | None) -> None:
        order, fused = self._order, self._combination
        estimates = self._bank_dxs[:, order][self._members]
        self._covs[0][np.ix_(order, order)] = fused.covariance
        self._dxs[0][order] = np.einsum("kij,kj->i", fused.weights, estimates)
        self._mark()
        self._feed_back_published()

    def _difference(self, k: int) -> float:
        others = [i for i in self._believed() if i != k]
        if not others:
            return 0.0
        joint = self._of([k, *others])
        best = best_combination(joint[1:, 1:])
        estimates = self._bank_dxs[:, self._order][others]
        d = self._bank_dxs[k, self._order] - np.einsum("kij,kj->i", best.weights, estimates)
        across = np.einsum("kij,kjl->il", best.weights, joint[1:, 0])
        s = joint[0, 0] + best.covariance - across - across.T
        tail = slice(len(d) - self._tested, len(d))
        scale = np.sqrt(np.diag(joint[0, 0])[tail])
        values, vectors = np.linalg.eigh(s[tail, tail] / np.outer(scale, scale))
        along = vectors.T @ (d[tail] / scale)
        distinct = values > SAME
        return float(np.sum(along[distinct] ** 2 / values[distinct]))

    # ------------------------------------------------------------------ faults, feedback, snapshots

    def _share_out(self, parts: Array) -> None:
        """Give each trusted filter the whole noise."""
        self._factors[:] = 0.0
        self._factors[self._believed()] = 1.0

    def _leave_out(self, local: int) -> None:
        self._fuse()
        self._take_over(None)
        self._copy_master(local, self._members, self._combination.weights)

    def _take_back(self, local: int) -> None:
        members = [i for i in self._believed() if i != local]
        fused = best_combination(self._of(members))
        self._copy_master(local, members, fused.weights)
        self._share_out(self._nominal)

    def _copy_master(self, local: int, members: Sequence[int], weights: Array) -> None:
        """Local filter `local` becomes the combination of the members."""
        order = self._order
        self._bank_dxs[local] = self._dxs[0]
        for other in range(len(self.names)):
            if other == local:
                continue
            part = self._of([*members, other])
            across = np.einsum("kij,kjl->il", weights, part[:-1, -1])
            self._joint[local, other] = 0.0
            self._joint[local, other][np.ix_(order, order)] = across
            self._joint[other, local] = self._joint[local, other].T
        self._joint[local, local] = self._covs[0]

    def _kept_arrays(self) -> tuple[Array, ...]:
        return *super()._kept_arrays(), self._joint
