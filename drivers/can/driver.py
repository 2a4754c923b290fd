"""What every driver of a device on a CAN bus has: a DBC file, a bus, stamps, pairing, events.

A driver adds its options (which signals it takes), how it plans them, and the measurement that a
complete set of values makes: see `drivers.can.imu` and `drivers.can.aids`. Each driver opens
the bus for itself, so several share one channel; the kernel gives each the frames it filters for.
"""

from __future__ import annotations

import asyncio
import importlib.util
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

from cantools.database.can.signal import Signal
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from drivers.base import (
    DriverOptions,
    DriverStatus,
    Emit,
    Now,
    PermanentDriverError,
    monotonic_ns,
)
from drivers.can.bus import CanBus, CanFilter, CanFrame, Interface
from drivers.can.dbc import (
    MessagePlan,
    RefusedFrameError,
    find_signal,
    load_dbc,
    parameter_group,
    plan_counter,
    plan_time,
)
from drivers.can.errors import ControllerState
from drivers.can.pairing import Group, Pairing
from drivers.measurements import (
    ArrivalStamp,
    DeviceEvent,
    DeviceStamp,
    KernelStamp,
    Measurement,
    Stamp,
)

EVENT_SPACING_NS = 10_000_000_000
"""The same state of the controller is told once in 10 s: on a shorted bus it changes ten times a
second (`restart-ms 100`); the counters keep account."""

Signals = tuple[str, ...]
Find = Callable[[str, str], tuple[MessagePlan, Signal]]
"""From "Message.Signal" and what it is for to the message's plan and the signal."""

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


class CanOptions(DriverOptions):
    """Which bus, which DBC, and what gives the time."""

    interface: Interface = "socketcan"
    channel: str = "can0"
    dbc: str
    """Path of a DBC file, or the name of a shipped one such as "sbg_ellipse"."""
    counter: str | Signals = ()
    """Counter of samples, plus one a sample; one a message where several messages carry it."""
    device_time: str | Signals = ()
    """The device's free-running time; unit and scale by the DBC."""
    timestamp: Literal["device", "kernel", "arrival"] | None = None
    """Default: device if `device_time` is given, else kernel where the bus stamps, else arrival."""
    latency_s: NonNegativeFloat = 0.0
    """From the instant of validity to the kernel's stamp or the arrival."""
    source_address: Annotated[int, Field(ge=0, le=253)] | None = None
    """SAE J1939 address of the device; without it the first that answers is taken."""
    timeout_s: PositiveFloat = 0.5
    """Without a sample for so long the device is `silent`."""

    @model_validator(mode="after")
    def _device_time_given(self) -> CanOptions:
        if self.timestamp == "device" and not self.device_time:
            raise ValueError("timestamp = 'device' needs device_time")
        return self


O = TypeVar("O", bound=CanOptions)  # noqa: E741


