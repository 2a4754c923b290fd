"""Protection levels of the solution, and what an operator hears when they pass the alert limits.

Each level bounds the error by itself: that of solution separation in the filter
(fusiond.integrity.protection), and that of each raw receiver's epochs
(fusiond.navigator.epoch_protection). The least of them is published; each is computed at its equal
part of the integrity risk, so that the least holds whichever it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fusiond.aiding.base import Aid
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.integrity.protection import IntegrityRisk, filter_protection
from fusiond.navigation.solution import Bound, BoundState
from fusiond.navigator.epoch_protection import EpochProtection
from fusiond.navigator.raw_gnss import RawEpochAid

RETURN_NS = 5_000_000_000
"""The levels must have been inside the limits for this long before the alarm ends: a level that
moves about its limit is one alarm. An alarm begins at once."""


class _Levels(NamedTuple):
    """Horizontal and vertical level (m; vertical None where the model holds the height), and what
    does not fit, in words."""

    hpl_m: float
    vpl_m: float | None
    blamed: list[str]


class ProtectionWatch:
    """Levels of an estimator; nothing where no alert limit is configured.

    `on_event(code, text)` hears `protection_level` when a level passes its limit and
    `protection_restored` when both are back.
    """

    def __init__(
        self, config: Config, estimator: Estimator, on_event: Callable[[str, str], None]
    ) -> None:
        options = config.integrity
        self._estimator = estimator if isinstance(estimator, SeparatedEstimator) else None
        self._event = on_event
        self._limits = options.horizontal_alert_limit_m, options.vertical_alert_limit_m
        self._beyond = False
        self._inside_since_ns = 0
        self._last: tuple[int, _Levels] | None = None
        self._raw = [name for name, s in config.aiding.items() if isinstance(s, RawAiding)]
        risk = options.integrity_risk_per_hour / (1 + len(self._raw))
        self._epochs = EpochProtection(risk, options.false_alarm_per_hour)
        if self._estimator is not None:
            self._risk = IntegrityRisk(
                risk,
                options.false_alarm_per_hour,
                options.priors(self._estimator.devices),
            )
            if not self._risk.monitored > 0.0:
                raise ConfigError(
                    "integrity: two devices at fault in one hour are likelier than"
                    " integrity_risk_per_hour: no protection level can be stated"
                )

    def look(self, aid: Aid) -> None:
        """An aid has been looked at; the estimator is where that left it."""
        if self._estimator is not None and isinstance(aid, RawEpochAid):
            self._epochs.look(aid, self._estimator.state)

    def restart(self) -> None:
        """The solution begins anew: what was heard said nothing of it."""
        self._epochs.clear()
        self._last = None

    def unknown(self) -> Bound:
        """Without a solution."""
        return Bound(BoundState.OFF if self._estimator is None else BoundState.UNKNOWN)

    def bound(self) -> Bound:
        """Of the estimator's state."""
        e = self._estimator
        if e is None:
            return self.unknown()
        last = self._last
        found = last[1] if last is not None and last[0] == e.t_ns else self._levels(e)
        vertical = math.nan if found.vpl_m is None else found.vpl_m
        state = BoundState.BEYOND if self._passed(found) else BoundState.WITHIN
        return Bound(state, found.hpl_m, vertical)

    def tell(self) -> None:
        """Compute the levels of the estimator's present state, with events where they pass."""
        e = self._estimator
        if e is None:
            return
        found = self._levels(e)
        self._last = e.t_ns, found
        if passed := self._passed(found):
            self._inside_since_ns = e.t_ns
            if not self._beyond:
                self._beyond = True
                self._event("protection_level", "; ".join(passed + found.blamed))
        elif self._beyond and e.t_ns - self._inside_since_ns >= RETURN_NS:
            self._beyond = False
            self._event("protection_restored", f"horizontal {found.hpl_m:.1f} m")

    def _levels(self, e: SeparatedEstimator) -> _Levels:
        vertical = not e.model.hold_height
        # What is not told yet may be the IMU's fault, which no mode stands for.
        covariances = e.covariances() + np.diag(e.wider[:3])
        of_filter = filter_protection(covariances, e.separations(), self._risk, vertical=vertical)
        names = zip(e.devices, of_filter.apart.tolist(), strict=True)
        blamed = [f"the solution without {name} is apart" for name, apart in names if apart]
        hpl, vpl = [of_filter.hpl_m], [math.inf if of_filter.vpl_m is None else of_filter.vpl_m]
        for source in self._raw:
            level = self._epochs.level(source, e)
            hpl.append(level.hpl_m)
            vpl.append(level.vpl_m)
            if level.left_out:
                blamed.append(f"{source} fits without {', '.join(level.left_out)}")
        return _Levels(min(hpl), min(vpl) if vertical else None, blamed)

    def _passed(self, found: _Levels) -> list[str]:
        """Which levels are beyond their limits, in words; a level that is not a number is."""
        levels = zip(("horizontal", "vertical"), (found.hpl_m, found.vpl_m), strict=True)
        return [
            f"{name} {level:.1f} m, limit {limit:g} m"
            for (name, level), limit in zip(levels, self._limits, strict=True)
            if limit is not None and level is not None and not level <= limit
        ]
