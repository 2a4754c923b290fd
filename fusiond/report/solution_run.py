"""Run from a solution file, which holds position, velocity, attitude, sigma and mode."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusiond.files.csv_tables import file_report
from fusiond.files.measurement_csv import read_solution
from fusiond.report.run import Problem, Run

POSIX_FROM_S = 1e9
"""Least POSIX time (s), in 2001; a smaller value is a second of the week or a time since start."""
_GAP_S = 1.0


def run_from_solution(path: Path) -> Run:
    """Read a run from a solution file. Raises `TableError`."""
    table = read_solution(path)
    posix = bool(len(table.t_s)) and float(table.t_s[0]) > POSIX_FROM_S
    run = Run(path.name, table, posix)
    run.facts = [("file", str(path)), ("rows", f"{len(table.t_s)}")]
    if table.rejected:
        said = file_report(len(table.t_s), table.rejected, first=3)
        first = "; ".join(said["first_rejected"])
        run.problems.append(
            Problem(
                "warning", f"{len(table.rejected)} rows cannot be true and are left out: {first}"
            )
        )
    if not len(table.t_s):
        run.problems.append(Problem("error", "no row of it can be used"))
    step = np.diff(table.t_s)
    for k in np.flatnonzero(step > _GAP_S)[:5]:
        run.problems.append(
            Problem("warning", f"no solution for {step[k]:.1f} s after t_s = {table.t_s[k]:.3f}")
        )
    return run
