"""Limits of the dashboard's web server: number of connections, and deadlines of each.

uvicorn waits indefinitely for a request, and for a browser to read its reply: a thousand slow
clients would hold all descriptors of the process. A connection therefore has a deadline for its
request, and for each next piece of a reply. At the limit the connection that has waited longest
without a request makes room; without one the newcomer is refused. A WebSocket has its own deadlines
(`fusiond.dashboard.browser_connection`).
"""

from __future__ import annotations

import asyncio
import socket
import time

from uvicorn.protocols.http.h11_impl import H11Protocol

from fusiond.outputs.sockets import LINGER_NOT

MOST_CONNECTIONS = 128
"""Most connections: sixteen browsers with six each, and two for their WebSockets."""
REQUEST_S = 10.0
"""Deadline of a request, as in the daemon's own servers (`fusiond.outputs.tcp`)."""
STUCK_S = 20.0
"""Time in which a client must take bytes of an answer, as for a viewer."""
LOOK_S = 0.5


class BoundedConnection(H11Protocol):
    """Connection with deadlines. uvicorn closes idle connections between two requests."""

    _since_s = _moved_s = 0.0
    _held_bytes = 0
    _looking: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._since_s = time.monotonic()
        if len(self.connections) > MOST_CONNECTIONS:
            self._make_room()
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._looking is not None:
            self._looking.cancel()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._since_s = time.monotonic()

    @property
    def _asked(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _make_room(self) -> None:
        waiting = [
            one for one in self.connections if isinstance(one, BoundedConnection) and not one._asked
        ]
        min(waiting, key=lambda one: one._since_s, default=self)._give_up()

    def _give_up(self) -> None:
        self.connections.discard(self)
        self.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, LINGER_NOT
        )
        self.transport.abort()

    def _look(self) -> None:
        self._looking = None
        if self not in self.connections:  # closed, or a WebSocket has it
            return
        now_s = time.monotonic()
        if not self._asked and now_s - self._since_s > REQUEST_S:
            self._give_up()
            return
        held_bytes = self.transport.get_write_buffer_size()
        if held_bytes != self._held_bytes or not held_bytes:
            self._held_bytes, self._moved_s = held_bytes, now_s
        elif now_s - self._moved_s > STUCK_S:
            self._give_up()
            return
        self._looking = self.loop.call_later(LOOK_S, self._look)
