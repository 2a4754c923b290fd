"""Active faults and the service of each source, for publication.

A fault of a source lasts from its finding until every series that it spoils is nominal again. A
corrected fault is over at once and is published for `CORRECTED_SHOWN_NS`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from fusiond.estimators.federated.options import local_of
from fusiond.integrity.fault_findings import Finding
from fusiond.integrity.series_states import Series, Service
from fusiond.navigator.timeline import Timeline

CORRECTED_SHOWN_NS = 60_000_000_000
"""Time for which a correction is shown: the longest usual polling interval, Prometheus's default of
a minute."""
WORST_FIRST = (Service.OUT, Service.PROBATION, Service.SUSPECTED, Service.NOMINAL)


class Fault(NamedTuple):
    """Active finding, and the series that it excludes or has on probation."""

    finding: Finding
    series: tuple[str, ...]


class SourceService:
    """Service state of sources, read from timeline and estimator without a change.

    `names`: the estimator's own sources; one name may stand for several series.
    """

    def __init__(self, timeline: Timeline, names: tuple[str, ...]) -> None:
        self._timeline, self._names = timeline, names

    def faults(self, t_ns: int) -> list[Fault]:
        """Active faults at `t_ns`, the latest last."""
        diagnosis, found = self._timeline.diagnosis, []
        for finding in diagnosis.findings:
            if finding.kind.corrected:
                if t_ns - finding.t_ns <= CORRECTED_SHOWN_NS:
                    found.append(Fault(finding, ()))
                continue
            spoiled = [name for name, s in diagnosis.series.items() if _suffers(finding, s)]
            if spoiled:
                found.append(Fault(finding, tuple(spoiled)))
        return sorted(found, key=lambda fault: fault.finding.t_ns)

    def states(self, source: str) -> dict[str, Service]:
        """State of each series of a source: all series of a device, else the one of that name. A
        filter with its own isolation has two states for each source."""
        if (local := self._local(source)) is not None:
            out = self._names[local] in self._timeline.estimator.isolated
            return {source: Service.OUT if out else Service.NOMINAL}
        series = self._timeline.diagnosis.series
        return {name: s.state for name, s in series.items() if source in (name, s.device)}

    def reason(self, source: str) -> str | None:
        """Reason for a source's exclusion; None if it is in use."""
        if (reason := self._timeline.diagnosis.excluded.get(source)) is not None:
            return reason
        local = self._local(source)
        return None if local is None else self._timeline.estimator.isolated.get(self._names[local])

    def _local(self, source: str) -> int | None:
        return local_of(source, self._names) if self._timeline.estimator.isolates else None


def worst(states: Iterable[Service]) -> Service | None:
    """Worst of some states; None without any."""
    found = set(states)
    return next((state for state in WORST_FIRST if state in found), None)


def _suffers(finding: Finding, one: Series) -> bool:
    """True if a series is out or on probation, and was out at the finding."""
    if one.state not in (Service.OUT, Service.PROBATION):
        return False
    spoils = finding.kind.spoils(one.device, one.locates, one.moves)
    return spoils and one.out_ns <= finding.t_ns
