"""Findings, and the faults that still exclude a series."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fusiond.estimators.fault_bank import DECIDED
from fusiond.integrity.catalogue import Kind
from fusiond.integrity.series_states import MOST_EVIDENCE


class Finding(NamedTuple):
    """Identified hypothesis: kind, instant of identification (ns), time since onset (s), size and
    one sigma of each number in the kind's unit, log odds."""

    kind: Kind
    t_ns: int
    since_s: float
    size: tuple[float, ...]
    sd: tuple[float, ...]
    log_odds: float

    @property
    def largest(self) -> int:
        """Index of the largest number."""
        return max(range(len(self.size)), key=lambda i: abs(self.size[i]))

    @property
    def text(self) -> str:
        """Text for the operator."""
        k, row = self.kind, self.largest
        axis = f", {k.axes[row]}" if k.axes[row] else ""
        amount = f"{self.size[row]:.3g} {k.unit}, {self.sd[row]:.2g} at one sigma{axis}"
        done = "corrected" if k.corrected else "left out"
        return f"{k.text} by {amount}, since {self.t_ns * 1e-9 - self.since_s:.0f} s: {done}"


class Lasting(NamedTuple):
    """Faults that may still exclude a series, each with its log likelihood below that of the
    best."""

    findings: tuple[Finding, ...] = ()
    worse: tuple[float, ...] = ()

    @staticmethod
    def of(findings: Iterable[Finding]) -> Lasting:
        """Faults of `findings` with similar likelihoods."""
        found = tuple(findings)
        return Lasting(found, (0.0,) * len(found))

    @property
    def shares(self) -> list[float]:
        """Probability of each fault, given that one of them lasts."""
        shares = [math.exp(min(self.worse) - w) for w in self.worse]
        return [share / sum(shares) for share in shares]

    def judged(self, nis: Sequence[float]) -> Lasting:
        """Faults after one more innovation with chi-square `nis` (k,) under each. A fault that is a
        thousand times less likely than another is dropped."""
        best = min(nis)
        worse = [
            w + 0.5 * min(one - best, MOST_EVIDENCE) for w, one in zip(self.worse, nis, strict=True)
        ]
        kept = [k for k, w in enumerate(worse) if w - min(worse) < DECIDED]
        return Lasting(tuple(self.findings[k] for k in kept), tuple(worse[k] for k in kept))

    def without(self, over: Lasting) -> Lasting:
        """Faults without the ended ones."""
        kept = [k for k, finding in enumerate(self.findings) if finding not in over.findings]
        return Lasting(tuple(self.findings[k] for k in kept), tuple(self.worse[k] for k in kept))
