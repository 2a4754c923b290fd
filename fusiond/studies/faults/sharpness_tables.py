"""Markdown tables of `sharpness` (totals, cells and phases) and of `real` (drives)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from fusiond.studies.faults.markdown import number, table
from fusiond.studies.faults.recorded_fault_free import PHASE as COMPARED
from fusiond.studies.faults.sigma_sharpness import PHASES, figures, nees_class
from fusiond.studies.faults.solution_errors import AXES

Row = dict[str, Any]
Rows = list[Row]

SUMS = ("cells", "phase", "runs", *AXES)
LINES = ("IMU", "receiver", "Hz", "lever arm", "phase", *AXES)
COUNTS = ("told", "phase", *AXES)
REAL = (
    "drive",
    "outages",
    "seconds",
    "not `navigating`, s",
    "isolated",
    "told",
    "published over own, 99 %",
    *AXES,
    "largest of each, RMS, m",
    "of all",
)
CONFIGURED = {"all": "all", "class": "the class alone"}
_ALL: tuple[tuple[str, Callable[[Row], bool]], ...] = (
    ("all told", lambda r: True),
    ("code", lambda r: r["receiver"] == "code"),
    ("code, shared errors", lambda r: r["receiver"] == "code, shared errors"),
    ("RTK", lambda r: r["receiver"] == "RTK"),
    ("RTK, shared errors", lambda r: r["receiver"] == "RTK, shared errors"),
    ("1 Hz", lambda r: r["rate_hz"] == 1.0),
    ("10 Hz", lambda r: r["rate_hz"] == 10.0),
    ("lever arm given", lambda r: bool(r["lever_given"])),
    ("lever arm not given", lambda r: not r["lever_given"]),
    ("consumer", lambda r: r["imu"] == "consumer"),
    ("mems", lambda r: r["imu"] == "mems"),
    ("tactical", lambda r: r["imu"] == "tactical"),
    ("data sheet", lambda r: r["imu"] == "data sheet"),
)


def sharpness(found: Rows) -> str:
    """Three tables and a line of sums."""
    reported = [row for row in found if row["told"] == "all"]
    by_class = [row for row in found if row["told"] != "all"]
    sums = [
        (name, phase, str(len(rows)), *_entries(rows, phase))
        for name, holds in _ALL
        if (rows := [row for row in reported if holds(row)])
        for phase in PHASES
    ]
    sums += [
        ("the class alone", phase, str(len(by_class)), *_entries(by_class, phase))
        for phase in PHASES
        if by_class
    ]
    lines = []
    for rows in _by_cell(found):
        cell = rows[0]
        lever = "given" if cell["lever_given"] else "not given"
        imu = cell["imu"] if cell["told"] == "all" else f"{cell['imu']}, the class alone"
        at = (imu, cell["receiver"], f"{cell['rate_hz']:g}", lever)
        lines += [(*at, phase, *_entries(rows, phase)) for phase in PHASES]
    crashes = sum(row["crash"] is not None for row in found)
    drives = len({row["drive"] for row in found})
    return (
        f"{table(COUNTS, _counts(found))}\n\n{table(SUMS, sums)}\n\n{table(LINES, lines)}\n\n"
        f"{len(found)} runs, at most {drives} a cell; {crashes} ended the navigator.\n"
    )


def _by_cell(found: Rows) -> Iterable[Rows]:
    for cell in sorted({row["cell"] for row in found}):
        yield [row for row in found if row["cell"] == cell]


def _entries(rows: Rows, phase: str) -> tuple[str, ...]:
    return tuple(_entry(*figures(rows, phase, name)) for name in AXES)


def _entry(nees: float, half: float, ratio: float) -> str:
    """NEES, marked if not right, and sigma over RMS."""
    if math.isnan(nees):
        return "-"
    text = f"{nees:.2f}"
    mark = {"right": text, "perhaps": f"{text}?", "outside": f"**{text}**"}
    return f"{mark[nees_class(nees, half)]} ({ratio:.2f})"


def _counts(found: Rows) -> list[tuple[str, ...]]:
    """Counts of right, perhaps and outside cells, by setting, phase and quantity."""
    lines = []
    for reported, name in CONFIGURED.items():
        cells = [rows for rows in _by_cell(found) if rows[0]["told"] == reported]
        for phase in PHASES:
            columns = []
            for quantity in AXES:
                numbers = [figures(rows, phase, quantity)[:2] for rows in cells]
                count = Counter(nees_class(*each) for each in numbers if not math.isnan(each[0]))
                columns.append(f"{count['right']}, {count['perhaps']}, {count['outside']}")
            if cells:
                lines.append((name, phase, *columns))
    return lines


def real(found: Rows) -> str:
    """Table with a line a drive, and one for all its sets of outages."""
    lines = []
    for name in dict.fromkeys(row["drive"] for row in found):
        those = [row for row in found if row["drive"] == name]
        quiet = [row for row in those if row["outages"] is None]
        held = [row for row in those if row["outages"] is not None]
        lines += [_of_drive(name, *each) for each in (("none", quiet), ("sets", held)) if each[1]]
    crashes = sum(row["crash"] is not None for row in found)
    return f"{table(REAL, lines)}\n\n{len(found)} runs; {crashes} ended the navigator.\n"


def _of_drive(name: str, outages: str, rows: Rows) -> tuple[str, ...]:
    reported: Counter[str] = sum((Counter(row["told"]) for row in rows), Counter())
    largest = [value for row in rows for value in row["largest_m"]]
    own = [row["own"]["most_99"] for row in rows if row["own"]["most_99"] is not None]
    return (
        name,
        outages if outages == "none" else f"{len(rows)} {outages}",
        f"{sum(row['seconds'] for row in rows):.0f}",
        f"{sum(row['not_navigating_s'] for row in rows):g}",
        str(sum(row["isolated"] for row in rows)),
        ", ".join(f"{what} x{n}" if n > 1 else what for what, n in reported.items()) or "-",
        number(max(own, default=None), "-"),
        *_entries(rows, COMPARED),
        number(math.sqrt(sum(x * x for x in largest) / len(largest)) if largest else None, "-"),
        number(max(largest, default=None), "-"),
    )
