"""Page of many drives: rows of `fusiond batch` or of `fusiond study --out`.

Rows of one configuration, version and part of a study form a group. Every plot shows the groups
side by side, and so the effect of a change on a fleet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusiond.files.csv_tables import Floats, TableError
from fusiond.files.resumable_parquet import Row, read_rows
from fusiond.report.page import page
from fusiond.report.page_items import Grid, Item, Plot, Section, Sentence, Series, Table

GROUPED = ("study", "part", "config_digest", "version", "seed")
MOST_GROUPS = 6
"""Most groups: the number of colours that a page can distinguish."""
MOST_BINS, FEWEST_BINS = 60, 8
"""Limits of the number of bins, which is the root of the number of drives."""
SHOWN_SHARE = 0.995
"""Share of drives on the axis; the last bar holds the rest, so that an outlier does not compress
the others into one bar."""
PERCENTILES = (5.0, 50.0, 95.0, 99.0, 100.0)
MOST_PLOTS = 12


class Shown(NamedTuple):
    """Figure of a row: column, title, unit and reference value."""

    column: str
    title: str
    unit: str
    good: str = ""
    expected: float | None = None


ERRORS = (
    Shown("error.horizontal_rms_m", "Horizontal error, RMS of a drive", "m"),
    Shown("error.horizontal_max_m", "Horizontal error, largest of a drive", "m"),
    Shown("error.down_rms_m", "Height error, RMS of a drive", "m"),
    Shown("error.v_horizontal_rms_m_s", "Horizontal velocity error, RMS of a drive", "m/s"),
    Shown("error.yaw_rms_deg", "Heading error, RMS of a drive", "deg"),
)
SIGMA = (
    Shown(
        "error.position_nees",
        "NEES of the position, mean of a drive",
        "",
        "The mean over the drives is 3 where sigma is honest, and more where it is too small. A "
        "drive alone tells little: its errors hang together.",
        3.0,
    ),
    Shown(
        "error.horizontal_inside_2_sigma",
        "Share of a drive's epochs inside 2 sigma horizontally",
        "",
        "The mean over the drives is 0.865 where sigma is honest (two axes, Gaussian).",
        0.8647,
    ),
    Shown(
        "error.horizontal_inside_3_sigma",
        "Share of a drive's epochs inside 3 sigma horizontally",
        "",
        "The mean over the drives is 0.989 where sigma is honest.",
        0.9889,
    ),
)
LISTED = (
    *("ended", "reason", "modes.navigating", "error.horizontal_rms_m", "error.horizontal_max_m"),
    *("error.yaw_rms_deg", "error.position_nees", "error.horizontal_inside_2_sigma", "events"),
)
_CALLED = {
    "modes.navigating": "navigating",
    "error.horizontal_rms_m": "horizontal RMS, m",
    "error.horizontal_max_m": "largest, m",
    "error.yaw_rms_deg": "heading RMS, deg",
    "error.position_nees": "NEES",
    "error.horizontal_inside_2_sigma": "inside 2 sigma",
    "config_digest": "configuration",
}


class Group(NamedTuple):
    """Rows of one configuration, version, part and seed."""

    label: str
    rows: Sequence[Row]


def report_drives(path: Path, out: Path) -> int:
    """Write the page `out` and return its number of drives. Raises `TableError`,
    `MissingPackageError`, OSError."""
    rows = read_rows(path, without=("result",))
    if not rows:
        raise TableError(f"{path}: there are no rows in it")
    if not all("ended" in row for row in rows):
        raise TableError(f"{path}: no rows of fusiond batch or study --out: `ended` is missing")
    title = f"{path.name}: {len(rows)} drives"
    out.write_text(page(f"{title}: fusiond report", document(title, rows)), encoding="utf-8")
    return len(rows)


def document(title: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Data of the page."""
    groups = groups_of(rows)
    failed = [row for row in rows if row["ended"] != "done"]
    problems = []
    if failed:
        counts = ", ".join(f"{n} {how}" for how, n in Counter(r["ended"] for r in failed).items())
        problems.append(["warning", f"{len(failed)} of {len(rows)} have no figures: {counts}."])
    sections = (
        _summary(groups),
        _failures(failed),
        _distributions("Errors against the truth", ERRORS, groups),
        _distributions("Is sigma honest?", SIGMA, groups),
        _verdicts(groups),
        _modes(groups),
        _outcomes(groups),
        _others(groups),
        _every(rows, groups),
    )
    return {
        "title": title,
        "made": f"fusiond report {version('fusiond')}",
        "note": "",
        "span": [0.0, 0.0],
        "drives": len(rows),
        "modes": [],
        "runs": [{"name": title, "zero": "", "problems": problems, "modes": [], "events": []}],
        "sections": [
            {"title": s.title, "rows": [[item.as_json(0.0)] for _, item in s.items]}
            for s in sections
            if s is not None
        ],
    }


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """Groups in order of their first rows, named by their difference; groups beyond `MOST_GROUPS`
    are merged."""
    keys = [tuple(str(row.get(name, "")) for name in GROUPED) for row in rows]
    distinct = list(dict.fromkeys(keys))
    changed_settings = [k for k in range(len(GROUPED)) if len({key[k] for key in distinct}) > 1]
    found = []
    for key in distinct[:MOST_GROUPS]:
        label = " ".join(key[k] for k in changed_settings if key[k]) or "drives"
        found.append(Group(label, [r for r, of in zip(rows, keys, strict=True) if of == key]))
    others = set(distinct[MOST_GROUPS:])
    if others:
        rest = [r for r, of in zip(rows, keys, strict=True) if of in others]
        found[-1] = Group(f"{len(others) + 1} others", [*found[-1].rows, *rest])
    return found


