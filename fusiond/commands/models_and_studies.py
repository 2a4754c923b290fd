"""Commands on models and studies: schema, study, model, bench."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusiond.commands.batch import (
    ClusterAddress,
    Timeout,
    Workers,
    outcome_counts,
    row_errors,
    runner_of,
)
from fusiond.commands.compile_progress import compiling
from fusiond.commands.shared import (
    EXIT_DATA,
    EXIT_UNAVAILABLE,
    JsonPath,
    config_errors,
    data_errors,
    load_or_exit,
    progress_bar,
    spinner,
    write_json,
)
from fusiond.studies import ABOUT, STUDIES

if TYPE_CHECKING:
    from fusiond.studies.monte_carlo import LostRun
    from fusiond.studies.stored_runs import StoredRuns

FEWEST_RUNS = 8
"""Fewest runs for workers: loading a worker's kernels takes two seconds, as long as several
runs."""


def schema(
    vehicle: Annotated[str, typer.Option(help="The vehicle's name in the topics.")] = "vehicle",
) -> None:
    """Print the MQTT topics and messages as an AsyncAPI document."""
    from fusiond.outputs.asyncapi import asyncapi  # noqa: PLC0415

    typer.echo(json.dumps(asyncapi(vehicle), indent=2))


def study(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of those above.")],
    runs: Annotated[
        int | None, typer.Option(min=2, help="Monte Carlo runs; the study's own by default.")
    ] = None,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    timeout: Timeout = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random runs.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="F.parquet", help="File with a row for each run; existing ones stay."),
    ] = None,
    json_path: JsonPath = None,
    plot: Annotated[Path | None, typer.Option(metavar="F.png", help="Draw the result.")] = None,
) -> None:
    """Repeat a paper's experiment, or one behind a default value."""
    if name not in STUDIES:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(STUDIES)}")
    if out is not None and not ABOUT[name].rows:
        raise typer.BadParameter(f"--out: {name} draws all its runs at once, none is a row")
    from importlib import import_module  # noqa: PLC0415

    _studies_installed()
    with compiling():
        module = import_module(STUDIES[name])
    with (
        stored_rows(out, name, seed) as kept,
        _runs(runs or ABOUT[name].runs, workers, cluster, timeout, kept) as lost,
        progress_bar(name) as progress,
    ):
        result = module.run_study(runs, seed, progress=progress)
    if lost:
        result["lost_runs"] = [asdict(run) for run in lost]
        for run in lost:
            typer.echo(f"fusiond: run {run.number} {run.ended}: {run.reason}", err=True)
    if json_path != "-":
        from fusiond.commands.study_report import print_study  # noqa: PLC0415

        print_study(module, result)
    write_json(result, json_path)
    if plot is not None:
        with data_errors():
            module.plot(result, plot)


# A paragraph that begins with \b keeps its lines in `--help`.
study.__doc__ = f"{study.__doc__}\n\n\b\n" + "\n".join(
    f"{name} ({about.runs} runs)\n    {about.text}" for name, about in ABOUT.items()
)


@contextmanager
def stored_rows(out: Path | None, name: str, seed: int) -> Iterator[StoredRuns | None]:
    """Context with the stored rows of a study in `out`; prints their number at the end."""
    if out is None:
        yield None
        return
    from fusiond.files.resumable_parquet import ResumableRows  # noqa: PLC0415
    from fusiond.studies.stored_runs import StoredRuns  # noqa: PLC0415

    with row_errors(), ResumableRows(out) as file:
        kept = StoredRuns(file, name, seed)
        try:
            yield kept
        finally:
            typer.echo(f"{out}: {outcome_counts({'there': kept.there, **kept.ended})}", err=True)


@contextmanager
def _runs(
    runs: int,
    workers: int | None,
    cluster: str | None,
    timeout_s: float | None,
    kept: StoredRuns | None,
) -> Iterator[Sequence[LostRun]]:
    """Context of a study's runs, which yields the lost ones. Runs stay in this process where they
    are too few to warm up workers and none are asked for."""
    few = runs < FEWEST_RUNS and kept is None
    if few and workers is None and cluster is None and timeout_s is None:
        yield ()
        return
    from fusiond.studies.monte_carlo import RunsLostError, runner_context  # noqa: PLC0415

    try:
        with runner_of(workers, cluster, timeout_s) as runner, runner_context(runner, kept) as lost:
            yield lost
    except RunsLostError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_DATA) from error


def model(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Such as ins21.")],
    config: Annotated[
        Path | None,
        typer.Option(metavar="CONFIG", help="For IMU and measurements; else the defaults."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Print an error-state model: states, units, noise, sigma."""
    from fusiond.commands.model_report import model_report, print_model  # noqa: PLC0415
    from fusiond.models.catalogue import MODELS  # noqa: PLC0415

    if name not in MODELS:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(MODELS)}")
    settings = None if config is None else load_or_exit(config)
    with config_errors():
        report = model_report(name, settings)
    if json_path != "-":
        print_model(report)
    write_json(report, json_path)


def _studies_installed() -> None:
    """Exit 69 where the extra `[studies]` is missing, with the command that installs it."""
    from importlib.util import find_spec  # noqa: PLC0415

    missing = [name for name in ("scipy", "pywt", "matplotlib") if find_spec(name) is None]
    if missing:
        from fusiond.files.install_extra import install_command  # noqa: PLC0415

        typer.echo(
            f"fusiond: studies need {', '.join(missing)}: {install_command('studies')}", err=True
        )
        raise typer.Exit(EXIT_UNAVAILABLE)


def bench(json_path: JsonPath = None) -> None:
    """Time the kernels against one numpy product."""
    _studies_installed()  # a paper's filter is timed too
    with compiling():
        from fusiond.bench.bench import bench as run_bench  # noqa: PLC0415
    from fusiond.commands.bench_report import print_bench  # noqa: PLC0415

    with spinner("timing"):
        figures = run_bench()
    if json_path != "-":
        print_bench(figures)
    write_json(figures, json_path)
