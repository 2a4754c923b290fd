"""Commands on files: process, calibrate, simulate, compare."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fusiond.commands.compile_progress import compiling
from fusiond.commands.shared import (
    EXIT_DATA,
    EXIT_UNAVAILABLE,
    ConfigPath,
    JsonPath,
    config_errors,
    data_errors,
    load_or_exit,
    progress_bar,
    spinner,
    write_json,
)

if TYPE_CHECKING:
    from drivers.raw.messages import System
    from fusiond.offline.calibrate import Pass
    from fusiond.offline.outages import Outage

MEASUREMENT_KINDS = (
    *("gnss", "rdss", "attitude", "bearing", "wheel", "barometer"),
    *("nmea", "ubx", "bestpos", "sbf", "raw"),
)
# What an engineer has to know of a log's times.
LOG_EVENTS = {
    "recorder_zone",
    "recorder_paused",
    "recorder_clock_off",
    "system_clock_stepped",
    "utc_jumped",
    "utc_implausible",
}
# What was recorded, as `process` and `calibrate` take it.
ImuFile = Annotated[Path | None, typer.Option("--imu", metavar="F.csv", help="IMU samples.")]
CanLog = Annotated[
    Path | None,
    typer.Option("--can", metavar="LOG", help="Recorded CAN bus: .log, .asc, .blf, .trc, .mf4."),
]
MeasurementFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--aid", metavar="KIND=F", help=f"Measurements, repeatable: {', '.join(MEASUREMENT_KINDS)}."
    ),
]


def process(
    config: ConfigPath,
    imu: ImuFile = None,
    can: CanLog = None,
    aid: MeasurementFiles = None,
    outage: Annotated[
        list[str] | None,
        typer.Option(
            metavar="START:LENGTH[:SOURCE,...]",
            help="Withhold measurements, all or of these sources, in s of the files; repeatable.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="F.csv", help="Write the solution; - is standard output.")
    ] = None,
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="Write the solution by all measurements, also later."),
    ] = False,
    systems: Annotated[
        str | None,
        typer.Option(metavar="C,G,E", help="Satellite systems of raw data to use."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Run the daemon's navigator on recorded files."""
    measurements = [_measurement_argument(text) for text in aid or []]
    outages = [_outage_argument(text) for text in outage or []]
    if out is not None and str(out) == "-" == json_path:
        raise typer.BadParameter("--out and --json cannot both be standard output")
    if (imu is None) == (can is None):
        raise typer.BadParameter("Give --imu or --can")
    if smooth and out is None:
        raise typer.BadParameter("--smooth: name a file to write with --out")
    settings = load_or_exit(config)
    with compiling():
        from fusiond.navigator.intake.kind import raw_receivers  # noqa: PLC0415
        from fusiond.offline.process import process as run_process  # noqa: PLC0415

        raw_receivers(settings.aiding)  # what they compile comes with the rest
    wanted = _systems_argument(systems)
    given = (settings, imu, measurements, outages, out, wanted, can)
    with _missing_packages(), config_errors(), data_errors(), progress_bar("processing") as bar:
        result = run_process(*given, smooth=smooth, progress=bar or (lambda done, total: None))
    _print_summary(result, err="-" in (json_path, str(out)))
    write_json(result, json_path)
    if not result["solution_rows"]:
        typer.echo(f"fusiond: No solution: {result['why']}", err=True)
        raise typer.Exit(EXIT_DATA)


@contextmanager
def _missing_packages() -> Iterator[None]:
    """Exit with the reason where the package of a file format is missing."""
    from fusiond.files.csv_tables import MissingPackageError  # noqa: PLC0415

    try:
        yield
    except MissingPackageError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error


def _recording(logs: list[Path]) -> Pass:
    """Function that replays the daemon's recording once."""
    from fusiond.recording.reader import Log  # noqa: PLC0415
    from fusiond.replay.replay_for_calibration import replay_for_calibration  # noqa: PLC0415

    # Its events are those of the drive, which has been: the report shows them.
    logging.getLogger("fusiond").addHandler(logging.NullHandler())
    return lambda config, look: replay_for_calibration(Log(logs), config, look)


