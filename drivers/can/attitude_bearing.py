"""Drivers `can_attitude` and `can_bearing`: attitude and bearings from a CAN bus, by any DBC.

A star tracker's or a reference unit's roll, pitch and yaw; a radar's azimuth and elevation of a
point whose number it sends. Signals are "Message.Signal"; their unit is that of the DBC (deg, rad,
mrad, arcsec ...).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

from pydantic import PositiveFloat

from drivers.base import DriverOptions, PermanentDriverError
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.dbc import plan_angle, plan_number
from drivers.can.decoder import CanDecoder, CanOptions, Find, Signals, plan_flags
from drivers.measurements import Attitude, Bearing, Measurement, Stamp

TURN = 2.0 * math.pi
NAN = math.nan


class CanMeasurementOptions(CanOptions):
    """Common options of both drivers."""

    valid: str | Signals = ()
    """Flags: a measurement with 0 in one is counted as `not_valid` and dropped."""
    timeout_s: PositiveFloat = 5.0
    """Time without a measurement after which the device is `silent`."""


class CanAttitudeOptions(CanMeasurementOptions):
    """Signals of roll, pitch and yaw (NED to body, 3-2-1), and one sigma of each.

    "" for an angle or a sigma that the device does not send.
    """

    rpy: tuple[str, str, str]
    sd_rpy: tuple[str, str, str] = ("", "", "")


class CanBearingOptions(CanMeasurementOptions):
    """Signals of the direction to a point, and of the point's number.

    Azimuth runs from the sensor's x (nominally forward) to its y (right), elevation is positive
    upwards.
    """

    azimuth: str
    elevation: str
    target: str
    sd_azimuth: str | None = None
    sd_elevation: str | None = None


class CanAttitudeDecoder(CanDecoder[CanAttitudeOptions]):
    """CAN frames in, attitudes out; no I/O. Slots: roll, pitch, yaw, sigma of each, flag."""

    def _plan_values(self, find: Find) -> list[float]:
        options = self._options
        if not any(options.rpy):
            raise PermanentDriverError("rpy: at least one angle must be a signal")
        for slot, name in enumerate((*options.rpy, *options.sd_rpy)):
            if name:
                what, low = ("rpy", -TURN) if slot < 3 else ("sd_rpy", 0.0)
                plan, signal = find(name, what)
                plan.axes.append(plan_angle(slot, signal, what, low, TURN))
        return [NAN] * 6 + plan_flags(find, 6, "valid", options.valid)

    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[Measurement]:
        roll, pitch, yaw, sd_roll, sd_pitch, sd_yaw, *valid = values
        if not all(valid):
            self.counters["not_valid"] += 1
            return ()
        sd = (sd_roll, sd_pitch, sd_yaw)
        return (Attitude(self.name, t_seen_ns, stamp, (roll, pitch, yaw), sd),)


class CanBearingDecoder(CanDecoder[CanBearingOptions]):
    """CAN frames in, bearings out; no I/O. Slots: azimuth, elevation, their sigma, target, flag."""

    def _plan_values(self, find: Find) -> list[float]:
        options = self._options
        if (options.sd_azimuth is None) != (options.sd_elevation is None):
            raise PermanentDriverError("sd_azimuth and sd_elevation: both or neither")
        angles = (
            ("azimuth", options.azimuth, -TURN),
            ("elevation", options.elevation, -0.25 * TURN),
            ("sd_azimuth", options.sd_azimuth, 0.0),
            ("sd_elevation", options.sd_elevation, 0.0),
        )
        for slot, (what, name, low) in enumerate(angles):
            if name is not None:
                plan, signal = find(name, what)
                high = 0.25 * TURN if what == "elevation" else TURN
                plan.axes.append(plan_angle(slot, signal, what, low, high))
        plan, signal = find(options.target, "target")
        plan.axes.append(plan_number(4, signal, "target"))
        return [NAN] * 5 + plan_flags(find, 5, "valid", options.valid)

    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[Measurement]:
        azimuth, elevation, sd_azimuth, sd_elevation, target, *valid = values
        if not all(valid):
            self.counters["not_valid"] += 1
            return ()
        sd = None if math.isnan(sd_azimuth) else (sd_azimuth, sd_elevation)
        return (Bearing(self.name, t_seen_ns, stamp, azimuth, elevation, sd, str(round(target))),)


class CanAttitudeDriver(CanDriver[CanAttitudeOptions]):
    """A star tracker or attitude reference on a CAN bus. `counters`: also `not_valid`."""

    Options: ClassVar[type[DriverOptions]] = CanAttitudeOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanAttitudeDecoder


class CanBearingDriver(CanDriver[CanBearingOptions]):
    """A radar on a CAN bus that measures known points. `counters`: also `not_valid`."""

    Options: ClassVar[type[DriverOptions]] = CanBearingOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanBearingDecoder
