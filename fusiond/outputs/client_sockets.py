"""Client sockets of all servers, served in turns at little cost to a tick.

All listeners and connections are in one epoll set, which the event loop sees as one descriptor.
When it is readable, the loop serves the servers in turns, one piece sent and one received each,
until nothing is left or the window's budget is spent; the rest waits for the next window. A piece
of work is one `accept`, one `recv` with the handling of its data, or one piece sent to a client.

    spent in any window of 10 ms <= 1 ms + one piece of work

The clients of a server take turns, too: a served client goes to the end of its server's queue
(epoll does so with level-triggered descriptors). Each of n clients at one of m servers has one turn
in m n, and clients of other servers do not wait for them.

Source: fair queueing, round robin by flow (Nagle, RFC 970).
"""

from __future__ import annotations

import asyncio
import resource
import select
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

WINDOW_NS = 10_000_000
"""A tick at 100 Hz, the rate by default."""
BUDGET_NS = 1_000_000
"""Processor time for clients between ticks: a tenth of a tick. A tick that falls due in a turn
starts 1 ms late, as by asyncio's own rounding, and all clients together cost a tenth of a core. 200
clients at 10 Hz, as promised in docs/outputs.md, cost a third of that."""
RESERVED_DESCRIPTORS = 256
"""Descriptors reserved for the daemon: some 40 in normal operation with all outputs; the rest for
files of a recording, of the state and of libraries. Half of them where the process has fewer than
twice as many."""
LOOK_S = 0.25
"""Interval of the check for missed deadlines."""
_AT_ONCE = 16
"""Events asked of the kernel in one go."""

Work = Callable[[], None]
Handler = Callable[[int], None]
"""Callback with the events of epoll(7)."""


class Guest(Protocol):
    """Connection of a client."""

    def look(self, now_ns: int) -> None:
        """Resume a paused client, or drop one whose time is over; called four times a second."""


