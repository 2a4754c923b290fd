"""`fusiond process --smooth`: the solution at each sample by all measurements, also later ones.

The filter runs as usual and records a tape (fusiond.estimators.smoothing). The daemon's solution at
each sample, in the last pass over it, is kept until the navigation has ended; then the smoother
runs backward over the tape and corrects it. Each start of the filter is smoothed separately,
because measurements before an alignment do not bear on the navigation after it. Invalid solutions
remain invalid: measurements that contradicted the filter cannot improve it backward.

Measurements at 12 instants a second make 0.3 GB of tape an hour, samples at 100 Hz 0.06 GB of
solutions. An hour is kept in memory; anything beyond it goes to a temporary file without a name in
TMPDIR. Nothing is thinned out or rounded to single precision: P_s = P - P Lambda P is a small
difference of large numbers where smoothing helps most.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config
from fusiond.estimators.smoothing.backward import Corrections, Smoother, correct, joined
from fusiond.estimators.smoothing.node import Nodes
from fusiond.estimators.smoothing.node_recorder import NEVER, Node, TapedKalman, nodes_of
from fusiond.files.solution_csv import SMOOTHED, STATUS
from fusiond.integrity.catalogue import Kind, table_of
from fusiond.models.model import Model
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.offline.solution_rows import Rows, RowsWriter

Held = list[NDArray[Any]] | tuple[int, int]
"""Arrays, or their place in the file and number."""

# Nodes and solutions that are put aside at once, some 13 MB and 1.4 MB; above the third number
# (bytes) they go to a file.
BLOCK_NODES, BLOCK_ROWS, MOST_BYTES = 2048, 8192, 512_000_000
_SMOOTHED, _INVALID = STATUS.index(SMOOTHED), STATUS.index(Mode.INVALID)


def taped(config: Config, model: Model, kinds: Sequence[Kind] = ()) -> TapedKalman:
    """Estimator of a configuration, with a tape and without protection levels, which do not apply
    to a smoothed solution. ConfigError for a filter that has no tape."""
    if config.estimator.filter != "kalman":
        raise ConfigError(
            f"estimator.filter: {config.estimator.filter!r} cannot be smoothed; choose 'kalman'"
        )
    return TapedKalman(model, config.imu.gap_s, faults=table_of(kinds))


class SmoothedRows:
    """Writer of the navigator's rows, smoothed once their start has ended.

    `navigator` has an estimator of `taped`. `rows`, `nodes`, `starts` count the smoothed ones.
    """

    def __init__(self, navigator: Navigator, writer: RowsWriter) -> None:
        estimator = navigator.estimator
        assert isinstance(estimator, TapedKalman)
        estimator.on_ended = self._finish
        self._navigator, self._estimator, self._writer = navigator, estimator, writer
        self._spool = _Spool()
        self._nodes: list[Held] = []
        self._rows: list[Held] = []
        self._kept: Node | None = None
        """The last node that was put aside."""
        self._first = 0
        """Number of the sample of the first pending row."""
        self._count = 0
        self._pending = _room(2 * BLOCK_ROWS)
        self.rows = self.nodes = self.starts = 0

    def follow(self) -> None:
        """Update after an advance of the navigator: rows of an earlier pass are replaced by the
        last one's."""
        e, imu = self._estimator, self._navigator.imu
        since = max(e.rewound, self._first, imu.start)
        upto = min(e.sample, self._first + self._count)
        if since < upto:
            ours = slice(since - self._first, upto - self._first)
            theirs = slice(since - imu.start, upto - imu.start)
            self._pending.nav[ours] = imu.nav[theirs]
            self._pending.sigmas[ours] = imu.sigmas[theirs]
        e.rewound = NEVER

    def take(self, first: int, rows: Rows) -> None:
        """Add rows of the samples from number `first` on, in sequence."""
        if not self._count:
            self._first = first
        begin, end = self._count, self._count + len(rows.times)
        if end > len(self._pending.times):
            grown = _room(2 * end)
            for ours, before in zip(grown, self._pending, strict=True):
                ours[:begin] = before[:begin]
            self._pending = grown
        for ours, new in zip(self._pending, rows, strict=True):
            ours[begin:end] = new
        self._count = end
        self._put_aside()

    def _put_aside(self) -> None:
        """Store rows that no rewind can reach in a file."""
        needed = self._navigator.imu.needed
        final = 0 if needed is None else min(needed - self._first, self._count)
        if final >= BLOCK_ROWS:
            self._rows.append(self._spool.put(*self._pending.part(0, final)))
            left = self._pending.part(final, self._count)
            for column, rest in zip(self._pending, left, strict=True):
                column[: len(rest)] = rest.copy()
            self._first, self._count = self._first + final, self._count - final
        newest, kept = self._estimator.newest, self._kept
        if newest is None:
            return
        if newest.number - (-1 if kept is None else kept.number) > 2 * BLOCK_NODES:
            nodes, last = nodes_of(newest, kept, self._navigator.timeline.oldest_ns)
            if last is not None:
                self._nodes.append(self._spool.put(*nodes))
                self.nodes += len(nodes.t_ns)
                last.previous, self._kept = None, last

    def _finish(self, newest: Node) -> None:
        """Smooth the navigation since one start and write its rows."""
        nodes, _ = nodes_of(newest, self._kept, NEVER)
        # A filter that has failed numerically is given up at once: its last node is not used.
        unsound = np.flatnonzero(~np.isfinite(nodes.bodies).all(axis=1))
        if unsound.size:
            nodes = nodes.first(int(unsound[0]))
        self.nodes += len(nodes.t_ns)
        self.starts += 1
        smoother = Smoother(self._estimator.model, self._estimator.published)
        back = [smoother.back(nodes).corrections]
        for held in reversed(self._nodes):
            back.append(smoother.back(Nodes(*self._spool.get(held))).corrections)
        back.reverse()
        found = joined(back)
        for held in self._rows:
            self._write(found, Rows(*self._spool.get(held)))
        self._write(found, self._pending.part(0, self._count))
        self._spool.close()
        self._nodes, self._rows, self._kept, self._count = [], [], None, 0

    def _write(self, found: Corrections, rows: Rows) -> None:
        done = correct(*found, rows.times, rows.nav, rows.sigmas)
        smoothed = rows.status[:done]
        smoothed[smoothed != _INVALID] = _SMOOTHED
        self.rows += int((smoothed == _SMOOTHED).sum())
        self._writer.write(rows)

    def counts(self) -> dict[str, int]:
        """Result of smoothing: rows, starts of the filter, nodes."""
        return {"rows": self.rows, "starts": self.starts, "nodes": self.nodes}

    def close(self) -> None:
        """End the rows."""
        self._estimator.end()


def _room(count: int) -> Rows:
    return Rows(
        np.empty(count, dtype=np.int64),
        np.empty((count, 10)),
        np.empty((count, 9)),
        np.empty(count, dtype=np.int64),
    )


class _Spool:
    """Store of array tuples, in memory while few, else in a temporary file."""

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._held_bytes = 0

    def put(self, *arrays: NDArray[Any]) -> Held:
        """Store arrays; return a handle to read them back."""
        size = sum(array.nbytes for array in arrays)
        if self._held_bytes + size <= MOST_BYTES:
            self._held_bytes += size
            return [array.copy() if array.base is not None else array for array in arrays]
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - until close()
        place = self._file.seek(0, 2)
        for array in arrays:
            np.save(self._file, array)
        return place, len(arrays)

    def get(self, held: Held) -> list[NDArray[Any]]:
        """Get stored arrays."""
        if isinstance(held, list):
            return held
        assert self._file is not None
        place, count = held
        self._file.seek(place)
        return [np.load(self._file) for _ in range(count)]

    def close(self) -> None:
        """Forget all."""
        self._held_bytes = 0
        if self._file is not None:
            self._file.close()
            self._file = None
