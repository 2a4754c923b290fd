"""Time for chrony: one datagram a second to the socket of its reference clock SOCK.

    offset = true UTC - CLOCK_REALTIME, at an instant of CLOCK_REALTIME

Of each second the report with the least delay is sent, since a delay can only be positive. Reports
are passed on as the receiver gave them, without the daemon's own estimate of UTC: chrony filters
them itself, and must see its correction of the clock in the next sample. Nothing is sent before UTC
is settled.

Source: refclock_sock.c of chrony 4.3, struct sock_sample.
"""

from __future__ import annotations

import socket
import struct
from collections import Counter

from drivers.base import DriverStatus
from fusiond.clock.results import TimeSample
from fusiond.configuration.outputs import Chrony
from fusiond.outputs.base import Surroundings
from fusiond.outputs.latest_value import Latest
from fusiond.outputs.messages.base import Message
from fusiond.outputs.topics import Topic

_SAMPLE = struct.Struct("@lldiiii")
"""struct timeval; offset (s); pulse, leap, padding, magic."""
_MAGIC = 0x534F434B
_SECOND_NS = 1_000_000_000


class ChronySocket:
    """Sender of samples to chronyd. Counters: `sent`, and `failed` while chronyd is absent or does
    not read.

    `on_event` receives `chrony_absent` once in each outage.
    """

    name = "chrony"
    sets_clocks = True
    nav_rate_hz = 0.1
    """No rate: chrony does not use `nav`."""

    def __init__(self, section: Chrony, around: Surroundings) -> None:
        self._path = str(section.socket)
        self._on_event = around.on_event
        self._best: TimeSample | None = None
        self._due: Latest[TimeSample] = Latest()
        self.counters: Counter[str] = Counter()
        self.status = DriverStatus("silent", "UTC is not settled yet")
        around.time().on_time = self._sampled

    def publish(self, topic: Topic, message: Message) -> None:
        """Ignore messages, which carry no time for chrony."""

    def _sampled(self, sample: TimeSample) -> None:
        """Keep the best sample of a UTC second; the first sample of the next second sends it."""
        best = self._best
        if best is not None and sample.utc_ns // _SECOND_NS != best.utc_ns // _SECOND_NS:
            self._due.put(best)
            best = None
        if best is None or _ahead_ns(sample) > _ahead_ns(best):
            self._best = sample

    async def run(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sock:
            while True:
                self._send(sock, await self._due.next())

    def _send(self, sock: socket.socket, sample: TimeSample) -> None:
        try:
            sock.sendto(packed(sample), self._path)
        except OSError as error:
            self.counters["failed"] += 1
            text = f"{self._path}: {error.strerror or error}"
            if self.status.state != "absent":
                self._on_event("chrony_absent", text)
            self.status = DriverStatus("absent", text)
        else:
            self.counters["sent"] += 1
            offset_s = _ahead_ns(sample) / _SECOND_NS
            self.status = DriverStatus("running", f"{self._path}: UTC - system {offset_s:+.4f} s")


def _ahead_ns(sample: TimeSample) -> int:
    """Lead (ns) of true UTC over the system clock by a sample; a delay makes it smaller."""
    return sample.utc_ns - sample.system_ns


def packed(sample: TimeSample) -> bytes:
    """Encode a sample as a datagram: 40 bytes where `long` has 64 bits."""
    second, rest_ns = divmod(sample.system_ns, _SECOND_NS)
    offset_s = _ahead_ns(sample) / _SECOND_NS
    return _SAMPLE.pack(second, rest_ns // 1000, offset_s, 0, 0, 0, _MAGIC)
