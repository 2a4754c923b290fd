"""Commands on recordings: replay, and the family `log`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from fusiond.commands.shared import (
    EXIT_DATA,
    JsonPath,
    config_errors,
    data_errors,
    spinner,
    write_json,
)

LogPaths = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="A recording: all its files, .mcap.")
]

log = typer.Typer(help="Recordings: look into, cut, join, mend, hand on.", no_args_is_help=True)


@contextmanager
def log_errors() -> Iterator[None]:
    """Exit 65 for what is no log, 74 for what cannot be read."""
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
        typer.Option(min=0.01, help="Publish over MQTT, this many times as fast as it was."),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Run a recording through the daemon's own parts; exit 1 where the bits are not the same."""
    from fusiond.replay.run import Wish  # noqa: PLC0415
    from fusiond.replay.run import replay as run_replay  # noqa: PLC0415

    wish = Wish(config, tuple(settings or ()), out, speed)
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
