"""The command line. Each command imports what it needs when it runs, so that `--help` is quick.

Exit codes follow sysexits.h: 65 a data file that cannot be used, 69 a package that a command needs
is not installed, 74 a file that cannot be written, 78 a configuration mistake; 2 a
wrong command line; 130 after Ctrl-C.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from fusiond.commands.shared import (
    AID_KINDS,
    EXIT_DATA,
    EXIT_UNAVAILABLE,
    aid_argument,
    config_errors,
    data_errors,
    load,
    outage_argument,
    plain,
    print_file,
    print_summary,
    progress_bar,
    spinner,
    systems_argument,
    write_json,
)
from fusiond.studies import STUDIES

app = typer.Typer(
    help="Inertial navigation aided by BeiDou RDSS and GNSS.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich" if sys.stdout.isatty() and sys.stderr.isatty() else None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration (TOML).")]
JsonPath = Annotated[
    str | None, typer.Option("--json", metavar="F.json", help="Write JSON; - is standard output.")
]


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(130)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed  # noqa: PLC0415

        typer.echo(f"fusiond {installed('fusiond')}")
        raise typer.Exit


# --------------------------------------------------------------------------- live


@app.command()
def run(config: ConfigPath) -> None:
    """Run the daemon."""
    loaded = load(config)
    from fusiond.live.daemon import run as run_daemon  # noqa: PLC0415

    run_daemon(loaded, config)


@app.command()
def demo(
    duration: Annotated[float, typer.Option(min=1.0, help="Seconds.")] = 60.0,
    headless: Annotated[bool, typer.Option("--headless", help="No live view.")] = False,
) -> None:
    """Run the real daemon on a simulated vehicle; the last line is a JSON summary."""
    from fusiond.demo.broker import DemoError  # noqa: PLC0415
    from fusiond.demo.demo import demo as run_demo  # noqa: PLC0415

    try:
        summary = run_demo(duration, headless or not sys.stdout.isatty())
    except DemoError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error
    typer.echo(json.dumps(plain(summary), allow_nan=False))


@app.command()
def check(
    config: ConfigPath,
    compile_kernels: Annotated[
        bool, typer.Option("--compile", help="Also compile what the daemon would compile at start.")
    ] = False,
) -> None:
    """Validate a configuration: 0, or 78 with every mistake.

    With --compile also that the model, with all that its aids add, fits the kernels.
    """
    loaded = load(config)
    if compile_kernels:
        import fusiond.live.daemon  # noqa: F401, PLC0415 - importing it compiles, into the cache
        from fusiond.commands.model_report import model_report  # noqa: PLC0415

        with config_errors():
            model_report(loaded.estimator.model, loaded)
    typer.echo(f"{config}: ok, vehicle {loaded.vehicle}")
    for name, source in loaded.sources.items():
        aid = loaded.aiding.get(name)
        typer.echo(f"  {name}: driver {source.driver}" + (f", aids as {aid.kind}" if aid else ""))
    for name, aid in loaded.aiding.items():
        if name not in loaded.sources:
            typer.echo(f"  {name}: aids as {aid.kind}, no source (for `process`)")


@app.command()
def doctor(
    config: ConfigPath,
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to listen.")] = 5.0,
) -> None:
    """Open every port for some seconds: what arrives, how often, how old, what is wrong."""
    loaded = load(config)
    from fusiond.doctor.doctor import doctor as run_doctor  # noqa: PLC0415

    raise typer.Exit(run_doctor(loaded, seconds))


# --------------------------------------------------------------------------- offline


@app.command()
def process(
    config: ConfigPath,
    imu: Annotated[Path, typer.Option(metavar="F.csv", help="IMU samples.")],
    aid: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND=F", help=f"Aid, repeatable: {', '.join(AID_KINDS)}."),
    ] = None,
    outage: Annotated[
        list[str] | None,
        typer.Option(metavar="START:LENGTH", help="Withhold aids, in s of the files; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="F.csv", help="Write the solution; - is standard output.")
    ] = None,
    systems: Annotated[
        str | None,
        typer.Option(metavar="C,G,E", help="Satellite systems of raw data to use."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Navigate through recorded files with the daemon's own navigator."""
    aids = [aid_argument(text) for text in aid or []]
    outages = [outage_argument(text) for text in outage or []]
    if out is not None and str(out) == "-" == json_path:
        raise typer.BadParameter("--out and --json cannot both be standard output")
    loaded = load(config)
    from fusiond.offline.process import process as run_process  # noqa: PLC0415

    with config_errors(), data_errors(), spinner("processing"):
        result = run_process(loaded, imu, aids, outages, out, systems_argument(systems))
    print_summary(result, err="-" in (json_path, str(out)))
    write_json(result, json_path)


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="static, drive, flight.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files.")],
    seed: Annotated[int, typer.Option(min=0, help="Of the random streams.")] = 0,
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="Seconds; the scenario's own by default.")
    ] = None,
    gnss_raw: Annotated[
        Literal["ubx", "rtcm3"] | None, typer.Option(help="Write the raw GNSS stream too.")
    ] = None,
    gnss_mask: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND:START:LENGTH", help="canyon, canyon2 to canyon4, tunnel; s."),
    ] = None,
) -> None:
    """Write imu.csv, gnss.csv, rdss.csv, truth.csv, gnss.ubx of a simulated vehicle."""
    from fusiond.simulation.files import simulate as run_simulate  # noqa: PLC0415
    from fusiond.simulation.gnss.masks import parse_mask  # noqa: PLC0415
    from fusiond.simulation.scenarios import SCENARIOS  # noqa: PLC0415

    if scenario not in SCENARIOS:
        raise typer.BadParameter(f"{scenario!r}: there are {', '.join(SCENARIOS)}")
    try:
        masked = SCENARIOS[scenario].masked([parse_mask(text) for text in gnss_mask or ()])
    except ValueError as error:
        raise typer.BadParameter(f"--gnss-mask: {error}") from error
    with data_errors(), spinner("simulating"):
        written = run_simulate(masked, out, seed, duration, gnss_raw=gnss_raw)
    for name, path in written.files.items():
        typer.echo(f"{path}: {written.rows[name]} rows")


