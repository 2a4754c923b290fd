"""Commands that say what the numbers stand on: schema, study, model, bench."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from fusiond.commands.compiling import compiling
from fusiond.commands.shared import (
    EXIT_UNAVAILABLE,
    JsonPath,
    config_errors,
    data_errors,
    load,
    progress_bar,
    spinner,
    write_json,
)
from fusiond.studies import ABOUT, STUDIES


def schema(
    vehicle: Annotated[str, typer.Option(help="The name in the topics.")] = "vehicle",
) -> None:
    """Print the MQTT topics and messages as an AsyncAPI document."""
    from fusiond.outputs.asyncapi import asyncapi  # noqa: PLC0415

    typer.echo(json.dumps(asyncapi(vehicle), indent=2))


def study(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of those above.")],
    runs: Annotated[
        int | None, typer.Option(min=2, help="Monte Carlo runs; the study's own by default.")
    ] = None,
    json_path: JsonPath = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="F.png", help="Draw the result (needs matplotlib).")
    ] = None,
) -> None:
    """Repeat a paper's experiment, or one that a default stands on."""
    if name not in STUDIES:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(STUDIES)}")
    from importlib import import_module  # noqa: PLC0415
    from importlib.util import find_spec  # noqa: PLC0415

    if plot is not None and find_spec("matplotlib") is None:
        typer.echo("fusiond: --plot needs matplotlib: pip install fusiond[report]", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE)
    with compiling():
        module = import_module(STUDIES[name])
    with progress_bar(name) as progress:
        result = module.run(runs, progress=progress)
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


def model(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Such as ins21.")],
    config: Annotated[
        Path | None,
        typer.Option(metavar="CONFIG", help="Whose IMU and aids; the defaults if none."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Print an error-state model: states, units, noise and initial sigma."""
    from fusiond.commands.model_report import model_report, print_model  # noqa: PLC0415
    from fusiond.models.catalogue import MODELS  # noqa: PLC0415

    if name not in MODELS:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(MODELS)}")
    loaded = None if config is None else load(config)
    with config_errors():
        report = model_report(name, loaded)
    if json_path != "-":
        print_model(report)
    write_json(report, json_path)


def bench(json_path: JsonPath = None) -> None:
    """Time the kernels against one numpy product."""
    with compiling():
        from fusiond.bench.bench import bench as run_bench  # noqa: PLC0415
    from fusiond.commands.bench_report import print_bench  # noqa: PLC0415

    with spinner("timing"):
        figures = run_bench()
    if json_path != "-":
        print_bench(figures)
    write_json(figures, json_path)
