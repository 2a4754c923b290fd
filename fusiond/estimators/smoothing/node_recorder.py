"""Kalman filter that records nodes for the smoother. It propagates each sample alone
(fusiond.estimators.multi_sample_covariance): its sigmas equal the other filter's within 1e-4 of
them.

Nodes form a linked list, the newest first. A snapshot holds the newest node of its instant, so a
rewind restores the tape with the state and drops later nodes: the tape is always that of the last
pass. A new start begins a new tape.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable, Renewal
from fusiond.estimators.base import Outcome, Snapshot
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.published_state import Published
from fusiond.estimators.shared_error_renewal import renew
from fusiond.estimators.smoothing.node import Nodes, body_size, links, write_body, write_rows
from fusiond.estimators.tilt_axes_rotation_after_update import turn_rows
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.estimators.update_with_exclusion import KEPT, Screened
from fusiond.models.blocks import CLOCK_OFFSET
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import NAV_SIZE, Q0

Array = NDArray[np.float64]

# Nodes lie no further apart (ns): between two the correction of the navigation state is taken for
# linear. A tilt of 2 deg that is corrected accelerates by 0.34 m/s^2, which over 0.25 s bends the
# position by a v^2 / 8 = 3 mm.
SPACING_NS = 250_000_000
NEVER = 1 << 62


class Node:
    """Node and its predecessor; `number` counts from the start of the tape."""

    __slots__ = ("body", "number", "ops", "previous", "t_ns")

    def __init__(self, previous: Node | None, t_ns: int, body: Array, ops: Array) -> None:
        self.previous, self.t_ns, self.body, self.ops = previous, t_ns, body, ops
        self.number: int = previous.number + 1 if previous is not None else 0


class _Kept(NamedTuple):
    """State of a snapshot."""

    newest: Node | None
    ops: tuple[Array, ...]
    fed_back: Array
    phi: Array
    closed_ns: int
    undoubted: bool


class TapedKalman(TiltAxesFilter):
    """The centralised filter (`fusiond.estimators.base.Estimator`), with a tape.

    `newest` is the newest node of the present start; `on_ended` receives the last node of an ended
    start.
    """

    carries_transition = True
    packs = False

    def __init__(
        self,
        model: Model,
        gap_s: float,
        on_ended: Callable[[Node], None] = lambda newest: None,
        faults: FaultTable = NO_FAULTS,
    ) -> None:
        super().__init__(model, gap_s, faults)
        self.newest: Node | None = None
        self.rewound = NEVER
        """Oldest sample that a rewind has revoked since the last reset to `NEVER`."""
        self.on_ended = on_ended
        self._before: Array = np.zeros_like(self._covs[0])
        self._rows: Innovation | NotApplicable = NotApplicable("")
        self._ops: list[Array] = []
        self._none: Array = np.empty((0, 2 * model.size + 2))
        self._fed_back: Array = np.zeros(model.size)
        self._closed_ns = 0
        self._links = links(model)
        self._body_size = body_size(model.size, self._links.shape[1])

    # ------------------------------------------------------------------ the tape

    def initialise(self, t_ns: int, sample: int, nav: Array, xi: Array, covariance: Array) -> None:
        """Initialise at `t_ns` with nav (10,), parameters (n,), P (n, n), and an empty tape."""
        self.end()
        super().initialise(t_ns, sample, nav, xi, covariance)
        self._phi[:], self._fed_back[:] = np.eye(len(self._phi)), 0.0
        self._ops, self.rewound = [], NEVER
        self._close()

    def publish_by(self, published: Published) -> None:
        """Set axes and clock of publication from the next start on: a tape has one clock and one
        unit."""
        self.end()
        super().publish_by(published)

    def end(self) -> None:
        """End the tape of this start."""
        if self.newest is None:
            return
        if self.t_ns > self._closed_ns or self._ops:
            self._close()
        newest, self.newest = self.newest, None
        self.on_ended(newest)

    def _close(self) -> None:
        """Close a node with the input since the last one."""
        body = np.empty(self._body_size)
        dx = self._dxs[0]
        write_body(
            *(self._covs[0], self._phi, dx, self._fed_back, self.nav, self.xi, self.step),
            *(self._links, self.published.time_slot, body),
        )
        ops = self._ops[0] if len(self._ops) == 1 else np.concatenate([self._none, *self._ops])
        self.newest = Node(self.newest, self.t_ns, body, ops)
        self._ops, self._closed_ns = [], self.t_ns

    def _fold(self, held: Array, z: Array, h: Array, r: Array) -> None:
        """Fold rows, already in `_before`, with the held estimate `held` (n,) before them."""
        ops = np.empty((len(z), 2 * len(held) + 2))
        write_rows(self._before, held, z, h, r, ops)
        self._ops.append(ops)
        if not self._holding:
            self._fed_back += held

    # ------------------------------------------------------------------ the filter

    def propagate(
        self, imu: ImuBuffer, target_ns: int, record: bool = False, passing: bool = False
    ) -> None:
        """Propagate to `target_ns`, or to the last sample that the buffer holds before it."""
        if self._ops and target_ns > self.t_ns:
            self._close()
        while target_ns - self._closed_ns > SPACING_NS:
            # At a whole sample: an interval that is split gives other last bits.
            row = int(np.searchsorted(imu.times[: imu.end], self._closed_ns + SPACING_NS))
            if row >= imu.end or imu.times[row] >= target_ns:
                break
            super().propagate(imu, int(imu.times[row]), record)
            self._close()
        super().propagate(imu, target_ns, record)

    def _fold_in(self, measurement: Linearised, noise: Array) -> Outcome:
        np.copyto(self._before, self._covs[0])
        held = self._dxs[0].copy()
        outcome = super()._fold_in(measurement, noise)
        rows = self._rows
        if outcome.name == "fused" and not isinstance(rows, NotApplicable):
            z, h, r = rows
            if measurement.screened:
                kept = np.array(outcome.rows) == KEPT
                z, h, r = z[kept], h[kept], r[kept]
            self._fold(held, z, h, r)
        return outcome

    def _carry_over(self, before: Array) -> None:
        """P after an update of an `_estimate` `before`."""
        self._close()  # with P as it was: T begins the transition to the next node
        super()._carry_over(before)
        turn_rows(self._phi, before[Q0:NAV_SIZE], self.nav[Q0:], *self._biases)
        self._keep(self._phi, before)

    def _renew(self, renewal: Renewal) -> None:
        """Renew shared errors of measurements, with the correlation to their earlier values."""
        self._close()  # with P as it was
        renew(renewal, self.model, (), (self._phi,))
        super()._renew(renewal)

    def _linearise(self, measurement: Linearised) -> Innovation | NotApplicable:
        """The measurement's innovation, linear in the error state."""
        self._rows = super()._linearise(measurement)
        return self._rows

    def _screen(self, measurement: Linearised, rows: Innovation, cov: Array, dx: Array) -> Screened:
        """Update by rows of a screened measurement. A receiver's clock that restarts has no
        past."""
        before = cov.copy()
        screened = super()._screen(measurement, rows, cov, dx)
        if np.may_share_memory(cov, self._covs):
            offsets = self.model.slots_of(CLOCK_OFFSET)
            if not np.array_equal(before[offsets], cov[offsets]):
                renewed = cov.copy()
                np.copyto(cov, before)
                self._close()
                np.copyto(cov, renewed)
                self._phi[offsets] = 0.0
            np.copyto(self._before, cov)
        return screened

    def adopt(self, mean: Array, spread: Array) -> None:
        """Subtract a fault's effect of mean (n,) from the state and add its `spread` (n, n) to
        P."""
        self._close()  # with P as it was: what was before does not jump
        self._fed_back += mean
        super().adopt(mean, spread)
        self._close()

    def release(self) -> None:
        """Feed back the held estimate."""
        self._fed_back += self._dxs[0]
        super().release()
        self._close()

    def _own_snapshot(self) -> object:
        return _Kept(
            self.newest,
            tuple(self._ops),
            self._fed_back.copy(),
            self._phi.copy(),
            self._closed_ns,
            self.undoubted,
        )

    def _own_restore(self, extra: object) -> None:
        assert isinstance(extra, _Kept)
        self.newest, self._ops, self._closed_ns = extra.newest, list(extra.ops), extra.closed_ns
        self._fed_back[:], self._phi[:] = extra.fed_back, extra.phi
        self.undoubted = extra.undoubted

    def restore(self, s: Snapshot) -> None:
        """Restore a snapshot, bit for bit."""
        self.rewound = min(self.rewound, s.sample)
        super().restore(s)


def nodes_of(newest: Node, after: Node | None, upto_ns: int) -> tuple[Nodes, Node | None]:
    """Nodes after `after` (None: all) up to `newest` and `upto_ns`, oldest first; and the last of
    them, None without any."""
    found: list[Node] = []
    node: Node | None = newest
    while node is not None and node is not after:
        if node.t_ns <= upto_ns:
            found.append(node)
        node = node.previous
    found.reverse()
    nodes = Nodes(
        np.array([node.t_ns for node in found], dtype=np.int64),
        np.array([node.body for node in found]) if found else np.empty((0, newest.body.size)),
        np.array([len(node.ops) for node in found], dtype=np.int64),
        np.concatenate([newest.ops[:0], *(node.ops for node in found)]),
    )
    return nodes, found[-1] if found else None
