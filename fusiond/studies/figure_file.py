"""Writer of figures of studies, with equal time axes and ticks in all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

DOTS_PER_INCH = 120
_TICKS = (1.0, 2.0, 5.0)
"""Ticks of a decade, on an axis that spans less than two."""


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure to `path`. A logarithmic axis has plain figures (0.2, not 2e-1); an
    axis of seconds is labelled as time."""
    for axes in figure.axes:
        if axes.get_xlabel() == "s":
            axes.set_xlabel("time, s")
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log" and not _labelled(axis):
                _plain(axis)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def _labelled(axis: Any) -> bool:
    """True if the study chose its own labels."""
    from matplotlib.ticker import LogFormatter  # noqa: PLC0415  (extra `[studies]`)

    return not isinstance(axis.get_major_formatter(), LogFormatter)


def _plain(axis: Any) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter  # noqa: PLC0415

    low, high = sorted(axis.get_view_interval())
    within = low > 0.0 and high < 100.0 * low
    axis.set_major_locator(LogLocator(subs=_TICKS if within else (1.0,)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
