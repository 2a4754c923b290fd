"""Commands on recordings: replay, and the group `log`."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fusiond.commands.compile_progress import compiling
from fusiond.commands.shared import (
    EXIT_DATA,
    EXIT_UNAVAILABLE,
    JsonPath,
    config_errors,
    data_errors,
    spinner,
    write_json,
)

if TYPE_CHECKING:
    from fusiond.recording.edit import Edited
    from fusiond.recording.reader import Log

LogPaths = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="A recording: all its files, .mcap.")
]

log = typer.Typer(help="Recordings: inspect, cut, join, repair, export.", no_args_is_help=True)


@contextmanager
def log_errors() -> Iterator[None]:
    """Exit 65 for a file that is not a log, 74 for one that cannot be read."""
    from fusiond.recording.reader import LogError  # noqa: PLC0415

    try:
        with data_errors():
            yield
    except LogError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_DATA) from error


def replay(
    logs: LogPaths,
    config: Annotated[
        Path | None, typer.Option(metavar="C.toml", help="Another configuration than the log's.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one value; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write solution.csv and events.csv there.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(min=0.01, help="Publish over MQTT at this multiple of real time."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Run a recording through the daemon's own parts.

    Exit code 1: the bits differ from the recorded ones."""
    with compiling():
        from fusiond.replay.replay_output import ReplayOptions  # noqa: PLC0415
        from fusiond.replay.replay_output import replay as run_replay  # noqa: PLC0415

    logging.getLogger("fusiond").addHandler(logging.NullHandler())  # events go into --out
    wish = ReplayOptions(config, tuple(settings or ()), out, speed)
    with log_errors(), config_errors(), spinner("replaying"):
        summary = run_replay(logs, wish)
    _print_replay(summary, err=json_path == "-")
    write_json(summary, json_path)
    if summary["identical"] is False:
        raise typer.Exit(1)


def _print_replay(summary: dict[str, Any], err: bool) -> None:
    for problem in (*summary["problems"], *summary["driver_faults"]):
        typer.echo(f"fusiond: {problem}", err=True)
    modes = ", ".join(f"{mode} {share:.1%}" for mode, share in summary["modes"].items())
    typer.echo(
        f"{summary['vehicle']}: {summary['duration_s']:.1f} s, {summary['ticks']} ticks, "
        f"from {summary['started_from']}; {modes}",
        err=err,
    )
    first = summary["first_difference"]
    if first is not None:
        typer.echo(
            f"not the same: first at tick {first['tick']}, {first['t_utc']}: {first['what']}; "
            f"{summary['differing_ticks']} ticks differ",
            err=err,
        )
    elif summary["identical"]:
        typer.echo(f"the same bits at all {summary['compared']} ticks", err=err)


# --------------------------------------------------------------------------- log

OutPath = Annotated[Path, typer.Option("--out", metavar="OUT", help="File or folder to write.")]
Kind = Literal["csv", "gpx", "kml", "geojson", "rosbag2"]


@log.command("info")
def info(logs: LogPaths, json_path: JsonPath = None) -> None:
    """Print contents and damage of a log."""
    from fusiond.recording.info import info as of  # noqa: PLC0415
    from fusiond.recording.reader import Log  # noqa: PLC0415

    with log_errors(), spinner("reading"):
        found = of(Log(logs))
    if json_path is not None:
        write_json(found, json_path)
        return
    for key, value in found.items():
        lines = value if isinstance(value, list) else [value]
        if isinstance(value, dict):
            lines = [f"{name}: {_short(each)}" for name, each in value.items()]
        if lines:
            typer.echo(f"{key:>24}  " + f"\n{'':>26}".join(_short(line) for line in lines))


def _short(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {each}" for name, each in value.items())
    return str(value)


@log.command("trim")
def trim(
    logs: LogPaths,
    out: OutPath,
    begin: Annotated[float, typer.Option("--from", metavar="S", help="Seconds from its start.")],
    end: Annotated[float, typer.Option("--to", metavar="S", help="Seconds from its start.")],
) -> None:
    """Cut a part out of a log, to be replayed by itself.

    It begins at the last state in the log before --from."""
    from fusiond.recording.edit import trim as cut  # noqa: PLC0415

    if end <= begin:
        raise typer.BadParameter("--to lies before --from")
    with log_errors(), spinner("cutting"):
        _print_edited(cut(logs, begin, end, out))


@log.command("merge")
def merge(logs: LogPaths, out: OutPath) -> None:
    """Join all parts of one recording."""
    from fusiond.recording.edit import merge as join  # noqa: PLC0415

    with log_errors(), spinner("joining"):
        _print_edited(join(logs, out))


@log.command("recover")
def recover(
    damaged: Annotated[Path, typer.Argument(metavar="LOG", help="One file.")], out: OutPath
) -> None:
    """Copy all readable messages of a damaged or truncated log."""
    from fusiond.recording.edit import recover as mend  # noqa: PLC0415

    with log_errors(), spinner("reading"):
        _print_edited(mend(damaged, out))


def _print_edited(edited: Edited) -> None:
    for problem in edited.problems:
        typer.echo(f"fusiond: {problem}", err=True)
    typer.echo(f"{edited.path}: {edited.messages} messages; begins with {edited.begins}")


@log.command("export")
def export(
    logs: LogPaths,
    out: OutPath,
    to: Annotated[Kind, typer.Option("--to", help="csv and rosbag2 write a folder.")],
    interval: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="Least time between points of a track.")
    ] = 0.0,
) -> None:
    """Export the track, the measurements as CSV, or a ROS bag."""
    from fusiond.recording.reader import Log  # noqa: PLC0415
    from fusiond.recording.track_export import export as write_track  # noqa: PLC0415

    with log_errors(), config_errors(), spinner("writing"), TemporaryDirectory() as folder:
        recording = Log(logs)
        if to in ("csv", "rosbag2"):
            written = _export_measurements(recording, Path(folder), out, to)
        else:
            written = {str(out): write_track(recording, out, to, interval)}
    for problem in recording.problems:
        typer.echo(f"fusiond: {problem}", err=True)
    for name, count in written.items():
        typer.echo(f"{name}: {count}")


def _export_measurements(recording: Log, folder: Path, out: Path, to: str) -> dict[str, int]:
    from fusiond.files.csv_tables import MissingPackageError  # noqa: PLC0415
    from fusiond.replay.measurement_csv_export import write_tables  # noqa: PLC0415
    from fusiond.replay.replay_config import replay_config  # noqa: PLC0415
    from fusiond.replay.rosbag_export import write_rosbag  # noqa: PLC0415

    config = replay_config(recording.about, folder)
    if to == "csv":
        return write_tables(recording, config, out)
    try:
        return write_rosbag(recording, config, out)
    except MissingPackageError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error
