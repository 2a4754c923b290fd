"""HTTP application of the page and its WebSocket, from local files alone.

Pages of other sites must not read the vehicle's position: the browser names the site in `Origin`,
and a name that was made to point here (DNS rebinding) in `Host`. Both are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from fusiond.dashboard.browser_connection import MOST_VIEWERS, BrowserConnection
from fusiond.dashboard.vehicles import Hub

LOOPBACK = ("localhost", "127.0.0.1", "::1")
HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; "
        b"connect-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; "
        b"frame-ancestors 'none'",
    ),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
    (b"cache-control", b"no-cache"),
)
"""Headers of every response."""


def application(
    hub: Hub, token: str | None, loopback: bool, base_map: Path | None = None
) -> Starlette:
    """Make the application. `loopback`: it is bound to loopback and accepts no other host name;
    `base_map`: a PMTiles file, of which the page requests ranges."""
    static = str(files("fusiond.dashboard").joinpath("static"))
    viewers: set[BrowserConnection] = set()

    async def index(request: Request) -> FileResponse:
        return FileResponse(f"{static}/index.html")

    async def land(request: Request) -> Response:
        return Response(status_code=204) if base_map is None else FileResponse(base_map)

    async def watch(socket: WebSocket) -> None:
        if not is_same_origin(socket.headers):
            await socket.close(1008, "of another site")
            return
        if len(viewers) >= MOST_VIEWERS:
            await socket.close(1013, "too many viewers")
            return
        await socket.accept()
        viewer = BrowserConnection(hub, socket, token)
        viewers.add(viewer)
        try:
            await viewer.serve()
        finally:
            viewers.discard(viewer)

    return Starlette(
        routes=[
            Route("/", index),
            Route("/map.pmtiles", land),
            WebSocketRoute("/watch", watch),
            Mount("/static", StaticFiles(directory=static, follow_symlink=True)),
        ],
        middleware=[Middleware(_HostCheck, loopback=loopback)],
    )


def is_same_origin(headers: Mapping[str, str]) -> bool:
    """True if the request's origin is this page, or absent."""
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc == headers.get("host")


def host_name(host: str) -> str | None:
    """The name in a `Host` header, without port and brackets."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


class _HostCheck:
    """Middleware that refuses unknown host names and adds security headers."""

    def __init__(self, app: ASGIApp, loopback: bool) -> None:
        self._app = app
        self._loopback = loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host = next(
            (value.decode("latin-1") for key, value in scope["headers"] if key == b"host"), ""
        )
        if self._loopback and host_name(host) not in LOOPBACK:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008, "reason": "unknown host"})
            else:
                await PlainTextResponse("unknown host\n", 421)(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *HEADERS]
            await send(message)

        await self._app(scope, receive, with_headers)
