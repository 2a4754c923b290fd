r"""Observed share of the configured white noise of wheels, side slip and compasses.

No device measures it: the value of a section or a file fits any vehicle. White noise is new in each
innovation of a series; the filter's own error and the drift state, with correlation time tau, are
common to neighbours. So for two innovations about tau / 2 apart, with q the known variance of the
rounding,

    D = E[(nu_k - nu_j)^2] / 2 = W + q + (change of drift and filter error)^2 / 2

is no less than the white variance W for any P (Allan's structure function, as for a receiver's
fixes: fusiond.aiding.fix_error_correlation). A repeated or smoothed wheel speed has changed its
error within that lag. With n such pairs while driving, c^2 of the configured variance s^2 counts,

    c^2 = (n max(LEAST, min(1, (D - q) / s^2)) + FIRST) / (n + FIRST)

c is at most 1: larger errors show in the innovations (fusiond.estimators.noise_scale). Of the
no-slip constraint only the lateral noise is learned: downwards there is no drift state, and the
configured value includes springs and road.

Source: Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Trans. AC 15
(1970), for noise from the innovations of a filter that is not optimal; Allan, Statistics of atomic
frequency standards, Proc. IEEE 54 (1966).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

LEAST = 1.0 / 64.0
"""Least share of the variance: an eighth of the sigma, as of drifts."""
FIRST, FORGETS = 15.0, 600.0
"""Pairs that all of it counts for at first, and pairs after which old ones are forgotten. The mean
of n squares of differences that share their ends scatters by sqrt(3 / n) of itself: by 0.45, as
where innovations are first believed more than what is stated (fusiond.estimators.noise_scale)."""
PART = 0.5
"""Lag in correlation times of the drift: most of a drift is the same then, and what is not makes
the white noise larger, not smaller."""
LATEST = 3.0
"""Lags beyond which two innovations have nothing to say about each other: a gap."""


@dataclass(slots=True)
class _Series:
    variance: float
    """Typed variance s^2."""
    lag_ns: int
    rounding: float
    """Variance q of the rounding."""
    total: float = 0.0
    count: float = 0.0
    last: tuple[int, float] | None = None
    """Instant and innovation of the last of a pair."""
    waiting: dict[int, float] = field(default_factory=dict)
    """Innovations that have not settled."""
    counted: list[tuple[int, float]] = field(default_factory=lambda: [(0, 1.0)])
    """Start (ns) of each c's validity."""

    def pair(self, t_ns: int, innovation: float) -> None:
        """Add the next innovation of a moving vehicle."""
        if self.last is None or t_ns - self.last[0] > LATEST * self.lag_ns:
            self.last = t_ns, innovation
            return
        if t_ns - self.last[0] < self.lag_ns:
            return
        kept = 1.0 - 1.0 / FORGETS
        square = 0.5 * (innovation - self.last[1]) ** 2 - self.rounding
        self.total = kept * self.total + square / self.variance
        self.count = kept * self.count + 1.0
        self.last = t_ns, innovation

    @property
    def found(self) -> float:
        if self.count == 0.0:
            return 1.0
        share = max(LEAST, min(1.0, self.total / self.count))
        return math.sqrt((self.count * share + FIRST) / (self.count + FIRST))


class WhiteNoise:
    """White noise of one vehicle's series by source; learned for each series that requests it."""

    def __init__(self) -> None:
        self.series: dict[str, _Series] = {}
        """By source, of those that are learned."""
        self._saved: Mapping[str, tuple[float, ...]] = {}

    @property
    def shown(self) -> dict[str, tuple[float, ...]]:
        """Number of pairs and their sum by source, for the next start."""
        return {name: (each.count, each.total) for name, each in self.series.items()}

    def take_up(self, shown: Mapping[str, tuple[float, ...]]) -> None:
        """Resume series without data so far from those of another drive."""
        self._saved = shown

    def counts(
        self, source: str, t_ns: int, sd: float, lasts_s: float, rounding_sd: float = 0.0
    ) -> float:
        """Factor c for a measurement of `t_ns` with configured `sd`, whose drift has the
        correlation time `lasts_s`."""
        one = self.series.get(source)
        if one is None:
            lag_ns = round(PART * lasts_s * 1e9)
            one = self.series[source] = _Series(sd * sd, lag_ns, rounding_sd * rounding_sd)
            if source in self._saved:
                one.count, one.total = self._saved[source]
                one.counted = [(0, one.found)]
        return next((c for since, c in reversed(one.counted) if since <= t_ns), 1.0)

    def receive(self, source: str, t_ns: int, innovation: float) -> None:
        """Receive an applied measurement, possibly repeated by a rewind; NaN: it was not fused."""
        one = self.series.get(source)
        if one is None:
            return
        if math.isnan(innovation):
            one.waiting.pop(t_ns, None)
        else:
            one.waiting[t_ns] = innovation

    def settle(self, t_ns: int, counts_ns: int, moving: bool) -> None:
        """Evaluate the data before `t_ns`, to which nothing is added any more; the result counts
        from `counts_ns` on. Data at rest (`moving` false) are dropped: wheels and tyres do not slip
        then."""
        for one in self.series.values():
            due = sorted(at for at in one.waiting if at <= t_ns)
            if not moving:
                one.last = None
            for at in due:
                innovation = one.waiting.pop(at)
                if moving:
                    one.pair(at, innovation)
            if moving and due:
                one.counted = [*one.counted[-3:], (counts_ns, one.found)]
