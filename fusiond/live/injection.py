"""Injected faults: `cmd/inject` falsifies a source's data and reports it.

Injection stands between drivers and clock, so all later parts treat the fault like a real one. Its
effect depends only on command and input: a replay of both reproduces it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.base import Emitted
from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    DeviceEvent,
    Heading,
    Height,
    ImuSample,
    MagneticHeading,
    PositionFix,
    TimeReport,
    WheelSpeed,
)
from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    RawGnssEpoch,
    SignalDelays,
)
from drivers.rdss.mail import FleetFix, Mail, MessageReceived, MessageStage
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.outputs.commands import Inject

SECOND_NS = 1_000_000_000
MOST_HELD = 100_000
"""Measurements that a delay may hold back: a minute of an IMU of 1 kHz. The oldest are let go."""
_VALUES = {
    ImuSample: ("gyro_rad_s", "accel_m_s2"),
    PositionFix: ("lat_rad", "lon_rad", "height_m", "v_ned_m_s"),
    DelayedFix: ("lat_rad", "lon_rad", "height_m"),
    Attitude: ("rpy_rad",),
    Bearing: ("azimuth_rad", "elevation_rad"),
    Heading: ("yaw_rad",),
    Height: ("height_m",),
    WheelSpeed: ("speed_m_s",),
}
"""Fields that a fault may alter; all else of it is its stamp or how good it claims to be."""


class Injection:
    """Active faults by source. `on_event(source, code, text)` receives `injected` and
    `injection_ended`."""

    def __init__(self, on_event: Callable[[str, str, str], None]) -> None:
        self._on_event = on_event
        self.faults: dict[str, Fault] = {}
        """Active faults by source."""

    def inject(self, command: Inject, t_ns: int) -> str:
        """Start a fault at `t_ns` in place of the source's earlier one; return its description."""
        self.faults[command.source] = Fault(command, t_ns)
        self._on_event(command.source, "injected", _description(command))
        return f"{command.source}: {_description(command)}"

    @property
    def active(self) -> tuple[str, ...]:
        """Descriptions of the active faults."""
        return tuple(
            f"{n}: {_description(f.command)}" for n, f in self.faults.items() if not f.over
        )

    def pass_on(self, item: Emitted) -> Iterator[Emitted]:
        """Pass on an item as the source's fault leaves it: unchanged, falsified, or not at all."""
        fault = self.faults.get(item.source)
        if fault is None or fault.over or isinstance(item, DeviceEvent | Mail):
            yield item
        else:
            yield from fault.pass_on(item)

    def tick(self, t_ns: int) -> Iterator[Emitted]:
        """Release delayed items that are due at `t_ns`, and end faults whose time is over."""
        for source, fault in tuple(self.faults.items()):
            yield from fault.due(t_ns)
            if not fault.over and t_ns >= fault.end_ns:
                fault.over = True
                self._on_event(source, "injection_ended", _description(fault.command))
            if fault.over and not fault.held:
                del self.faults[source]


class Fault:
    """Injected fault that is active, or still holds delayed measurements."""

    def __init__(self, command: Inject, t_ns: int) -> None:
        self.command = command
        self.start_ns = t_ns
        self.end_ns = t_ns + round(command.duration_s * SECOND_NS)
        self.over = False
        self.held: list[tuple[int, Emitted]] = []
        # The seed is the command's instant, which is recorded: a replay makes the same noise.
        self._random = np.random.default_rng(t_ns)
        self._frozen: dict[type, dict[str, Any]] = {}

    def pass_on(self, item: Emitted) -> Iterator[Emitted]:
        match self.command.fault:
            case "drop":
                return
            case "delay":
                assert not isinstance(item, NavigationMessage | DeviceEvent | Mail)
                delay_ns = round(self.command.size * SECOND_NS)
                self.held.append((item.t_seen_ns + delay_ns, item))
                if len(self.held) > MOST_HELD:
                    yield self.held.pop(0)[1]
            case "freeze":
                yield self._freeze(item)
            case _:
                yield self._off(item)

    def due(self, t_ns: int) -> Iterator[Emitted]:
        while self.held and (self.held[0][0] <= t_ns):
            item = self.held.pop(0)[1]
            yield replace(item, t_seen_ns=t_ns)

    def _freeze(self, item: Emitted) -> Emitted:
        names = _VALUES.get(type(item))
        if names is None:
            return item
        values = self._frozen.setdefault(type(item), {n: getattr(item, n) for n in names})
        return replace(item, **values)

    def _error(self, t_seen_ns: int) -> float:
        size = self.command.size
        if self.command.fault == "drift":
            return size * (t_seen_ns - self.start_ns) / SECOND_NS
        if self.command.fault == "noise":
            return size * float(self._random.standard_normal())
        return size

    def _off(self, item: Emitted) -> Emitted:
        """Item with the error of `jump`, `drift` or `noise` added."""
        c = self.command
        match item:
            case ImuSample():
                error = self._error(item.t_seen_ns)
                if c.part == "gyro":
                    return replace(item, gyro_rad_s=_plus(item.gyro_rad_s, c, math.radians(error)))
                return replace(item, accel_m_s2=_plus(item.accel_m_s2, c, error))
            case PositionFix() | DelayedFix():
                # Noise has no direction: both axes get it.
                towards = math.radians(c.direction_deg)
                error = self._error(item.t_seen_ns)
                north, east = error * math.cos(towards), error * math.sin(towards)
                if c.fault == "noise":
                    north, east = error, self._error(item.t_seen_ns)
                height = item.height_m or 0.0
                lat = item.lat_rad + north / (meridian_radius(item.lat_rad) + height)
                radius = (transverse_radius(item.lat_rad) + height) * math.cos(item.lat_rad)
                return replace(item, lat_rad=lat, lon_rad=item.lon_rad + east / radius)
            case Height():
                return replace(item, height_m=item.height_m + self._error(item.t_seen_ns))
            case WheelSpeed():
                return replace(item, speed_m_s=item.speed_m_s + self._error(item.t_seen_ns))
            case Heading() | MagneticHeading():
                error = math.radians(self._error(item.t_seen_ns))
                return replace(item, yaw_rad=item.yaw_rad + error)
            case Attitude():
                error = math.radians(self._error(item.t_seen_ns))
                roll, pitch, yaw = item.rpy_rad
                return replace(item, rpy_rad=(roll, pitch, yaw + error))
            case Bearing():
                error = math.radians(self._error(item.t_seen_ns))
                return replace(item, azimuth_rad=item.azimuth_rad + error)
            case RawGnssEpoch() | TimeReport() | DeviceEvent():
                return item
            case Ephemeris() | Klobuchar() | Bdgim() | SignalDelays() | Correction():
                return item
            case MessageReceived() | MessageStage() | FleetFix():
                return item


def _plus(
    vector: tuple[float, float, float], command: Inject, error: float
) -> tuple[float, float, float]:
    x, y, z = vector
    match command.axis:
        case "x":
            return x + error, y, z
        case "y":
            return x, y + error, z
        case "z":
            return x, y, z + error


def _description(c: Inject) -> str:
    """Describe a fault in words."""
    size = f" {c.size:g}" if c.fault in ("delay", "jump", "drift", "noise") else ""
    return f"{c.fault}{size} for {c.duration_s:g} s"
