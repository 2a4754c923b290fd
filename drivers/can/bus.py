"""CAN bus under asyncio that reopens itself when its interface disappears and returns.

python-can opens and filters the bus. Reading is done here, because python-can's `Notifier` polls a
dead descriptor for ever and its `AsyncBufferedReader` is unbounded. A bus with a descriptor
(`socketcan`, `udp_multicast`) is read in a callback of the event loop, `FRAMES_PER_WAKEUP` frames a
turn at most, or when its owner calls `poll`: waking for each frame of an IMU costs five times as
much as the frames. A bus without one (`virtual`) is read by a thread into a ring of `RING_FRAMES`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

from can.typechecking import CanFilter

from drivers.base import Backoff, Now, monotonic_ns
from drivers.can.errors import ControllerState, controller_state, error_names
from drivers.can.python_can_import import can
from drivers.can.socket_frames import (
    CANFD_BYTES,
    DATAGRAM_BYTES,
    Decode,
    datagram_decoder,
    of_can_frame,
)

FRAMES_PER_WAKEUP = 64
"""Most frames handled in one turn of the loop: 2 ms of work, 15 ms of a full 500 kbit/s bus."""
RING_FRAMES = 1024
"""Most frames a thread may hold for the loop: 1.7 s of an IMU of 600 frames/s."""
CHECK_S = 1.0
"""Interval of reading the kernel's count of frames dropped for want of buffer space."""
LONGEST_WAIT_S = 1.0
"""Longest wait between attempts to open: trying costs three system calls, so try often."""

Interface = Literal["socketcan", "virtual", "udp_multicast"]

_TIMESPEC = struct.Struct("@ll")
_SO_TIMESTAMPNS, _SO_MEMINFO, _SK_MEMINFO_DROPS = 35, 55, 8


class CanFrame(NamedTuple):
    """A frame as received; for an error frame `can_id` holds the error classes.

    `t_seen_ns` is the monotonic instant of arrival: by the bus's stamp if between the last reading
    and this one, else the instant of reading. `realtime_ns` is that stamp (CLOCK_REALTIME) or None.
    """

    can_id: int
    extended: bool
    data: bytes
    t_seen_ns: int
    realtime_ns: int | None = None
    remote: bool = False
    error: bool = False


class _BusFaultError(Exception):
    """Error: the bus has become unreadable; the text is the reason."""


Read = Callable[[], CanFrame | None]
_NO_FRAME = CanFrame(0, False, b"", 0)
"""Reading of a datagram that holds no frame."""


