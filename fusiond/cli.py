"""The command line. Each command imports what it needs when it runs, so that `--help` is quick.

Exit codes follow sysexits.h: 65 a data file that cannot be used, 69 a package that a command needs
is not installed, 74 a file that cannot be written, 78 a configuration mistake; 2 a
wrong command line; 130 after Ctrl-C.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fusiond.studies import STUDIES

if TYPE_CHECKING:
    from drivers.raw.messages import System
    from fusiond.config import Config

EXIT_DATA = 65
EXIT_UNAVAILABLE = 69
EXIT_IO = 74
EXIT_CONFIG = 78
AID_KINDS = ("gnss", "rdss", "attitude", "bearing", "wheel", "nmea", "raw")

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
    loaded = _load(config)
    from fusiond.daemon import run as run_daemon  # noqa: PLC0415

    run_daemon(loaded, config)


@app.command()
def demo(
    duration: Annotated[float, typer.Option(min=1.0, help="Seconds.")] = 60.0,
    headless: Annotated[bool, typer.Option("--headless", help="No live view.")] = False,
) -> None:
    """Run the real daemon on a simulated vehicle; the last line is a JSON summary."""
    from fusiond.demo import demo as run_demo  # noqa: PLC0415
    from fusiond.demo_broker import DemoError  # noqa: PLC0415

    try:
        summary = run_demo(duration, headless or not sys.stdout.isatty())
    except DemoError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error
    typer.echo(json.dumps(_plain(summary), allow_nan=False))


@app.command()
def check(
    config: ConfigPath,
    compile_kernels: Annotated[
        bool, typer.Option("--compile", help="Also compile what the daemon would compile at start.")
    ] = False,
) -> None:
    """Validate a configuration: 0, or 78 with every mistake."""
    loaded = _load(config)
    if compile_kernels:
        import fusiond.daemon  # noqa: F401, PLC0415 - importing it compiles, into the cache
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
    loaded = _load(config)
    from fusiond.doctor import doctor as run_doctor  # noqa: PLC0415

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
    aids = [_aid(text) for text in aid or []]
    outages = [_outage(text) for text in outage or []]
    if out is not None and str(out) == "-" == json_path:
        raise typer.BadParameter("--out and --json cannot both be standard output")
    loaded = _load(config)
    from fusiond.offline import process as run_process  # noqa: PLC0415

    with _data_errors(), _spinner("processing"):
        result = run_process(loaded, imu, aids, outages, out, _systems(systems))
    _print_summary(result, err="-" in (json_path, str(out)))
    _write_json(result, json_path)


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
    from fusiond.simulation.gnss_masks import parse_mask  # noqa: PLC0415
    from fusiond.simulation.scenarios import SCENARIOS  # noqa: PLC0415

    if scenario not in SCENARIOS:
        raise typer.BadParameter(f"{scenario!r}: there are {', '.join(SCENARIOS)}")
    try:
        masked = SCENARIOS[scenario].masked([parse_mask(text) for text in gnss_mask or ()])
    except ValueError as error:
        raise typer.BadParameter(f"--gnss-mask: {error}") from error
    with _data_errors(), _spinner("simulating"):
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
    from fusiond.compare import NothingToCompareError  # noqa: PLC0415
    from fusiond.compare import compare as run_compare  # noqa: PLC0415
    from fusiond.compare_report import print_report  # noqa: PLC0415
    from fusiond.csv_tables import file_report  # noqa: PLC0415
    from fusiond.files import read_solution, read_truth  # noqa: PLC0415

    with _data_errors():
        tables = read_solution(solution), read_truth(truth)
        for path, table in zip((solution, truth), tables, strict=True):
            if table.rejected:
                _print_file(str(path), file_report(len(table.t_s), table.rejected), err=True)
        try:
            report = run_compare(*tables, after_s=after)
        except NothingToCompareError as error:
            typer.echo(f"fusiond: {error}", err=True)
            raise typer.Exit(EXIT_DATA) from error
    if json_path != "-":
        print_report(report)
    _write_json(report, json_path)


@app.command()
def schema(
    vehicle: Annotated[str, typer.Option(help="The name in the topics.")] = "vehicle",
) -> None:
    """Print the MQTT topics and messages as an AsyncAPI document."""
    from fusiond.outputs.messages import asyncapi  # noqa: PLC0415

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
    with _progress(name) as progress:
        result = module.run(runs, progress=progress)
    if json_path != "-":
        from fusiond.studies.report import print_study  # noqa: PLC0415

        print_study(module, result)
    _write_json(result, json_path)
    if plot is not None:
        with _data_errors():
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
    from fusiond.estimators.model import MODELS  # noqa: PLC0415
    from fusiond.model_report import model_report, print_model  # noqa: PLC0415

    if name not in MODELS:
        raise typer.BadParameter(f"{name!r}: there are {', '.join(MODELS)}")
    report = model_report(name, None if config is None else _load(config))
    if json_path != "-":
        print_model(report)
    _write_json(report, json_path)


@app.command()
def bench() -> None:
    """Time the kernels against one numpy product; prints JSON."""
    from fusiond.bench import bench as run_bench  # noqa: PLC0415

    with _spinner("timing"):
        figures = run_bench()
    _write_json(figures, "-")


# --------------------------------------------------------------------------- shared


def _load(path: Path) -> Config:
    from fusiond.load_config import ConfigError, load_config  # noqa: PLC0415

    try:
        return load_config(path)
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(EXIT_CONFIG) from error


@contextmanager
def _data_errors() -> Iterator[None]:
    from fusiond.csv_tables import TableError  # noqa: PLC0415

    try:
        yield
    except TableError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_DATA) from error
    except BrokenPipeError:
        raise
    except OSError as error:
        typer.echo(f"fusiond: {error.filename or 'output'}: {error.strerror or error}", err=True)
        raise typer.Exit(EXIT_IO) from error


def _aid(text: str) -> tuple[str, Path]:
    kind, equals, path = text.partition("=")
    if not equals or not path or kind not in AID_KINDS:
        raise typer.BadParameter(f"--aid {text}: KIND=FILE with KIND of {', '.join(AID_KINDS)}")
    return kind, Path(path)


def _outage(text: str) -> tuple[float, float]:
    start, _, length = text.partition(":")
    try:
        window = float(start), float(length)
    except ValueError:
        window = (0.0, 0.0)
    if not (isfinite(window[0]) and isfinite(window[1]) and window[1] > 0.0):
        raise typer.BadParameter(f"--outage {text}: START:LENGTH in seconds, LENGTH above 0")
    return window


def _systems(text: str | None) -> tuple[System, ...] | None:
    if text is None:
        return None
    from drivers.raw.messages import SYSTEMS  # noqa: PLC0415

    letters = [letter.strip().upper() for letter in text.split(",")]
    if not set(letters) <= set(SYSTEMS) or len(set(letters)) < len(letters):
        raise typer.BadParameter(f"--systems {text}: G GPS, E Galileo, C BeiDou, each once")
    return tuple(s for s in SYSTEMS if s in letters)


def _spinner(text: str) -> AbstractContextManager[object]:
    """A moving sign on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console  # noqa: PLC0415

    return Console(stderr=True).status(text)


