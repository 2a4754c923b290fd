"""Interface of a driver: a name, options, counters, a state, and one coroutine.

A driver runs until it is cancelled. It opens its device, reopens it with growing waits when it
disappears, and hands over measurements and events by calling `emit`. Nothing that a device does
makes it raise. A fault that no retry can repair, such as a missing DBC file, raises
`PermanentDriverError` in the constructor.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

from pydantic import BaseModel, ConfigDict

from drivers.measurements import DeviceEvent, Measurement
from drivers.raw.messages import RawEvent
from drivers.rdss.mail import Mail

Emitted = Measurement | RawEvent | DeviceEvent | Mail
"""Types that a driver may emit. A `NavigationMessage` has no stamp: it contains its own validity.
"""
Emit = Callable[[Emitted], None]
Now = Callable[[], int]

State = Literal["starting", "absent", "silent", "running", "failed"]


class DriverError(Exception):
    """Transient fault of a device or line, after which the driver retries."""


class PermanentDriverError(DriverError):
    """Fault that no retry can repair: the configuration or the installation must change."""


class DriverOptions(BaseModel):
    """Base of every driver's options: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(slots=True)
class DriverStatus:
    """State of a device for `health`, with the reason in one sentence.

    `starting` not yet tried; `absent` the port or bus cannot be opened; `silent` open but nothing
    intelligible for the driver's time-out; `running`; `failed` permanently.
    """

    state: State = "starting"
    detail: str = ""


def state_event(source: str, t_ns: int, port: str, status: DriverStatus) -> DeviceEvent:
    """Event of a serial line's new state: `device_absent`, `device_silent` or `device_running`."""
    said = status.detail or status.state
    text = said if port in said else f"{port}: {said}"
    return DeviceEvent(source, t_ns, f"device_{status.state}", text)


class Driver(Protocol):
    """Driver of a device. `counters` holds every received, refused and damaged item by name."""

    Options: ClassVar[type[DriverOptions]]
    name: str
    counters: Counter[str]
    status: DriverStatus

    async def run(self) -> None:
        """Serve the device until cancelled."""


@dataclass(slots=True)
class Backoff:
    """Waits between attempts to reopen a device, doubling from `first_s` up to `longest_s`."""

    first_s: float = 0.25
    longest_s: float = 5.0
    _next_s: float = 0.0

    def next(self) -> float:
        """Next wait, s."""
        self._next_s = min(self.longest_s, self._next_s * 2 or self.first_s)
        return self._next_s

    def reset(self) -> None:
        """Return to the first wait, after a success."""
        self._next_s = 0.0


def monotonic_ns() -> int:
    """Host's monotonic clock (ns): CLOCK_MONOTONIC_RAW, which is neither stepped nor slewed.

    adjtimex(2) slews CLOCK_MONOTONIC together with the system clock, by up to 10 %.
    """
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