class CanDecoder(ABC, Generic[O]):
    """CAN frames in, measurements out; no I/O.

    PermanentDriverError from the constructor when DBC and mapping do not fit. `counters`: those of
    `Pairing`, the refusals of `MessagePlan.decode`, `samples`, `other_frames` (not mapped) and
    `other_source` (mapped message of another J1939 address).
    """

    def __init__(self, name: str, options: O, counters: Counter[str] | None = None) -> None:
        self.name = name
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._options = options
        plans, constants = self._plan()
        self.plans = plans
        self._pairing = Pairing(plans, constants, self.counters)
        self._by_id: dict[tuple[int, bool], int] = {}
        self._by_pgn: dict[int, int] = {}
        for index, plan in enumerate(plans):
            message = plan.message
            if self._is_j1939(plan):
                self._by_pgn[parameter_group(message.frame_id)] = index
            else:
                self._by_id[message.frame_id, message.is_extended_frame] = index
        self._address = options.source_address
        self._seen: set[int] = set()

    @property
    def device_restarts(self) -> int:
        """How often the device's clock began anew."""
        time = self._pairing.device_time
        return time.restarts if time is not None else 0

    @property
    def filters(self) -> list[CanFilter]:
        """What the bus must let through."""
        filters: list[CanFilter] = []
        for plan in self.plans:
            frame_id, extended = plan.message.frame_id, plan.message.is_extended_frame
            mask = 0x1FFF_FFFF if extended else 0x7FF
            if self._is_j1939(plan):
                group = parameter_group(frame_id)
                mask = 0x03FF_FF00 if group & 0xFF or group >> 8 & 0xFF >= 240 else 0x03FF_0000
                frame_id = group << 8
                if self._options.source_address is not None:
                    frame_id, mask = frame_id | self._options.source_address, mask | 0xFF
            filters.append({"can_id": frame_id, "can_mask": mask, "extended": extended})
        return filters

    def take_missing(self) -> list[str]:
        """Mapped messages not received since this was asked last, such as "0x121 IMU_ACCEL"."""
        seen, self._seen = self._seen, set()
        return [
            f"0x{plan.message.frame_id:X} {plan.message.name}"
            for index, plan in enumerate(self.plans)
            if index not in seen
        ]

    def reset(self) -> None:
        """After a pause: start pairing afresh, take the first J1939 address that answers."""
        self._pairing.reset()
        self._address = self._options.source_address

    def feed(
        self,
        can_id: int,
        extended: bool,
        data: bytes,
        t_seen_ns: int,
        realtime_ns: int | None = None,
    ) -> Measurement | None:
        """Take one data frame; the sample that it completes, if any. Never raises."""
        index = self._by_id.get((can_id, extended))
        if index is None and extended and self._by_pgn:
            index = self._by_pgn.get(parameter_group(can_id))
            if index is not None and not self._from_our_device(can_id & 0xFF):
                self.counters["other_source"] += 1
                return None
        if index is None:
            self.counters["other_frames"] += 1
            return None
        self._seen.add(index)
        try:
            part = self.plans[index].decode(data)
        except RefusedFrameError as refused:
            self.counters[str(refused)] += 1
            return None
        group = self._pairing.feed(index, part, data, t_seen_ns, realtime_ns)
        if group is None:
            return None
        self.counters["samples"] += 1
        return self._measurement(group.values, group.t_seen_ns, self._stamp(group))

    def _from_our_device(self, address: int) -> bool:
        if self._address is None:
            self._address = address
        return address == self._address

    def _stamp(self, group: Group) -> Stamp:
        options = self._options
        if group.ticks_ns is not None and options.timestamp in (None, "device"):
            restarts = self.device_restarts
            clock = self.name if restarts == 0 else f"{self.name}/{restarts}"
            return DeviceStamp(clock, group.ticks_ns)
        if group.realtime_ns is not None and options.timestamp in (None, "kernel"):
            return KernelStamp(group.realtime_ns, options.latency_s)
        return ArrivalStamp(options.latency_s)

    def _is_j1939(self, plan: MessagePlan) -> bool:
        """By the DBC's VFrameFormat, or because the configuration names a source address."""
        message = plan.message
        named = self._options.source_address is not None
        return message.is_extended_frame and (message.protocol == "j1939" or named)

    def _plan(self) -> tuple[list[MessagePlan], list[float]]:
        """The plan of each message, and the values (by slot) of what no signal gives."""
        options = self._options
        database = load_dbc(options.dbc)
        plans: dict[str, MessagePlan] = {}

        def find(name: str, what: str) -> tuple[MessagePlan, Any]:
            message, signal = find_signal(database, name, what)
            return plans.setdefault(message.name, MessagePlan(message)), signal

        constants = self._plan_values(find)
        for name in _names(options.counter):
            plan, signal = find(name, "counter")
            plan.counter = plan_counter(signal)
        for name in _names(options.device_time):
            plan, signal = find(name, "device_time")
            plan.time = plan_time(signal)
        return list(plans.values()), constants

    @abstractmethod
    def _plan_values(self, find: Find) -> list[float]:
        """Add the mapped signals to the plans that `find` gives; the constants by slot."""

    @abstractmethod
    def _measurement(self, values: list[float], t_seen_ns: int, stamp: Stamp) -> Measurement | None:
        """What a complete set of values (by slot) says; None, counted, where it says nothing."""


