"""Sources that are out of service, told to the operator and asked for by name; faults told."""

from __future__ import annotations

from collections.abc import Callable

from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.options import local_of
from fusiond.navigator.timeline import Timeline


class ServiceEvents:
    """What timeline and estimator leave out; `on_event(code, text)` hears of it.

    `names`: the estimator's own sources, of which a name may stand for several series.
    """

    def __init__(
        self,
        timeline: Timeline,
        names: tuple[str, ...],
        on_event: Callable[[str, str], None],
    ) -> None:
        self._timeline, self._names, self._event = timeline, names, on_event
        self._told: dict[str, str] = {}
        self._told_ns: dict[str, int] = {}

    @property
    def _estimator(self) -> Estimator:
        return self._timeline.estimator

    def tell(self) -> None:
        """Events where the isolated sources are no longer those last told."""
        for finding in self._timeline.diagnosis.findings:
            told_ns = self._told_ns.get(finding.kind.name, -1)
            if finding.kind.corrected and finding.t_ns > told_ns:
                self._told_ns[finding.kind.name] = finding.t_ns
                self._event("sensor_fault", finding.text)
        now = self._estimator.isolated | self._timeline.diagnosis.excluded
        if now == self._told:
            return
        for source, reason in now.items():
            if source not in self._told:
                self._event("isolated", f"{source} is left out of the solution: {reason}")
        for source in self._told:
            if source not in now:
                self._event("readmitted", f"{source} is believed again")
        self._told = now

    def reason(self, source: str) -> str | None:
        """Why a source of aids is left out; None if it is not."""
        if (reason := self._timeline.diagnosis.excluded.get(source)) is not None:
            return reason
        found = self._estimator.isolated
        if not found:
            return None
        local = local_of(source, self._names)
        return None if local is None else found.get(self._names[local])
