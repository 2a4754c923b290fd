"""An IMU on a CAN bus: samples become the frames that a DBC file describes.

The options are those of the driver that will read the frames, so that any IMU a configuration
describes can be simulated. A value is rounded to the signal's resolution and saturates at its
range, as a device's does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import can
from cantools.database.can import Message

from drivers.can_dbc import (
    FORCE_UNITS,
    RATE_UNITS,
    find_signal,
    load_dbc,
    plan_axis,
    plan_counter,
    plan_time,
)
from drivers.can_signals import CanImuOptions

SIM_IMU = CanImuOptions(
    interface="virtual",
    channel="fusiond-sim",
    dbc="fusiond_sim_imu",
    gyro=("SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"),
    accel=("SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"),
    counter=("SIM_TIME.TIME_COUNTER", "SIM_GYRO.GYRO_COUNTER", "SIM_ACCEL.ACCEL_COUNTER"),
    device_time="SIM_TIME.TIME",
)
"""The simulation's own IMU: `config/dbc/fusiond_sim_imu.dbc`, 2 deg/h and 20 ug a step."""


@dataclass(frozen=True, slots=True)
class _Slot:
    """Where a value goes: raw = round((value - offset) / scale), within low..high."""

    message: str
    signal: str
    scale: float
    offset: float
    low: int
    high: int
    is_float: bool


class CanImu:
    """Encodes samples; no bus and no clock. Raises `PermanentDriverError` for wrong options."""

    def __init__(self, options: CanImuOptions = SIM_IMU) -> None:
        database = load_dbc(options.dbc)
        messages: dict[str, Message] = {}
        self._axes: list[tuple[int, _Slot]] = []
        self._counters: list[tuple[str, str, int]] = []
        self._times: list[tuple[str, str, int, Fraction]] = []
        for slot, name in enumerate((*options.gyro, *options.accel)):
            if not isinstance(name, str):
                continue  # an axis that the device does not measure
            gyro = slot < 3
            message, signal = find_signal(
                database, name.removeprefix("-"), "gyro" if gyro else "accel"
            )
            axis = plan_axis(
                slot,
                signal,
                name.startswith("-"),
                RATE_UNITS if gyro else FORCE_UNITS,
                options.gyro_unit if gyro else options.accel_unit,
            )
            messages[message.name] = message
            low, high = 0, (1 << signal.length) - 1
            if signal.is_signed:
                low, high = -(high + 1 >> 1), high >> 1
            place = _Slot(
                message.name,
                signal.name,
                axis.scale,
                axis.offset,
                low=low,
                high=high,
                is_float=signal.is_float,
            )
            self._axes.append((slot, place))
        for name in _names(options.counter):
            message, signal = find_signal(database, name, "counter")
            messages[message.name] = message
            self._counters.append((message.name, signal.name, plan_counter(signal).modulus))
        for name in _names(options.device_time):
            message, signal = find_signal(database, name, "device_time")
            messages[message.name] = message
            stamp = plan_time(signal)
            self._times.append((message.name, signal.name, stamp.modulus, stamp.tick_ns))
        # The bus carries the lowest identifier first.
        self._messages = sorted(messages.values(), key=lambda m: m.frame_id)
        self._source_address = options.source_address

    def frames(
        self, number: int, t_ns: int, gyro: Sequence[float], accel: Sequence[float]
    ) -> list[can.Message]:
        """The frames of sample `number`, true at `t_ns` of the device's clock; rad/s and m/s^2."""
        values = (*gyro, *accel)
        raw: dict[str, dict[str, int | float]] = {
            message.name: {signal.name: 0 for signal in message.signals}
            for message in self._messages
        }
        for index, slot in self._axes:
            count = (values[index] - slot.offset) / slot.scale
            if not slot.is_float:
                count = min(max(round(count), slot.low), slot.high)
            raw[slot.message][slot.signal] = count
        for message_name, signal_name, modulus in self._counters:
            raw[message_name][signal_name] = number % modulus
        for message_name, signal_name, modulus, tick_ns in self._times:
            raw[message_name][signal_name] = int(t_ns / tick_ns) % modulus
        return [
            can.Message(
                arbitration_id=self._identifier(message),
                is_extended_id=message.is_extended_frame,
                data=message.encode(raw[message.name], scaling=False, strict=False),
            )
            for message in self._messages
        ]

    def _identifier(self, message: Message) -> int:
        if self._source_address is None:
            return message.frame_id
        return message.frame_id & ~0xFF | self._source_address


def _names(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names
