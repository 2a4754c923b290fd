"""Events of protection levels that pass the alert limits.

The computation (fusiond.navigator.protection_levels) is imported only if a limit is configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.navigation.solution import Bound, BoundState

if TYPE_CHECKING:
    from fusiond.navigator.protection_levels import Level, Levels

RETURN_NS = 5_000_000_000
"""Time inside the limits that ends an alarm, so that a level near its limit gives a single alarm.
An alarm begins at once."""


NO_BOUND = Bound(BoundState.OFF)
"""Bound without a configured alert limit."""


class ProtectionWatch:
    """Protection levels of an estimator; inactive without an alert limit.

    `on_event(code, text)` receives `protection_level` when a level passes its limit and
    `protection_restored` when both are back.
    """

    def __init__(
        self, config: Config, estimator: Estimator, on_event: Callable[[str, str], None]
    ) -> None:
        options = config.integrity
        self._levels: Levels | None = None
        if isinstance(estimator, SeparatedEstimator):
            from fusiond.navigator.protection_levels import Levels  # noqa: PLC0415

            self._levels = Levels(config, estimator)
        self.watches = self._levels is not None
        """True if levels are computed."""
        self._event = on_event
        self._limits = options.horizontal_alert_limit_m, options.vertical_alert_limit_m
        self._beyond = False
        self._inside_since_ns = 0
        self._last: tuple[int, Level] | None = None

    def look(self, measurement: AidingMeasurement) -> None:
        """Update the levels after a processed measurement, from the estimator's state."""
        if self._levels is not None:
            self._levels.look(measurement)

    def restart(self) -> None:
        """Restart with the solution, without earlier data."""
        if self._levels is not None:
            self._levels.restart()
        self._last = None

    def unknown(self) -> Bound:
        """Levels without a solution."""
        return Bound(BoundState.OFF if self._levels is None else BoundState.UNKNOWN)

    def bound(self) -> Bound:
        """Levels of the estimator's state."""
        if self._levels is None:
            return Bound(BoundState.OFF)
        last = self._last
        found = last[1] if last is not None and last[0] == self._levels.t_ns else self._levels.now()
        vertical = math.nan if found.vpl_m is None else found.vpl_m
        state = BoundState.BEYOND if self._passed(found) else BoundState.WITHIN
        return Bound(state, found.hpl_m, vertical)

    def report(self) -> None:
        """Compute the levels of the estimator's present state; report each that passes a limit."""
        if self._levels is None:
            return
        t_ns, found = self._levels.t_ns, self._levels.now()
        self._last = t_ns, found
        if passed := self._passed(found):
            self._inside_since_ns = t_ns
            if not self._beyond:
                self._beyond = True
                self._event("protection_level", "; ".join(passed + found.blamed))
        elif self._beyond and t_ns - self._inside_since_ns >= RETURN_NS:
            self._beyond = False
            self._event("protection_restored", f"horizontal {found.hpl_m:.1f} m")

    def _passed(self, found: Level) -> list[str]:
        """Text on levels beyond their limits, levels that are not a number among them."""
        levels = zip(("horizontal", "vertical"), (found.hpl_m, found.vpl_m), strict=True)
        return [
            f"{name} {level:.1f} m, limit {limit:g} m"
            for (name, level), limit in zip(levels, self._limits, strict=True)
            if limit is not None and level is not None and not level <= limit
        ]
