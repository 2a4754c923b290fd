"""What the commands share: their arguments, their exit codes, what they print."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from drivers.raw.messages import System
    from fusiond.configuration.schema import Config

EXIT_DATA = 65
EXIT_UNAVAILABLE = 69
EXIT_IO = 74
AID_KINDS = ("gnss", "rdss", "attitude", "bearing", "wheel", "nmea", "raw")


@contextmanager
def config_errors() -> Iterator[None]:
    """Every mistake of a configuration on standard error, and exit 78."""
    from fusiond.configuration.load import EXIT_CONFIG, ConfigError  # noqa: PLC0415

    try:
        yield
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(EXIT_CONFIG) from error


def load(path: Path) -> Config:
    """The configuration at `path`."""
    from fusiond.configuration.load import load_config  # noqa: PLC0415

    with config_errors():
        return load_config(path)


@contextmanager
def data_errors() -> Iterator[None]:
    """Exit 65 for a table that cannot be used, 74 for a file that cannot be read or written."""
    from fusiond.files.csv_tables import TableError  # noqa: PLC0415

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


def aid_argument(text: str) -> tuple[str, Path]:
    """KIND=FILE."""
    kind, equals, path = text.partition("=")
    if not equals or not path or kind not in AID_KINDS:
        raise typer.BadParameter(f"--aid {text}: KIND=FILE with KIND of {', '.join(AID_KINDS)}")
    return kind, Path(path)


def outage_argument(text: str) -> tuple[float, float]:
    """START:LENGTH."""
    start, _, length = text.partition(":")
    try:
        window = float(start), float(length)
    except ValueError:
        window = (0.0, 0.0)
    if not (isfinite(window[0]) and isfinite(window[1]) and window[1] > 0.0):
        raise typer.BadParameter(f"--outage {text}: START:LENGTH in seconds, LENGTH above 0")
    return window


def systems_argument(text: str | None) -> tuple[System, ...] | None:
    """C,G,E."""
    if text is None:
        return None
    from drivers.raw.messages import SYSTEMS  # noqa: PLC0415

    letters = [letter.strip().upper() for letter in text.split(",")]
    if not set(letters) <= set(SYSTEMS) or len(set(letters)) < len(letters):
        raise typer.BadParameter(f"--systems {text}: G GPS, E Galileo, C BeiDou, each once")
    return tuple(s for s in SYSTEMS if s in letters)


def spinner(text: str) -> AbstractContextManager[object]:
    """A moving sign on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console  # noqa: PLC0415

    return Console(stderr=True).status(text)


@contextmanager
def progress_bar(text: str) -> Iterator[Callable[[int, int], None] | None]:
    """A bar on a terminal, called with (done, total); nothing in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import Progress  # noqa: PLC0415

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def plain(value: object) -> object:
    """The same value in what JSON knows: nan and inf become null, paths text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if isfinite(value) else None
    if value is None or isinstance(value, str | bool | int):
        return value
    return str(value)


def write_json(value: object, path: str | None) -> None:
    """To a file, to standard output for "-", nowhere for None."""
    if path is None:
        return
    text = json.dumps(plain(value), indent=2, allow_nan=False)
    if path == "-":
        typer.echo(text)
        return
    with data_errors():
        Path(path).write_text(text + "\n", encoding="utf-8")


def print_file(name: str, report: dict[str, Any], err: bool) -> None:
    """One file as `csv_tables.file_report` describes it."""
    rejected = sum(report["rejected"].values())
    typer.echo(f"{name}: {report['rows']} rows, {rejected} rejected", err=err)
    for row in report["first_rejected"]:
        typer.echo(f"  {row}", err=err)


def print_summary(result: dict[str, Any], err: bool) -> None:
    """`files`: what was read; `sources`: each aid's measurements by outcome."""
    for name, report in result["files"].items():
        print_file(name, report, err)
    for name, outcomes in result["sources"].items():
        counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
        typer.echo(f"{name}: {counts or 'nothing'}", err=err)
