"""Consistency monitors of all sources: the evidence of their innovations on the filter's sigma."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain, groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.estimators.base import Outcome
from fusiond.integrity.consistency import (
    FEWEST,
    Consistency,
    ConsistencyOptions,
    Verdict,
)
from fusiond.integrity.innovation_window import ConsistencyMonitor
from fusiond.models.model import Model

Array = NDArray[np.float64]


@dataclass(slots=True)
class _Series:
    """Monitor with its input: m, global number, innovation (m,), NIS."""

    monitor: ConsistencyMonitor
    waiting: list[tuple[int, int, Sequence[float] | Array, float]] = field(default_factory=list)


class Verdicts:
    """Monitors of all sources, fed with the innovations of fused measurements.

    A measurement may hold several series (`AidingMeasurement.series`), each with a monitor of its
    own: a receiver's raw epochs have one for each satellite system, `<source>_<system>`.

    Innovations are stored on arrival and judged together by `report`: a run through files brings
    hundreds of them at once. `on_change(source, verdict)` then receives changed verdicts.
    Constraints are not judged. Errors that a source's measurements share through states of `model`
    are not visible in innovations (`AidingMeasurement.shares`).
    """

    def __init__(
        self, window: int, alpha: float, model: Model, on_change: Callable[[str, str], None]
    ) -> None:
        self._window, self._alpha, self._model = window, alpha, model
        self._on_change = on_change
        self._series: dict[str, _Series] = {}
        self._heard = 0
        self.waiting: list[tuple[AidingMeasurement, Outcome]] = []
        """Fused measurements not yet judged, once each even after rewinds."""
        self._turned: list[tuple[int, str, Verdict]] = []
        """Changed verdicts not yet reported, with the number of the innovation."""

    def judge(self, measurement: AidingMeasurement, outcome: Outcome) -> None:
        """Store a fused measurement's innovation; to be called once for each, even if a rewind
        fuses it again."""
        if measurement.constraint or not outcome.whitened:
            return
        if not measurement.screened:
            series = self._series.get(measurement.source) or self._begin(
                measurement.source, measurement
            )
            self._heard += 1
            whitened = outcome.whitened
            series.waiting.append((len(whitened), self._heard, whitened, outcome.nis))
            return
        for name, row in measurement.series(outcome.whitened, outcome.rows).items():
            source = f"{measurement.source}_{name}"
            series = self._series.get(source) or self._begin(source, measurement)
            self._heard += 1
            series.waiting.append((len(row), self._heard, row, float(row @ row)))

    def _begin(self, source: str, measurement: AidingMeasurement) -> _Series:
        window = max(FEWEST, self._window // 2) if measurement.delayed else self._window
        shared = self._model.slots_of_all(measurement.shares).size > 0
        options = ConsistencyOptions(window, self._alpha, gate=measurement.gate, shared=shared)
        series = self._series[source] = _Series(ConsistencyMonitor(options))
        return series

    def report(self) -> None:
        """Judge the innovations since the last call; report changed verdicts in order."""
        self._judge_all()
        for _, source, verdict in sorted(self._turned):
            self._on_change(source, verdict)
        self._turned.clear()

    def _judge_all(self) -> None:
        for measurement, outcome in self.waiting:
            self.judge(measurement, outcome)
        self.waiting.clear()
        for source, series in self._series.items():
            waiting = series.waiting
            if not waiting:
                continue
            series.waiting = []
            for _, alike in groupby(waiting, key=itemgetter(0)):
                _, numbers, rows, nis = zip(*alike, strict=True)
                whitened = np.fromiter(chain.from_iterable(rows), np.float64)
                judged = series.monitor.take(whitened.reshape(len(rows), -1), np.array(nis))
                for row, verdict in judged:
                    self._turned.append((numbers[row], source, verdict))

    def reset(self) -> None:
        """Restart with the filter; earlier innovations say nothing about the new start."""
        self.waiting.clear()
        self._turned.clear()
        for series in self._series.values():
            series.waiting.clear()
            series.monitor.reset()

    def verdict(self, source: str) -> Verdict | None:
        """A source's verdict; None for one that is not judged."""
        self._judge_all()
        series = self._series.get(source)
        return None if series is None else series.monitor.verdict

    def reports(self) -> dict[str, Consistency]:
        """The tests' figures by source."""
        self._judge_all()
        return {name: series.monitor.report() for name, series in self._series.items()}
