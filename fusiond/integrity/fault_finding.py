"""Findings, and for which of them a series is out while it may last."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fusiond.estimators.fault_bank import DECIDED
from fusiond.integrity.catalogue import Kind
from fusiond.integrity.service import MOST_EVIDENCE


class Finding(NamedTuple):
    """An identified hypothesis: its kind, when (ns) it was, and since when (s); its size and one
    sigma of each number in the kind's unit; log odds."""

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
        """For people."""
        k, row = self.kind, self.largest
        axis = f", {k.axes[row]}" if k.axes[row] else ""
        amount = f"{self.size[row]:.3g} {k.unit}, {self.sd[row]:.2g} at one sigma{axis}"
        done = "corrected" if k.corrected else "left out"
        return f"{k.text} by {amount}, since {self.t_ns * 1e-9 - self.since_s:.0f} s: {done}"


class Lasting(NamedTuple):
    """The faults for which a series may be out, and by how much (log likelihood) each has been
    worse than the best since."""

    findings: tuple[Finding, ...] = ()
    worse: tuple[float, ...] = ()

    @staticmethod
    def of(findings: Iterable[Finding]) -> Lasting:
        """Of faults that fit alike."""
        found = tuple(findings)
        return Lasting(found, (0.0,) * len(found))

    def judged(self, nis: Sequence[float]) -> Lasting:
        """After one more innovation, whose chi-square is `nis` (k,) if each of them lasts: a fault
        is none that another one explains better, a thousand to one."""
        best = min(nis)
        worse = [
            w + 0.5 * min(one - best, MOST_EVIDENCE) for w, one in zip(self.worse, nis, strict=True)
        ]
        kept = [k for k, w in enumerate(worse) if w - min(worse) < DECIDED]
        return Lasting(tuple(self.findings[k] for k in kept), tuple(worse[k] for k in kept))

    def without(self, over: Lasting) -> Lasting:
        """Less those that have turned out to be over."""
        kept = [k for k, finding in enumerate(self.findings) if finding not in over.findings]
        return Lasting(tuple(self.findings[k] for k in kept), tuple(self.worse[k] for k in kept))
