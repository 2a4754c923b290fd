"""Items of a page: plots, tables, track, sentences. The page reads `as_json(zero_s)`, with times
counted from `zero_s`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.report.plot_arrays import packed, thinned

Role = Literal["line", "points", "refused", "bound", "steps", "bars"]
"""Style of a series. `bound`: thin and dashed, such as two sigma around zero; `refused`: the
measurements that were not used."""


@dataclass(frozen=True, slots=True)
class Series:
    """One curve (n,)."""

    label: str
    values: Floats
    role: Role = "line"
    like: int | None = None
    """Series with the same colour."""


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves over one abscissa (n,): time (s) on the page's axis, or the quantity of `x_label`.

    `good`: one sentence on the look of a good plot. `levels` are horizontal lines.
    """

    title: str
    unit: str
    x: Floats
    series: Sequence[Series]
    good: str
    x_label: str | None = None
    log: bool = False
    levels: Sequence[float] = ()

    def as_json(self, zero_s: float) -> dict[str, Any]:
        x, columns = self.x, np.stack([s.values for s in self.series], axis=1)
        if self.x_label is None:
            x, columns = thinned(x - zero_s, columns)
        return {
            "kind": "plot",
            "title": self.title,
            "unit": self.unit,
            "good": self.good,
            "x_label": self.x_label,
            "log": self.log,
            "levels": list(self.levels),
            "x": packed(x),
            "series": [
                {"label": s.label, "role": s.role, "like": s.like, "y": packed(columns[:, k])}
                for k, s in enumerate(self.series)
            ],
        }


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    good: str = ""
    wrong: frozenset[int] = frozenset()
    """The rows that a reader should see first."""

    def as_json(self, zero_s: float) -> dict[str, Any]:
        return {
            "kind": "table",
            "title": self.title,
            "head": list(self.head),
            "rows": [list(row) for row in self.rows],
            "good": self.good,
            "wrong": sorted(self.wrong),
        }


@dataclass(frozen=True, slots=True)
class Grid:
    """Table that a reader sorts and searches, of up to a hundred thousand rows; `links` are the
    targets of the first cells."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]
    links: Sequence[str]
    wrong: frozenset[int] = frozenset()

    def as_json(self, zero_s: float) -> dict[str, Any]:
        rows = [
            [float(f"{v:.5g}") if isinstance(v, float) else v for v in row] for row in self.rows
        ]
        return {
            "kind": "grid",
            "title": self.title,
            "head": list(self.head),
            "rows": rows,
            "links": list(self.links) if any(self.links) else [],
            "wrong": sorted(self.wrong),
        }


@dataclass(frozen=True, slots=True)
class Track:
    """Track seen from above: metres north and east of its beginning, (n,) each.

    `mode` are indices into the modes' names, `sigma` the horizontal one (m), `sd_n` and `sd_e` its
    parts. `truth` (m, 2) is north and east of another track, if there is one.
    """

    t_s: Floats
    north: Floats
    east: Floats
    sd_n: Floats
    sd_e: Floats
    mode: Floats
    good: str
    truth: Floats | None = None

    def as_json(self, zero_s: float) -> dict[str, Any]:
        arrays = {
            "t": self.t_s - zero_s,
            "north": self.north,
            "east": self.east,
            "sd_n": self.sd_n,
            "sd_e": self.sd_e,
            "mode": self.mode,
        }
        truth = self.truth if self.truth is not None else np.empty((0, 2))
        return {
            "kind": "track",
            "title": "Track",
            "good": self.good,
            "truth": [packed(truth[:, 0]), packed(truth[:, 1])],
            **{name: packed(values) for name, values in arrays.items()},
        }


@dataclass(frozen=True, slots=True)
class Sentence:
    """Missing item, and why."""

    text: str

    def as_json(self, zero_s: float) -> dict[str, Any]:
        return {"kind": "sentence", "text": self.text}


Item = Plot | Table | Grid | Track | Sentence


@dataclass(frozen=True, slots=True)
class Section:
    """Items under one heading; items of one `key` in two runs stand side by side."""

    title: str
    items: Sequence[tuple[str, Item]] = field(default_factory=tuple)
