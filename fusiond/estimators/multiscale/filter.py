r"""Multi-scale filter: M = 2^(N-1) successive states estimated together, in the wavelet domain.

An epoch is an instant at which a measurement was fused. With epoch k the block (k-M+1 ... k) is
predicted from the block (k-2M+1 ... k-M), updated with what was measured at its M epochs, and its
last element is the solution. So M chains of blocks run interleaved; each sees every measurement
once. The recursion is in `fusiond.estimators.multiscale.block`.

Feedback: u is the sum of all feedback, propagated by the transitions,

    u_(j+1) = Phi_j u_j + d_(j+1),   y = x + u:   y_(j+1) = Phi_j y_j + w_j,   z + H u = H y + v

so y has no inputs. Blocks estimate y; with its estimate y^ of now, d = y^ - u is fed back.

The first 2M - 1 epochs are an ordinary filter's. Its posteriors at the epochs 1 ... M are the first
elements of the first blocks (eq. 21 and 22). N = 1 is the ordinary filter throughout.

Source: paper 001, sections 3 and 4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable, State
from fusiond.estimators.base import AS_STATED, Estimator, Outcome, gate_threshold
from fusiond.estimators.multiscale.block import (
    Block,
    Window,
    begin,
    fold,
    newest,
    predict,
    rebase,
    rows_on,
)
from fusiond.estimators.multiscale.wavelet import wavelet_matrix
from fusiond.estimators.published_state import sigmas
from fusiond.estimators.state_array import RECORDED, USED
from fusiond.estimators.update import fuse, update, work
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer

Array = NDArray[np.float64]

# W of an epoch by itself: the start's.
_ALONE = np.ones((1, 1))


class _Open(NamedTuple):
    """A block that ends now, not yet kept: W, the block, u (n,) now, the M blocks before it (none
    in the start), whether its last epoch is kept already, whether the start still lasts."""

    w: Array
    block: Block
    u: Array
    blocks: list[Block]
    again: bool
    starting: bool


class MultiscaleEstimator(Estimator):
    """Block filter of paper 001 (`fusiond.estimators.base.Estimator`).

    `scales` N is 1 to 4; `wavelet` a PyWavelets name, orthonormal (ValueError if not). The
    propagated covariance is the noise Q since the last epoch, with the transition Phi; P = Phi P_k
    Phi^T + Q is computed on demand. Error estimate 0 is that of `hold`, 1 the feedback since the
    last epoch other than by a measurement.
    """

    carries_transition = True

    def __init__(self, model: Model, gap_s: float, scales: int = 2, wavelet: str = "haar") -> None:
        super().__init__(model, gap_s, (1.0, 1.0))
        # Behind Q there is room for P while its sigmas are recorded.
        self._covs, self._shares, self._p = self._covs[:1], self._shares[:1], self._covs[1]
        self._memory.head[USED], self._memory.head[RECORDED] = 1, 1
        self._w = wavelet_matrix(wavelet, scales).copy()  # kernels take no read-only array
        self._window: Window | None = None
        self._blocks: list[Block] = []
        self._starts: list[tuple[Array, Array]] = []
        self._epoch_ns = 0
        self._posterior: Array = np.zeros((model.size, model.size))

    @property
    def covariance(self) -> Array:
        """P (n, n) of the published error state."""
        n = self.model.size
        phi = self._phi[:n, :n]
        p: Array = phi @ self._posterior @ phi.T
        p += self._covs[0, :n, :n]
        return 0.5 * (p + p.T)

    @property
    def state(self) -> State:
        """View of the filter for a measurement."""
        return State(self.nav, self.xi, self.step, self.model, self.covariance)

    @property
    def length(self) -> int:
        """M, epochs in a block."""
        return len(self._w)

    @property
    def epochs(self) -> int:
        """Epochs that are kept: up to 2 M - 1."""
        return 0 if self._window is None else len(self._window.ends)

    def sigmas(self) -> Array:
        """One sigma (9,): position, velocity (n, e, d), roll, pitch, yaw."""
        out = np.empty(9)
        sigmas(self.covariance, self.nav, self.step, *self.published, out)
        return out

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self._restart(super().covariance.copy())

    def propagate(
        self, imu: ImuBuffer, target_ns: int, record: bool = False, passing: bool = False
    ) -> None:
        """Propagate to `target_ns`, or to the last sample that the buffer holds before it."""
        if not record:
            super().propagate(imu, target_ns)
            return
        # Sigmas at every sample want P at every sample.
        n = self.model.size
        self._p[:n, :n] = self.covariance
        self._memory.head[USED] = 2
        super().propagate(imu, target_ns, record)
        self._memory.head[USED] = 1

    def _restart(self, p: Array) -> None:
        """Restart without epochs, from P (n, n)."""
        self._posterior = p
        self._window, self._blocks, self._starts = None, [], []
        self._since_epoch()

    def _since_epoch(self) -> None:
        """Reset the input since the last epoch."""
        self._covs[0], self._dxs[1], self._carrying = 0.0, 0.0, False
        self._phi[:] = np.eye(len(self._phi))

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection."""
        innovation = self._linearise(measurement)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        if measurement.screened:
            return self._update_by_rows(measurement, innovation)
        degrees = innovation.z.shape[0]
        threshold = gate_threshold(measurement.gate, degrees)
        nis, y = self._fuse(innovation, threshold)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        return Outcome("gated", nis, degrees)

    def _linearise(self, measurement: Linearised) -> Innovation | NotApplicable:
        """The innovation of a measurement, which sees P and not Q alone."""
        return self._weighed(measurement, measurement.innovation(self.state))

    def _fuse(self, rows: Innovation, threshold: float) -> tuple[float, Array]:
        """Update; NIS and whitened innovation (m,). Beyond `threshold` nothing changes."""
        z, h, r = rows
        o = self._open()
        total, (y, g) = z + h @ o.u, work(len(z), o.block.cov.shape[1])
        on_block, state = rows_on(o.w, len(o.w) - 1, h), (self.nav, self.xi)
        block = o.block.cov, o.block.mean
        nis = fuse(*state, *block, total, on_block, r, threshold, True, y, g)
        if nis <= threshold:
            self._commit(o, total, h, r)
        return nis, y

    def _update_by_rows(self, measurement: Linearised, rows: Innovation) -> Outcome:
        """Update by all rows, or by none.

        Rows are judged on the newest element alone, to which they refer. If the receiver has reset
        its clock, blocks that reach back before it are dropped.
        """
        z, h, r = rows
        o = self._open()
        mean, cov = self._newest(o)
        before, total = cov.copy(), z + h @ o.u
        s = self._screen(measurement, Innovation(total, h, r), cov, mean)
        if not np.array_equal(cov, before):
            self._restart(self.covariance)
            o = self._open()
            total = z + h @ o.u
            s = self._screen(measurement, Innovation(total, h, r), o.block.cov, o.block.mean)
        kept, codes = s.codes == KEPT, tuple(s.codes.tolist())
        if not kept.any():
            return Outcome("gated", s.nis, 0, (), codes)
        total, h, r = total[kept], h[kept], r[kept]
        update(o.block.cov, o.block.mean, total, rows_on(o.w, len(o.w) - 1, h), r)
        self._commit(o, total, h, r)
        return Outcome("fused", s.nis, int(kept.sum()), tuple(s.y.tolist()), codes)

    def _open(self) -> _Open:
        """Block that ends now, with all earlier measurements; changes nothing."""
        w, last = self._w, self._window
        again = last is not None and self.t_ns == self._epoch_ns
        starting = not self._blocks and self.epochs + (not again) < 2 * len(w)
        u, blocks = self._fed_back(), self._blocks
        if starting:
            block, w = Block(u + self._dxs[0], self.covariance), _ALONE
        elif again:
            block = Block(blocks[-1].mean.copy(), blocks[-1].cov.copy())
        else:
            assert last is not None
            blocks = blocks or self._first_blocks(last)
            block = self._next_block(last, blocks[0])
        return _Open(w, block, u, blocks, again, starting)

    def _newest(self, o: _Open) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) now."""
        n = self.model.size
        mean, cov = np.empty(n), np.empty((n, n))
        newest(o.w, *o.block, mean, cov)
        return mean, cov

    def _commit(self, o: _Open, total: Array, h: Array, r: Array) -> None:
        """Store a block updated with total = h y + v, and its present state."""
        n, u, last = self.model.size, o.u, self._window
        mean, self._posterior = self._newest(o)
        if self._holding:
            self._dxs[0] = mean - u
        else:
            self._feed_back(mean - u)
            u = mean
        if o.again:
            assert last is not None
            self._window = last.measured_again(u, total, h, r)
        else:
            phi, q = self._phi[None, :n, :n].copy(), self._covs[:, :n, :n].copy()
            self._append(Window(phi, q, u[None], total, h, r, np.array([len(r)])), o.starting)
        if o.starting:
            self._starts = [*self._starts[: self.epochs - 1], (mean, self._posterior)]
        elif o.again:
            self._blocks = [*o.blocks[:-1], o.block]
        else:
            self._rebase([*o.blocks[1:], o.block])
        self._epoch_ns = self.t_ns
        self._since_epoch()

    def _append(self, epoch: Window, starting: bool) -> None:
        """Append an epoch, replacing the oldest unless the start still collects them."""
        last = self._window
        self._window = epoch if last is None else last.followed_by(epoch, 0 if starting else 1)

    def _next_block(self, last: Window, block: Block) -> Block:
        """Block that ends now, after `block`, updated with all earlier measurements."""
        n, m = self.model.size, len(self._w)
        phi = np.concatenate((last.phi[1:], self._phi[None, :n, :n]))
        q = np.concatenate((last.q[1:], self._covs[:, :n, :n]))
        found = Block(np.empty(m * n), np.empty((m * n, m * n)))
        predict(self._w, *block, phi, q, *found)
        fold(self._w, *found, 0, m, 2 * m - 1, last.z, last.h, last.r, last.ends)
        return found

    def _first_blocks(self, start: Window) -> list[Block]:
        """Blocks that begin at the epochs 1 ... M of the start, from its posteriors there."""
        n, m, blocks = self.model.size, len(self._w), []
        for first, (mean, cov) in enumerate(self._starts[:m]):
            block, rest = Block(np.empty(m * n), np.empty((m * n, m * n))), first + 1
            begin(
                self._w, mean, cov, start.phi[rest : first + m], start.q[rest : first + m], *block
            )
            fold(self._w, *block, 1, rest, first + m, start.z, start.h, start.r, start.ends)
            blocks.append(block)
        return blocks

    def _rebase(self, blocks: list[Block]) -> None:
        """Rebase the stored blocks to small numbers (`rebase`)."""
        assert self._window is not None
        window = self._window
        means = np.array([b.mean for b in blocks])
        u, z = window.u.copy(), window.z.copy()
        rebase(self._w, window.phi, u, z, window.h, window.ends, means)
        self._window = window._replace(u=u, z=z)
        self._blocks = [Block(mean, b.cov) for mean, b in zip(means, blocks, strict=True)]
        self._starts = []

    def _fed_back(self) -> Array:
        """u (n,), now."""
        since: Array = self._dxs[1].copy()
        if self._window is not None:
            n = self.model.size
            since += self._phi[:n, :n] @ self._window.u[-1]
        return since

    def hold(self) -> None:
        """Estimate without feedback from now on; errors propagate beside the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back the held estimate."""
        self._holding = False
        self._feed_back(self._dxs[0])
        self._dxs[1] += self._dxs[0]
        self._dxs[0] = 0.0
        self._carrying = bool(self._dxs[1].any())

    def _own_snapshot(self) -> object:
        """Epochs, blocks and transition; lists and arrays are replaced, never written to."""
        kept = self._window, self._blocks, self._starts
        return (*kept, self._posterior, self._epoch_ns, self._carrying, self._phi.copy())

    def _own_restore(self, extra: object) -> None:
        """Restore the state of `_own_snapshot`."""
        assert isinstance(extra, tuple)
        self._window, self._blocks, self._starts, self._posterior = extra[:4]
        self._epoch_ns, self._carrying, phi = extra[4:]
        self._phi[:] = phi