def _values(rows: Iterable[Row], column: str) -> Floats:
    """Values of a column, without rows that lack it."""
    return np.array([row[column] for row in rows if column in row], dtype=np.float64)


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def _summary(groups: Sequence[Group]) -> Section:
    rows = []
    for group in groups:
        first, ended = group.rows[0], Counter(row["ended"] for row in group.rows)
        named = [_text(first.get(name)) for name in GROUPED]
        hows = ", ".join(f"{count} {how}" for how, count in ended.most_common())
        rows.append([group.label, *named, str(len(group.rows)), hows])
    head = ["group", *(_CALLED.get(name, name) for name in GROUPED), "drives", "ended"]
    return Section("Summary", [("groups", _full("What is in this file", head, rows))])


def _failures(failed: Sequence[Row]) -> Section | None:
    if not failed:
        return None
    same = Counter((row["ended"], row.get("reason", "")) for row in failed)
    example = {(r["ended"], r.get("reason", "")): _name(r) for r in reversed(failed)}
    rows = [[str(n), *key, example[key]] for key, n in same.most_common()]
    table = Table("Why there are no figures", ["drives", "ended", "reason", "such as"], rows)
    return Section("Failures", [("reasons", table)])


def _distributions(title: str, wanted: Sequence[Shown], groups: Sequence[Group]) -> Section | None:
    present = [s for s in wanted if any(len(_values(g.rows, s.column)) for g in groups)]
    if not present:
        return None
    items: list[tuple[str, Item]] = [("table", _spread("Over the drives", present, groups))]
    items += [(s.column, _histogram(s, groups)) for s in present]
    return Section(title, items)


def _spread(title: str, shown: Sequence[Shown], groups: Sequence[Group]) -> Table:
    rows = []
    for s in shown:
        for group in groups:
            values = _values(group.rows, s.column)
            if not len(values):
                continue
            at = np.percentile(values, PERCENTILES).tolist()
            half = 2.576 * float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 0
            mean = f"{values.mean():.4g} ± {half:.2g}"
            expected = "" if s.expected is None else f"{s.expected:.4g}"
            name = f"{s.title}{', ' + s.unit if s.unit else ''}"
            cells = [mean, expected, *(f"{v:.4g}" for v in at), str(len(values))]
            rows.append([name, *([group.label] if len(groups) > 1 else []), *cells])
    head = ["", *(["group"] if len(groups) > 1 else []), "mean", "expected"]
    head += [*(f"{share:g} %" for share in PERCENTILES), "drives"]
    return _full(title, head, rows, "The mean with its 99 % interval, drives being independent.")


def _histogram(shown: Shown, groups: Sequence[Group]) -> Plot:
    of = [_values(group.rows, shown.column) for group in groups]
    every = np.concatenate(of)
    low, high = float(every.min()), float(np.quantile(every, SHOWN_SHARE, method="higher"))
    if high <= low:
        low, high = low - 0.1 * (abs(low) or 1.0), low
    bins = min(MOST_BINS, max(FEWEST_BINS, round(max(map(len, of)) ** 0.5)))
    edges = np.linspace(low, high, bins + 1)
    beyond = int((every > high).sum())
    many = len(groups) > 1
    series = []
    for group, values in zip(groups, of, strict=True):
        counts, _ = np.histogram(np.minimum(values, high), edges)
        if many:  # shares, as outlines that close at the last edge
            shares = np.append(counts, counts[-1]) / max(len(values), 1)
            series.append(Series(group.label, shares, "steps"))
        else:
            series.append(Series(group.label, counts.astype(float), "bars"))
    good = shown.good
    if beyond:
        good = f"{good} The last bar holds {beyond} beyond it, up to {every.max():.4g}.".strip()
    label = f"{shown.title}{', ' + shown.unit if shown.unit else ''}"
    x = edges if many else 0.5 * (edges[1:] + edges[:-1])
    return Plot(shown.title, "share of the group" if many else "drives", x, series, good, label)


