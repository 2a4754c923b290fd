"""Client of an NTRIP caster: keeps the connection alive and passes whole frames on.

Only whole RTCM 3 frames with a correct checksum pass, so that no torn frame and no command reaches
the receiver.
"""

from __future__ import annotations

import asyncio
import os
import ssl
from collections import Counter
from collections.abc import Callable
from functools import partial
from socket import socket
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from drivers.base import Backoff, DriverOptions
from drivers.detached_call import aside
from drivers.network_port import connect
from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.ntrip.protocol import CasterRefusedError, CasterReply, mountpoint_request
from drivers.port import READ_BYTES, ByteBudget

PASSWORD_VARIABLE = "FUSIOND_NTRIP_PASSWORD"
DEFAULT_PORT = 2101
"""IANA's for ntrip-caster."""
SILENT_S = 20.0
"""A caster sends every second. Receivers use a correction for 60 s (u-blox
CFG-NAVSPG-CONSTR_DGNSSTO): time for two more attempts before RTK is lost."""
GGA_S = 10.0
"""Network casters ask for a position every 5 to 60 s; ten seconds at 30 m/s are 300 m of a
network's 30 km."""
FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0
"""First and longest wait between attempts: casters lock out frequent clients; most allow an attempt
a minute."""

NtripState = Literal["starting", "waiting", "running", "lost", "refused"]


class NtripOptions(DriverOptions):
    """Section `ntrip` of a receiver: the source of its corrections."""

    caster: Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]+(:\d{1,5})?$")]
    """HOST or HOST:PORT."""
    mountpoint: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.+-]{1,100}$")]
    user: str = ""
    """User name; the password is in the environment, FUSIOND_NTRIP_PASSWORD."""
    tls: bool = False
    """Use TLS; the caster's certificate must come from an authority that the system trusts."""
    send_gga: bool = False
    """Send the receiver's own position up: for mountpoints that make corrections for a place."""

    @field_validator("user")
    @classmethod
    def _one_line(cls, user: str) -> str:
        if ":" in user or not user.isprintable():
            raise ValueError("a user has no colon and no line end (RFC 7617)")
        return user

    @model_validator(mode="after")
    def _port_of_tls(self) -> Self:
        if self.tls and ":" not in self.caster:
            raise ValueError("with tls the caster needs its port, HOST:PORT: no common one exists")
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        host, _, port = self.caster.partition(":")
        return host, int(port or DEFAULT_PORT)


class _Frames:
    """RTCM 3 frames of a stream, and counters of its other contents."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._of_stream: Counter[str] = Counter()
        self._splitter = StreamSplitter(self._of_stream)

    def feed(self, data: bytes) -> list[bytes]:
        items = self._splitter.feed(data)
        frames = [i.raw for i in items if isinstance(i, Frame) and i.kind == "rtcm"]
        self._counters["ntrip_frames"] += len(frames)
        self._counters["ntrip_not_rtcm"] += len(items) - len(frames)
        self._counters["ntrip_damaged"] += self._of_stream.pop("rtcm_damaged", 0)
        self._counters["ntrip_garbage_bytes"] += self._of_stream.pop("garbage_bytes", 0)
        return frames


def _reach(host: str, port: int, tls: bool) -> tuple[socket, ssl.SSLContext | None]:
    """Open a connection to the caster; for TLS it reads the files of the authorities."""
    context = ssl.create_default_context() if tls else None
    return connect(host, port), context


def _without_tls(error: ssl.SSLError) -> str:
    """Reason why a TLS connection failed, with the remedy."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"its certificate is not accepted: {error.verify_message} (an authority of your own: "
            "SSL_CERT_FILE in the environment)"
        )
    if error.reason == "WRONG_VERSION_NUMBER":
        return "there is no TLS at that port"
    return error.reason or str(error)