def calibrate(
    config: ConfigPath,
    logs: Annotated[
        list[Path] | None, typer.Argument(metavar="LOG.mcap", help="The daemon's recording.")
    ] = None,
    imu: ImuFile = None,
    can: CanLog = None,
    aid: MeasurementFiles = None,
    out: Annotated[
        Path | None, typer.Option(metavar="F.toml", help="Write the lines of TOML there too.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Estimate mounting, lever arms, offsets, scales from a drive.

    Input: files, or a recording of the daemon. Output: TOML."""
    measurements = [_measurement_argument(text) for text in aid or []]
    if [bool(logs), imu is not None, can is not None].count(True) != 1 or (logs and measurements):
        raise typer.BadParameter("Give LOG.mcap alone, or --imu or --can")
    settings = load_or_exit(config)
    from fusiond.commands.recordings import log_errors  # noqa: PLC0415

    with compiling():
        from fusiond.navigator.intake.kind import raw_receivers  # noqa: PLC0415
        from fusiond.offline.calibrate import calibrate as run_calibrate  # noqa: PLC0415
        from fusiond.offline.calibrate import files  # noqa: PLC0415

        navigate = _recording(logs) if logs else files(imu, measurements, can)
        raw_receivers(settings.aiding)  # what they compile comes with the rest
    with (
        _missing_packages(),
        config_errors(),
        data_errors(),
        log_errors(),
        progress_bar("calibrating") as bar,
    ):
        found = run_calibrate(settings, navigate, bar or (lambda done, total: None))
    if not found.result["solution_rows"]:
        typer.echo(f"fusiond: No solution: {found.result['why']}", err=True)
        raise typer.Exit(EXIT_DATA)
    if not found.toml.strip():
        typer.echo(f"fusiond: Nothing to calibrate by: {found.result['why']}", err=True)
        raise typer.Exit(EXIT_DATA)
    typer.echo(found.toml, nl=False, err=json_path == "-")
    if out is not None:
        with data_errors():
            out.write_text(found.toml, encoding="utf-8")
    write_json(found.as_json(), json_path)


def simulate(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="static, drive, flight.")],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the files.")] = None,
    live: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Drive in real time instead: devices for `fusiond run DIR/vehicle.toml`.",
        ),
    ] = None,
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
    """Simulate a vehicle: write its files, or act as its devices.

    Files: imu.csv, gnss.csv, rdss.csv, barometer.csv, truth.csv. With --live it serves as the
    devices of a daemon."""
    if live is not None:
        if out is not None or gnss_raw is not None or gnss_mask or scenario != "drive":
            raise typer.BadParameter("--live: the scenario drive, without --out and --gnss-...")
        _live(live, duration, seed)
        return
    if out is None:
        raise typer.BadParameter("--out or --live: where to write, or be devices for a daemon")
    with compiling():
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


def _live(folder: Path, duration_s: float | None, seed: int) -> None:
    with compiling():
        from fusiond.simulation.live import live as run_live  # noqa: PLC0415
    with _missing_packages(), data_errors():
        sent = run_live(folder, duration_s, seed, typer.echo)
    typer.echo(", ".join(f"{count} {name}" for name, count in sorted(sent.items())))


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
    """Compare a solution with a truth: errors, and errors by sigma."""
    from fusiond.commands.compare_report import print_report  # noqa: PLC0415
    from fusiond.files.csv_tables import file_report  # noqa: PLC0415
    from fusiond.files.measurement_csv import read_solution, read_truth  # noqa: PLC0415
    from fusiond.offline.compare import NothingToCompareError  # noqa: PLC0415
    from fusiond.offline.compare import compare as run_compare  # noqa: PLC0415

    with data_errors():
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
    write_json(report, json_path)


def _measurement_argument(text: str) -> tuple[str, Path]:
    """Parse KIND=FILE."""
    kind, equals, path = text.partition("=")
    if not equals or not path or kind not in MEASUREMENT_KINDS:
        raise typer.BadParameter(
            f"--aid {text}: KIND=FILE with KIND of {', '.join(MEASUREMENT_KINDS)}"
        )
    return kind, Path(path)


def _outage_argument(text: str) -> Outage:
    """Parse START:LENGTH[:SOURCE,...]."""
    start, _, rest = text.partition(":")
    length, colon, sources = rest.partition(":")
    try:
        window = float(start), float(length)
    except ValueError:
        window = (0.0, 0.0)
    names = tuple(name.strip() for name in sources.split(",")) if colon else ()
    if not (isfinite(window[0]) and isfinite(window[1]) and window[1] > 0.0 and all(names)):
        raise typer.BadParameter(
            f"--outage {text}: START:LENGTH in seconds, LENGTH above 0, then :SOURCE,... if any"
        )
    return (*window, names) if names else window


def _systems_argument(text: str | None) -> tuple[System, ...] | None:
    """Parse satellite systems such as C,G,E."""
    if text is None:
        return None
    from drivers.raw.messages import SYSTEMS  # noqa: PLC0415

    letters = [letter.strip().upper() for letter in text.split(",")]
    if not set(letters) <= set(SYSTEMS) or len(set(letters)) < len(letters):
        raise typer.BadParameter(f"--systems {text}: G GPS, E Galileo, C BeiDou, each once")
    return tuple(s for s in SYSTEMS if s in letters)


def _print_summary(result: dict[str, Any], err: bool) -> None:
    """Print what `files` were read, each source's measurements by outcome, and the solution."""
    for name, report in result["files"].items():
        _print_file(name, report, err)
    for name, outcomes in result["sources"].items():
        counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
        typer.echo(f"{name}: {counts or 'nothing'}", err=err)
    for event in result["events"]:
        if event["code"] in LOG_EVENTS:
            typer.echo(f"! {event['text']}", err=err)
    rows = result["solution_rows"]
    if not rows:
        return
    for line in result["apart"]:
        typer.echo(f"! {line}", err=err)
    how = result["aligned"] or "lost again"
    typer.echo(f"aligned at {result['solution_from_s']:.3f} s: {how}", err=err)
    samples = result["files"]["imu"]
    used = samples["rows"] - sum(samples["rejected"].values())
    modes = ", ".join(f"{n} {mode}" for mode, n in result["solution_modes"].items())
    share = 100.0 * rows / used
    typer.echo(f"solution: {rows} of {used} samples: {modes} ({share:.1f} %)", err=err)
    if "smoothed" in result:
        smoothed = result["smoothed"]
        starts = f", by {smoothed['starts']} starts" if smoothed["starts"] > 1 else ""
        typer.echo(f"smoothed: {smoothed['rows']} of them{starts}", err=err)


def _print_file(name: str, report: dict[str, Any], err: bool) -> None:
    """Print the report of one file, made by `csv_tables.file_report`."""
    rejected = sum(report["rejected"].values())
    typer.echo(f"{name}: {report['rows']} rows, {rejected} rejected", err=err)
    for row in report["first_rejected"]:
        typer.echo(f"  {row}", err=err)
