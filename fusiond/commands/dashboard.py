"""Command dashboard: messages of a vehicle in a browser."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusiond.commands.shared import EXIT_UNAVAILABLE, config_errors, freeze_imports, load_or_exit

if TYPE_CHECKING:
    from fusiond.dashboard.broker import Access

TOKEN_VARIABLE = "FUSIOND_DASHBOARD_TOKEN"


def dashboard(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[LOG...]", help="Play a recording instead: all its files, .mcap."),
    ] = None,
    mqtt: Annotated[str, typer.Option(metavar="HOST:PORT", help="The broker.")] = "localhost:1883",
    config: Annotated[
        Path | None,
        typer.Option(metavar="C.toml", help="Broker, user and certificates of its [mqtt]."),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to serve at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve at; 0: any.")] = 8770,
    speed: Annotated[
        float, typer.Option(min=0.01, max=1000.0, help="Speed of a recording; 1: real time.")
    ] = 1.0,
    base_map: Annotated[
        Path | None,
        typer.Option("--map", metavar="F.pmtiles", help="Draw this map below the track."),
    ] = None,
    commands: Annotated[
        bool, typer.Option("--commands", help="Let holders of the token send commands.")
    ] = False,
) -> None:
    """Show a vehicle in the browser, live or from a recording."""
    import secrets  # noqa: PLC0415

    from fusiond.dashboard.serve import (  # noqa: PLC0415
        DashboardError,
        PageAddress,
        serve_broker,
        serve_log,
    )

    freeze_imports()
    token = os.environ.get(TOKEN_VARIABLE) or secrets.token_urlsafe(16)
    page_address = PageAddress(host, port, token if commands and not logs else None, base_map)
    if not page_address.loopback:
        typer.echo("fusiond: everyone who reaches this address sees the vehicle", err=True)
    try:
        if logs:
            from fusiond.commands.recordings import log_errors  # noqa: PLC0415

            with log_errors():
                serve_log(logs, speed, page_address, typer.echo)
        else:
            access = _at(mqtt) if config is None else _of(config)
            serve_broker(access, page_address, typer.echo)
    except DashboardError as error:
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error


def _at(address: str) -> Access:
    from fusiond.dashboard.broker import Access  # noqa: PLC0415

    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise typer.BadParameter(f"{address!r} is no HOST:PORT", param_hint="--mqtt")
    return Access(host.strip("[]"), int(port))


def _of(path: Path) -> Access:
    """The broker of a configuration."""
    from fusiond.dashboard.broker import Access  # noqa: PLC0415
    from fusiond.outputs import broker_access  # noqa: PLC0415

    options = load_or_exit(path).mqtt
    with config_errors():
        password, tls = broker_access.password(options), broker_access.tls_context(options)
    return Access(options.host, options.port, options.username, password, tls)
