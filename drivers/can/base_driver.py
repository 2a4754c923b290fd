"""Base of CAN drivers: a bus, a codec, stamps, states, events.

The codec of most drivers is a `drivers.can.decoder.CanDecoder`, which a DBC file describes. Each
driver opens the bus for itself, so several may share one channel; the kernel gives each the frames
of its filters. Recorded frames enter by the same method, `CanDriver.feed`.
"""

from __future__ import annotations

import asyncio
import importlib.util
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Generic, Literal, Protocol, TypeVar

from can.typechecking import CanFilter
from pydantic import NonNegativeFloat, PositiveFloat

from drivers.base import (
    DriverOptions,
    DriverStatus,
    Emit,
    Now,
    PermanentDriverError,
    monotonic_ns,
)
from drivers.can.bus import CanBus, CanFrame, Interface
from drivers.can.errors import ControllerState
from drivers.external_inputs import Inputs
from drivers.measurements import (
    ArrivalStamp,
    DeviceEvent,
    KernelStamp,
    Measurement,
    Stamp,
)

EVENT_SPACING_NS = 10_000_000_000
"""Interval of events of the same controller state: on a shorted bus it changes ten times a second
(`restart-ms 100`); counters record each change."""

CONTROLLER_EVENTS: dict[ControllerState, tuple[str, str]] = {
    "bus_off": (
        "bus_off",
        "the CAN controller left the bus: check wiring, termination and bit rate; it returns after "
        "`restart-ms`, or by `ip link set {channel} type can restart`",
    ),
    "passive": ("error_passive", "the CAN controller is error passive: the bus is damaged"),
    "warning": ("error_warning", "the CAN controller counts many errors"),
    "active": ("error_active", "the CAN controller is error active again"),
}


class BusOptions(DriverOptions):
    """Bus and source of time."""

    interface: Interface = "socketcan"
    channel: str = "can0"
    timestamp: Literal["device", "kernel", "arrival"] | None = None
    """Source of the stamp. Default: device if its time is given, else kernel where the bus stamps,
    else arrival."""
    latency_s: NonNegativeFloat = 0.0
    """Delay from validity to the kernel's stamp or the arrival."""
    timeout_s: PositiveFloat = 0.5
    """Time without a sample after which the device is `silent`."""

    def stamp(self, realtime_ns: int | None) -> Stamp:
        """Stamp of a frame without a time of the device, from the bus."""
        if realtime_ns is not None and self.timestamp in (None, "kernel"):
            return KernelStamp(realtime_ns, self.latency_s)
        return ArrivalStamp(self.latency_s)


O = TypeVar("O", bound=BusOptions)  # noqa: E741


class Codec(Protocol):
    """Codec of frames into measurements; no I/O. It counts refusals in the given counters. Its
    constructor (name, options, counters) raises PermanentDriverError for options that it cannot
    serve."""

    @property
    def filters(self) -> list[CanFilter]:
        """Filters of the bus."""

    @property
    def device_restarts(self) -> int:
        """Number of restarts of the device's clock."""

    def take_missing(self) -> list[str]:
        """Wanted messages not received since the last call, such as "0x121 IMU_ACCEL"."""

    def reset(self) -> None:
        """Restart after a pause: later frames do not belong to earlier ones."""

    def feed(self, frame: CanFrame) -> Sequence[Measurement]:
        """Process one data frame and return the measurements that it completes. Never raises."""


