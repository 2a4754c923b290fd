"""Command report: a run as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusiond.commands.batch import row_errors
from fusiond.commands.recordings import log_errors
from fusiond.commands.shared import spinner


def report(
    run: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...|SOLUTION.csv", help="All files of a log, or a solution."),
    ] = None,
    batch: Annotated[
        Path | None,
        typer.Option(metavar="F.parquet", help="Many drives: rows of `batch` or `study --out`."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="T.csv", help="Truth in the solution's time; for a log in UTC."),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG|SOLUTION.csv", help="A second run; repeat for a log's files."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="F.html", help="The page; by default named after the first file."),
    ] = None,
) -> None:
    """Write a report of one drive, or of many, as one HTML file.

    The file needs no network."""
    if (batch is None) == (not run) or (batch is not None and (truth or beside)):
        raise typer.BadParameter("a log or a solution, or --batch with rows and nothing else")
    if out is None:
        first = batch or (run or [])[0]
        out = Path(first.with_suffix(".html").name)
    if batch is None:
        _of_drive(run or [], out, truth, beside or [])
    else:
        from fusiond.report.drives_page import report_drives  # noqa: PLC0415

        with row_errors(), spinner("writing the report"):
            drives = report_drives(batch, out)
        typer.echo(f"{drives} drives", err=True)
    typer.echo(f"{out}: {out.stat().st_size * 1e-6:.2f} MB")


def _of_drive(run: list[Path], out: Path, truth: Path | None, beside: list[Path]) -> None:
    from fusiond.report.report import report as write_report  # noqa: PLC0415

    with log_errors(), spinner("writing the report"):
        runs = write_report(run, out, truth, beside)
    for one in runs:
        for problem in one.problems:
            name = "" if problem.text.startswith(one.name) else f"{one.name}: "
            typer.echo(f"fusiond: {name}{problem.text}", err=True)