@contextmanager
def _progress(text: str) -> Iterator[Callable[[int, int], None] | None]:
    """A bar on a terminal, called with (done, total); nothing in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import Progress  # noqa: PLC0415

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _plain(value: object) -> object:
    """The same value in what JSON knows: nan and inf become null, paths text."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if isfinite(value) else None
    if value is None or isinstance(value, str | bool | int):
        return value
    return str(value)


def _write_json(value: object, path: str | None) -> None:
    if path is None:
        return
    text = json.dumps(_plain(value), indent=2, allow_nan=False)
    if path == "-":
        typer.echo(text)
        return
    with _data_errors():
        Path(path).write_text(text + "\n", encoding="utf-8")


def _print_file(name: str, report: dict[str, Any], err: bool) -> None:
    """One file as `csv_tables.file_report` describes it."""
    rejected = sum(report["rejected"].values())
    typer.echo(f"{name}: {report['rows']} rows, {rejected} rejected", err=err)
    for row in report["first_rejected"]:
        typer.echo(f"  {row}", err=err)


def _print_summary(result: dict[str, Any], err: bool) -> None:
    """`files`: what was read; `sources`: each aid's measurements by outcome."""
    for name, report in result["files"].items():
        _print_file(name, report, err)
    for name, outcomes in result["sources"].items():
        counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
        typer.echo(f"{name}: {counts or 'nothing'}", err=err)
