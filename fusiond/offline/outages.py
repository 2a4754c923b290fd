"""Outages: windows in which recorded measurements are withheld, to test the navigator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

Outage: TypeAlias = tuple[float, float] | tuple[float, float, tuple[str, ...]]
"""Start and length (s of the files), and the withheld sources: all without names."""


def withheld(source: str, t_s: float, outages: Sequence[Outage]) -> bool:
    """True if the source's measurement at `t_s` lies in an outage."""
    return any(
        start <= t_s < start + length and (not names or source in names[0])
        for start, length, *names in outages
    )


def named(outages: Sequence[Outage]) -> set[str]:
    """Names of the sources in the windows."""
    return {name for _, _, *names in outages for group in names for name in group}