def _full(title: str, head: Sequence[str], rows: Sequence[Sequence[str]], good: str = "") -> Table:
    """Table without empty columns."""
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    return Table(title, [head[k] for k in kept], [[row[k] for k in kept] for row in rows], good)


def _verdicts(groups: Sequence[Group]) -> Section | None:
    before = "consistency."
    rows = []
    for group in groups:
        sources = dict.fromkeys(n[len(before) :] for r in group.rows for n in r if n[:12] == before)
        for source in sources:
            said = Counter(r[before + source] for r in group.rows if before + source in r)
            cells = ", ".join(f"{count} {verdict}" for verdict, count in said.most_common())
            rows.append([*([group.label] if len(groups) > 1 else []), source, cells])
    if not rows:
        return None
    head = [*(["group"] if len(groups) > 1 else []), "source", "verdict at the end, drives"]
    good = "Nearly all drives `consistent`, or `too_few` on short ones."
    return Section("Verdicts", [("verdicts", Table("Of each source", head, rows, good))])


def _modes(groups: Sequence[Group]) -> Section | None:
    names = dict.fromkeys(n for g in groups for r in g.rows for n in r if n.startswith("modes."))
    if not names:
        return None
    head = ["group", *(name[6:] for name in names)]
    rows = []
    for group in groups:
        with_modes = [r for r in group.rows if any(name in r for name in names)]
        means = (sum(r.get(n, 0.0) for r in with_modes) / max(len(with_modes), 1) for n in names)
        rows.append([group.label, *(f"{100 * mean:.2f} %" for mean in means)])
    items: list[tuple[str, Item]] = [("table", Table("Share of the time", head, rows))]
    share = Shown("modes.navigating", "Share of a drive in mode navigating", "")
    if share.column in names:
        items.append(("navigating", _histogram(share, groups)))
    return Section("Modes", items)


def _outcomes(groups: Sequence[Group]) -> Section | None:
    before = "outcomes."
    rows = []
    for group in groups:
        total: Counter[str] = Counter()
        drives: Counter[str] = Counter()
        for row in group.rows:
            for name, count in row.items():
                if name.startswith(before):
                    total[name[len(before) :]] += count
                    drives[name[len(before) :]] += 1
        of_source: Counter[str] = Counter()
        for name, count in total.items():
            of_source[name.rpartition(".")[0]] += count
        for name, count in total.items():
            source, _, outcome = name.rpartition(".")
            share = f"{100 * count / max(of_source[source], 1):.2f} %"
            label = [group.label] if len(groups) > 1 else []
            rows.append([*label, source, outcome, str(count), share, str(drives[name])])
    if not rows:
        return None
    head = [*(["group"] if len(groups) > 1 else []), "source", "outcome", "measurements"]
    head += ["share of the source", "drives"]
    return Section("Outcomes", [("outcomes", Table("What became of measurements", head, rows))])


def _others(groups: Sequence[Group]) -> Section | None:
    """Tables of a study whose rows are not drives: every numeric column."""
    if any(s.column in row for s in ERRORS for g in groups for row in g.rows):
        return None
    known = {*GROUPED, "run", "ended", "reason"}
    known_parts = ("modes.", "outcomes.")
    numbers = dict.fromkeys(
        name
        for group in groups
        for row in group.rows
        for name, value in row.items()
        if name not in known and isinstance(value, float) and not name.startswith(known_parts)
    )
    if not numbers:
        return Section("Figures", [("none", Sentence("No row has a figure."))])
    shown = [Shown(name, name, "") for name in numbers]
    plotted = [s for s in shown if s.column.endswith(("nees", "nees.mean"))][:MOST_PLOTS]
    items: list[tuple[str, Item]] = [("table", _spread("Over the runs", shown, groups))]
    items += [(s.column, _histogram(s, groups)) for s in plotted or shown[:MOST_PLOTS]]
    return Section("Figures", items)


def _name(row: Row) -> str:
    if "log" in row:
        return Path(row["log"]).name
    return f"run {row.get('run', '')}"


def _every(rows: Sequence[Row], groups: Sequence[Group]) -> Section:
    present = [name for name in LISTED if any(row.get(name, "") != "" for row in rows)]
    label_of = {id(row): group.label for group in groups for row in group.rows}
    many = len(groups) > 1
    head = ["drive", *(["group"] if many else []), *(_CALLED.get(n, n) for n in present)]
    cells = [
        [_name(row), *([label_of[id(row)]] if many else []), *(row.get(n) for n in present)]
        for row in rows
    ]
    links = [Path(row["log"]).as_uri() if "log" in row else "" for row in rows]
    wrong = frozenset(k for k, row in enumerate(rows) if row["ended"] != "done")
    grid = Grid("All drives", head, cells, links, wrong)
    return Section("Drives", [("drives", grid)])
