"""Findings: hypotheses that were identified."""

from __future__ import annotations

from typing import NamedTuple

from fusiond.integrity.catalogue import OVER, Kind


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
        """Index of the largest number; of what was followed and is over the share."""
        if self.kind.of == OVER:
            return 0
        return max(range(len(self.size)), key=lambda i: abs(self.size[i]))

    @property
    def text(self) -> str:
        """For people."""
        k, row = self.kind, self.largest
        axis = f", {k.axes[row]}" if k.axes[row] else ""
        amount = f"{self.size[row]:.3g} {k.unit}, {self.sd[row]:.2g} at one sigma{axis}"
        done = "corrected" if k.corrected else "left out"
        return f"{k.text} by {amount}, since {self.t_ns * 1e-9 - self.since_s:.0f} s: {done}"
