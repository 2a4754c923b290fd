"""WebSocket connection of one browser: at most ten frames a second, each with all changes.

An unread frame delays this viewer alone; newer data replace older ones, so that the next frame is
up to date.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import secrets
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from fusiond.dashboard.vehicles import Hub
from fusiond.outputs.json_requests import NotUnderstoodError, parsed

FRAME_S = 0.1
BEAT_S = 1.0
"""Longest time without a frame, after which a page reports a lost connection."""
SEND_TIMEOUT_S = 20.0
"""Time after which a browser that accepts nothing is disconnected; it reconnects by itself."""
MOST_VIEWERS = 16
LARGEST_REQUEST = 4096
COMMANDS = ("request_fix", "start_recording", "stop_recording", "reset_filter")
"""Commands that need only an id. The daemon accepts only those in its configuration."""


class BrowserConnection:
    """Connection to one browser, until it leaves."""

    def __init__(self, hub: Hub, socket: WebSocket, token: str | None) -> None:
        self._hub = hub
        self._socket = socket
        self._token = token
        self._vehicle: str | None = None
        self._count = 0
        self._replies: list[dict[str, Any]] = []

    async def serve(self) -> None:
        """Send and receive, and return when the browser has left or has been given up."""
        tasks = [asyncio.create_task(self._send()), asyncio.create_task(self._receive())]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            error = task.exception()
            if isinstance(error, TimeoutError):
                await self._give_up()
            elif error is not None and not isinstance(error, WebSocketDisconnect):
                raise error

    async def _give_up(self) -> None:
        """Close the connection to a browser that may not receive it."""
        with contextlib.suppress(TimeoutError, WebSocketDisconnect):
            async with asyncio.timeout(FRAME_S):
                await self._socket.close(1013, "too slow")

    # ------------------------------------------------------------------ to the browser

    async def _send(self) -> None:
        await self._put({"hello": self._greeting()})
        loop = asyncio.get_running_loop()
        beat_s, sent_link = 0.0, None
        while True:
            frame = self._frame()
            news = frame["messages"] or frame["rows"] or frame["link"] != sent_link or self._replies
            if news or loop.time() >= beat_s:
                frame["answers"], self._replies = self._replies, []
                await self._put(frame)
                beat_s, sent_link = loop.time() + BEAT_S, frame["link"]
            await asyncio.sleep(FRAME_S)

    async def _put(self, frame: dict[str, Any]) -> None:
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await self._socket.send_text(json.dumps(frame, separators=(",", ":"), allow_nan=False))

    def _greeting(self) -> dict[str, Any]:
        return {
            "version": version("fusiond"),
            "origin": self._hub.origin,
            "speed": self._hub.speed,
            "commands": list(COMMANDS) if self._may_command else [],
        }

    @property
    def _may_command(self) -> bool:
        return self._token is not None and self._hub.send_command is not None

    def _frame(self) -> dict[str, Any]:
        """New data for the browser. The first vehicle by name is shown until the browser names
        one."""
        hub = self._hub
        names = sorted(hub.vehicles)
        name = self._vehicle if self._vehicle in hub.vehicles else next(iter(names), None)
        if name != self._vehicle:
            self._vehicle, self._count = name, 0
        new: dict[str, Any] = {"messages": {}, "rows": {}}
        if name is not None:
            vehicle = hub.vehicles[name]
            new = vehicle.since(self._count)
            new["first"] = self._count == 0
            self._count = vehicle.count
        return {
            "now": hub.now_s(),
            "link": asdict(hub.link),
            "vehicle": name,
            "vehicles": names,
            "refused": hub.refused,
            **new,
        }

    # ------------------------------------------------------------------ from the browser

    async def _receive(self) -> None:
        while True:
            text = await self._socket.receive_text()
            try:
                asked = parsed(text) if len(text) <= LARGEST_REQUEST else None
            except NotUnderstoodError:
                asked = None
            if not isinstance(asked, dict):
                self._answer(False, "not understood")
            elif "vehicle" in asked:
                self._look_at(asked["vehicle"])
            elif "command" in asked:
                self._command(asked["command"], asked.get("token"))
            else:
                self._answer(False, "not understood")

    def _look_at(self, name: object) -> None:
        if isinstance(name, str) and name in self._hub.vehicles and name != self._vehicle:
            self._vehicle, self._count = name, 0

    def _command(self, name: object, token: object) -> None:
        """Forward a command; refused unless commands are on, the token is right and the command is
        known."""
        send = self._hub.send_command
        if self._token is None or send is None:
            self._answer(False, "this dashboard sends no commands: start it with --commands")
        elif not isinstance(token, str) or not _same(token, self._token):
            self._answer(False, "refused: wrong token")
        elif not isinstance(name, str) or name not in COMMANDS or self._vehicle is None:
            self._answer(False, f"{name!r} is no command of this dashboard")
        else:
            send(self._vehicle, name, f"dashboard-{secrets.token_hex(4)}")
            self._answer(True, f"{name} is on its way")

    def _answer(self, ok: bool, text: str) -> None:
        self._replies = [*self._replies[-7:], {"ok": ok, "text": text}]


def _same(given: str, token: str) -> bool:
    """Compare tokens in constant time."""
    return hmac.compare_digest(given.encode(), token.encode())
