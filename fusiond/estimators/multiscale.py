r"""Multi-scale filter: M = 2^(N-1) successive states estimated together, in the wavelet domain.

An epoch is an instant at which an aid was fused. With epoch k the block (k-M+1 ... k) is predicted
from the block (k-2M+1 ... k-M), updated with what was measured at its M epochs, and its last
element is the solution. So M chains of blocks run interleaved; each sees every measurement once.
What follows from what is said in `fusiond.estimators.multiscale_block`.

Feedback: u is all that was ever fed back, carried along by the transitions,

    u_(j+1) = Phi_j u_j + d_(j+1),   y = x + u:   y_(j+1) = Phi_j y_j + w_j,   z + H u = H y + v

so y has no inputs. Blocks estimate y; with its estimate y^ of now, d = y^ - u is fed back.

The first 2M - 1 epochs are an ordinary filter's. Its posteriors at the epochs 1 ... M are the first
elements of the first blocks (eq. 21 and 22). N = 1 is the ordinary filter throughout.

Source: paper 001, sections 3 and 4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised, NotApplicable
from fusiond.estimators.base import ErrorStateFilter, Outcome, gate_threshold
from fusiond.estimators.model import Model
from fusiond.estimators.multiscale_block import (
    Block,
    Epoch,
    begin,
    fold,
    newest,
    predict,
    rebased,
    rows_on,
)
from fusiond.estimators.update import fuse
from fusiond.estimators.wavelet import wavelet_matrix

Array = NDArray[np.float64]


class MultiscaleEstimator(ErrorStateFilter):
    """Block filter of paper 001 (`fusiond.estimators.base.Estimator`).

    `scales` N is 1 to 4; `wavelet` a PyWavelets name, orthonormal (ValueError if not).
    Covariance 0 is the published P, covariance 1 the noise Q since the last epoch; error estimate 0
    is what `hold` carries, 1 what was fed back since the last epoch apart from a measurement.
    """

    def __init__(
        self, model: Model, gap_s: float, scales: int = 2, wavelet: str = "haar"
    ) -> None:
        super().__init__(model, gap_s, (1.0, 1.0))
        self._w = wavelet_matrix(wavelet, scales)
        self._phi = np.eye(model.width)
        self._window: list[Epoch] = []
        self._blocks: list[Block] = []
        self._starts: list[tuple[Array, Array]] = []
        self._epoch_ns = 0

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        self._begin_anew()

    def _begin_anew(self) -> None:
        """No epoch yet: what follows starts from covariance 0."""
        self._window, self._blocks, self._starts = [], [], []
        self._since_epoch()

    def _since_epoch(self) -> None:
        """Nothing has happened since the last epoch."""
        self._covs[1], self._dxs[1], self._carrying = 0.0, 0.0, False
        self._phi[:] = np.eye(len(self._phi))

    def update(self, aid: Linearised, inflate: bool = False) -> Outcome:
        """Fold one aid in, or name why not. With `inflate`, a failed gate widens P and passes:
        blocks that were wrong are given up, and the start comes again."""
        innovation = aid.innovation(self.state)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        z, h, r = innovation
        degrees = z.shape[0]
        threshold = gate_threshold(aid.gate, degrees)
        nis, y = self._fuse(z, h, r, threshold)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        if not inflate:
            return Outcome("gated", nis, degrees)
        self._widen(self._covs[0], z - h @ self._dxs[0], h)
        self._begin_anew()
        self._fuse(z, h, r, math.inf)
        return Outcome("fused", nis, degrees)

    def _fuse(self, z: Array, h: Array, r: Array, threshold: float) -> tuple[float, Array]:
        """NIS and whitened innovation (m,); beyond `threshold` nothing has changed."""
        n, w = self.model.size, self._w
        again = bool(self._window) and self.t_ns == self._epoch_ns
        u = self._fed_back()
        phi, q = self._phi[:n, :n].copy(), self._covs[1, :n, :n].copy()
        epoch = Epoch(phi, q, u, z + h @ u, h, r)
        starting = not self._blocks and len(self._window) + (not again) < 2 * len(w)
        if starting:
            block = Block(u + self._dxs[0], self._covs[0, :n, :n].copy())
            w = np.ones((1, 1))
        elif again:
            last = self._blocks[-1]
            block = Block(last.mean.copy(), last.cov.copy())
        else:
            blocks = self._blocks or self._first_blocks()
            block = predict(w, blocks[0], [*self._window[1:], epoch])
            fold(w, block, 0, self._window[len(w) :])
        y = np.zeros(len(z))
        rows = rows_on(w, len(w) - 1, h)
        nis = fuse(self.nav, self.xi, block.cov, block.mean, epoch.z, rows, r, threshold, True, y)
        if not nis <= threshold:
            return nis, y
        mean, self._covs[0, :n, :n] = newest(w, block)
        if self._holding:
            self._dxs[0] = mean - u
        else:
            self._feed_back(mean - u)
            epoch = epoch._replace(u=mean)
        if again:
            before = self._window.pop()
            epoch = Epoch(
                before.phi,
                before.q,
                epoch.u,
                np.concatenate([before.z, epoch.z]),
                np.vstack([before.h, h]),
                np.concatenate([before.r, r]),
            )
        self._window.append(epoch)
        if starting:
            del self._starts[len(self._window) - 1 :]
            self._starts.append((mean, self._covs[0, :n, :n].copy()))
        elif again:
            self._blocks[-1] = block
        else:
            self._starts.clear()
            self._window, self._blocks = rebased(self._w, self._window[1:], [*blocks[1:], block])
        self._epoch_ns = self.t_ns
        self._since_epoch()
        return nis, y

    def _first_blocks(self) -> list[Block]:
        """Blocks that begin at the epochs 1 ... M of the start, from its posteriors there."""
        m, found = len(self._w), []
        for first, (mean, cov) in enumerate(self._starts[:m]):
            following = self._window[first + 1 : first + m]
            block = begin(self._w, mean, cov, following)
            fold(self._w, block, 1, following)
            found.append(block)
        return found

    def _fed_back(self) -> Array:
        """u (n,), now."""
        since: Array = self._dxs[1].copy()
        if self._window:
            n = self.model.size
            since += self._phi[:n, :n] @ self._window[-1].u
        return since

    def hold(self) -> None:
        """From now on estimate without feedback: errors are carried along with the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back what was carried."""
        self._holding = False
        self._feed_back(self._dxs[0])
        self._dxs[1] += self._dxs[0]
        self._dxs[0] = 0.0
        self._carrying = bool(self._dxs[1].any())

    def _own_snapshot(self) -> object:
        """Epochs, blocks and transition; their arrays are never written to again."""
        lists = tuple(self._window), tuple(self._blocks), tuple(self._starts)
        return (*lists, self._epoch_ns, self._carrying, self._phi.copy())

    def _own_restore(self, extra: object) -> None:
        """Back to what `_own_snapshot` gave."""
        assert isinstance(extra, tuple)
        window, blocks, starts, self._epoch_ns, self._carrying, phi = extra
        self._window, self._blocks, self._starts = list(window), list(blocks), list(starts)
        self._phi[:] = phi
