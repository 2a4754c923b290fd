"""Encoder of a device's values as the frames of a DBC file.

The encoder uses the plan of the decoder that will read the frames, so that it can simulate any
device of a configuration. A value is rounded to the signal's resolution and saturates at its range,
as in a device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cantools.database.can import Message
from cantools.database.can.signal import Signal

from drivers.can.decoder import CanDecoder
from drivers.can.python_can_import import can


class CanEncoder:
    """Encoder, the inverse of `decoder`; no bus and no clock."""

    def __init__(self, decoder: CanDecoder[Any], source_address: int | None = None) -> None:
        # The bus carries the lowest identifier first.
        self._plans = sorted(decoder.plans, key=lambda plan: plan.message.frame_id)
        self._source_address = source_address

    def frames(self, number: int, t_ns: int, values: Sequence[float]) -> list[can.Message]:
        """Frames of sample `number`, valid at `t_ns` of the device's clock; SI values by slot."""
        frames = []
        for plan in self._plans:
            message: Message = plan.message
            signals = {signal.name: signal for signal in message.signals}
            raw: dict[str, int | float] = dict.fromkeys(signals, 0)
            for axis in plan.axes:
                count = (values[axis.slot] - axis.offset) / axis.scale
                raw[axis.signal] = _in_range(signals[axis.signal], count)
            if plan.counter is not None:
                raw[plan.counter.signal] = number % plan.counter.modulus
            if plan.time is not None:
                raw[plan.time.signal] = int(t_ns / plan.time.tick_ns) % plan.time.modulus
            frames.append(
                can.Message(
                    arbitration_id=self._identifier(message),
                    is_extended_id=message.is_extended_frame,
                    data=message.encode(raw, scaling=False, strict=False),
                )
            )
        return frames

    def _identifier(self, message: Message) -> int:
        if self._source_address is None:
            return int(message.frame_id)
        return int(message.frame_id) & ~0xFF | self._source_address


def _in_range(signal: Signal, count: float) -> int | float:
    """Round and saturate a value; a float signal is unlimited."""
    if signal.is_float:
        return count
    low, high = 0, (1 << signal.length) - 1
    if signal.is_signed:
        low, high = -(high + 1 >> 1), high >> 1
    return min(max(round(count), low), high)
