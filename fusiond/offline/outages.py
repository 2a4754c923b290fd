"""Windows in which recorded measurements are withheld, to see what the navigation does without
them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

Outage: TypeAlias = tuple[float, float] | tuple[float, float, tuple[str, ...]]
"""Start and length (s of the files), and the sources that are withheld: all without names."""


def withheld(source: str, t_s: float, outages: Sequence[Outage]) -> bool:
    """True if what the source measured at `t_s` lies in a window of its own or of all."""
    return any(
        start <= t_s < start + length and (not names or source in names[0])
        for start, length, *names in outages
    )


def named(outages: Sequence[Outage]) -> set[str]:
    """The sources that the windows name."""
    return {name for _, _, *names in outages for group in names for name in group}
