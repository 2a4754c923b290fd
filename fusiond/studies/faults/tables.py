"""What the fault studies found as Markdown, and into which page it goes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

Rows = list[dict[str, Any]]

MATRIX = (
    "fault",
    "phase",
    "verdict",
    "noticed, s",
    "events",
    "modes meanwhile",
    "largest, m",
    "largest yaw, deg",
    "largest error/sigma",
    "longest lie, s",
    "recovered, s",
)
POWER = (
    "fault of position",
    "runs",
    "noticed",
    "noticed after, s (median)",
    "at most",
    "largest error, m",
    "longest lie, s",
)
ALARMS = ("hours", "event", "times", "in 24 h")


def matrix(found: Rows) -> str:
    """A line a row, and the count of each verdict."""
    lines = []
    for row in found:
        codes = Counter(event["code"] for event in row["events"])
        lines.append(
            (
                row["fault"],
                row["phase"],
                row["verdict"],
                _number(row["noticed_s"], "never"),
                _counted(codes),
                ", ".join(row["modes"]) or "-",
                _number(row["largest_horizontal_m"], "inf"),
                _number(row["largest_yaw_deg"], "inf"),
                f"{_number(row['largest_ratio'], 'inf')} {row['largest_ratio_of']}".strip(),
                _number(row["longest_lie_s"], "-"),
                _number(row["recovered_s"], "never"),
            )
        )
    counts = Counter(row["verdict"] for row in found).most_common()
    counted = ", ".join(f"{n} {v}" for v, n in counts)
    return f"{_table(MATRIX, lines)}\n\n{len(found)} rows: {counted}.\n"


def power(found: Rows) -> str:
    """A line a size."""
    return (
        _table(
            POWER,
            (
                (
                    row["fault"],
                    str(row["runs"]),
                    f"{row['noticed']} of {row['runs']}",
                    _number(row["median_s"], "-"),
                    _number(row["slowest_s"], "-"),
                    _number(row["largest_horizontal_m"], "inf"),
                    _number(row["longest_lie_s"], "-"),
                )
                for row in found
            ),
        )
        + "\n"
    )


def alarms(found: Rows) -> str:
    """A line an event that came with nothing wrong, and how long the mode was another."""
    hours = sum(row["hours"] for row in found)
    events: Counter[str] = Counter()
    for row in found:
        events.update(row["events"])
    lines = [
        (f"{hours:g}", code, str(n), f"{24.0 * n / hours:.3g}") for code, n in events.most_common()
    ]
    other_s = sum(row["not_navigating_s"] for row in found)
    lie_s = max(row["longest_lie_s"] for row in found)
    return (
        f"{_table(ALARMS, lines)}\n\n{hours:g} hours simulated; of them {other_s:g} s in another "
        f"mode than `navigating` after the start; longest time beyond five sigma {lie_s:g} s.\n"
    )


TABLES: Mapping[str, Callable[[Rows], str]] = {"matrix": matrix, "power": power, "alarms": alarms}


def put_into(page: Path, kind: str, text: str) -> None:
    """Replace what stands between the marks of `kind` in a page; ValueError without them."""
    begin, end = f"<!-- {kind}: written by --page -->\n", f"<!-- end of {kind} -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page} has no marks of {kind}")
    page.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def _table(header: Iterable[str], lines: Iterable[tuple[str, ...]]) -> str:
    header = tuple(header)
    return "\n".join(
        "| " + " | ".join(line) + " |" for line in (header, ("---",) * len(header), *lines)
    )


def _counted(codes: Mapping[str, int]) -> str:
    return ", ".join(f"{code} x{n}" if n > 1 else code for code, n in codes.items()) or "-"


def _number(value: float | None, none: str) -> str:
    return none if value is None or math.isnan(value) else f"{value:.3g}"
