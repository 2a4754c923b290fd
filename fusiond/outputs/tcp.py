"""TCP server whose clients delay neither each other nor a tick.

All work for a client is done in turns (`fusiond.outputs.client_sockets`) and charged to its
allowance: a client that sends too much is read more slowly, one with too many requests is dropped.
Output that a client has not read waits in its connection: 16 KiB in the process and as much again
in the kernel. While both are full, epochs are skipped; after thirty in a row, or half a minute
without reading, the client is dropped. A connection counts until its descriptor is closed.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Protocol

from fusiond.outputs.activation import activated
from fusiond.outputs.client_rate_limits import Allowance
from fusiond.outputs.client_slots import gives_way, host_of
from fusiond.outputs.client_sockets import Guests, ServerQueue
from fusiond.outputs.listening_port import Port
from fusiond.outputs.sockets import LINGER_NOT, bound, tune

MOST_CLIENTS = 256
"""Most clients: a quarter of a process's default descriptors (1024, RLIMIT_NOFILE)."""
MOST_WAITING_BYTES = 16384
"""Some ten epochs of gpsd's JSON, 1 to 1.5 kB each: a second at 10 Hz. What is older is no use."""
MOST_SKIPPED = 30
"""Epochs in a row: 3 s at 10 Hz, half a minute at 1 Hz, the time that gpsd's clients wait."""
STUCK_S = 30.0
"""Time in which a client must accept waiting data: thirty epochs at 1 Hz."""
REQUEST_S = 10.0
"""Longest wait for a request that a connection begins with: the scrape_timeout that Prometheus has
by default."""
HASTY_S = 1.0
"""Idle time after which a client may be closed for a new one; one that reads nothing is idle."""
PAUSE_S = 1.0
"""Pause when no descriptor is available; the kernel queues connections meanwhile."""
SHORT_LOGGED_S = 60.0
"""Between two events about that."""
_READ_BYTES = 1024
"""Bytes read in one step: at most 50 requests of gpsd."""
_BACKLOG = 128
_SHORT = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_GONE = select.EPOLLHUP | select.EPOLLERR
_SECOND_NS = 1_000_000_000

log = logging.getLogger("fusiond")


class Session(Protocol):
    """State of one client."""

    def receive(self, data: bytes) -> None:
        """Process received bytes, a KiB at most."""

    def end(self) -> None:
        """Release the session after the connection's end."""


class Unheard:
    """Session that ignores input, which is read only to notice the connection's end."""

    def receive(self, data: bytes) -> None:
        pass

    def end(self) -> None:
        pass


