"""Driver `obd_speed`: the vehicle's speed from its diagnostics, in whole km/h.

Service 01, parameter 0D (SAE J1979, ISO 15031-5): one byte, km/h, no sign. A request and its answer
are single frames of ISO 15765-2, by identifiers of ISO 15765-4, 6.3:

    11 bit   request to all 7DF        answers 7E8 to 7EF
    29 bit   request to all 18DB33F1   answers 18DAF1xx, xx the answering unit

    7DF  02 01 0D ..             service 01, parameter 0D
    7E8  03 41 0D 32 ..          50 km/h
    7E8  03 7F 01 12 ..          refused

The driver sends requests of its own, or only listens to the replies that another tester requests.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Annotated, ClassVar, Literal

from can.typechecking import CanFilter
from pydantic import Field, NonNegativeFloat, PositiveFloat

from drivers.base import DriverOptions
from drivers.can.base_driver import BusOptions, CanDriver, Codec
from drivers.can.bus import CanFrame
from drivers.measurements import Measurement, WheelSpeed
from drivers.quantization import Rounding, rounded_speed

REQUESTS: dict[int, tuple[int, bool]] = {11: (0x7DF, False), 29: (0x18DB_33F1, True)}
"""Identifier of a request to every unit, and True for one of 29 bits."""
REPLY_FILTERS: dict[int, CanFilter] = {
    11: {"can_id": 0x7E8, "can_mask": 0x7F8, "extended": False},
    29: {"can_id": 0x18DA_F100, "can_mask": 0x1FFF_FF00, "extended": True},
}
PADDING = 0x55
"""Unused bytes, as in the examples of ISO 15765-4: all frames have eight."""
SERVICE, SPEED = 0x01, 0x0D
ANSWERED, REFUSED = 0x40, 0x7F
STEP_M_S = 1.0 / 3.6
LENGTHS = (
    dict.fromkeys(range(0x20), 1)
    | dict.fromkeys((0x02, 0x03, 0x0C, 0x10, *range(0x14, 0x1C), 0x1F), 2)
    | dict.fromkeys((0x00, 0x01), 4)
)
"""Bytes of the parameters up to 1F, several of which may share a reply (SAE J1979, annex B)."""
MOST_RATE_HZ = 20.0
"""Highest request rate: a unit has 50 ms for its reply (P2 of ISO 15765-4)."""


class ObdSpeedOptions(BusOptions):
    """Options of the OBD speed: bus, identifiers, and requests."""

    identifiers: Literal[11, 29] = 11
    """Number of bits of the vehicle's identifiers."""
    unit: Annotated[int, Field(ge=0, le=255)] | None = None
    """Identifier of the unit that counts: the last digits of its identifier, 0xE8 for 7E8 or xx of
    18DAF1xx. Without it the first that answers, until it falls silent."""
    ask_hz: Annotated[float, Field(ge=0.0, le=MOST_RATE_HZ)] = 0.0
    """Request interval; 0 only listens to the answers that another tester gets."""
    rounding: Rounding = "unknown"
    """Rounding of the vehicle to whole km/h: no standard says, and the data sheet seldom."""
    accuracy_m_s: NonNegativeFloat = 0.0
    """One sigma of the speed beside the rounding, where known."""
    timeout_s: PositiveFloat = 3.0


def request(identifiers: int) -> CanFrame:
    """The frame that asks every unit for the speed."""
    can_id, extended = REQUESTS[identifiers]
    data = bytes([2, SERVICE, SPEED]).ljust(8, bytes([PADDING]))
    return CanFrame(can_id, extended, data, 0)


class ObdSpeedDecoder:
    """Decoder of OBD replies into speeds; no I/O.

    `counters`: `samples`, `other_frames` (no answer to a tester), `other_unit`, `other_answers` (of
    another service or parameter), `refused` (a unit that does not know the speed), `several_frames`
    (an answer longer than a frame, which is not put together), `undecodable`.
    """

    def __init__(
        self, name: str, options: ObdSpeedOptions, counters: Counter[str] | None = None
    ) -> None:
        self.name = name
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._options = options
        self._filter = REPLY_FILTERS[options.identifiers]
        self._unit = options.unit
        self._seen = False

    @property
    def filters(self) -> list[CanFilter]:
        return [self._filter]

    @property
    def device_restarts(self) -> int:
        return 0  # it has no clock

    def take_missing(self) -> list[str]:
        seen, self._seen = self._seen, False
        if seen:
            return []
        wanted = self._filter["can_id"]
        return [f"answers to a tester (0x{wanted:X} and its neighbours)"]

    def reset(self) -> None:
        self._unit = self._options.unit

    def feed(self, frame: CanFrame) -> Sequence[Measurement]:
        wanted = self._filter
        ours = frame.can_id & wanted["can_mask"] == wanted["can_id"]
        if not ours or frame.extended != wanted["extended"]:
            self.counters["other_frames"] += 1
            return ()
        self._seen = True
        value_km_h = self._speed(frame.data)
        if isinstance(value_km_h, str):
            self.counters[value_km_h] += 1
            return ()
        unit = frame.can_id & 0xFF
        if self._unit is None:
            self._unit = unit
        if unit != self._unit:
            self.counters["other_unit"] += 1
            return ()
        self.counters["samples"] += 1
        o = self._options
        r = rounded_speed(value_km_h * STEP_M_S, STEP_M_S, o.rounding)
        return (
            WheelSpeed(
                self.name,
                frame.t_seen_ns,
                o.stamp(frame.realtime_ns),
                r.mean_m_s,
                sd_m_s=o.accuracy_m_s or None,
                rounding_sd_m_s=r.sd_m_s,
                signed=r.mean_m_s == 0.0,
                shared_step_m_s=r.shared_step_m_s,
            ),
        )

    @staticmethod
    def _speed(data: bytes) -> int | str:
        """Speed in km/h from a reply, or the counter of the refusal."""
        if not data:
            return "undecodable"
        kind, length = data[0] >> 4, data[0] & 0x0F
        if kind in (1, 2):
            return "several_frames"
        payload = data[1 : 1 + length]
        if kind != 0 or length < 2 or len(payload) < length:
            return "undecodable"
        if payload[0] == REFUSED:
            return "refused" if payload[1] == SERVICE else "other_answers"
        if payload[0] != ANSWERED + SERVICE:
            return "other_answers"
        at = 1
        while at < length:
            pid = payload[at]
            if pid not in LENGTHS:
                return "other_answers"
            if at + LENGTHS[pid] >= length:
                return "undecodable"
            if pid == SPEED:
                return payload[at + 1]
            at += 1 + LENGTHS[pid]
        return "other_answers"


class ObdSpeedDriver(CanDriver[ObdSpeedOptions]):
    """A vehicle's diagnostics. `counters`: also `asked`, `not_sent` (the bus took no request)."""

    Options: ClassVar[type[DriverOptions]] = ObdSpeedOptions
    Decoder: ClassVar[Callable[..., Codec]] = ObdSpeedDecoder

    async def run(self) -> None:
        """Serve the device until cancelled, with requests if configured."""
        if not self.options.ask_hz:
            await super().run()
            return
        asking = asyncio.create_task(self._ask())
        try:
            await super().run()
        finally:
            asking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await asking

    async def _ask(self) -> None:
        frame = request(self.options.identifiers)
        while True:
            if self._up:
                self.inputs.sent(frame.data)
                sent = self._bus.send(frame)
                self.counters["asked" if sent else "not_sent"] += 1
            await asyncio.sleep(1.0 / self.options.ask_hz)
