r"""Federated filter: a local filter for each source of measurements, a master, fault isolation.

Every local filter estimates the whole error state of the one common navigation state from its own
source's measurements; the master fuses the estimates and feeds the result back. Sharing factors
beta_i, sum beta_i = 1, divide the common information: the initial estimate, the process noise, and
measurements of no source (standstill, an operator):

    P_i(0) = P(0) / beta_i,   Q_i = Q / beta_i,   R_i = R / beta_i of a common measurement

so that the sum of the information is that of one filter. P_i is then an upper bound that allows
treating the estimates as uncorrelated (Carlson, 1990, section III), and P_g = (sum P_i^-1)^-1
bounds the fused estimate: its covariance if the parts are fused at once, more if local filters
continue, as (sum (P_i + Q / beta_i)^-1)^-1 >= (sum P_i^-1)^-1 + Q.

Local filters after a fusion, which is after every update:

`no_reset`      nothing; x_i <- x_i - x_g as the navigation state is corrected. Nothing comes from
                one local filter into another.
`fusion_reset`  x_i <- x_g, P_i <- P_g / beta_i. Equal to the centralised filter.
`zero_reset`    the master keeps all, a local filter starts its next update with no information:
                beta_i = 0, the master's own part is 1. Equal to the centralised filter too.
`rescale`       a local filter that was updated keeps the part `retained` of its information and
                hands the rest to the master's own estimate: P_i <- P_i / retained.

The first and the last are in fusiond.estimators.federated.no_reset, those with a reset in
fusiond.estimators.federated.reset; this module has what they share.

Source: Carlson, IEEE Trans. AES 26 (1990), 517; Carlson and Berarducci, NAVIGATION 41 (1994), 297;
paper 004, section 3. Tests and isolation: fusiond.estimators.federated.isolation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable
from fusiond.estimators.base import AS_STATED, Estimator, Outcome, gate_threshold
from fusiond.estimators.federated.fusion_kernels import combine
from fusiond.estimators.federated.isolation import INNOVATION, FaultDetection, Record
from fusiond.estimators.federated.options import FederatedOptions, local_of
from fusiond.estimators.update import normalised_innovation_squared, update
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.models.blocks import CLOCK_OFFSET
from fusiond.models.model import Model

Array = NDArray[np.float64]

# No adaptive factor falls below this part of an equal one: a filter that starves cannot come back.
LEAST_PART = 0.1


class _Own(NamedTuple):
    arrays: tuple[Array, ...]
    records: tuple[Record, ...]


class FederatedFilter(Estimator):
    """Common part of the modes; `names` are the local filters.

    `_bank` (k, width, width) and `_bank_dxs` (k, n) are estimates to be fused, `_factors` (N,) the
    sharing factors of the local filters.
    """

    def __init__(
        self, model: Model, gap_s: float, names: tuple[str, ...], options: FederatedOptions
    ) -> None:
        super().__init__(model, gap_s)
        if not names:
            raise ValueError("a federated filter needs at least one local filter")
        if options.shares and (len(options.shares) != len(names) or not min(options.shares) > 0.0):
            raise ValueError("one positive share for each local filter")
        self.options, self.names = options, names
        relative = np.array(options.shares) if options.shares else np.ones(len(names))
        self._nominal: Array = relative / relative.sum()
        self._factors: Array = np.zeros(len(names))
        self._faults = FaultDetection(
            len(names), options.false_alarm, options.window, options.readmit_after
        )
        self._local_of: dict[str, int | None] = {}
        estimates = self._estimates
        self._bank: Array = np.zeros((estimates, model.width, model.width))
        self._bank_dxs: Array = np.zeros((estimates, model.size))
        self._weight: Array = np.zeros(estimates)
        self._arrange(model.active)
        self._share_out(self._nominal)

    @property
    def _estimates(self) -> int:
        """Number of estimates in `_bank`."""
        raise NotImplementedError

    def _arrange(self, used: NDArray[np.bool_]) -> None:
        """Lay out the work space: the used states, position and velocity last."""
        slots = np.flatnonzero(used)
        tested = (slots >= 3) & (slots < 9)
        self._order = np.concatenate([slots[~tested], slots[tested]]).astype(np.int64)
        self._tested = int(tested.sum())
        k, a = len(self._weight), len(slots)
        self._infos: Array = np.zeros((k + 1, a, a))
        self._vectors: Array = np.zeros((k + 1, a))
        self._scale: Array = np.ones(a)
        self._fused: Array = np.zeros((a, a))
        self._estimate: Array = np.zeros(a)
        self._trace: Array = np.zeros(k)

    @property
    def isolates(self) -> bool:
        """True if it detects and excludes faulty sources itself."""
        return self.options.fault_detection

    @property
    def isolated(self) -> dict[str, str]:
        """Sources that a fault detection keeps out of the solution, and why."""
        records = zip(self.names, self._faults.records, strict=True)
        return {name: record.reason for name, record in records if record.reason}

    @property
    def shares(self) -> dict[str, float]:
        """The sharing factors of the local filters."""
        return dict(zip(self.names, self._factors.tolist(), strict=True))

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        super().initialise(t_ns, sample, nav, xi, covariance)
        # A state that is known exactly and stays so has no information matrix.
        known = (np.diag(covariance) <= 0.0) & (self.model.noise[1:] <= 0.0).all(axis=0)
        self._arrange(self.model.active & ~known)
        self._faults.reset()
        self._share_out(self._nominal)

    # ------------------------------------------------------------------ update

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection.

        NIS and whitened innovation of the outcome are those of the published estimate; for a
        screened measurement those of the filter that judges its rows.
        """
        i = self._linearise(measurement)
        if isinstance(i, NotApplicable):
            return Outcome(i.outcome)
        if measurement.source not in self._local_of:
            self._local_of[measurement.source] = local_of(measurement.source, self.names)
        local = self._local_of[measurement.source]
        isolated = local is not None and self._faults.is_isolated(local)
        self._bring_up()
        judge = None if isolated else local
        cov, dx = self._judge(judge)
        if measurement.screened:
            return self._update_by_rows(measurement, i, local, cov, dx)
        degrees = i.z.shape[0]
        threshold = gate_threshold(measurement.gate, degrees)
        y = np.zeros(degrees)
        nis = published = normalised_innovation_squared(cov, i.z - i.h @ dx, i.h, i.r, y)
        if judge is not None and self.options.mode == "no_reset":
            z = i.z - i.h @ self._dxs[0]
            published = normalised_innovation_squared(self._covs[0], z, i.h, i.r, y)
        if not (math.isfinite(nis) and math.isfinite(published)):
            return Outcome("not_finite", nis, degrees)
        whitened = tuple(y.tolist()) if published <= threshold else ()
        if not self._believes(local, nis, degrees, threshold):
            return Outcome("isolated", published, degrees, whitened)
        if nis > threshold:
            return Outcome("gated", published, degrees)
        return Outcome(self._fold(local, i), published, degrees, whitened)

    def _update_by_rows(
        self,
        measurement: Linearised,
        rows: Innovation,
        local: int | None,
        cov: Array,
        dx: Array,
    ) -> Outcome:
        """Update a local filter by all rows, or by none.

        For the innovation test an epoch counts with the rows that pass, or as failed if most do
        not: screening removes single bad satellites.
        """
        trial = cov.copy()
        s = self._screen(measurement, rows, trial, dx)
        kept = s.codes == KEPT
        count, most = int(kept.sum()), 2 * int(kept.sum()) >= len(kept)
        degrees = count if most else len(kept)
        nis = s.nis if most else math.inf
        codes = tuple(s.codes.tolist())
        if not self._believes(local, nis, degrees, gate_threshold(measurement.gate, degrees)):
            return Outcome("isolated", s.nis, count, (), codes)
        if not kept.any():
            return Outcome("gated", s.nis, 0, (), codes)
        offsets = self.model.slots_of(CLOCK_OFFSET)
        if not np.array_equal(trial[offsets], cov[offsets]):
            self._forget_clock(offsets)
        name = self._fold(local, Innovation(rows.z[kept], rows.h[kept], rows.r[kept]))
        return Outcome(name, s.nis, int(kept.sum()), tuple(s.y.tolist()), codes)

    def _believes(self, local: int | None, nis: float, degrees: int, threshold: float) -> bool:
        """Test an innovation; True if its filter is trusted afterwards."""
        if local is None:
            return True
        if self._faults.is_isolated(local):
            if self._faults.behaves(local, nis, degrees, threshold):
                self._take_back(local)
            return False
        sound = self._faults.innovation(local, nis, degrees, threshold)
        return sound or not self._isolate(local, INNOVATION)

    def _forget_clock(self, offsets: list[int]) -> None:
        """Reset the clock offsets after the receiver has set its clock."""
        initial = self.model.initial[offsets] ** 2
        for cov, share in self._kept():
            cov[offsets] = 0.0
            cov[:, offsets] = 0.0
            cov[offsets, offsets] = initial / share

    # ------------------------------------------------------------------ what a mode says

    def _bring_up(self) -> None:
        """Make the bank ready for an update."""

    def _judge(self, local: int | None) -> tuple[Array, Array]:
        """Covariance and error estimate for the gate of a measurement."""
        return self._covs[0], self._dxs[0]

    def _kept(self) -> list[tuple[Array, float]]:
        """The covariances that are kept between updates, with their shares."""
        return [(self._covs[0], 1.0)]

    def _fold(self, local: int | None, i: Innovation) -> str:
        """Fold an innovation that passed its gate into one local filter or all; its outcome."""
        raise NotImplementedError

    def _take_back(self, local: int) -> None:
        """Start a readmitted local filter from the master."""
        raise NotImplementedError

    def _leave_out(self, local: int) -> None:
        """Remove an isolated local filter's information from the master."""
        raise NotImplementedError

    # ------------------------------------------------------------------ parts of an update

    @staticmethod
    def _fuse_into(cov: Array, dx: Array, i: Innovation, share: float = 1.0) -> None:
        """Fold the share of an innovation into an estimate, without gate and feedback."""
        update(cov, dx, i.z, i.h, i.r / share)

    def _combine(self) -> bool:
        """Fuse the bank's estimates with `_weight` into the work space."""
        return combine(
            self._bank,
            self._bank_dxs,
            self._weight,
            self._order,
            self._infos,
            self._vectors,
            self._scale,
            self._fused,
            self._estimate,
            self._trace,
        )

    def _isolate(self, local: int, reason: str) -> bool:
        """Isolate a local filter, if the others suffice; True if done."""
        if not (self.options.fault_detection and self._faults.may_isolate(local, self.t_ns)):
            return False
        self._faults.isolate(local, reason)
        self._share_out(self._nominal)
        self._leave_out(local)
        return True

    def _believed(self) -> list[int]:
        return [i for i in range(len(self.names)) if not self._faults.is_isolated(i)]

    def _share_out(self, parts: Array) -> None:
        """Set the factors from `parts` (N,): those of the trusted filters sum to 1."""
        believed = self._believed()
        self._factors[:] = parts
        self._factors[believed] /= parts[believed].sum()

    def _adapt(self, trace: Array) -> None:
        """Factors proportional to 1 / `trace` (N,), scaled traces of the local covariances."""
        part = np.divide(1.0, trace, out=np.zeros_like(trace), where=trace > 0.0)
        self._share_out(np.maximum(part / part.sum(), LEAST_PART / len(part)))

    # ------------------------------------------------------------------ snapshots

    def _kept_arrays(self) -> tuple[Array, ...]:
        """Arrays of a snapshot beside those of every filter."""
        return (self._factors,)

    def _own_snapshot(self) -> object:
        return _Own(tuple(a.copy() for a in self._kept_arrays()), tuple(self._faults.records))

    def _own_restore(self, extra: object) -> None:
        assert isinstance(extra, _Own)
        for array, kept in zip(self._kept_arrays(), extra.arrays, strict=True):
            array[:] = kept
        self._faults.records = list(extra.records)

    # ------------------------------------------------------------------ feedback

    def _feed_back_published(self) -> None:
        """Feed back the published estimate, unless feedback is held."""
        if self._holding:
            return
        self._feed_back(self._dxs[0])
        self._shift(self._dxs[0])
        self._dxs[0] = 0.0

    def _shift(self, x: Array) -> None:
        """Correct the error estimates for a correction `x` (n,) of the navigation state."""

    def hold(self) -> None:
        """Estimate without feedback from now on; errors propagate beside the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back the held estimate."""
        self._holding = False
        self._feed_back_published()