class Client:
    """Connection of a client."""

    def __init__(self, sock: socket.socket, server: TcpServer, host: str) -> None:
        self.host = host
        self._socket = sock
        self._server = server
        self._guests = server.guests
        self._queue = server.queue
        self._fd = sock.fileno()
        self._counters = server.counters
        self._out: deque[bytes | memoryview] = deque()
        self._out_bytes = 0
        self._skipped = 0
        now_ns = time.perf_counter_ns()
        self.since_ns = now_ns
        self._allowance = Allowance(now_ns)
        self._moved_ns = now_ns
        self.request_due = False
        """True until the client states its request, within `REQUEST_S`."""
        self._flushing = self._slowed = self._finishing = self.closed = False
        self.session: Session | None = None
        self.on_room: Callable[[], None] | None = None
        """Called when the kernel has taken all data."""
        self._wanted = select.EPOLLIN
        self._queue.watch(self._fd, self._wanted, self._ready)
        self._guests.came(self)

    # ------------------------------------------------------------------ for the server

    def send(self, data: bytes) -> None:
        """Queue all of `data`, or nothing while too much is waiting; never waits."""
        if self.closed or self._finishing:
            return
        if self._out_bytes > MOST_WAITING_BYTES:
            self._counters["skipped"] += 1
            self._skipped += 1
            if self._skipped >= MOST_SKIPPED:
                self.drop("clients_dropped")
            return
        self._skipped = 0
        self._put(data)

    def finish(self, data: bytes = b"") -> None:
        """Send `data` and what is waiting, then close."""
        if self.closed or self._finishing:
            return
        self._finishing = True
        if data:
            self._put(data)
        elif not self._out:
            self.close()

    def charge(self) -> bool:
        """Count one request. Beyond the limit drop the client and return False."""
        now_ns = time.perf_counter_ns()
        self._allowance.messages.spend(1.0, now_ns)
        if not self._allowance.messages.empty(now_ns):
            return True
        self.drop("clients_flooding")
        return False

    @property
    def waiting_bytes(self) -> int:
        return self._out_bytes

    def drop(self, reason: str) -> None:
        """Close at once and discard waiting data; counted as `reason`."""
        if not self.closed:
            self._counters[reason] += 1
            # Close by a reset: otherwise the kernel would store unread data for a minute.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER_NOT)
            self.close()

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        self._queue.forget(self._fd)
        self._guests.left(self)
        self._socket.close()
        self._out.clear()
        session, self.session, self.on_room = self.session, None, None  # breaks reference cycles
        self._server.ended(self)
        if session is not None:
            session.end()

    def owes(self, now_ns: int) -> bool:
        """True if the client is overdue with its request, or with reading its last reply."""
        since_ns = self.since_ns if self.request_due else self._moved_ns
        due = self.request_due or self._finishing
        return due and now_ns - since_ns > HASTY_S * _SECOND_NS

    # ------------------------------------------------------------------ pieces of work

    def look(self, now_ns: int) -> None:
        if self._slowed and not self._allowance.must_wait(now_ns):
            self._slowed = False
            self._wait_for(self._wanted | select.EPOLLIN)
        if self._out and now_ns - self._moved_ns > STUCK_S * _SECOND_NS:
            self.drop("clients_dropped")
        elif self.request_due and now_ns - self.since_ns > REQUEST_S * _SECOND_NS:
            self.drop("malformed")

    def _ready(self, events: int) -> None:
        if events & select.EPOLLOUT:
            self._flush()
        if not self.closed and events & (select.EPOLLIN | _GONE):
            self._read()

    def _read(self) -> None:
        start_ns = time.perf_counter_ns()
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        if not data:
            self._hung_up()
            return
        try:
            if self.session is not None and not self._finishing:
                self.session.receive(data)
        except Exception:
            log.exception("%s: a client's request failed", self._server.name)
            self.drop("clients_faulty")
        if self.closed:
            return
        now_ns = time.perf_counter_ns()
        self._allowance.bytes.spend(len(data), now_ns)
        self._allowance.microseconds.spend((now_ns - start_ns) * 1e-3, now_ns)
        if self._allowance.must_wait(now_ns):
            self._slowed = True
            self._counters["slowed"] += 1
            self._wait_for(self._wanted & ~select.EPOLLIN)

    def _hung_up(self) -> None:
        """Close after the client's end of sending, once pending replies are sent."""
        self._wait_for(self._wanted & ~select.EPOLLIN)
        self.finish()

    def _put(self, data: bytes) -> None:
        if not self._out:
            self._moved_ns = time.perf_counter_ns()
        self._out.append(data)
        self._out_bytes += len(data)
        self._counters["sent"] += 1
        if not self._flushing:
            self._flushing = True
            self._queue.do(self._flush)

    def _flush(self) -> None:
        self._flushing = False
        try:
            while self._out:
                data = self._out[0]
                sent = self._socket.send(data)
                self._moved_ns = time.perf_counter_ns()
                self._out_bytes -= sent
                if sent < len(data):
                    self._out[0] = memoryview(data)[sent:]
                    break
                self._out.popleft()
        except BlockingIOError:
            pass
        except OSError:
            self.close()
            return
        if self._out:
            self._flushing = True
            self._wait_for(self._wanted | select.EPOLLOUT)
            return
        self._wait_for(self._wanted & ~select.EPOLLOUT)
        if self._finishing:
            self.close()
        elif self.on_room is not None:
            self.on_room()

    def _wait_for(self, events: int) -> None:
        if events != self._wanted and not self.closed:
            self._wanted = events
            self._queue.change(self._fd, events)


class _Listener:
    """Listening sockets of a port."""

    def __init__(self, sockets: list[socket.socket]) -> None:
        self.sockets = sockets


