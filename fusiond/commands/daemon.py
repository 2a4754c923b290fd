"""Commands around the daemon: run, demo, check, doctor."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from fusiond.commands.compile_progress import compiling
from fusiond.commands.shared import (
    EXIT_UNAVAILABLE,
    ConfigPath,
    can_draw,
    config_errors,
    load_or_exit,
    to_json_types,
)

RecordPath = Annotated[
    Path | None,
    typer.Option("--record", metavar="DIR", help="Record everything into files of this folder."),
]


def run(config: ConfigPath, record: RecordPath = None) -> None:
    """Run the daemon."""
    # -P: no file of the working folder is taken for a module.
    arguments = [config] if record is None else [config, record]
    program = [sys.executable, "-P", "-m", "fusiond.live", *map(str, arguments)]
    os.execv(sys.executable, program)  # the same process, another program


def demo(
    duration: Annotated[float, typer.Option(min=1.0, help="Seconds.")] = 60.0,
    headless: Annotated[bool, typer.Option("--headless", help="No live view.")] = False,
    record: RecordPath = None,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Also serve the page of `fusiond dashboard`.")
    ] = False,
    paper: Annotated[
        str | None, typer.Option(metavar="NUMBER", help="A paper's model and devices: 000 to 004.")
    ] = None,
) -> None:
    """Run the real daemon on a simulated vehicle.

    The last line is a JSON summary."""
    from fusiond.demo.broker import DemoError  # noqa: PLC0415

    with compiling() as widths:
        from fusiond.demo.demo import demo as run_demo  # noqa: PLC0415
        from fusiond.demo.demo import demo_setup  # noqa: PLC0415
        from fusiond.navigator.kernel_widths import kernel_widths  # noqa: PLC0415
        from fusiond.navigator.navigator import Navigator  # noqa: PLC0415
        from fusiond.simulation.papers import PAPERS  # noqa: PLC0415

        if paper is not None and paper not in PAPERS:
            raise typer.BadParameter(f"--paper {paper}: there are {', '.join(PAPERS)}")
        widths.update(kernel_widths(Navigator(demo_setup(paper).config)))
    try:
        summary = run_demo(duration, headless or not can_draw(sys.stdout), record, dashboard, paper)
    except DemoError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error
    typer.echo(json.dumps(to_json_types(summary), allow_nan=False))


def check(
    config: ConfigPath,
    compile_kernels: Annotated[
        bool, typer.Option("--compile", help="Also compile what the daemon would compile at start.")
    ] = False,
) -> None:
    """Validate a configuration: 0, or 78 with every mistake.

    Valid settings that cannot work are marked with ! and leave the exit code at 0. --compile also
    checks that the model, with all its measurements, fits the kernels.
    """
    settings = load_or_exit(config)
    from fusiond.configuration.doubts import doubts  # noqa: PLC0415

    if compile_kernels:
        with compiling() as widths, config_errors():
            import fusiond.live.daemon  # noqa: F401, PLC0415 - importing it compiles, into the cache
            from fusiond.navigator.kernel_widths import kernel_widths  # noqa: PLC0415
            from fusiond.navigator.navigator import Navigator  # noqa: PLC0415

            widths.update(kernel_widths(Navigator(settings)))  # and so does its filter
    typer.echo(f"{config}: ok, vehicle {settings.vehicle}")
    for name, source in settings.sources.items():
        section = settings.aiding.get(name)
        typer.echo(
            f"  {name}: driver {source.driver}" + (f", used as {section.kind}" if section else "")
        )
    for name in settings.outputs.served:
        typer.echo(f"  output {name}")
    for name, section in settings.aiding.items():
        if name not in settings.sources:
            typer.echo(f"  {name}: used as {section.kind}, no source (for `process`)")
    for doubt in doubts(settings):
        typer.echo(f"  ! {doubt}")


def doctor(
    config: ConfigPath,
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to listen.")] = 5.0,
    transmit: Annotated[
        bool, typer.Option("--transmit", help="Let an RDSS terminal ask for fixes: it transmits.")
    ] = False,
) -> None:
    """Open every port for some seconds and report what is wrong.

    For each port: what arrives, how often, how old, and what is wrong."""
    settings = load_or_exit(config)
    from fusiond.doctor.doctor import doctor as run_doctor  # noqa: PLC0415

    raise typer.Exit(run_doctor(settings, seconds, transmit))
