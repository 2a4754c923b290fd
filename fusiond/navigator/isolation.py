"""Sources that the fault detection leaves out: told to the operator, and asked for by name."""

from __future__ import annotations

from collections.abc import Callable

from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.options import local_of


class Isolation:
    """What the estimator leaves out of `names`, its sources; `on_event(code, text)` hears of it."""

    def __init__(
        self,
        estimator: Estimator,
        names: tuple[str, ...],
        on_event: Callable[[str, str], None],
    ) -> None:
        self._estimator, self._names, self._event = estimator, names, on_event
        self._told: dict[str, str] = {}

    def tell(self) -> None:
        """Events where the isolated sources are no longer those last told."""
        now = self._estimator.isolated
        for source, reason in now.items():
            if source not in self._told:
                self._event("isolated", f"{source} is left out of the solution: {reason}")
        for source in self._told:
            if source not in now:
                self._event("readmitted", f"{source} is believed again")
        self._told = now

    def reason(self, source: str) -> str | None:
        """Why a source of aids is left out; None if it is not."""
        found = self._estimator.isolated
        if not found:
            return None
        local = local_of(source, self._names)
        return None if local is None else found.get(self._names[local])
