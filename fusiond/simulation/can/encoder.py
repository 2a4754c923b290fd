"""Values of a device become the frames that a DBC file describes.

The plan is that of the driver's decoder that will read the frames, so that any device which a
configuration describes can be simulated. A value is rounded to the signal's resolution and
saturates at its range, as a device's does.
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
        """The frames of sample `number`, true at `t_ns` of the device's clock; SI by slot."""
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
    """Rounded and saturated; a float signal takes everything."""
    if signal.is_float:
        return count
    low, high = 0, (1 << signal.length) - 1
    if signal.is_signed:
        low, high = -(high + 1 >> 1), high >> 1
    return min(max(round(count), low), high)
