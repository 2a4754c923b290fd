"""One consistency monitor for each source of aids: what its innovations say of the filter's
sigma."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.estimators.base import Outcome
from fusiond.estimators.screening import KEPT
from fusiond.integrity.consistency import (
    FEWEST,
    Consistency,
    ConsistencyOptions,
    Verdict,
)
from fusiond.integrity.monitor import ConsistencyMonitor
from fusiond.models.model import Model

Array = NDArray[np.float64]


class Verdicts:
    """Feeds the innovations that were fused to their sources' monitors.

    An aid may hold several series (`Aid.series`), each with a monitor of its own: a receiver's raw
    epochs have one for each satellite system, `<source>_<system>`.

    `on_change(source, verdict)` hears when a verdict turns. Constraints are not judged. What the
    aids of a source share by the states of `model` no innovation shows (`Aid.shares`).
    """

    def __init__(
        self, window: int, alpha: float, model: Model, on_change: Callable[[str, str], None]
    ) -> None:
        self._window, self._alpha, self._model = window, alpha, model
        self._on_change = on_change
        self._monitors: dict[str, ConsistencyMonitor] = {}

    def judge(self, aid: Aid, outcome: Outcome) -> None:
        """An aid has been fused; to be called once for each, though a rewind brings it again."""
        if aid.constraint or not outcome.whitened:
            return
        if not aid.screened:
            self._add(aid.source, aid, np.array(outcome.whitened), outcome.nis)
            return
        kept = np.array(outcome.rows) == KEPT
        for name, row in aid.series(outcome.whitened, kept).items():
            self._add(f"{aid.source}_{name}", aid, row, float(row @ row))

    def _add(self, source: str, aid: Aid, row: Array, nis: float) -> None:
        monitor = self._monitors.get(source)
        if monitor is None:
            window = max(FEWEST, self._window // 2) if aid.late else self._window
            shared = self._model.slots_of_all(aid.shares).size > 0
            options = ConsistencyOptions(window, self._alpha, gate=aid.gate, shared=shared)
            monitor = self._monitors[source] = ConsistencyMonitor(options)
        before = monitor.verdict
        monitor.add_whitened(row, nis)
        if monitor.verdict != before:
            self._on_change(source, monitor.verdict)

    def reset(self) -> None:
        """The filter starts anew: what came before says nothing of it."""
        for monitor in self._monitors.values():
            monitor.reset()

    def verdict(self, source: str) -> Verdict | None:
        """A source's verdict; None for one that is not judged."""
        monitor = self._monitors.get(source)
        return None if monitor is None else monitor.verdict

    def reports(self) -> dict[str, Consistency]:
        """The tests' figures by source."""
        return {name: monitor.report() for name, monitor in self._monitors.items()}