class Guests:
    """Connections of all servers of a daemon; at most `most` are open.

    It needs a running event loop while a descriptor is watched, and is only called within that
    loop. `postponed` counts windows with a spent budget.
    """

    def __init__(self) -> None:
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self.most = max(soft // 2, soft - RESERVED_DESCRIPTORS)
        self.wanted = 0
        """Places of all servers that listen."""
        self.postponed = 0
        self._open: set[Guest] = set()
        self._queues: deque[ServerQueue] = deque()
        """Queues with watched descriptors, the next in turn first."""
        self._epoll: select.epoll | None = None
        """Descriptors of the queues."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._window_ns = self._left_ns = 0
        self._paused: asyncio.TimerHandle | None = None
        self._due: asyncio.Handle | None = None
        self._looking: asyncio.TimerHandle | None = None

    # ------------------------------------------------------------------ connections

    @property
    def full(self) -> bool:
        """True if another connection would use a descriptor that the daemon needs."""
        return len(self._open) >= self.most

    def places(self, wanted: int) -> int:
        """Places of a server that wants `wanted`: fewer in proportion if there are not enough for
        all."""
        return min(wanted, self.most * wanted // max(wanted, self.wanted))

    def came(self, guest: Guest) -> None:
        self._open.add(guest)

    def left(self, guest: Guest) -> None:
        self._open.discard(guest)

    # ------------------------------------------------------------------ for the queues

    def begin(self, queue: ServerQueue, fd: int) -> None:
        """Add a queue with descriptors to watch; `fd`, its epoll set, is readable while one is
        ready."""
        if self._epoll is None:
            self._begin()
        assert self._epoll is not None
        self._epoll.register(fd, select.EPOLLIN)
        self._queues.append(queue)

    def end(self, queue: ServerQueue, fd: int) -> None:
        """Remove `queue` from the watched queues."""
        self._queues.remove(queue)
        if self._epoll is not None:
            self._epoll.unregister(fd)
            if not self._queues:
                self._end()

    def due(self) -> None:
        """Schedule a turn for queued work, which no descriptor signals."""
        if self._paused is None and self._due is None:
            self._due = asyncio.get_running_loop().call_soon(self._turn)

    # ------------------------------------------------------------------ turns

    def _begin(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._epoll = select.epoll()
        self._loop.add_reader(self._epoll.fileno(), self._turn)
        self._looking = self._loop.call_later(LOOK_S, self._look)

    def _end(self) -> None:
        assert self._loop is not None
        assert self._epoll is not None
        for handle in (self._paused, self._due, self._looking):
            if handle is not None:
                handle.cancel()
        self._paused = self._due = self._looking = None
        self._loop.remove_reader(self._epoll.fileno())
        self._epoll.close()
        self._epoll = self._loop = None

    def _turn(self) -> None:
        self._due = None
        if self._paused is not None or self._epoll is None:
            return
        start_ns = now_ns = time.perf_counter_ns()
        if start_ns >= self._window_ns:
            self._window_ns, self._left_ns = start_ns + WINDOW_NS, BUDGET_NS
        end_ns = start_ns + self._left_ns
        idle = 0
        while idle < len(self._queues) and now_ns < end_ns:
            queue = self._queues[0]
            self._queues.rotate(-1)
            idle = 0 if queue.serve() else idle + 1
            now_ns = time.perf_counter_ns()
        self._left_ns -= now_ns - start_ns
        if idle < len(self._queues):
            self._pause(now_ns)

    def _pause(self, now_ns: int) -> None:
        """Stop serving until the next window, after the budget is spent."""
        assert self._loop is not None
        assert self._epoll is not None
        self.postponed += 1
        self._loop.remove_reader(self._epoll.fileno())
        wait_s = max(0, self._window_ns - now_ns) * 1e-9
        self._paused = self._loop.call_later(wait_s, self._resume)

    def _resume(self) -> None:
        self._paused = None
        if self._epoll is not None and self._loop is not None:
            self._loop.add_reader(self._epoll.fileno(), self._turn)
            self._turn()

    def _look(self) -> None:
        assert self._loop is not None
        now_ns = time.perf_counter_ns()
        for guest in tuple(self._open):
            guest.look(now_ns)
        if self._loop is not None:
            self._looking = self._loop.call_later(LOOK_S, self._look)


class ServerQueue:
    """Descriptors and queued work of one server."""

    def __init__(self, guests: Guests) -> None:
        self._guests = guests
        self._handlers: dict[int, Handler] = {}
        self._events: deque[tuple[int, int, Handler]] = deque()
        self._work: deque[Work] = deque()
        self._epoll: select.epoll | None = None

    def watch(self, fd: int, events: int, handler: Handler) -> None:
        """Call `handler(events)` in a turn while `events` hold for `fd`."""
        if self._epoll is None:
            self._epoll = select.epoll()
            self._guests.begin(self, self._epoll.fileno())
        self._epoll.register(fd, events)
        self._handlers[fd] = handler

    def change(self, fd: int, events: int) -> None:
        """Change the events of an `fd` that is watched."""
        if self._epoll is not None:
            self._epoll.modify(fd, events)

    def forget(self, fd: int) -> None:
        """Remove a descriptor before it is closed."""
        if self._handlers.pop(fd, None) is None or self._epoll is None:
            return
        self._epoll.unregister(fd)
        if not self._handlers:
            self._guests.end(self, self._epoll.fileno())
            self._epoll.close()
            self._epoll = None
            self._events.clear()
            self._work.clear()

    def do(self, work: Work) -> None:
        """Queue `work` for a turn."""
        self._work.append(work)
        self._guests.due()

    def serve(self) -> bool:
        """Send one piece and receive one; False without either."""
        return self._send_one() | self._receive_one()

    def _send_one(self) -> bool:
        if not self._work:
            return False
        self._work.popleft()()
        return True

    def _receive_one(self) -> bool:
        if not self._events and self._epoll is not None:
            for fd, events in self._epoll.poll(0, _AT_ONCE):
                self._events.append((fd, events, self._handlers[fd]))
        if not self._events:
            return False
        fd, events, handler = self._events.popleft()
        # The descriptor may have been closed meanwhile, and its number used again.
        if self._handlers.get(fd) is handler:
            handler(events)
        return True