class CanBus:
    """CAN bus, reopened indefinitely; sends only on request.

    With `polled`, set before `run`, a bus that has a descriptor is read by `poll` alone.

    `counters`: `bus_opened`, `bus_closed`, `bus_open_failed`, `frames`, `remote_frames`,
    `error_frames`, `error_<class>`, `error_overflow` (controller lost frames), `socket_overflow`
    (kernel dropped frames that were not read in time), `ring_overflow`, `bad_datagrams`.
    """

    def __init__(
        self,
        interface: Interface,
        channel: str,
        filters: Sequence[CanFilter] = (),
        counters: Counter[str] | None = None,
        *,
        now_ns: Now = monotonic_ns,
    ) -> None:
        self.interface = interface
        self.channel = channel
        self.controller: ControllerState = "active"
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._filters = list(filters)
        self._now_ns = now_ns
        self._backoff = Backoff(longest_s=LONGEST_WAIT_S)
        self._on_frame: Callable[[CanFrame], None] = lambda frame: None
        self._on_controller: Callable[[ControllerState], None] = lambda state: None
        self._drops_seen = 0
        self._bus: can.BusABC | None = None
        self.polled = False
        self._drain: Callable[[], None] | None = None
        self._read_ns = 0
        """Instant at which nothing was left to read."""

    async def run(
        self,
        on_frame: Callable[[CanFrame], None],
        on_link: Callable[[bool, str], None],
        on_controller: Callable[[ControllerState], None],
    ) -> None:
        """Listen until cancelled.

        `on_frame` gets every data frame. `on_link(up, why)` is called when the bus opens, when it
        disappears, and when it cannot be opened (again only if the reason changes).
        `on_controller(state)` is called when error frames show a new state of the controller. An
        exception of a callback is a bug of the caller: it closes the bus and is raised.
        """
        self._on_frame, self._on_controller = on_frame, on_controller
        reported = ""
        while True:
            try:
                bus = self._open()
            except (OSError, can.CanError, ValueError) as error:
                self.counters["bus_open_failed"] += 1
                if (why := self._explain(error)) != reported:
                    on_link(False, why)
                    reported = why
                await asyncio.sleep(self._backoff.next())
                continue
            self.counters["bus_opened"] += 1
            self.controller = "active"
            self._drops_seen = 0
            self._bus = bus
            try:
                on_link(True, "")
                reported = await self._serve(bus)
            finally:
                self._bus = None
                with contextlib.suppress(OSError, can.CanError):
                    bus.shutdown()
                self.counters["bus_closed"] += 1
            on_link(False, reported)
            await asyncio.sleep(self._backoff.next())

    def poll(self) -> None:
        """Read `FRAMES_PER_WAKEUP` waiting frames at most; the rest follows in the next turn of the
        loop."""
        if self.polled and self._drain is not None:
            self._drain()

    def send(self, frame: CanFrame) -> bool:
        """Send a frame; False if the bus is down or its queue is full. Never waits."""
        if self._bus is None:
            return False
        message = can.Message(
            arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (OSError, can.CanError):
            return False
        return True

    # ----------------------------------------------------------------- opening

    def _open(self) -> can.BusABC:
        """Open the bus; OSError or CanError when the interface is absent or down."""
        if self.interface != "socketcan":
            return can.Bus(interface=self.interface, channel=self.channel, ignore_config=True)
        socket.if_nametoindex(self.channel)
        bus = can.Bus(
            interface="socketcan",
            channel=self.channel,
            ignore_config=True,
            fd=True,  # a classic interface works without CAN FD
            can_filters=self._filters or None,
            ignore_rx_error_frames=False,
        )
        # A bind to an interface that is down succeeds and leaves ENETDOWN behind (net/can/raw.c).
        sock: socket.socket = getattr(bus, "socket")  # noqa: B009 (SocketcanBus has one)
        pending = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:
            bus.shutdown()
            raise OSError(pending, os.strerror(pending))
        return bus

    def _explain(self, error: Exception) -> str:
        code = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
        if self.interface == "socketcan":
            if code == errno.ENETDOWN:
                return f"{self.channel} is down (ip link set {self.channel} up)"
            if code in (errno.ENODEV, errno.ENXIO) or "no interface" in str(error):
                return f"there is no interface {self.channel}"
            if code == errno.EAFNOSUPPORT:
                return "this kernel has no CAN (modprobe can_raw)"
        return f"{self.interface} {self.channel}: {error}"

    # ----------------------------------------------------------------- reading

    async def _serve(self, bus: can.BusABC) -> str:
        """Read until the bus disappears; return the reason."""
        loop = asyncio.get_running_loop()
        gone: asyncio.Future[str] = loop.create_future()
        try:
            fd = bus.fileno()
        except NotImplementedError:
            return await _ThreadReader(self, bus, gone).wait_until_gone()
        sock: socket.socket | None = getattr(bus, "socket", None)
        own: socket.socket | None = None
        if sock is not None:
            read = partial(self.read_socket, sock, CANFD_BYTES, of_can_frame)
        else:
            own = socket.socket(fileno=fd)
            read = partial(self.read_socket, own, DATAGRAM_BYTES, datagram_decoder())
        self._drain = partial(self._readable, read, gone)
        self._read_ns = self._now_ns()
        if not self.polled:
            loop.add_reader(fd, self._drain)
        try:
            while not gone.done():
                await asyncio.wait([gone], timeout=CHECK_S)
                if sock is not None:
                    self._count_drops(sock)
            return gone.result()
        finally:
            self._drain = None
            loop.remove_reader(fd)
            if own is not None:
                own.detach()  # the bus closes it

    def _readable(self, read: Read, gone: asyncio.Future[str]) -> None:
        """Read the waiting frames, the rest in the next turn of the loop."""
        if self.drain(read, gone) and self.polled:
            gone.get_loop().call_soon(self._readable, read, gone)

    def drain(self, read: Read, gone: asyncio.Future[str]) -> bool:
        """Deliver the next `FRAMES_PER_WAKEUP` frames; True if there may be more. A fault ends the
        watch."""
        try:
            for _ in range(0 if gone.done() else FRAMES_PER_WAKEUP):
                frame = read()
                if frame is None:
                    return False
                if frame is not _NO_FRAME:
                    self.deliver(frame)
        except _BusFaultError as fault:
            gone.set_result(str(fault))
        except Exception as defect:
            gone.set_exception(defect)
        return not gone.done()

    def _arrived_ns(self, realtime_ns: int | None) -> int:
        """Monotonic instant of the arrival of a frame that is read now."""
        now_ns = self._now_ns()
        if realtime_ns is None:
            return now_ns
        arrived_ns = now_ns - (time.time_ns() - realtime_ns)
        # A stamp from before the system clock was set, or of another clock, is outside.
        return arrived_ns if self._read_ns <= arrived_ns <= now_ns else now_ns

    def read_socket(self, sock: socket.socket, size: int, decode: Decode) -> CanFrame | None:
        """Read one frame of a socket with its kernel stamp; None without one.

        It costs a quarter of `bus.recv(0)`, and keeps the stamp's nanoseconds. A datagram on
        `udp_multicast` that is no CAN frame is counted and skipped.
        """
        try:
            raw, control, _, _ = sock.recvmsg(size, 64, socket.MSG_DONTWAIT)
        except (BlockingIOError, InterruptedError):
            self._read_ns = self._now_ns()
            return None
        except OSError as failure:
            raise _BusFaultError(self._explain(failure)) from failure
        realtime_ns = None
        for level, kind, value in control:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack_from(value)
                realtime_ns = seconds * 1_000_000_000 + nanoseconds
        try:
            can_id, extended, data, remote, of_error = decode(raw)
        except Exception:  # python-can may raise anything for strange datagrams in its group
            self.counters["bad_datagrams"] += 1
            return _NO_FRAME
        arrived_ns = self._arrived_ns(realtime_ns)
        return CanFrame(can_id, extended, data, arrived_ns, realtime_ns, remote, of_error)

    def read_message(self, bus: can.BusABC, timeout_s: float) -> CanFrame | None:
        """Read one frame of a bus without a descriptor through python-can; None without one."""
        try:
            message = bus.recv(timeout_s)
        except (OSError, can.CanError) as error:
            raise _BusFaultError(self._explain(error)) from error
        if message is None:
            self._read_ns = self._now_ns()
            return None
        realtime_ns = round(message.timestamp * 1e9) if message.timestamp > 0.0 else None
        return CanFrame(
            message.arbitration_id,
            message.is_extended_id,
            bytes(message.data),
            self._arrived_ns(realtime_ns),
            realtime_ns,
            message.is_remote_frame,
            message.is_error_frame,
        )

    def _count_drops(self, sock: socket.socket) -> None:
        """Add the kernel's newly dropped frames (SK_MEMINFO_DROPS, since Linux 4.12)."""
        with contextlib.suppress(OSError, struct.error):
            info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_SK_MEMINFO_DROPS + 1))
            (drops,) = struct.unpack_from("@I", info, 4 * _SK_MEMINFO_DROPS)
            if drops > self._drops_seen:
                self.counters["socket_overflow"] += drops - self._drops_seen
                self._drops_seen = drops

    # ----------------------------------------------------------------- handing over

    def deliver(self, frame: CanFrame) -> None:
        """Process one frame: pass data to `on_frame`, and follow the controller's state by error
        frames."""
        if frame.error:
            self.counters["error_frames"] += 1
            for name in error_names(frame.can_id, frame.data):
                self.counters[f"error_{name}"] += 1
            self._controller_is(controller_state(frame.can_id, frame.data))
            return
        if frame.remote:
            self.counters["remote_frames"] += 1
            return
        self.counters["frames"] += 1
        self._backoff.reset()
        if self.controller == "bus_off":
            self._controller_is("active")  # a controller in bus-off receives nothing
        self._on_frame(frame)

    def _controller_is(self, state: ControllerState | None) -> None:
        if state is not None and state != self.controller:
            self.controller = state
            self._on_controller(state)


