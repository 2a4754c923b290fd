"""One consistency monitor for each source of aids: what its innovations say of the filter's
sigma."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.pseudorange import PseudorangeAid
from fusiond.aiding.rdss_position import RdssPositionAid
from fusiond.estimators.base import Outcome
from fusiond.integrity.consistency import (
    FEWEST,
    Consistency,
    ConsistencyOptions,
    Verdict,
)
from fusiond.integrity.monitor import ConsistencyMonitor
from fusiond.navigator.raw_gnss import per_system
from fusiond.navigator.timeline import Entry

Array = NDArray[np.float64]


class Verdicts:
    """Feeds each fused innovation to its source's monitor, once, however often it is applied.

    A receiver's raw epochs have a monitor for each satellite system, `<source>_<system>`.

    `on_change(source, verdict)` hears when a verdict turns. `ignored` sources are not measured (the
    filter's own constraints): their innovations are neither independent nor white, and no verdict
    on a sigma follows from them.
    """

    def __init__(
        self,
        window: int,
        alpha: float,
        ignored: frozenset[str],
        on_change: Callable[[str, str], None],
    ) -> None:
        self._window, self._alpha = window, alpha
        self._ignored = ignored
        self._on_change = on_change
        self._monitors: dict[str, ConsistencyMonitor] = {}

    def judge(self, entry: Entry, outcome: Outcome) -> None:
        """An aid has been applied."""
        source = entry.aid.source
        if entry.judged or not outcome.whitened or source in self._ignored:
            return
        entry.judged = True
        if isinstance(entry.aid, PseudorangeAid):
            for system, figures in per_system(entry.aid, outcome).items():
                row = np.array(figures)
                self._add(f"{source}_{system}", entry, row, float(row @ row))
            return
        self._add(source, entry, np.array(outcome.whitened), outcome.nis)

    def _add(self, source: str, entry: Entry, row: Array, nis: float) -> None:
        monitor = self._monitors.get(source)
        if monitor is None:
            late = isinstance(entry.aid, RdssPositionAid)
            window = max(FEWEST, self._window // 2) if late else self._window
            options = ConsistencyOptions(window, self._alpha, gate=entry.aid.gate)
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
