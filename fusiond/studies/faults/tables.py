"""Markdown tables of the fault studies, and the page of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fusiond.studies.faults.faulty_hours import by_fault
from fusiond.studies.faults.hours import rates
from fusiond.studies.faults.markdown import number, table
from fusiond.studies.faults.power import powers
from fusiond.studies.faults.service_tables import service
from fusiond.studies.faults.sharpness_tables import real, sharpness

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
    "fault",
    "size",
    "noticed",
    "after, s (median)",
    "at most",
    "largest error, m",
    "largest error/sigma",
    "lies",
    "longest, s",
)
BOUNDS = (
    "fault",
    "receiver or phase",
    "runs",
    "beyond five sigma after, s",
    "open to who knows it, s",
    "can be told after, s",
    "lies over 2 s until open",
    "longest, s",
    "error until told, m",
)
ALARMS = ("vehicle", "hours", "alarm", "times", "in 24 h", "99 % interval", "stated in 24 h")
HAPPENED = (
    "fault",
    "times",
    "noticed",
    "after, s (median)",
    "at most",
    "recovered",
    "after, s (median)",
    "at most",
    "largest error/sigma",
    "beyond, s",
    "lies",
    "longest, s",
)
SLOW_S = 60.0
"""Longest acceptable recovery (s) after a fault."""


def recorded_table(found: Rows) -> str:
    """Table with a line for each fault, phase and instant that lied, lasted over a minute beyond
    its end, or ended the navigator; and the count of each verdict."""
    named = [{**row, "fault": f"{row['fault']}, at {row['at_s']:g} s"} for row in found]
    return matrix_table([row for row in named if _failed(row)]).rpartition("\n\n")[0] + _count(
        found
    )


def _failed(row: Mapping[str, Any]) -> bool:
    slow = row["recovered_s"] is None or row["recovered_s"] > SLOW_S
    over = row["end_s"] + SLOW_S <= row["duration_s"]
    return row["verdict"] in {"crashed", "lie"} or (slow and over)


def matrix_table(found: Rows) -> str:
    """Table with a line a row, and the count of each verdict."""
    lines = []
    for row in found:
        codes = Counter(event["code"] for event in row["events"])
        lines.append(
            (
                row["fault"],
                row["phase"],
                row["verdict"],
                number(row["noticed_s"], "never"),
                _counted(codes),
                ", ".join(row["modes"]) or "-",
                number(row["largest_horizontal_m"], "inf"),
                number(row["largest_yaw_deg"], "inf"),
                f"{number(row['largest_ratio'], 'inf')} {row['largest_ratio_of']}".strip(),
                _lie(row),
                number(row["recovered_s"], "never"),
            )
        )
    return table(MATRIX, lines) + _count(found)


def _lie(row: Mapping[str, Any]) -> str:
    """The longest lie, and the modes of all seconds beyond five sigma."""
    lie_s, modes = number(row["longest_lie_s"], "-"), ", ".join(row["lie_modes"])
    return f"{lie_s} ({modes})" if modes else lie_s


def _count(found: Rows) -> str:
    counts = Counter(row["verdict"] for row in found).most_common()
    counted = ", ".join(f"{n} {v}" for v, n in counts)
    return f"\n\n{len(found)} rows: {counted}.\n"


def power_table(found: Rows) -> str:
    """Table with a line a kind and size of fault."""
    lines = [
        (
            row["fault"],
            row["size"],
            f"{row['noticed']} of {row['runs']}",
            number(row["median_s"], "-"),
            number(row["slowest_s"], "-"),
            number(row["largest_horizontal_m"], "inf"),
            number(row["largest_ratio"], "inf"),
            str(row["lies"]),
            number(row["longest_lie_s"], "-"),
        )
        for row in powers(found)
    ]
    return table(POWER, lines) + "\n"


def alarm_table(found: Rows) -> str:
    """Table with a line a vehicle and alarm, and the time of errors beyond five sigma."""
    hours = sum(row["hours"] for row in found)
    other_s = sum(row["not_navigating_s"] for row in found)
    return (
        f"{_reported(found)}\n\n{hours:.4g} hours simulated; of them {other_s:g} s in another "
        f"mode than `navigating` after the start. {_beyond(found)}\n"
    )


def fault_table(found: Rows) -> str:
    """Table with a line a fault, the alarms of the quiet between faults, and the errors in it."""
    lines = [
        (
            row["fault"],
            str(row["times"]),
            f"{row['noticed']} of {row['begun']}",
            number(row["noticed_median_s"], "-"),
            number(row["noticed_slowest_s"], "-"),
            f"{row['recovered']} of {row['begun']}",
            number(row["recovered_median_s"], "-"),
            number(row["recovered_slowest_s"], "-"),
            number(row["largest_ratio"], "inf"),
            str(row["beyond_s"]),
            str(row["lies"]),
            number(row["longest_lie_s"], "-"),
        )
        for row in by_fault(found)
    ]
    happened = [fault for row in found for fault in row["faults"]]
    beyond_s = sum(fault["beyond_s"] for fault in happened)
    crashes = sum(row["crash"] is not None for row in found)
    hours = sum(row["simulated_hours"] for row in found)
    quiet = sum(row["hours"] for row in found)
    other_s = sum(row["not_navigating_s"] for row in found)
    return (
        f"{table(HAPPENED, lines)}\n\n{len(happened)} faults in {hours:.4g} hours simulated; "
        f"{crashes} ended the navigator. Beyond five sigma in any mode: {beyond_s} s.\n"
        f"\n{_reported(found)}\n\n{quiet:.4g} hours quiet, and {other_s:g} s as far from any fault "
        f"in another mode than `navigating`. {_beyond(found)}\n"
    )


def _reported(found: Rows) -> str:
    lines = [
        (
            row["kind"],
            f"{row['hours']:.4g}",
            row["what"],
            str(row["times"]),
            f"{row['per_24_h']:.3g}",
            f"{row['interval'][0]:.3g} to {row['interval'][1]:.3g}",
            f"{row['stated_per_24_h']:.2g}",
        )
        for row in rates(found)
    ]
    return table(ALARMS, lines)


def _beyond(found: Rows) -> str:
    beyond: Counter[str] = sum((Counter(row["beyond_s"]) for row in found), Counter())
    counted = ", ".join(f"{q} {s} s" for q, s in beyond.items()) or "none"
    lie_s = max(row["longest_lie_s"] for row in found)
    return f"Beyond five sigma in any mode: {counted}; at most {lie_s:g} s together."


def bounds_table(found: Rows) -> str:
    """Table with a line a fault and receiver or phase: instants of its runs in order, longest
    lie."""
    lines = []
    for key in dict.fromkeys((row["fault"], row["where"]) for row in found):
        rows = [row for row in found if (row["fault"], row["where"]) == key]
        instants = [
            ", ".join(number(row[name], "never") for row in rows)
            for name in ("beyond_s", "open_s", "detected_s")
        ]
        lies = sum(row["lies"] for row in rows)
        longest = number(max(row["lie_s"] for row in rows), "-")
        least = number(max(row["least_m"] for row in rows), "-")
        lines.append((*key, str(len(rows)), *instants, str(lies), longest, least))
    lies = sum(row["lies"] for row in found)
    return f"{table(BOUNDS, lines)}\n\n{len(found)} runs; in {lies} no test keeps from a lie.\n"


TABLES: Mapping[str, Callable[[Rows], str]] = {
    "matrix": matrix_table,
    "power": power_table,
    "alarms": alarm_table,
    "faulty": fault_table,
    "recorded": recorded_table,
    "service": service,
    "sharpness": sharpness,
    "bounds": bounds_table,
    "real": real,
}


def replace_table(page: Path, kind: str, text: str) -> None:
    """Replace the text between the marks of `kind` in a page; ValueError without them."""
    begin, end = f"<!-- {kind}: written by --page -->\n", f"<!-- end of {kind} -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page} has no marks of {kind}")
    page.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def _counted(codes: Mapping[str, int]) -> str:
    return ", ".join(f"{code} x{n}" if n > 1 else code for code, n in codes.items()) or "-"