@app.command()
def compare(
    solution: Annotated[Path, typer.Argument(metavar="SOLUTION.csv")],
    truth: Annotated[
        Path, typer.Argument(metavar="TRUTH.csv", help="truth.csv, or a gnss.csv as a track.")
    ],
    after: Annotated[
        float, typer.Option(min=0.0, help="Leave out the solution's first seconds.")
    ] = 0.0,
    json_path: JsonPath = None,
) -> None:
    """Errors of a solution, and how they sit with its stated sigma."""
    from fusiond.commands.compare_report import print_report  # noqa: PLC0415
    from fusiond.files.csv_tables import file_report  # noqa: PLC0415
    from fusiond.files.tables import read_solution, read_truth  # noqa: PLC0415
    from fusiond.offline.compare import NothingToCompareError  # noqa: PLC0415
    from fusiond.offline.compare import compare as run_compare  # noqa: PLC0415

    with data_errors():
        tables = read_solution(solution), read_truth(truth)
        for path, table in zip((solution, truth), tables, strict=True):
            if table.rejected:
                print_file(str(path), file_report(len(table.t_s), table.rejected), err=True)
        try:
            report = run_compare(*tables, after_s=after)
        except NothingToCompareError as error:
            typer.echo(f"fusiond: {error}", err=True)
            raise typer.Exit(EXIT_DATA) from error
    if json_path != "-":
        print_report(report)
    write_json(report, json_path)


@app.command()
def schema(
    vehicle: Annotated[str, typer.Option(help="The name in the topics.")] = "vehicle",
) -> None:
    """Print the MQTT topics and messages as an AsyncAPI document."""
    from fusiond.outputs.asyncapi import asyncapi  # noqa: PLC0415

    typer.echo(json.dumps(asyncapi(vehicle), indent=2))


@app.command()
def study(
    name: Annotated[str, typer.Argument(metavar="NAME", help=", ".join(STUDIES) + ".")],
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


@app.command()
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
    from fusiond.models.model import MODELS  # noqa: PLC0415

    if name not in MODELS:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(MODELS)}")
    loaded = None if config is None else load(config)
    with config_errors():
        report = model_report(name, loaded)
    if json_path != "-":
        print_model(report)
    write_json(report, json_path)


@app.command()
def bench() -> None:
    """Time the kernels against one numpy product; prints JSON."""
    from fusiond.bench.bench import bench as run_bench  # noqa: PLC0415

    with spinner("timing"):
        figures = run_bench()
    write_json(figures, "-")
