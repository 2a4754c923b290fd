"""A GNSS receiver that speaks NMEA 0183 on a serial line: see `docs/gnss-nmea.md`."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated, ClassVar

from pydantic import Field, PositiveFloat

from drivers.base import DriverStatus, Emit, Now, State, monotonic_ns, state_event
from drivers.measurements import Measurement, TimeReport
from drivers.nmea_decoder import NmeaDecoder, NmeaDecoding
from drivers.serial_line import SerialLine

__all__ = ["NmeaDecoder", "NmeaDecoding", "NmeaDriver", "NmeaOptions"]

SILENCE_S = 0.05
"""A pause that ends an epoch: receivers send an epoch's sentences in one burst."""
STATUS_INTERVAL_S = 0.25

_LIFE_SIGNS = ("bytes_in", "ubx_frames", "rtcm_frames")
_REFUSALS = {
    "no_fix": "the receiver has no fix",
    "dead_reckoning_refused": "only the receiver's own dead reckoning, which is not fused",
    "manual_refused": "the receiver repeats a position that was put in by hand",
    "simulator_refused": "the receiver simulates: allow_simulator would accept it",
    "duplicate_epoch": "the receiver repeats an epoch or goes back in time",
    "unknown_quality": "the receiver states a GGA quality that NMEA does not know",
}


class NmeaOptions(NmeaDecoding):
    """Options of a `driver = "nmea"` source."""

    port: str
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115200
    timeout_s: PositiveFloat = 5.0
    """Without a verified sentence for this long the device is `silent`; five epochs at 1 Hz."""


class NmeaDriver:
    """Reads the line, hands over fixes, headings and times; says in `status` what is wrong."""

    Options: ClassVar[type[NmeaOptions]] = NmeaOptions

    def __init__(
        self, name: str, options: NmeaOptions, emit: Emit, now_ns: Now = monotonic_ns
    ) -> None:
        self.name = name
        self.status = DriverStatus()
        self._options = options
        self._emit = emit
        self._now_ns = now_ns
        self._line = SerialLine(options.port, options.baud, now_ns)
        self.counters = self._line.counters
        self._decoder = NmeaDecoder(name, options, self.counters)
        self._silence: asyncio.TimerHandle | None = None
        self._alive_ns = now_ns()
        """When the line opened or a sentence last verified."""
        self._window: dict[str, int] = {}
        """Counters at that instant: what came since and was not understood."""
        self._useful_ns = self._alive_ns
        """When the line opened or a fix or heading was last handed over."""

    async def run(self) -> None:
        """Serve the receiver until cancelled."""
        watch = asyncio.create_task(self._watch())
        try:
            await self._line.run(self._on_bytes, self._on_open, self._on_close)
        finally:
            watch.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watch

    def _on_open(self) -> None:
        self._mark_alive()
        self._useful_ns = self._alive_ns
        self.status.state, self.status.detail = "starting", "open, no sentence yet"

    def _on_close(self, why: str) -> None:
        self._stop_timer()
        self._hand_over(self._decoder.flush())

    def _on_bytes(self, data: bytes, t_seen_ns: int) -> None:
        self._stop_timer()
        before = self.counters["sentences"]
        self._hand_over(self._decoder.feed(data, t_seen_ns))
        if self.counters["sentences"] > before:
            self._mark_alive()
            self._set_state("running", self._running_detail())
        if self._decoder.epoch_open:
            loop = asyncio.get_running_loop()
            self._silence = loop.call_later(SILENCE_S, self._on_silence)

    def _on_silence(self) -> None:
        self._silence = None
        self._hand_over(self._decoder.silence())

    def _stop_timer(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None

    def _hand_over(self, found: list[Measurement]) -> None:
        for measurement in found:
            if not isinstance(measurement, TimeReport):
                self._useful_ns = measurement.t_seen_ns
            self._emit(measurement)

    # ----------------------------------------------------------------- status

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(STATUS_INTERVAL_S)
            if not self._line.is_open:
                self._set_state("absent", self._line.detail)
            elif self._now_ns() - self._alive_ns > self._options.timeout_s * 1e9:
                self._set_state("silent", self._silent_detail())
            elif self.status.state == "running":
                self._set_state("running", self._running_detail())

    def _mark_alive(self) -> None:
        self._alive_ns = self._now_ns()
        self._window = {name: self.counters[name] for name in _LIFE_SIGNS}

    def _set_state(self, state: State, detail: str) -> None:
        changed = state != self.status.state
        self.status.state, self.status.detail = state, detail
        if changed:
            self._emit(state_event(self.name, self._now_ns(), self._options.port, self.status))

    def _running_detail(self) -> str:
        if self._now_ns() - self._useful_ns < self._options.timeout_s * 1e9:
            return ""
        if not self.counters["epochs"]:
            return "sentences arrive, but none that counts: switch on GGA and RMC"
        return _REFUSALS.get(self._decoder.refusal, "epochs arrive, but none has a position")

    def _silent_detail(self) -> str:
        seconds = self._options.timeout_s
        if self.counters["bytes_in"] == self._window["bytes_in"]:
            return f"no bytes for {seconds:g} s"
        if any(self.counters[name] > self._window[name] for name in ("ubx_frames", "rtcm_frames")):
            return "UBX or RTCM 3 frames arrive, but no NMEA: switch on NMEA output on this port"
        return (
            f"bytes arrive, but no NMEA sentence verifies at {self._options.baud} baud:"
            " is that the receiver's rate?"
        )
