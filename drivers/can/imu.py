"""Driver `can_imu`: any IMU on a CAN bus, described by a DBC file and a mapping of its axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from drivers.base import DriverOptions, PermanentDriverError
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.dbc import FORCE_UNITS, RATE_UNITS, plan_axis
from drivers.can.decoder import CanDecoder, CanOptions, Find
from drivers.measurements import ImuSample, Stamp

AxisSource = str | float
Triad = tuple[AxisSource, AxisSource, AxisSource]


class CanImuOptions(CanOptions):
    """Bus, DBC and signals of the axes x, y, z of the sensor.

    An axis is "Message.Signal", with a leading "-" to reverse its sign, or a number (rad/s or
    m/s^2) for an axis that the device does not measure.
    """

    gyro: Triad
    accel: Triad
    gyro_unit: str | None = None
    """Instead of the unit that the DBC states."""
    accel_unit: str | None = None


class CanImuDecoder(CanDecoder[CanImuOptions]):
    """Decoder of CAN frames into IMU samples; no I/O."""

    def _plan_values(self, find: Find) -> list[float]:
        options = self._options
        constants = [0.0] * 6
        triads: tuple[tuple[str, Triad, dict[str, float], str | None], ...] = (
            ("gyro", options.gyro, RATE_UNITS, options.gyro_unit),
            ("accel", options.accel, FORCE_UNITS, options.accel_unit),
        )
        for first, (what, triad, units, unit) in zip((0, 3), triads, strict=True):
            mapped = 0
            for slot, source in enumerate(triad, start=first):
                number = _number(source)
                if number is not None:
                    constants[slot] = number
                    continue
                mapped += 1
                text = str(source)
                plan, signal = find(text.lstrip("+-"), what)
                plan.axes.append(plan_axis(slot, signal, text.startswith("-"), units, unit))
            if not mapped:
                raise PermanentDriverError(f"{what}: at least one axis must be a signal")
        return constants

    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[ImuSample]:
        gx, gy, gz, ax, ay, az = values
        return (ImuSample(self.name, t_seen_ns, stamp, (gx, gy, gz), (ax, ay, az)),)


def _number(source: AxisSource) -> float | None:
    try:
        return float(source)
    except ValueError:
        return None


class CanImuDriver(CanDriver[CanImuOptions]):
    """An IMU on a CAN bus; see `CanDriver` for its counters and events."""

    Options: ClassVar[type[DriverOptions]] = CanImuOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanImuDecoder
