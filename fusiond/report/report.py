"""`fusiond report`: page of one or two runs, with errors against a truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fusiond.files.measurement_csv import TrajectoryTable, read_truth
from fusiond.report import filter_plots, imu_and_host, overview, states
from fusiond.report.log_run import run_from_log
from fusiond.report.page import page
from fusiond.report.page_items import Item, Section
from fusiond.report.run import Problem, Run
from fusiond.report.solution_run import run_from_solution


def report(
    paths: Sequence[Path], out: Path, truth: Path | None = None, beside: Sequence[Path] = ()
) -> list[Run]:
    """Write the page `out` and return its runs. `paths` and `beside`: the files of a log, or one
    solution file. Raises `LogError`, `TableError`, OSError."""
    runs = [_read(paths), *([_read(beside)] if beside else [])]
    table = None if truth is None else read_truth(truth)
    title = " and ".join(run.name for run in runs)
    html = page(f"{title}: fusiond report", document(title, runs, table))
    out.write_text(html, encoding="utf-8")
    return runs


def _read(paths: Sequence[Path]) -> Run:
    if len(paths) == 1 and paths[0].suffix.lower() == ".csv":
        return run_from_solution(paths[0])
    return run_from_log(paths)


def document(title: str, runs: Sequence[Run], truth: TrajectoryTable | None) -> dict[str, Any]:
    """Data of the page."""
    zeros = _zeros(runs)
    same_time = len(set(zeros)) == 1
    spans = [
        (a - zero, b - zero) for run, zero in zip(runs, zeros, strict=True) for a, b in [run.span_s]
    ]
    sections = [_sections(run, truth) for run in runs]
    joined = _joined(sections, zeros)
    note = ""
    if len(runs) > 1:
        note = "The second run is drawn beside the first, on the same axes."
        if not same_time:
            note += " They have no time in common: each begins at 0."
        elif (difference := states.difference(*runs)) is not None:
            rows = [[item.as_json(zeros[1])] for _, item in difference.items]
            joined.insert(1, {"title": difference.title, "rows": rows})
    return {
        "title": title,
        "made": f"fusiond report {version('fusiond')}",
        "note": note,
        "span": [min(a for a, _ in spans), max(b for _, b in spans)],
        "modes": list(overview.MODES),
        "runs": [_about(run, zero) for run, zero in zip(runs, zeros, strict=True)],
        "sections": joined,
    }


def _zeros(runs: Sequence[Run]) -> list[float]:
    """Zero of each run's times: the earliest instant of all where they overlap."""
    spans = [run.span_s for run in runs]
    first = min(a for a, _ in spans)
    if max(a for a, _ in spans) <= min(b for _, b in spans):
        return [first] * len(spans)
    return [a for a, _ in spans]


def _about(run: Run, zero: float) -> dict[str, Any]:
    started = f"t_s = {zero:.3f} of the file"
    if run.posix:
        started = f"{datetime.fromtimestamp(zero, UTC):%Y-%m-%d %H:%M:%S.%f} UTC"
    return {
        "name": run.name,
        "zero": f"Time 0 is {started}.",
        "problems": [list(problem) for problem in run.problems],
        "modes": [[a - zero, b - zero, mode] for a, b, mode in run.modes()],
        "events": [[e.t_s - zero, e.level, e.source, e.code, e.text] for e in run.events],
    }


def _sections(run: Run, truth: TrajectoryTable | None) -> list[Section]:
    if truth is not None:
        truth = replace(truth, t_s=truth.t_s - run.truth_offset_s)
        if truth.rejected:
            text = f"{len(truth.rejected)} rows of the truth cannot be true: {truth.rejected[0]}"
            run.problems.append(Problem("warning", text))
    made = (
        overview.summary(run),
        overview.track(run, truth),
        states.states(run),
        None if truth is None else states.errors(run, truth),
        filter_plots.innovations(run),
        states.parameters(run),
        filter_plots.verdicts(run),
        filter_plots.delays(run),
        filter_plots.satellites(run),
        imu_and_host.inertial(run),
        imu_and_host.computer(run),
    )
    return [section for section in made if section is not None]


def _joined(runs: Sequence[Sequence[Section]], zeros: Sequence[float]) -> list[dict[str, Any]]:
    """Merge sections by title and items by key, so that two runs share a row."""
    titles = dict.fromkeys(section.title for sections in runs for section in sections)
    # A run without a section does not move it to the end.
    order = max(runs, key=len)
    places = {section.title: k for k, section in enumerate(order)}
    joined = []
    for title in sorted(titles, key=lambda t: places.get(t, len(places))):
        found: list[dict[str, Item]] = [
            next((dict(section.items) for section in sections if section.title == title), {})
            for sections in runs
        ]
        keys = dict.fromkeys(key for items in found for key in items)
        rows = [
            [
                items[key].as_json(zero) if key in items else None
                for items, zero in zip(found, zeros, strict=True)
            ]
            for key in keys
        ]
        joined.append({"title": title, "rows": rows})
    return joined
