"""Events of faults and of service, reported once each."""

from __future__ import annotations

from collections.abc import Callable

from fusiond.integrity.catalogue import OVER
from fusiond.navigator.timeline import Timeline


class ServiceEvents:
    """Changes since the last look; `on_event(code, text)` receives it."""

    def __init__(self, timeline: Timeline, on_event: Callable[[str, str], None]) -> None:
        self._timeline, self._event = timeline, on_event
        self._isolates = timeline.estimator.isolates
        self._out: dict[str, str] = {}
        """Excluded series as reported, with reasons."""
        self._found_ns: dict[tuple[str, str], int] = {}
        """Instant of the last finding by kind and device."""

    def report(self) -> bool:
        """Report changes of service; True if there are new findings.

        Events: `sensor_fault` for each step that was corrected, `fault_over` for a source's fault
        that the solution had followed, `isolated` and `readmitted` for each series that has left
        service or returned."""
        diagnosis, found = self._timeline.diagnosis, False
        for finding in diagnosis.findings:
            key = finding.kind.name, finding.kind.device
            if finding.t_ns <= self._found_ns.get(key, -1):
                continue
            self._found_ns[key], found = finding.t_ns, True
            if finding.kind.corrected:
                over = finding.kind.of == OVER
                self._event("fault_over" if over else "sensor_fault", finding.text)
        now = diagnosis.excluded
        if self._isolates:
            now = self._timeline.estimator.isolated | now
        for source, reason in now.items():
            if source not in self._out:
                self._event("isolated", f"{source} is excluded from the solution: {reason}")
        for source in self._out:
            if source not in now:
                self._event("readmitted", f"{source} is used again")
        self._out = now
        return found
