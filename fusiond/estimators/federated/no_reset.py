r"""Federated filter whose local filters continue after a fusion: `no_reset` and `rescale`.

Only the published covariance B and the transition matrix Phi are propagated through the samples.
Local filters follow at an update, with the process noise of B divided by their factors:

    P_i <- Phi (P_i - B / beta_i) Phi^T + B' / beta_i,   x_i <- Phi x_i

Gate and innovation test are the local filter's own in `no_reset`, the master's in `rescale`, where
the local filter keeps little information.

A local filter whose measurements do not observe some states grows without bound in them. Beyond
`MOST` times the best variance it receives the part `LITTLE` of the others' information, which they
lose: the sum is unchanged. Apart from this part in a million, `no_reset` keeps local filters
separate.

A readmitted local filter gets x_g and P_g / beta_i, and the others lose that share: P_j <- P_j / (1
- beta_i).

Source: Carlson, IEEE Trans. AES 26 (1990), 517.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation
from fusiond.estimators.federated.continuing_base import CarriedFilter
from fusiond.estimators.federated.fusion_kernels import (
    carry,
    cholesky,
    difference,
    inverse_of_factor,
    publish,
)

Array = NDArray[np.float64]

# 1e-6 of the information changes no digit that counts; sums lose half of a double's digits at 1e8.
LITTLE = 1e-6
MOST = 1e8


class NoResetFilter(CarriedFilter):
    """`no_reset` and `rescale` (`fusiond.estimators.base.Estimator`).

    Bank: 0 ... N - 1 the local filters, N the master's own part in `rescale`.
    """

    _bank_shares: Array
    """Sharing factors of the bank."""

    @property
    def _rescales(self) -> bool:
        return self.options.mode == "rescale"

    @property
    def _estimates(self) -> int:
        return len(self.names) + self._rescales

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self._bank[:] = self._covs[0] / self._bank_shares[:, None, None]
        self._bank_dxs[:] = 0.0
        self._mark()

    def local(self, name: str) -> tuple[Array, Array]:
        """Copies of a local filter's error estimate (n,) and covariance (n, n), relative to the
        common navigation state."""
        n, i = self.model.size, self.names.index(name)
        bank, dxs = self._bank.copy(), self._bank_dxs.copy()
        carry(bank, dxs, self._bank_shares, self._phi, self._before, self._covs[0])
        return dxs[i], bank[i, :n, :n]

    # ------------------------------------------------------------------ the bank in time

    def _bring_up(self) -> None:
        carry(
            self._bank,
            self._bank_dxs,
            self._bank_shares,
            self._phi,
            self._before,
            self._covs[0],
        )
        self._mark()

    def _members(self) -> list[int]:
        """Filters of the bank that contribute information."""
        return self._believed() + ([len(self.names)] if self._rescales else [])

    # ------------------------------------------------------------------ update

    def _judge(self, local: int | None) -> tuple[Array, Array]:
        if local is None or self._rescales:
            return self._covs[0], self._dxs[0]
        return self._bank[local], self._bank_dxs[local]

    def _kept(self) -> list[tuple[Array, float]]:
        bank = zip(self._bank, self._bank_shares.tolist(), strict=True)
        return [(self._covs[0], 1.0), *bank]

    def _fold(self, local: int | None, i: Innovation) -> str:
        if local is None:
            for k in self._members():
                share = float(self._bank_shares[k])
                self._fuse_into(self._bank[k], self._bank_dxs[k], i, share)
        else:
            self._fuse_into(self._bank[local], self._bank_dxs[local], i)
            self._faults.received(local, self.t_ns)
        return self._fuse_all(local)

    def _fuse(self) -> bool:
        self._weight[:] = 0.0
        self._weight[self._members()] = 1.0
        return self._combine()

    def _difference(self, k: int) -> float:
        return difference(
            self._bank[k],
            self._bank_dxs[k],
            self._order,
            self._infos,
            self._vectors,
            self._scale,
            k,
            self._tested,
        )

    def _take_over(self, updated: int | None) -> None:
        """Publish the fused estimate; local filters follow the mode."""
        publish(self._covs[0], self._dxs[0], self._order, self._fused, self._estimate)
        if self._rescales and updated is not None:
            self._hand_over(updated)
        if self._trace.max() > MOST:
            for k in np.flatnonzero(self._trace[: len(self.names)] > MOST).tolist():
                self._bound(k)
        self._mark()
        if self.options.adaptive:
            self._adapt(self._trace[: len(self.names)])
        self._feed_back_published()

    def _hand_over(self, k: int) -> None:
        """Move the information that filter k does not retain to the master's estimate, the last
        one."""
        kept = self.options.retained
        for part in (self._infos, self._vectors):
            part[-2] += (1.0 - kept) * part[k]
            part[k] *= kept
        self._set(len(self.names))
        self._bank[k] /= kept

    def _bound(self, k: int) -> None:
        """Bound filter k by a little information of all others, which lose it."""
        for part in (self._infos, self._vectors):
            part[k] += LITTLE * (part[-1] - part[k])
        self._set(k)
        for other in self._members():
            if other != k:
                self._bank[other] /= 1.0 - LITTLE

    def _set(self, k: int) -> None:
        """Write filter k of the bank from its scaled information."""
        factor, p = self._infos[k].copy(), np.empty_like(self._infos[k])
        if not cholesky(factor):
            return
        inverse_of_factor(factor, p)
        x = p @ self._vectors[k] * self._scale
        p *= np.outer(self._scale, self._scale)
        publish(self._bank[k], self._bank_dxs[k], self._order, p, x)

    def _share_out(self, parts: Array) -> None:
        super()._share_out(parts)
        self._bank_shares = self._factors.copy()
        if self._rescales:
            own = self.options.master_share
            self._bank_shares = np.append(self._factors * (1.0 - own), own)

    # ------------------------------------------------------------------ faults, feedback, snapshots

    def _leave_out(self, local: int) -> None:
        if self._fuse():
            self._take_over(None)
        self._bank[local] = self._covs[0]
        self._bank_dxs[local] = self._dxs[0]

    def _take_back(self, local: int) -> None:
        self._share_out(self._nominal)
        share = float(self._bank_shares[local])
        for other in self._members():
            self._bank[other] /= 1.0 - share
        self._bank[local] = self._covs[0] / share
        self._bank_dxs[local] = self._dxs[0]

    def _kept_arrays(self) -> tuple[Array, ...]:
        return *super()._kept_arrays(), self._bank, self._bank_shares