def _names(signals: str | Signals) -> Signals:
    return (signals,) if isinstance(signals, str) else signals


class CanDriver(Generic[O]):
    """A device on a CAN bus. `counters`: those of `CanBus` and of its decoder.

    Events: `interface_down`, `interface_up`, `bus_off`, `error_passive`, `error_warning`,
    `error_active`, `device_restarted`.
    """

    Options: ClassVar[type[DriverOptions]]
    Decoder: ClassVar[type[CanDecoder[Any]]]

    def __init__(self, name: str, options: O, emit: Emit, now_ns: Now = monotonic_ns) -> None:
        if options.interface == "udp_multicast" and importlib.util.find_spec("msgpack") is None:
            raise PermanentDriverError("interface udp_multicast needs the package msgpack")
        self.name = name
        self.options = options
        self.counters: Counter[str] = Counter()
        self.status = DriverStatus()
        self._emit = emit
        self._now_ns = now_ns
        self._decoder = self.Decoder(name, options, self.counters)
        # The other interfaces filter in Python, which the decoder does anyhow.
        filters = self._decoder.filters if options.interface == "socketcan" else ()
        self._bus = CanBus(
            options.interface, options.channel, filters, self.counters, now_ns=now_ns
        )
        self._up = False
        self._was_down = False
        self._restarts = 0
        self._sample_ns = 0
        self._told_ns: dict[str, int] = {}

    async def run(self) -> None:
        """Serve the device until cancelled."""
        watch = asyncio.create_task(self._watch())
        try:
            await self._bus.run(self._on_frame, self._on_link, self._on_controller)
        finally:
            watch.cancel()

    def _on_frame(self, frame: CanFrame) -> None:
        sample = self._decoder.feed(
            frame.can_id, frame.extended, frame.data, frame.t_seen_ns, frame.realtime_ns
        )
        if sample is None:
            return
        self._sample_ns = frame.t_seen_ns
        if self.status.state != "running":
            self.status.state, self.status.detail = "running", ""
        if self._decoder.device_restarts != self._restarts:
            self._restarts = self._decoder.device_restarts
            self._event("device_restarted", "the device's clock began anew: it was restarted")
        self._emit(sample)

    def _on_link(self, up: bool, why: str) -> None:
        self._up = up
        self._sample_ns = self._now_ns()
        if up:
            self.status.state, self.status.detail = "silent", "open, nothing heard yet"
            if self._was_down:
                self._event("interface_up", f"{self.options.channel} is back")
            return
        self._decoder.reset()
        self._was_down = True
        self.status.state, self.status.detail = "absent", why
        self._event("interface_down", why)

    def _on_controller(self, state: ControllerState) -> None:
        code, text = CONTROLLER_EVENTS[state]
        text = text.format(channel=self.options.channel)
        if state == "bus_off":
            self.status.state, self.status.detail = "silent", text
        now_ns = self._now_ns()
        if now_ns - self._told_ns.get(code, now_ns - EVENT_SPACING_NS) >= EVENT_SPACING_NS:
            self._told_ns[code] = now_ns
            self._event(code, f"{self.options.channel}: {text}")

    async def _watch(self) -> None:
        """Say `silent` when samples stop."""
        while True:
            await asyncio.sleep(self.options.timeout_s / 2)
            missing = self._decoder.take_missing()
            quiet_s = (self._now_ns() - self._sample_ns) * 1e-9
            if self._up and quiet_s >= self.options.timeout_s:
                if self._bus.controller != "bus_off":
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
