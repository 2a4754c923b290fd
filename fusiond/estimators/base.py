r"""Estimators: the interface of a closed-loop error-state filter, and its common part.

One navigation state is propagated through the IMU's samples, with one covariance and one error
estimate for each filter of the estimator (`covs`, `dxs`; filter 0 is published). An error estimate
is subtracted from the navigation state (`feed_back`); estimates of parameters stay in `xi`.

Gate: with S = H P H^T + R, nu^T S^-1 nu is chi-square with m degrees of freedom while filter and
measurement agree; beyond the quantile of the measurement's gate probability the measurement is
rejected.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1; Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import (
    LENT_ROWS,
    Innovation,
    Linearised,
    NotApplicable,
    Renewal,
    State,
)
from fusiond.estimators.corrected_imu import sensor_estimates
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.fault_bank_interface import Hypotheses
from fusiond.estimators.measurement_loop_kernel import KNOWS, RESULT, TURNED, run_for
from fusiond.estimators.propagation import (
    CARRY,
    HOLD_HEIGHT,
    PASSING,
    RECORD,
    propagate_for,
)
from fusiond.estimators.published_state import WIDER, Published, sigmas, surely_moves, widen
from fusiond.estimators.robust import reweighted
from fusiond.estimators.shared_error_renewal import renew
from fusiond.estimators.state_array import AHEAD, memory
from fusiond.estimators.update import feed_back, normalised_innovation_squared
from fusiond.estimators.update_with_exclusion import KEPT, Screened, screened
from fusiond.models.model import Model
from fusiond.navigation.chi_square import quantile
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import step_before

Array = NDArray[np.float64]


AS_STATED = np.ones(3)
_NO_WIDER = np.zeros(WIDER)


class _Thresholds(dict[tuple[float, int], float]):
    """Chi-square quantiles by gate probability and degrees of freedom, cached."""

    def __missing__(self, key: tuple[float, int]) -> float:
        found = self[key] = quantile(key[1], 1.0 - key[0])
        return found


THRESHOLDS = _Thresholds()
MANY = 1000.0
"""Number of innovations whose mean has no noise of its own to speak of: 3 % of one sigma."""


def gate_threshold(probability: float, degrees: int) -> float:
    """Chi-square quantile for a gate probability."""
    return THRESHOLDS[probability, degrees]


class Outcome(NamedTuple):
    """Outcome of a measurement: its name, and the innovation that led to it (NIS, dimension, and
    L^-1 nu with S = L L^T). `rows`: outcome of each row of a screened measurement
    (fusiond.estimators.update_with_exclusion); `whitened` is 0 for a rejected row. `lasting`: for
    an excluded measurement, the NIS if each of its possible faults lasts; `evidence_limits`:
    chi-square by which innovations without noise distinguish that from the fault's end. `first`:
    innovation of the first row, if a Kalman filter has fused the measurement at once, else NaN."""

    name: str
    nis: float = float("nan")
    degrees: int = 0
    whitened: tuple[float, ...] = ()
    rows: tuple[int, ...] = ()
    lasting: tuple[float, ...] = ()
    evidence_limits: tuple[float, ...] = ()
    first: float = math.nan  # the one that equals itself in a tuple


class Ran(NamedTuple):
    """Result of a run of packed measurements: number processed, `DONE` or the reason for stopping,
    results (k, RESULT)."""

    done: int
    how: int
    results: Array


class Snapshot(NamedTuple):
    """State for a later restore, `kept` and `held` as in `Memory`; `extra` is the estimator's
    own."""

    t_ns: int
    sample: int
    kept: Array
    held: Array | None
    holding: bool
    extra: object


class Estimator:
    """Interface of an estimator for timeline, navigator and studies, with the common part: state,
    propagation, feedback and snapshots.

    State at `t_ns` (ns) after samples of the buffer up to, not including, `sample` (absolute).
    `shares` (k,): filter i gets its process noise and its initial covariance divided by shares[i].
    """

    carries_transition: ClassVar[bool] = False
    """True if `_phi` (width, width) is propagated, too."""

    def __init__(
        self,
        model: Model,
        gap_s: float,
        shares: tuple[float, ...] = (1.0,),
        faults: FaultTable = NO_FAULTS,
    ) -> None:
        self.model = model
        self.t_ns = 0
        self.sample = 0
        self.passing = False
        """True after a propagation in passing, which must be repeated before an update."""
        self.published = Published(model.time_slot)
        """Axes and clock of publication: at first the clock of the model's receiver."""
        m = memory(model, round(gap_s * 1e9), shares, self.carries_transition, faults)
        self._memory, self._array, self.nav, self.xi, self.step = m, m.array, m.nav, m.xi, m.step
        self._phi, self._shares = m.phi, m.shares
        self.wider = m.wider
        """Variances (9,) that `sigmas` has beyond P's: what hypotheses of a fault leave open."""
        self._covs: Array = m.covs
        self._cov: Array = self._covs[0]
        self._covariance: Array = self._cov[: model.size, : model.size]
        lent = {rows: Innovation.unwritten(rows, model.size) for rows in range(LENT_ROWS + 1)}
        self._view = State(self.nav, self.xi, self.step, model, self._covariance, lent)
        self._dxs: Array = m.dxs
        self._dx: Array = self._dxs[0]
        m.published[:] = self.published
        own = m.bank, faults, model, (m.nav, m.xi, m.step, m.published), m.wider
        self.hypotheses = Hypotheses(*own) if faults.groups else None
        """Bank of fault hypotheses; None without one."""
        self._holding = False
        self._carrying = False
        self._run_with: tuple[NDArray[Any], ...] = ()
        """Arrays of `run`; none for an estimator that takes measurements one by one."""
        self._knows = np.zeros(KNOWS)
        self.turns = False
        """True while the heading may be far off, and updates have another form."""
        self.turned = 0.0
        """Rotation (rad) by the last fused update of the axes in which P has the tilt."""
        self.kernel_options = HOLD_HEIGHT if model.hold_height else 0
        self._kernel = propagate_for(model.width)

    @property
    def covariance(self) -> Array:
        """P (n, n) of the published error state, a view."""
        return self._covariance

    @property
    def isolates(self) -> bool:
        """True if it detects and excludes faulty sources itself."""
        return False

    @property
    def heading_known(self) -> bool:
        """True if the heading has been known since the start; a filter may lose it."""
        return False

    @property
    def runs(self) -> bool:
        """True if it takes packed measurements in one call: not while an estimate is held, or
        updates turn."""
        return bool(self._run_with) and not (self._holding or self.turns)

    @property
    def isolated(self) -> dict[str, str]:
        """Sources that a fault detection keeps out of the solution, and why."""
        return {}

    def publish_by(self, published: Published) -> None:
        """Set axes and clock of publication from the next start on."""
        self.published = published
        self._memory.published[:] = published

    def axes_known(self, sd_rad: float) -> None:
        """Set the sigma of the axes of the unit in use."""
        self.published = self.published._replace(axes_sd_rad=sd_rad)
        self._memory.published[:] = self.published

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Start at `t_ns` with nav (10,), parameters (n,), P (n, n)."""
        self.t_ns, self.sample = t_ns, sample
        self.nav[:], self.xi[:] = nav, xi
        p = covariance.copy()
        p[~self.model.active] = 0.0
        p[:, ~self.model.active] = 0.0
        n = self.model.size
        self._covs[:] = 0.0
        self._covs[:, :n, :n] = p / self._shares[:, None, None]
        self._dxs[:], self._holding, self.wider[:] = 0.0, False, 0.0
        self._memory.sums[:], self._memory.head[AHEAD], self.passing = 0.0, 0, False
        self.step[:] = step_before(nav)
        if self.hypotheses is not None:
            self.hypotheses.begin(t_ns, nav, self.step)

    def propagate(
        self, imu: ImuBuffer, target_ns: int, record: bool = False, passing: bool = False
    ) -> None:
        """Propagate to `target_ns`, or to the last earlier sample in the buffer. In `passing`, no
        update may follow there, and later results are bit for bit as without the call."""
        if self.hypotheses is not None:
            self.hypotheses.conclude()
        options = self.kernel_options
        if passing:
            options |= PASSING
        self.passing = passing
        if record:
            options |= RECORD
        if self._holding or self._carrying:
            options |= CARRY
        self.sample, self.t_ns = self._kernel(
            self._array, imu.packed, self.sample, self.t_ns, target_ns, options
        )

    def run(
        self, imu: ImuBuffer, rows: Array, series: Array, record: bool, kept: tuple[int, int]
    ) -> Ran:
        """Apply packed measurements `rows` (k, SIZE), each at its instant, with the noise of their
        `series` (s, .); `kept`: instant (ns) of the last checkpoint, and the interval to the next.
        """
        results = np.empty((len(rows), RESULT))
        options = self.kernel_options | (RECORD if record else 0)
        self.sample, self.t_ns, done, how = run_for(self.model.width)(
            *(self._array, imu.packed, rows, results, series, *self._run_with),
            *(self.sample, self.t_ns, options, self.model.hold_height, self.passing, *kept),
        )
        self.passing, self.turned = False, self._knows.item(TURNED)
        return Ran(done, how, results)

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Update by one measurement, or return the reason for its rejection; `noise` (3,): factors
        on the variances of its first three rows."""
        raise NotImplementedError

    def hold(self) -> None:
        """Estimate without feedback from now on; errors propagate beside the state."""
        raise NotImplementedError

    def release(self) -> None:
        """Feed back the held estimate."""
        raise NotImplementedError

    @property
    def state(self) -> State:
        """View of the filter for a measurement."""
        return self._view

    @property
    def sensor_errors(self) -> Array:
        """Estimates (12,): rate bias (rad/s), force bias (m/s^2), rate and force scale (1)."""
        estimate = np.empty(12)
        slot, kind = self.model.sensor_terms
        sensor_estimates(self.xi, slot, kind, estimate)
        return estimate

    def sigmas(self) -> Array:
        """One sigma (9,): position, velocity (n, e, d), roll, pitch, yaw."""
        if self.hypotheses is not None:
            self.hypotheses.conclude()
        out = np.empty(9)
        sigmas(self._covs[0], self.nav, self.step, *self.published, out)
        widen(self.wider, out)
        return out

    def surely_moves(self, published: bool) -> bool:
        """True if the horizontal velocity proves motion by its sigma: the `published` one, or P's
        alone."""
        of = self._cov, self.nav, self.step, self._memory.published
        if not surely_moves(*of, _NO_WIDER):
            return False
        if not published or self.hypotheses is None:
            return True
        self.hypotheses.conclude()
        return bool(surely_moves(*of, self.wider))

    def _feed_back(self, dx: Array) -> None:
        """Subtract the error estimate (n,) from the navigation state and add its parameters to
        `xi`."""
        if self.hypotheses is not None:
            self.hypotheses.keep_fed_back(dx)
        feed_back(self.nav, self.xi, dx)

    def _screen(self, measurement: Linearised, rows: Innovation, cov: Array, dx: Array) -> Screened:
        """Update by rows of a screened measurement, without changing `cov` and `dx`; a restarted
        clock changes `cov`."""
        return screened(measurement, rows, self.model, gate_threshold(measurement.gate, 1), cov, dx)

    def look(self, measurement: Linearised, lasting: Array | None = None) -> Outcome:
        """Innovation of an `isolated` measurement, without an update. `lasting` (k, 3): effect of
        each possible fault on it, if it lasts."""
        rows = self._linearise(measurement)
        if isinstance(rows, NotApplicable):
            return Outcome(rows.outcome)
        z, h, r = rows
        cov, dx = self.covariance.copy(), self._dxs[0]
        if self.hypotheses is not None:
            cov += self.hypotheses.opened_of_all()
        if measurement.screened:
            s = self._screen(measurement, rows, cov, dx)
            codes = tuple(s.codes.tolist())
            self._leave(measurement, codes)
            return Outcome("isolated", s.nis, codes.count(KEPT), (), codes)
        y = np.zeros(z.shape[0])
        nis = normalised_innovation_squared(cov, z - h @ dx, h, r, y)
        if lasting is None:
            return Outcome("isolated", nis, z.shape[0], tuple(y.tolist()))
        lefts = [z - h @ dx - added[: z.shape[0]] for added in lasting]
        lasts = tuple(normalised_innovation_squared(cov, nu, h, r, y.copy()) for nu in lefts)
        # The filter's own error is common to all of them, so that only their noise averages out.
        mean = [(added[: z.shape[0]], r / MANY) for added in lasting]
        limits = tuple(normalised_innovation_squared(cov, b, h, s, y.copy()) for b, s in mean)
        return Outcome("isolated", nis, z.shape[0], tuple(y.tolist()), (), lasts, limits)

    def adopt(self, mean: Array, spread: Array) -> None:
        """Subtract a fault's effect of mean (n,) from the state and add its `spread` (n, n) to
        P."""
        n, xi = self.model.size, self.xi.copy()
        self._correct(mean)
        if self.hypotheses is not None:
            self.hypotheses.decided(self.t_ns, self.nav, self.step, mean, xi, self._cov)
        self._cov[:n, :n] += spread
        self.wider[:] = 0.0

    def _correct(self, mean: Array) -> None:
        """Subtract a fault's effect (n,) from the state, as an update does."""
        self._feed_back(mean)

    def _renew(self, renewal: Renewal) -> None:
        """Renew shared errors of measurements from an instant on."""
        others = [self.xi, *self._dxs]
        if self.hypotheses is not None:
            self.hypotheses.conclude()
            others.append(self.hypotheses.sensitivities)
        renew(renewal, self.model, self._covs, others)
        if renewal.estimate is not None:
            self.xi[self.model.slots_of_all(renewal.blocks)] = renewal.estimate

    def _leave(self, measurement: Linearised, codes: tuple[int, ...]) -> None:
        """Clone the state for the next measurement; `codes` are the outcomes of the screened
        rows."""
        if measurement.screened:
            renewal = measurement.leaves(self._view, codes)
            if renewal is not None:
                self._renew(renewal)

    def _linearise(self, measurement: Linearised) -> Innovation | NotApplicable:
        """The measurement's innovation, linear in the error state."""
        return self._weighed(measurement, measurement.innovation(self._view))

    def _weighed(
        self, measurement: Linearised, rows: Innovation | NotApplicable
    ) -> Innovation | NotApplicable:
        """Rows with the weights of a robust measurement; others unchanged."""
        if not measurement.robust or isinstance(rows, NotApplicable):
            return rows
        return reweighted(rows, self.model, self.covariance, self._dxs[0])

    def snapshot(self) -> Snapshot:
        """Copy of the state, for `restore`."""
        if self.hypotheses is not None:
            self.hypotheses.conclude()
        m = self._memory
        held = m.held.copy() if m.head[AHEAD] else None
        extra = self._own_snapshot()
        return Snapshot(self.t_ns, self.sample, m.kept.copy(), held, self._holding, extra)

    def restore(self, s: Snapshot) -> None:
        """Restore a snapshot, bit for bit."""
        m = self._memory
        self.t_ns, self.sample, m.kept[:], _, self._holding, extra = s
        m.head[AHEAD] = s.held is not None
        self.passing = s.held is not None or bool(self.hypotheses and self.hypotheses.waits)
        if s.held is not None:
            m.held[:] = s.held
        self._own_restore(extra)

    def _own_snapshot(self) -> object:
        """Own state of a kind of estimator beside the shared state; never changed afterwards."""
        return None

    def _own_restore(self, extra: object) -> None:
        """Restore the state of `_own_snapshot`."""
