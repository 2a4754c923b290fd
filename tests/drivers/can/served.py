"""A driver at work on a virtual bus, and frames for its codec without one."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable
from typing import Any

import can

from drivers.base import Emitted
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.bus import CanFrame
from drivers.measurements import DeviceEvent, Measurement
from tests.patience import until

SECOND = 1_000_000_000
Frames = Iterable[tuple[int, bytes]]


def fed(codec: Codec, frames: Frames, t_ns: int = 0, extended: bool = False) -> list[Measurement]:
    """What a codec makes of frames (identifier, data) that come at `t_ns`."""
    found = [codec.feed(CanFrame(can_id, extended, data, t_ns)) for can_id, data in frames]
    return [m for measurements in found for m in measurements]


class Served:
    """A driver and what it emits. Its clock stands still but for what a test adds."""

    def __init__(self, make: type[CanDriver[Any]], name: str, options: dict[str, Any]) -> None:
        self.now_ns = 7_000 * SECOND
        self.emitted: list[Emitted] = []
        self.channel = f"t-{name}"
        given = {**options, "interface": "virtual", "channel": self.channel}
        valid = make.Options.model_validate(given)
        self.driver = make(name, valid, self.emitted.append, lambda: self.now_ns)

    @property
    def codes(self) -> list[str]:
        return [e.code for e in self.emitted if isinstance(e, DeviceEvent)]

    @property
    def measurements(self) -> list[Emitted]:
        return [e for e in self.emitted if not isinstance(e, DeviceEvent)]

    @contextlib.asynccontextmanager
    async def run(self) -> AsyncIterator[can.BusABC]:
        """Serve it; the other end of its bus."""
        task = asyncio.create_task(self.driver.run())
        try:
            await until(lambda: self.driver.status.state != "starting")
            with can.Bus(interface="virtual", channel=self.channel, ignore_config=True) as bus:
                yield bus
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def sent(bus: can.BusABC, frames: Frames, extended: bool = False) -> None:
    """Put data frames on a bus."""
    for can_id, data in frames:
        bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=extended))