class CanDriver(Generic[O]):
    """A device on a CAN bus. `counters`: those of `CanBus` and of its decoder.

    Events: `interface_down`, `interface_up`, `bus_off`, `error_passive`, `error_warning`,
    `error_active`, `device_restarted`.
    """

    Options: ClassVar[type[DriverOptions]]
    Decoder: ClassVar[Callable[..., Codec]]

    def __init__(self, name: str, options: O, emit: Emit, now_ns: Now = monotonic_ns) -> None:
        if options.interface == "udp_multicast" and importlib.util.find_spec("msgpack") is None:
            raise PermanentDriverError("interface udp_multicast needs the package msgpack")
        self.name = name
        self.options = options
        self.counters: Counter[str] = Counter()
        self.status = DriverStatus()
        self._emit = emit
        self.inputs = Inputs(now_ns)
        self.inputs.on("frame", lambda frame, t_ns: self.feed(frame))
        self.inputs.on("open", self._on_open)
        self.inputs.on("close", self._on_close)
        self.inputs.on("controller", self._on_controller)
        self.inputs.on("watch", self._on_watch)
        self._now_ns = self.inputs.now_ns
        self._decoder = self.Decoder(name, options, self.counters)
        # Other interfaces filter in Python, which the decoder does itself.
        filters = self._decoder.filters if options.interface == "socketcan" else ()
        self._bus = CanBus(
            options.interface, options.channel, filters, self.counters, now_ns=now_ns
        )
        self._up = False
        self._controller: ControllerState = "active"
        self._was_down = False
        self._restarts = 0
        self._sample_ns = 0
        self._reported_ns: dict[str, int] = {}

    async def run(self) -> None:
        """Serve the device until cancelled."""
        watch = asyncio.create_task(self._watch())
        try:
            take = self.inputs.take
            await self._bus.run(
                lambda frame: take("frame", frame, frame.t_seen_ns),
                lambda up, why: take("open") if up else take("close", why),
                lambda state: take("controller", state),
            )
        finally:
            watch.cancel()

    def poll_from_now_on(self) -> Callable[[], None]:
        """Return the function by which the caller reads the bus from now on; call before `run`."""
        self._bus.polled = True
        return self._bus.poll

    def feed(self, frame: CanFrame) -> None:
        """Process one data frame, from the bus or a log, and hand over the measurements that it
        completes."""
        measurements = self._decoder.feed(frame)
        if not measurements:
            return
        self._sample_ns = frame.t_seen_ns
        if self.status.state != "running":
            self.status.state, self.status.detail = "running", ""
        if self._decoder.device_restarts != self._restarts:
            self._restarts = self._decoder.device_restarts
            self._event("device_restarted", "The device restarted: its clock began again")
        for measurement in measurements:
            self._emit(measurement)

    def _on_open(self, _: None, t_ns: int) -> None:
        self._up = True
        self._sample_ns = t_ns
        self._controller = "active"
        self.status.state, self.status.detail = "silent", "open, nothing heard yet"
        if self._was_down:
            self._event("interface_up", f"{self.options.channel} is back")

    def _on_close(self, why: str, t_ns: int) -> None:
        self._up = False
        self._sample_ns = t_ns
        self._decoder.reset()
        self._was_down = True
        self.status.state, self.status.detail = "absent", why
        self._event("interface_down", why)

    def _on_controller(self, state: ControllerState, t_ns: int) -> None:
        self._controller = state
        code, text = CONTROLLER_EVENTS[state]
        text = text.format(channel=self.options.channel)
        if state == "bus_off":
            self.status.state, self.status.detail = "silent", text
        if t_ns - self._reported_ns.get(code, t_ns - EVENT_SPACING_NS) >= EVENT_SPACING_NS:
            self._reported_ns[code] = t_ns
            self._event(code, f"{self.options.channel}: {text}")

    async def _watch(self) -> None:
        """Set the state to `silent` when samples stop."""
        while True:
            await asyncio.sleep(self.options.timeout_s / 2)
            self.inputs.take("watch")

    def _on_watch(self, _: None, t_ns: int) -> None:
        missing = self._decoder.take_missing()
        quiet_s = (t_ns - self._sample_ns) * 1e-9
        if self._up and quiet_s >= self.options.timeout_s:
            if self._controller != "bus_off":
                self.status.state, self.status.detail = "silent", self._explain(missing)
            self._decoder.reset()

    def _explain(self, missing: list[str]) -> str:
        if not missing:
            return "frames arrive but make no samples: see the counters"
        detail = f"nothing heard of {', '.join(missing)}"
        packets = Path("/sys/class/net", self.options.channel, "statistics/rx_packets")
        if self.options.interface == "socketcan" and packets.is_file():
            detail += (
                f"; {self.options.channel} received {packets.read_text().strip()} frames so far"
            )
        return detail

    def _event(self, code: str, text: str) -> None:
        self._emit(DeviceEvent(self.name, self._now_ns(), code, text))
