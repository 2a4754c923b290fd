"""Command report: a run as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusiond.commands.recordings import log_errors
from fusiond.commands.shared import spinner


def report(
    run: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...|SOLUTION.csv", help="All files of a log, or a solution."),
    ],
    out: Annotated[Path, typer.Option(metavar="F.html", help="Where the page is written.")],
    truth: Annotated[
        Path | None,
        typer.Option(metavar="T.csv", help="Truth, in the solution's time; of a log in UTC."),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG|SOLUTION.csv", help="A second run; repeat for a log's files."),
    ] = None,
) -> None:
    """Write what happened on a drive as one HTML file, which needs no network."""
    from fusiond.report.report import report as write_report  # noqa: PLC0415

    with log_errors(), spinner("writing the report"):
        runs = write_report(run, out, truth, beside or ())
    for one in runs:
        for problem in one.problems:
            name = "" if problem.text.startswith(one.name) else f"{one.name}: "
            typer.echo(f"fusiond: {name}{problem.text}", err=True)
    typer.echo(f"{out}: {out.stat().st_size * 1e-6:.2f} MB")
