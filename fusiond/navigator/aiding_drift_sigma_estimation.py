r"""Magnitudes of configured drifts: side slip, wheel drift, compass disturbance.

No device states them, and the configured values fit any vehicle. Each is a Markov state x of
configured sigma s, of which c x acts on its measurement. From the filter's x^ and P, some
correlation times apart, the measurements alone give x~ of variance R (as in
fusiond.navigator.imu_grade),

    1 / R = 1 / P - 1 / s^2,   x~ = x^ R / P,   x~ ~ N(0, g s^2 / c^2 + R)

g is the level, as a variance ratio. The log likelihood is summed on a grid of g with a uniform
prior, while the vehicle moves: at rest wheels and tyres do not slip. An instant counts as

    w = (s^2 / c^2 / (s^2 / c^2 + R))^2 min(1, T / (2 tau))

of an instant at which x is measured without noise: its part of the Fisher information of log g,
reduced for instants T apart within a correlation time tau. With n their sum c^2 is

    (n E[g] + FIRST) / (n + FIRST)

No level is above the configured one: larger errors show in the innovations
(fusiond.estimators.noise_scale).

Source: Gelman, Carlin, Stern, Dunson, Vehtari, Rubin, Bayesian Data Analysis, 3rd ed. (2013),
section 5.4; Priestley, Spectral Analysis and Time Series (1981), section 5.3.2, for the number of
independent values of a process.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import speed_of
from fusiond.aiding.compass import DISTURBANCE
from fusiond.estimators.base import Estimator
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import SIDE_DRIFT, WHEEL_DRIFT
from fusiond.navigator.imu_vibration_noise_share import COUNTS_NS, EVERY_NS
from fusiond.navigator.sensor_white_noise import WhiteNoise

Array = NDArray[np.float64]

TYPED = (SIDE_DRIFT, WHEEL_DRIFT, DISTURBANCE)
"""Beginnings of the names of their blocks."""
GRID: Final = 4.0 ** np.arange(-3.0, 0.1, 0.25)
"""Levels: the full variance, down to an eighth of the sigma."""
FIRST = 6.0
"""Instants, a minute of them, that it counts that all of it is there: a filter that has once been
too sure of its course stays so, and slip comes with bends, of which a street has one a minute. It
is a choice after results: log likelihoods of estimates 20 s ahead, summed over `drive_0708`,
`css_164` and four simulated drives, are above those of a full level by 34 with six, 56 with two and
68 with one. But with two a calibrated `drive_0708` had a false isolation more, just before an
outage, with one its outages end 5.5 m off, and with either a heading that was lost in silent bends
is found by no slip."""
FORGETS = 180.0
"""Instants after which old ones are forgotten, half an hour: loads, tyres and roads change."""
MOVES_M_S = 2.0
"""Least speed (m/s) of the slip constraint."""


@dataclass(slots=True)
class _Drift:
    slot: int
    variance: float
    """Configured variance s^2."""
    weight: float
    """Weight of an instant, by the duration of its error."""
    log: Array = field(default_factory=lambda: np.zeros(len(GRID)))
    count: float = 0.0
    counted: list[tuple[int, float]] = field(default_factory=lambda: [(0, 1.0)])
    """Start (ns) of each c's validity."""

    def at(self, t_ns: int) -> float:
        return next((c for since, c in reversed(self.counted) if since <= t_ns), 1.0)

    @property
    def found(self) -> float:
        weight = np.exp(self.log - self.log.max())
        mean = float(weight @ GRID / weight.sum())
        return math.sqrt((self.count * mean + FIRST) / (self.count + FIRST))


class DriftLevels:
    """Drift levels of one vehicle, by names of blocks of its model."""

    def __init__(self, model: Model) -> None:
        self._drifts: dict[str, _Drift] = {}
        self.white = WhiteNoise()
        """White noise of the same sensors."""
        self._moved = False
        for block in model.blocks:
            if block.name.startswith(TYPED) and block.steady > 0.0:
                weight = min(1.0, 0.5e-9 * EVERY_NS / block.tau_s)
                (slot,) = model.slots_of(block.name)
                self._drifts[block.name] = _Drift(slot, block.steady**2, weight)

    @property
    def shown(self) -> dict[str, tuple[float, ...]]:
        """Number of instants and log likelihoods of `GRID` by block, for the next start."""
        return {
            name: (d.count, *(d.log - d.log.max()).tolist()) for name, d in self._drifts.items()
        }

    def take_up(self, shown: Mapping[str, tuple[float, ...]]) -> None:
        """Resume with the levels of another drive."""
        for name in self._drifts.keys() & shown.keys():
            drift = self._drifts[name]
            drift.count, drift.log = max(shown[name][0], 0.0), np.array(shown[name][1:])
            drift.counted = [(0, drift.found)]

    def counts(self, block: str, t_ns: int) -> float:
        """Factor c for a measurement of `t_ns`; 1 for any other block."""
        drift = self._drifts.get(block)
        return 1.0 if drift is None else drift.at(t_ns)

    def look(self, e: Estimator) -> None:
        """Evaluate the filter's state at an instant of the grid, once nothing earlier can
        arrive."""
        moved, self._moved = self._moved, speed_of(e.nav) >= MOVES_M_S
        self.white.settle(e.t_ns, e.t_ns + COUNTS_NS, moved and self._moved)
        if not self._moved:
            return
        for drift in self._drifts.values():
            p, s2 = float(e.covariance[drift.slot, drift.slot]), drift.variance
            if not 0.0 < p < s2:
                continue
            r = p * s2 / (s2 - p)
            shown = float(e.xi[drift.slot]) * r / p
            whole = s2 / drift.at(e.t_ns) ** 2
            variance = whole * GRID + r
            kept = 1.0 - drift.weight / FORGETS
            drift.log *= kept
            drift.log -= 0.5 * drift.weight * (np.log(variance) + shown**2 / variance)
            drift.count = kept * drift.count + drift.weight * (whole / (whole + r)) ** 2
            drift.counted = [*drift.counted[-3:], (e.t_ns + COUNTS_NS, drift.found)]