class NtripClient:
    """Client that runs until cancelled. `write(frame)` passes a frame to the receiver, False if
    that fails; `gga()` gives the receiver's last position as a sentence, empty without one;
    `on_state(state, text)` receives changes of state.

    `counters`: `ntrip_connected`, `ntrip_failed` (attempts that brought no corrections, and
    connections that ended), `ntrip_bytes`, `ntrip_frames`, `ntrip_damaged` (frames whose checksum
    is wrong), `ntrip_not_rtcm` (other sound messages), `ntrip_garbage_bytes`,
    `ntrip_write_refused` (the receiver's line was closed or congested), `ntrip_gga_sent`.
    """

    def __init__(
        self,
        options: NtripOptions,
        counters: Counter[str],
        write: Callable[[bytes], bool],
        gga: Callable[[], bytes],
        on_state: Callable[[NtripState, str], None],
        backoff: Backoff | None = None,
    ) -> None:
        self.state: NtripState = "starting"
        self.detail = ""
        """Reason for the absence of corrections; empty while they arrive."""
        self._options = options
        self._counters = counters
        self._write = write
        self._gga = gga
        self._on_state = on_state
        self._backoff = backoff or Backoff(FIRST_WAIT_S, LONGEST_WAIT_S)
        self._where = f"{options.caster}/{options.mountpoint}"

    async def run(self) -> None:
        """Fetch corrections indefinitely, with growing waits after failures."""
        while True:
            try:
                await self._position_known()
                await self._fetch()
            except CasterRefusedError as error:
                asked = self._options.user and PASSWORD_VARIABLE not in os.environ
                hint = f"; {PASSWORD_VARIABLE} is not set" if asked else ""
                self._set_state("refused", f"{error}{hint}")
            except ssl.SSLEOFError:
                self._set_state("lost", "the caster closed the connection")
            except ssl.SSLError as error:
                self._set_state("refused", _without_tls(error))
            except OSError as error:
                self._set_state("lost", error.strerror or str(error))
            except EOFError:
                self._set_state("lost", "the caster closed the connection")
            self._counters["ntrip_failed"] += 1
            await asyncio.sleep(self._backoff.next())

    async def _position_known(self) -> None:
        """Wait for the receiver's position, without which a caster of local corrections closes or
        is silent."""
        while self._options.send_gga and not self._gga():
            self._set_state("waiting", "the receiver has no position to send to the caster yet")
            await asyncio.sleep(FIRST_WAIT_S)

    async def _fetch(self) -> None:
        """Serve one connection; its end is an exception."""
        host, port = self._options.address
        reach = partial(_reach, host, port, self._options.tls)
        connected, context = await aside(reach, lambda orphan: orphan[0].close())
        name = host if context is not None else None
        reader, writer = await asyncio.open_connection(
            sock=connected, ssl=context, server_hostname=name
        )
        upward: asyncio.Task[None] | None = None
        try:
            password = os.environ.get(PASSWORD_VARIABLE, "")
            o = self._options
            writer.write(mountpoint_request(host, port, o.mountpoint, o.user, password))
            self._counters["ntrip_connected"] += 1
            if o.send_gga:
                upward = asyncio.create_task(self._send_positions(writer))
            await self._read(reader)
        finally:
            if upward is not None:
                upward.cancel()
                await asyncio.gather(upward, return_exceptions=True)
            writer.transport.abort()  # nothing that we sent must be waited for

    async def _read(self, reader: asyncio.StreamReader) -> None:
        reply, stream, budget = CasterReply(), _Frames(self._counters), ByteBudget()
        loop = asyncio.get_running_loop()
        began_s: float | None = None
        try:
            async with asyncio.timeout(SILENT_S) as silence:
                while data := await reader.read(READ_BYTES):
                    self._counters["ntrip_bytes"] += len(data)
                    frames = stream.feed(reply.feed(data))
                    if frames:
                        now_s = loop.time()
                        silence.reschedule(now_s + SILENT_S)
                        began_s = now_s if began_s is None else began_s
                        if now_s - began_s > LONGEST_WAIT_S:  # not one that closes at once
                            self._backoff.reset()
                        self._set_state("running", "")
                    for frame in frames:
                        self._counters["ntrip_write_refused"] += not self._write(frame)
                    if reply.over is not None:
                        raise reply.over
                    # Without a wait, reading of waiting data would not let other tasks run.
                    await asyncio.sleep(budget.spend(len(data)))
                raise EOFError
        except TimeoutError:
            if not silence.expired():
                raise
            raise OSError(f"nothing for {SILENT_S:g} s") from None

    async def _send_positions(self, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(self._gga() + b"\r\n")
            self._counters["ntrip_gga_sent"] += 1
            await asyncio.sleep(GGA_S)

    def _set_state(self, state: NtripState, why: str) -> None:
        changed = state != self.state
        self.state = state
        self.detail = f"no corrections of {self._where}: {why}" if why else ""
        if changed:
            self._on_state(state, self.detail or f"corrections of {self._where}")
