"""Codec of devices that a DBC file describes: frames to measurements; no I/O.

A driver adds the options that name its signals, their plans, and the measurements of a complete set
of values: see `drivers.can.imu` or `drivers.can.wheel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any, Generic, Protocol, TypeVar

from can.typechecking import CanFilter
from cantools.database.can.signal import Signal
from pydantic import Field, model_validator

from drivers.can.base_driver import BusOptions
from drivers.can.bus import CanFrame
from drivers.can.dbc import (
    MessagePlan,
    RefusedFrameError,
    find_signal,
    load_dbc,
    parameter_group,
    plan_counter,
    plan_number,
    plan_time,
)
from drivers.can.pairing import Group, Pairing
from drivers.measurements import DeviceStamp, Measurement, Stamp

Signals = tuple[str, ...]


class Find(Protocol):
    """Function from "Message.Signal" and its purpose to the message's plan and the signal.

    The frames of all messages are combined into one set. Messages of which only `held` values are
    used may come at another rate: their latest value is used.
    """

    def __call__(self, name: str, what: str, held: bool = False) -> tuple[MessagePlan, Signal]: ...


class CanOptions(BusOptions):
    """Bus, DBC and source of time."""

    dbc: str
    """Path of a DBC file, or the name of a shipped one such as "sbg_ellipse"."""
    counter: str | Signals = ()
    """Counter of samples, plus one a sample; one a message where several messages carry it."""
    device_time: str | Signals = ()
    """The device's free-running time; unit and scale by the DBC."""
    source_address: Annotated[int, Field(ge=0, le=253)] | None = None
    """SAE J1939 address of the device; without it the first that answers is taken."""

    @model_validator(mode="after")
    def _device_time_given(self) -> CanOptions:
        if self.timestamp == "device" and not self.device_time:
            raise ValueError("timestamp = 'device' needs device_time")
        return self


O = TypeVar("O", bound=CanOptions)  # noqa: E741

HELD_NS = 1_000_000_000
"""Lifetime of a held value: gears and directions are sent at 1 Hz or faster, and in less than a
second no vehicle stops and drives the other way."""


class CanDecoder(ABC, Generic[O]):
    """Decoder of CAN frames into measurements; no I/O.

    The constructor raises PermanentDriverError if DBC and mapping do not match. `counters`: those
    of `Pairing`, the refusals of `MessagePlan.decode`, `samples`, `other_frames` (not mapped) and
    `other_source` (mapped message of another J1939 address).
    """

    def __init__(self, name: str, options: O, counters: Counter[str] | None = None) -> None:
        self.name = name
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._options = options
        plans, constants = self._plan()
        self.plans = plans
        """Plans of the messages that form a sample, then of those with held values."""
        paired = [plan for plan in plans if plan.paired]
        self._pairing = Pairing(paired, constants, self.counters)
        self._held: list[tuple[int, list[tuple[int, float]]] | None]
        self._held = [None] * (len(plans) - len(paired))
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
        """Number of restarts of the device's clock."""
        time = self._pairing.device_time
        return time.restarts if time is not None else 0

    @property
    def filters(self) -> list[CanFilter]:
        """Filters of the bus."""
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
        """Mapped messages not received since the last call, such as "0x121 IMU_ACCEL"."""
        seen, self._seen = self._seen, set()
        return [
            f"0x{plan.message.frame_id:X} {plan.message.name}"
            for index, plan in enumerate(self.plans)
            if index not in seen
        ]

    def reset(self) -> None:
        """Restart pairing after a pause, and accept the first J1939 address that replies."""
        self._pairing.reset()
        self._held = [None] * len(self._held)
        self._address = self._options.source_address

    def feed(self, frame: CanFrame) -> Sequence[Measurement]:
        """Process one data frame and return the measurements that it completes. Never raises."""
        can_id = frame.can_id
        index = self._by_id.get((can_id, frame.extended))
        if index is None and frame.extended and self._by_pgn:
            index = self._by_pgn.get(parameter_group(can_id))
            if index is not None and not self._from_our_device(can_id & 0xFF):
                self.counters["other_source"] += 1
                return ()
        if index is None:
            self.counters["other_frames"] += 1
            return ()
        self._seen.add(index)
        try:
            part = self.plans[index].decode(frame.data)
        except RefusedFrameError as refused:
            self.counters[str(refused)] += 1
            return ()
        arrival_ns = frame.t_seen_ns if frame.realtime_ns is None else frame.realtime_ns
        if not self.plans[index].paired:
            self._held[index - len(self.plans)] = arrival_ns, part.values
            return ()
        group = self._pairing.feed(index, part, frame.data, frame.t_seen_ns, frame.realtime_ns)
        if group is None:
            return ()
        self.counters["samples"] += 1
        for held in self._held:
            if held is not None and abs(arrival_ns - held[0]) <= HELD_NS:
                for slot, value in held[1]:
                    group.values[slot] = value
        return self._measurements(group.values, group.t_seen_ns, self._stamp(group))

    def _from_our_device(self, address: int) -> bool:
        if self._address is None:
            self._address = address
        return address == self._address

    def _stamp(self, group: Group) -> Stamp:
        if group.ticks_ns is not None and self._options.timestamp in (None, "device"):
            restarts = self.device_restarts
            clock = self.name if restarts == 0 else f"{self.name}/{restarts}"
            return DeviceStamp(clock, group.ticks_ns)
        return self._options.stamp(group.realtime_ns)

    def _is_j1939(self, plan: MessagePlan) -> bool:
        """True for J1939, by the DBC's VFrameFormat or a configured source address."""
        message = plan.message
        named = self._options.source_address is not None
        return message.is_extended_frame and (message.protocol == "j1939" or named)

    def _plan(self) -> tuple[list[MessagePlan], list[float]]:
        """Plan of each message, and the constant values (by slot) without a signal."""
        options = self._options
        database = load_dbc(options.dbc)
        plans: dict[str, MessagePlan] = {}

        def find(name: str, what: str, held: bool = False) -> tuple[MessagePlan, Any]:
            message, signal = find_signal(database, name, what)
            plan = plans.setdefault(message.name, MessagePlan(message))
            plan.paired |= not held
            return plan, signal

        constants = self._plan_values(find)
        for name in names_of(options.counter):
            plan, signal = find(name, "counter")
            plan.counter = plan_counter(signal)
        for name in names_of(options.device_time):
            plan, signal = find(name, "device_time")
            plan.time = plan_time(signal)
        return sorted(plans.values(), key=lambda plan: not plan.paired), constants

    @abstractmethod
    def _plan_values(self, find: Find) -> list[float]:
        """Add the mapped signals to the plans that `find` gives; the constants by slot."""

    @abstractmethod
    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[Measurement]:
        """Measurements of a complete set of values (by slot); a set without any is counted."""


def names_of(signals: str | Signals | None) -> Signals:
    """Names in an option with one signal, several or none."""
    if signals is None:
        return ()
    return (signals,) if isinstance(signals, str) else signals


def plan_flags(
    find: Find, first: int, what: str, signals: str | Signals, held: bool = False
) -> list[float]:
    """Plan the flags in slots from `first` on. Their values before any is received are 0, not
    valid; without flags everything is valid."""
    names = names_of(signals)
    for slot, name in enumerate(names, start=first):
        plan, signal = find(name, what, held)
        plan.axes.append(plan_number(slot, signal, what))
    return [0.0] * len(names)
