r"""Typed white noise of wheels, side slip and compasses: how much of it a vehicle shows.

No device measures it: what a section or a file states is typed, and fits any vehicle. The
innovations of a series have it anew in each, and what they share besides does not: the filter's
own error, and a drift of which the filter has a state and which lasts for tau. So of two that lie a
lag of tau / 2 apart or little more, with q the variance of the rounding, which is known,

    D = E[(nu_k - nu_j)^2] / 2 = W + q + (what drift and filter have changed by)^2 / 2

is no less than the white variance W, whatever P says of the rest (Allan's structure function, as of
a receiver's fixes: fusiond.aiding.fix_errors). A wheel that repeats its speed, or a bus that
smooths it, looks white to nobody at that lag: its error moves on. With n such pairs of a vehicle
that drives, c^2 of the typed variance s^2 counts,

    c^2 = (n max(LEAST, min(1, (D - q) / s^2)) + FIRST) / (n + FIRST)

None is above what is typed: that a series errs by more, its innovations say
(fusiond.estimators.noise_scale). Of no slip it is the side's: down there is no state of a drift,
and what is typed stands for springs and road as well.

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
        """Take the next innovation of a vehicle that drives."""
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
    """White noise of the series of one vehicle, by source; those that ask for it are learned."""

    def __init__(self) -> None:
        self.series: dict[str, _Series] = {}
        """By source, of those that are learned."""
        self._saved: Mapping[str, tuple[float, ...]] = {}

    @property
    def shown(self) -> dict[str, tuple[float, ...]]:
        """Number of pairs and their sum by source, for the next start."""
        return {name: (each.count, each.total) for name, each in self.series.items()}

    def take_up(self, shown: Mapping[str, tuple[float, ...]]) -> None:
        """Resume series that nothing has come of with those of another drive."""
        self._saved = shown

    def counts(
        self, source: str, t_ns: int, sd: float, lasts_s: float, rounding_sd: float = 0.0
    ) -> float:
        """c of a measurement of `t_ns` with typed `sd`, whose drift lasts for `lasts_s`."""
        one = self.series.get(source)
        if one is None:
            lag_ns = round(PART * lasts_s * 1e9)
            one = self.series[source] = _Series(sd * sd, lag_ns, rounding_sd * rounding_sd)
            if source in self._saved:
                one.count, one.total = self._saved[source]
                one.counted = [(0, one.found)]
        return next((c for since, c in reversed(one.counted) if since <= t_ns), 1.0)

    def receive(self, source: str, t_ns: int, innovation: float) -> None:
        """A measurement has been applied, or again after a rewind; NaN: it was not fused."""
        one = self.series.get(source)
        if one is None:
            return
        if math.isnan(innovation):
            one.waiting.pop(t_ns, None)
        else:
            one.waiting[t_ns] = innovation

    def settle(self, t_ns: int, counts_ns: int, moving: bool) -> None:
        """Nothing comes any more that is earlier than `t_ns`; what is found counts from `counts_ns`
        on. Without `moving` what was valid since the last time shows nothing: at rest wheels and
        tyres do not slip."""
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
