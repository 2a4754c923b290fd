"""Common base of receiver and compass drivers: one device on one line.

The decoder makes measurements of bytes. The driver hands them over, ends an epoch when the line
falls silent, and keeps `status`: whether the device is present and intelligible.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Protocol, Self

from pydantic import Field, PositiveFloat, model_validator

from drivers.base import DriverOptions, DriverStatus, Emit, Now, State, state_event
from drivers.external_inputs import Inputs
from drivers.measurements import DeviceEvent, Measurement, TimeReport
from drivers.network_port import PortName, on_network, open_port
from drivers.ntrip.client import NtripClient, NtripOptions
from drivers.rate_search import ENOUGH_BYTES, RateSearch
from drivers.raw.messages import NavigationMessage, RawEvent
from drivers.reconnecting_line import SerialLine

SILENCE_S = 0.05
"""A pause that ends an epoch: receivers send an epoch's sentences in one burst."""
STATUS_INTERVAL_S = 0.25

_LIFE_SIGNS = ("bytes_in", "sentences", "ubx_frames", "rtcm_frames", "logs", "sbf_blocks")


class ReceiverDecoder(Protocol):
    """Decoder of bytes into measurements."""

    @property
    def gga(self) -> bytes:
        """Last GGA with a position, without its line end; empty before one."""

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch."""

    @property
    def cautions(self) -> dict[str, str]:
        """Cautions of what arrives, by counter."""

    def feed(self, data: bytes, t_seen_ns: int) -> Sequence[Measurement | RawEvent]: ...

    def silence(self) -> Sequence[Measurement | RawEvent]: ...

    def flush(self) -> Sequence[Measurement | RawEvent]: ...


class ReceiverOptions(DriverOptions):
    """Options of a receiver: its port and initial commands."""

    port: PortName
    """A serial device, or an address of a network: see `docs/network.md`."""
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115200
    timeout_s: PositiveFloat = 5.0
    """Time without verified input after which the device is `silent`; five epochs at 1 Hz."""
    ntrip: NtripOptions | None = None
    """Corrections of a caster, written to the receiver."""

    @model_validator(mode="after")
    def _receiver_can_be_written_to(self) -> Self:
        if self.ntrip is not None and self.port.startswith("gpsd://"):
            raise ValueError("ntrip: nothing can be written to a receiver behind a gpsd")
        return self


class ReceiverDriver:
    """Base of drivers of one device on one line. Subclasses provide the decoder and the texts of
    `status.detail`."""

    alive_by: tuple[str, ...] = ("sentences",)
    """Counters of which one must grow for the device to be `running`."""

    def __init__(self, name: str, options: ReceiverOptions, emit: Emit, now_ns: Now) -> None:
        self.name = name
        self.status = DriverStatus()
        self._port = options.port
        self._baud = options.baud
        self._timeout_s = options.timeout_s
        self._emit = emit
        self.inputs = Inputs(now_ns)
        self.inputs.on("read", self._on_bytes)
        self.inputs.on("open", self._on_open)
        self.inputs.on("close", self._on_close)
        self.inputs.on("silence", self._on_silence)
        self.inputs.on("watch", self._on_watch)
        self._now_ns = self.inputs.now_ns
        self._line = SerialLine(options.port, options.baud, now_ns, open_port=open_port)
        self._rates = RateSearch(options.baud)
        self._open = False
        self._reported: set[str] = set()
        """Cautions that have been an event."""
        self._why_closed = ""
        self.counters: Counter[str] = self._line.counters
        self._decoder = self._make_decoder()
        self._ntrip: NtripClient | None = None
        if options.ntrip is not None:
            self._ntrip = NtripClient(
                options.ntrip,
                self.counters,
                self._pass_on,
                lambda: self._decoder.gga,
                self._corrections_changed,
            )
        self._silence: asyncio.TimerHandle | None = None
        self._alive_ns = now_ns()
        """Instant of the line's opening or of its last verified input."""
        self._window: dict[str, int] = {}
        """Counters at that instant: what came since and was not understood."""
        self._useful_ns = self._alive_ns
        """Instant when the line opened or a measurement was last handed over."""

    @property
    def cautions(self) -> dict[str, str]:
        """Cautions by counter: limits on the quality of fixes, and the actions taken."""
        found, rates = self._decoder.cautions, self._rates
        if rates.baud != rates.configured and self.status.state == "running":
            return {**found, "baud_followed": self._other_rate()}
        return found

    def _other_rate(self) -> str:
        rates = self._rates
        return (
            f"{self._port} makes sense at {rates.baud} baud, and not at {rates.configured} as "
            "configured: it is read at that; correct baud, or set the receiver's rate"
        )

    def _make_decoder(self) -> ReceiverDecoder:
        """Make the decoder, which counts in `self.counters`."""
        raise NotImplementedError

    def _useless_detail(self) -> str:
        """Reason why the input has given no measurement within the timeout."""
        raise NotImplementedError

    def _unintelligible_detail(self) -> str:
        """Reason why the received bytes are not this driver's input."""
        raise NotImplementedError

    def _where_to_look(self) -> str:
        """End of a sentence on unrecognised bytes: the place to look next."""
        if on_network(self._port):
            return f" from {self._port}: does it serve what the receiver sends?"
        return f" at {self._baud} baud: is that the receiver's rate?"

    async def run(self) -> None:
        """Serve the receiver until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch())
            if self._ntrip is not None:
                tasks.create_task(self._ntrip.run())
            opened = partial(self.inputs.take, "open")
            tasks.create_task(self._line.run(self._read, opened, self._closed))

    def _pass_on(self, frame: bytes) -> bool:
        """Write a frame of the caster to the receiver; False if that is impossible."""
        return self._line.write(frame)

    def _corrections_changed(self, state: str, text: str) -> None:
        self._emit(DeviceEvent(self.name, self._now_ns(), f"ntrip_{state}", text))

    # ------------------------------------------------------------------ the line and the timer

    def _read(self, data: bytes, t_seen_ns: int) -> None:
        self._stop_timer()
        self.inputs.take("read", data, t_seen_ns)
        if self._decoder.epoch_open:
            loop = asyncio.get_running_loop()
            self._silence = loop.call_later(SILENCE_S, self._fell_silent)

    def _closed(self, why: str) -> None:
        self._stop_timer()
        self.inputs.take("close", why)

    def _fell_silent(self) -> None:
        self._silence = None
        self.inputs.take("silence")

    def _stop_timer(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None

    # ------------------------------------------------------------------ inputs

    def _on_open(self, _: None, t_ns: int) -> None:
        self._open = True
        self._mark_alive()
        self._useful_ns = self._alive_ns
        self.status.state, self.status.detail = "starting", "open, nothing verified yet"

    def _on_close(self, why: str, t_ns: int) -> None:
        self._open, self._why_closed = False, why
        self._hand_over(self._decoder.flush())

    def _on_bytes(self, data: bytes, t_seen_ns: int) -> None:
        before = self._signs_of_life()
        self._hand_over(self._decoder.feed(data, t_seen_ns))
        if self._signs_of_life() > before:
            self._mark_alive()
            if self.status.state != "running":
                self._rates.understood()
            self._set_state("running", self._running_detail())

    def _on_silence(self, _: None, t_ns: int) -> None:
        self._hand_over(self._decoder.silence())

    def _hand_over(self, found: Sequence[Measurement | RawEvent]) -> None:
        for measurement in found:
            if not isinstance(measurement, TimeReport | NavigationMessage):
                self._useful_ns = measurement.t_seen_ns
            self._emit(measurement)
        for code, text in self.cautions.items() if found else ():
            if code not in self._reported:
                self._reported.add(code)
                self._emit(DeviceEvent(self.name, self._now_ns(), code, text))

    # ----------------------------------------------------------------- status

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(STATUS_INTERVAL_S)
            self.inputs.take("watch")

    def _on_watch(self, _: None, t_ns: int) -> None:
        if not self._open:
            self._set_state("absent", self._line.detail or self._why_closed)
        elif t_ns - self._alive_ns > self._timeout_s * 1e9:
            detail = self._silent_detail()
            self._set_state("silent", detail)
            if detail.endswith(self._where_to_look()) and not on_network(self._port):
                self._try_next_rate(t_ns)
        elif self.status.state == "running":
            self._set_state("running", self._running_detail())

    def _try_next_rate(self, t_ns: int) -> None:
        if self._since_alive("bytes_in") < ENOUGH_BYTES:
            return
        baud = self._rates.next(t_ns, self.counters["bytes_in"])
        if baud is not None:
            self.counters["bauds_tried"] += 1
            self._reported.discard("baud_followed")
            self._line.set_baud(baud)

    def _signs_of_life(self) -> int:
        return sum(self.counters[name] for name in self.alive_by)

    def _mark_alive(self) -> None:
        self._alive_ns = self._now_ns()
        self._window = {name: self.counters[name] for name in _LIFE_SIGNS}

    def _set_state(self, state: State, detail: str) -> None:
        changed = state != self.status.state
        self.status.state, self.status.detail = state, detail
        if changed:
            self._emit(state_event(self.name, self._now_ns(), self._port, self.status))

    def _since_alive(self, name: str) -> int:
        """Growth of a counter of bytes, sentences or frames since the device's last valid input."""
        return self.counters[name] - self._window.get(name, 0)

    def _running_detail(self) -> str:
        if self._now_ns() - self._useful_ns < self._timeout_s * 1e9:
            return self._ntrip.detail if self._ntrip is not None else ""
        return self._useless_detail()

    def _silent_detail(self) -> str:
        if not self._since_alive("bytes_in"):
            return f"no bytes for {self._timeout_s:g} s"
        return self._unintelligible_detail()
