"""Markdown tables of `service`: sums by group, a line a fault, and the recovery from outages."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from fusiond.studies.faults.markdown import number, table
from fusiond.studies.faults.service import (
    AFTER_OUTAGES,
    FAULTS,
    IMU,
    NONE,
    OUTAGES_S,
    POSITION,
    RECEIVERS,
    VELOCITY,
)

Rows = list[dict[str, Any]]

FIGURES = (
    "runs",
    "over 2 s beyond 5 sigma",
    "longest, s",
    "largest error, m",
    "out, s (median)",
    "at most",
    "of it after the fault, s (median)",
    "at most",
    "sigma within 1.5, s (median)",
    "at most",
)
SUMS = ("faults", "receiver", *FIGURES)
LINES = ("fault", "receiver", *FIGURES)
OUTAGES = (
    "receiver",
    "outage, s",
    "`navigating` after, s (median)",
    "at most",
    "position's sigma within 1.5, s (median)",
    "at most",
    "velocity's",
    "at most",
    "longest lie, s",
)
GROUPS = {
    "all of receivers": (POSITION, VELOCITY),
    POSITION: (POSITION,),
    VELOCITY: (VELOCITY,),
    IMU: (IMU,),
    NONE: (NONE,),
}


def service(found: Rows) -> str:
    """Table with sums by group and receiver, a line a fault, and a line a receiver and outage."""
    faults = [row for row in found if row["part"] == "fault"]
    outages = [row for row in found if row["part"] == "outages"]
    sums, lines = [], []
    for name, groups in GROUPS.items():
        rows = [row for row in faults if row["group"] in groups]
        for receiver in RECEIVERS:
            sums.append((name, receiver, *_figures(_of(rows, receiver))))
    for name in FAULTS:
        rows = [row for row in faults if row["fault"] == name]
        for receiver in RECEIVERS:
            lines.append((name, receiver, *_figures(_of(rows, receiver))))
    after = [
        (receiver, f"{length_s:g}", *_after(_of(outages, receiver), length_s))
        for receiver in AFTER_OUTAGES
        for length_s in OUTAGES_S.values()
    ]
    crashes = sum(row["crash"] is not None for row in found)
    drives = len({row["drive"] for row in found})
    return (
        f"{table(SUMS, sums)}\n\n{table(LINES, lines)}\n\n{table(OUTAGES, after)}\n\n"
        f"{len(found)} runs on {drives} drives; {crashes} ended the navigator.\n"
    )


def _of(rows: Rows, receiver: str) -> Rows:
    return [row for row in rows if row["receiver"] == receiver]


def _figures(rows: Rows) -> tuple[str, ...]:
    if not rows:
        return ("0", *("-",) * (len(FIGURES) - 1))
    lies = sum(row["lies"] for row in rows)
    errors = [row["largest_m"] for row in rows]
    return (
        str(len(rows)),
        f"{lies} ({100.0 * lies / len(rows):.0f} %)" if lies else "0",
        number(max(row["longest_lie_s"] for row in rows), "-"),
        "inf" if None in errors else number(max(errors), "-"),
        *_spread(row["out_s"] for row in rows),
        *_spread(row["out_after_s"] for row in rows),
        *_spread(row["settled_s"]["position"] for row in rows),
    )


def _after(rows: Rows, length_s: float) -> tuple[str, ...]:
    those = [each for row in rows for each in row["outages"] if each["length_s"] == length_s]
    if not those:
        return ("-",) * (len(OUTAGES) - 2)
    return (
        *_spread(each["navigating_s"] for each in those),
        *_spread(each["settled_s"]["position"] for each in those),
        *_spread(each["settled_s"]["velocity"] for each in those),
        number(max(each["longest_lie_s"] for each in those), "-"),
    )


def _spread(values: Iterable[float | None]) -> tuple[str, str]:
    """Median and maximum, with None as the largest."""
    found = [float("inf") if value is None else value for value in values]
    return _time(found, statistics.median_low), _time(found, max)


def _time(values: Sequence[float], of: Any) -> str:
    value = float(of(values))
    return "never" if value == float("inf") else number(value, "-")