class _ThreadReader:
    """Reader of a bus without a descriptor, in a daemon thread, through a bounded ring."""

    POLL_S = 0.1
    """Longest wait in the thread, and so its longest life after its bus."""

    def __init__(self, owner: CanBus, bus: can.BusABC, gone: asyncio.Future[str]) -> None:
        self._owner = owner
        self._bus = bus
        self._gone = gone
        self._ring: deque[CanFrame | _BusFaultError] = deque(maxlen=RING_FRAMES)
        self._scheduled = False
        self._stop = threading.Event()

    async def wait_until_gone(self) -> str:
        threading.Thread(target=self._pump, name=f"can-{self._owner.channel}", daemon=True).start()
        try:
            return await self._gone
        finally:
            self._stop.set()

    def _pump(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            try:
                while not self._stop.is_set():
                    frame = self._owner.read_message(self._bus, self.POLL_S)
                    if frame is not None:
                        self._push(frame)
            except _BusFaultError as fault:
                self._push(fault)

    def _push(self, item: CanFrame | _BusFaultError) -> None:
        if len(self._ring) == RING_FRAMES:
            self._owner.counters["ring_overflow"] += 1
        self._ring.append(item)
        if not self._scheduled:
            self._scheduled = True
            self._gone.get_loop().call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        """Process the ring in the event loop; clears the flag first, so that no frame is missed."""
        self._scheduled = False
        if self._owner.drain(self._next, self._gone):
            self._scheduled = True
            self._gone.get_loop().call_soon(self._drain)

    def _next(self) -> CanFrame | None:
        item = self._ring.popleft() if self._ring else None
        if isinstance(item, _BusFaultError):
            raise item
        return item
