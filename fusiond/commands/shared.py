"""Shared arguments, exit codes and output of the commands."""

from __future__ import annotations

import gc
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

if TYPE_CHECKING:
    from fusiond.configuration.schema import Config

# Objects made since the last collection: a filter at work makes so many in minutes.
COLLECT_AFTER = 50_000
EXIT_DATA = 65
EXIT_UNAVAILABLE = 69
EXIT_IO = 74
ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration (TOML).")]
JsonPath = Annotated[
    str | None, typer.Option("--json", metavar="F.json", help="Write JSON; - is standard output.")
]


def parse_mqtt(text: str) -> tuple[str, int]:
    """Host and port of HOST, HOST:PORT or [IPV6]:PORT. Raises `typer.BadParameter`."""
    from urllib.parse import urlsplit  # noqa: PLC0415

    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or parts.path or "@" in text:
        raise typer.BadParameter(f"--mqtt {text}: HOST, HOST:PORT or [IPV6]:PORT")
    return host, 1883 if port is None else port


@contextmanager
def config_errors() -> Iterator[None]:
    """Print every mistake of a configuration on standard error and exit 78."""
    from fusiond.configuration.load import EXIT_CONFIG, ConfigError  # noqa: PLC0415

    try:
        yield
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(EXIT_CONFIG) from error


def load_or_exit(path: Path) -> Config:
    """The configuration at `path`."""
    from fusiond.configuration.load import load_config  # noqa: PLC0415

    with config_errors():
        return load_config(path)


@contextmanager
def data_errors() -> Iterator[None]:
    """Exit 65 for a table that cannot be used, 74 for one that cannot be read or written."""
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


def freeze_imports() -> None:
    """Exempt the imported code of a command from garbage collection, and enable collection."""
    gc.freeze()
    gc.set_threshold(COLLECT_AFTER)


def can_draw(stream: TextIO) -> bool:
    """True if `stream` is a terminal that supports drawing."""
    return stream.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")


def spinner(text: str) -> AbstractContextManager[object]:
    """Show a spinner on a terminal, nothing in a pipe."""
    if not can_draw(sys.stderr):
        return nullcontext()
    from rich.console import Console  # noqa: PLC0415

    return Console(stderr=True).status(text)


@contextmanager
def progress_bar(text: str) -> Iterator[Callable[[int, int], None] | None]:
    """A bar on a terminal, called with (done, total); nothing in a pipe."""
    if not can_draw(sys.stderr):
        yield None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import Progress  # noqa: PLC0415

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def to_json_types(value: object) -> object:
    """Convert a value to JSON types: nan and inf become null, paths text."""
    if isinstance(value, dict):
        return {str(key): to_json_types(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_types(item) for item in value]
    if isinstance(value, float):
        return value if isfinite(value) else None
    if value is None or isinstance(value, str | bool | int):
        return value
    return str(value)


def write_json(value: object, path: str | None) -> None:
    """Write JSON to a file, to standard output for "-", nowhere for None."""
    if path is None:
        return
    text = json.dumps(to_json_types(value), indent=2, allow_nan=False)
    if path == "-":
        typer.echo(text)
        return
    with data_errors():
        Path(path).write_text(text + "\n", encoding="utf-8")
