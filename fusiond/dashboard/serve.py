"""`fusiond dashboard`: hub, source and web server in one event loop."""

from __future__ import annotations

import asyncio
import importlib.util
import socket
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from fusiond.dashboard.broker import Access, Broker
from fusiond.dashboard.vehicles import Hub
from fusiond.files.install_extra import install_command

PMTILES = b"PMTiles\x03"
"""Header of a file of version 3."""
SEND_BUFFER = 128 * 1024
"""Send buffer of a browser's socket (bytes): room for some frames, not for minutes of them."""


Source = Callable[[], Coroutine[Any, Any, None]]
"""Coroutine that feeds a hub until cancelled."""


class DashboardError(Exception):
    """Error: the dashboard cannot start; the text says what to do."""


@dataclass(frozen=True, slots=True)
class PageAddress:
    """Address of the server. `token` permits commands; None permits none. `base_map`: a PMTiles
    file to draw below the track."""

    host: str = "127.0.0.1"
    port: int = 8770
    token: str | None = None
    base_map: Path | None = None

    @property
    def loopback(self) -> bool:
        return is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """True if only this computer can reach `host`."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def serve_broker(access: Access, page_address: PageAddress, report: Callable[[str], None]) -> None:
    """Show the vehicles of a broker until a signal. `report` receives the page's address."""
    hub = Hub(time.monotonic, f"{access.host}:{access.port}")
    broker = Broker(access, hub)
    if page_address.token is not None:
        hub.send_command = broker.send_command
    _run(hub, broker.listen, page_address, report)


def serve_log(
    paths: Sequence[Path], speed: float, page_address: PageAddress, report: Callable[[str], None]
) -> None:
    """Show a log as it plays. Raises `LogError` for a file that is not a log."""
    from fusiond.dashboard.player import Player  # noqa: PLC0415 - 150 MB of numerics behind it

    player = Player(paths, speed)
    hub = Hub(player.now_s, player.origin, speed)

    async def play() -> None:
        await player.play(hub)

    _run(hub, play, page_address, report)


def _run(
    hub: Hub,
    source: Source,
    page_address: PageAddress,
    report: Callable[[str], None],
) -> None:
    if page_address.base_map is not None:
        check_map(page_address.base_map)
    if importlib.util.find_spec("uvicorn") is None or importlib.util.find_spec("starlette") is None:
        raise DashboardError(
            f"the dashboard's packages are not installed: {install_command('dashboard')}"
        )
    listener = listening_socket(page_address)
    port = listener.getsockname()[1]
    host = f"[{page_address.host}]" if ":" in page_address.host else page_address.host
    report(
        f"http://{host}:{port}/" + (f"#token={page_address.token}" if page_address.token else "")
    )

    # A signal is the web server's: it ends in order, then lets the signal do its work.
    asyncio.run(serve(hub, source, page_address, listener, asyncio.Event()))


def check_map(path: Path) -> None:
    """Check a map file. Raises `DashboardError` for an unsupported one."""
    try:
        with path.open("rb") as file:
            head = file.read(len(PMTILES))
    except OSError as error:
        raise DashboardError(f"{path}: {error.strerror or error}") from error
    if head != PMTILES:
        raise DashboardError(f"{path}: no PMTiles file of version 3")


def listening_socket(page_address: PageAddress) -> socket.socket:
    """Open a listening socket. Raises `DashboardError` where that fails."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            page_address.host, page_address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        made = socket.socket(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        made.bind(address)
        made.listen()
    except OSError as error:
        text = f"{page_address.host}:{page_address.port}: {error.strerror or error}"
        raise DashboardError(f"{text}: choose another with --host and --port") from error
    return made


async def serve(
    hub: Hub,
    source: Source,
    page_address: PageAddress,
    listener: socket.socket,
    stop: asyncio.Event,
) -> None:
    """Serve `source` at `listener` until `stop` or until the source fails."""
    import uvicorn  # noqa: PLC0415 - an extra

    from fusiond.dashboard.connection_limits import BoundedConnection  # noqa: PLC0415 - the same
    from fusiond.dashboard.web import application  # noqa: PLC0415 - the same

    config = uvicorn.Config(
        application(hub, page_address.token, page_address.loopback, page_address.base_map),
        http=BoundedConnection,
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # a core's worth of it, for a local network
        ws_max_size=65536,
        log_level="error",
        access_log=False,
        lifespan="off",
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    feeding = asyncio.create_task(source(), name="source")
    served = asyncio.create_task(server.serve(sockets=[listener]), name="server")
    stopped = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait({feeding, served, stopped}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        server.should_exit = True
        failed = feeding.done() or served.done()
        for task in (feeding, stopped):
            task.cancel()
        await asyncio.gather(served, feeding, stopped, return_exceptions=not failed)