class TcpServer:
    """Server at `host:port`, or at the socket `name` of the service manager.

    `greet(client)` gives the session of a connection. `counters`: `clients` (since the start),
    `clients_refused` (too many at once), `clients_dropped` (did not read), `clients_flooding`
    (asked too often), `clients_gave_way` (to one of another host, or with an unread answer),
    `clients_faulty` (a fault of the server), `slowed` (read later, as it sent too much),
    `malformed`, `sent`, `skipped` (epochs that a client was too slow for). `port` has the state of
    the listening port.
    """

    def __init__(
        self,
        name: str,
        port: Port,
        guests: Guests,
        greet: Callable[[Client], Session],
        most: int = MOST_CLIENTS,
    ) -> None:
        self.name = name
        self.guests = guests
        self.queue = ServerQueue(guests)
        self.port = port
        self._greet = greet
        self._most = most
        self.counters: Counter[str] = Counter()
        self.clients: dict[Client, None] = {}
        self._short_logged_ns: int | None = None

    async def run(self) -> None:
        """Listen until cancelled; retry while the port is taken."""
        listener = await self.port.open(self._listening)
        for sock in listener.sockets:
            self._watch(sock)
        self.guests.wanted += self._most
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            self.guests.wanted -= self._most
            for sock in listener.sockets:
                self.queue.forget(sock.fileno())
                sock.close()
            for client in tuple(self.clients):
                client.close()

    def send(self, data: Callable[[Client], bytes]) -> None:
        """Send each client the bytes that `data(client)` returns, if any."""
        for client in tuple(self.clients):
            payload = data(client)
            if payload:
                client.send(payload)

    def ended(self, client: Client) -> None:
        """Remove a client whose connection is closed."""
        del self.clients[client]
        self.port.serves(len(self.clients))

    # ------------------------------------------------------------------ new connections

    async def _listening(self, host: str, port: int) -> _Listener:
        held = activated(self.name)
        sockets = await bound(host, port) if held is None else [held]
        for sock in sockets:
            sock.setblocking(False)
            # Each connection inherits this limit: otherwise the kernel would store megabytes for a
            # client that does not read.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_WAITING_BYTES // 2)
            sock.listen(_BACKLOG)
        return _Listener(sockets)

    def _watch(self, listening: socket.socket) -> None:
        if listening.fileno() >= 0:  # unless it was closed during a pause
            self.queue.watch(listening.fileno(), select.EPOLLIN, lambda _: self._accept(listening))

    def _accept(self, listening: socket.socket) -> None:
        try:
            sock, address = listening.accept()
        except OSError as error:
            if error.errno in _SHORT:
                self._pause(listening, error)
            return  # otherwise the client has disconnected already
        host = host_of(address)
        self._make_room(host)
        if len(self.clients) >= self._places or self.guests.full:
            self.counters["clients_refused"] += 1
            sock.close()
            return
        try:
            tune(sock, STUCK_S)
        except OSError:
            sock.close()
            return
        self.counters["clients"] += 1
        client = Client(sock, self, host)
        self.clients[client] = None
        self.port.serves(len(self.clients))
        client.session = self._greet(client)

    @property
    def _places(self) -> int:
        return self.guests.places(self._most)

    def _make_room(self, host: str) -> None:
        """Disconnect a client of a full server, if `host` may have its place."""
        if len(self.clients) < self._places:
            return
        client = gives_way(self.clients, host, time.perf_counter_ns())
        if client is not None:
            client.drop("malformed" if client.request_due else "clients_gave_way")

    def _pause(self, listening: socket.socket, error: OSError) -> None:
        """Pause accepting while no descriptor is left; report it once a minute at most."""
        now_ns = time.perf_counter_ns()
        logged_ns = self._short_logged_ns
        if logged_ns is None or now_ns - logged_ns > SHORT_LOGGED_S * _SECOND_NS:
            self._short_logged_ns = now_ns
            self.port.report("clients_refused", f"none for now: {error.strerror}")
        self.queue.forget(listening.fileno())
        asyncio.get_running_loop().call_later(PAUSE_S, self._watch, listening)
