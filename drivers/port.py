"""Ports: interface of a non-blocking open port, the serial port, and the limit on bytes parsed.

The limit is the fastest rate of a real receiver:

    a bucket of BURST bytes, filled at the line's rate; each byte read takes one out of it

Navigation comes first: parsing a byte of the worst stream takes some microseconds (`python -m
tests.fuzz.hostile`), so a flood over a network could use the whole processor. Bytes beyond the
limit wait with their sender (TCP, a pty) or are lost in the kernel (UDP).
"""

from __future__ import annotations

import contextlib
import errno
import os
import termios
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol

import serial

READ_BYTES = 1024
"""Most bytes handed over at a time: 11 ms of a line at 921600 baud, and less than a millisecond of
parsing, so that a device that floods leaves every other task its turn."""

LINE_BYTES_S = 92_160.0
"""Byte rate of 921600 baud, a receiver's highest UART rate, at ten bits a byte; 60 satellites of
two signals at 10 Hz (RXM-RAWX and RXM-SFRBX) take half of it."""
BURST = 65_536.0
"""The largest datagram; seven of the longest epochs (8 kB)."""

OPEN_ERRORS = (OSError, ValueError, OverflowError, termios.error)
"""Exceptions of opening a port or reaching a host.

A port is absent, locked, no terminal, or refuses the baud rate (SerialException is an OSError)."""


class Port(Protocol):
    """Open port. Raises BlockingIOError if nothing can be read or written now, another OSError if
    it is broken."""

    at_end: str
    """Meaning of a read without bytes, in words."""

    @property
    def writable(self) -> bool:
        """True if the far end can receive."""

    def fileno(self) -> int:
        """Descriptor for the event loop."""

    def read(self) -> bytes:
        """Waiting bytes; no bytes at the end of the stream."""

    def write(self, data: bytes | bytearray) -> int:
        """Number of bytes taken."""

    def changed(self) -> str:
        """Reason why the port's name no longer refers to this device; empty while it does."""

    def set_baud(self, baud: int) -> None:
        """Change the baud rate, if any."""

    def close(self) -> None:
        """Close at once."""


OpenPort = Callable[[str, int, Counter[str]], Port]
"""Function that opens a port by name at a baud rate, with the counters of its line; may take
seconds, raises `OPEN_ERRORS`."""


def open_serial(path: str, baud: int, counters: Counter[str]) -> Port:
    """Open a serial device; no network address. Raises `OPEN_ERRORS`."""
    return SerialPort(path, baud)


_WHY = {
    errno.ENOENT: "does not exist",
    errno.EACCES: "may not be opened (no permission)",
    errno.EBUSY: "is in use by another program (busy)",
    errno.EAGAIN: "is in use by another program (locked)",
}


def why_not_open(error: Exception) -> str:
    """Reason why a port did not open, for a text behind its name or with it."""
    code = getattr(error, "errno", None)
    return str(error) if code is None else _WHY.get(code, str(error))


class SerialPort:
    """Serial port: 8 data bits, no parity, 1 stop bit, no flow control, raw bytes.

    pyserial opens and configures it; reading and writing use its descriptor directly, so that every
    read is bounded and an end of file is recognised.
    """

    at_end = "end of file, the device went away"
    """VMIN is 1, so an idle line says EAGAIN: no bytes is a hang-up, and would be for ever."""
    writable = True

    def __init__(self, path: str, baud: int) -> None:
        # `exclusive` is flock, not TIOCEXCL, which outlives a killed daemon while another process
        # (a simulator on a pty) holds the terminal open. `inter_byte_timeout` 0 makes pyserial set
        # VMIN 1 and VTIME 0; with its default, VMIN 0, an idle line reads like an end of file.
        self._path = path
        self._serial = serial.Serial(path, baud, timeout=0, exclusive=True, inter_byte_timeout=0)
        with contextlib.suppress(ValueError):  # a pty, or an adapter without low latency
            self._serial.set_low_latency_mode(True)

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def read(self) -> bytes:
        return os.read(self.fileno(), READ_BYTES)

    def write(self, data: bytes | bytearray) -> int:
        return os.write(self.fileno(), data)

    def changed(self) -> str:
        try:
            if os.stat(self._path).st_rdev == os.fstat(self.fileno()).st_rdev:
                return ""
        except OSError:
            pass
        return f"{self._path} no longer names the device that was opened"

    def set_baud(self, baud: int) -> None:
        self._serial.baudrate = baud

    def close(self) -> None:
        with contextlib.suppress(*OPEN_ERRORS):
            self._serial.reset_output_buffer()  # otherwise close waits for a dead line, up to 30 s
        self._serial.close()


class ByteBudget:
    """Token bucket of one line at `baud`; `now_s` is monotonic."""

    def __init__(self, baud: int = 0, now_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = max(LINE_BYTES_S, baud / 10.0)
        self._now_s = now_s
        self._left, self._filled_s = BURST, now_s()

    def spend(self, count: int) -> float:
        """Spend `count` bytes; return how long to wait before the next read, s."""
        now_s = self._now_s()
        self._left = min(BURST, self._left + self._rate * (now_s - self._filled_s)) - count
        self._filled_s = now_s
        return max(0.0, -self._left / self._rate)
