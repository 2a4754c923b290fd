"""Markdown tables and their numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable


def table(header: Iterable[str], lines: Iterable[tuple[str, ...]]) -> str:
    """Format a table in Markdown."""
    header = tuple(header)
    return "\n".join(
        "| " + " | ".join(line) + " |" for line in (header, ("---",) * len(header), *lines)
    )


def number(value: float | None, none: str) -> str:
    """Format a value with three significant figures, `none` for None."""
    return none if value is None or math.isnan(value) else f"{value:.3g}"
