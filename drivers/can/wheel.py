"""Driver `can_wheel`: the vehicle's speed from its own wheel speeds, by any DBC.

    v = mean( v_i of wheels that do not steer,  v_j cos(delta) of wheels that do )

v_i the speed of a wheel along its own rolling direction, delta the angle of the steered wheels
against the vehicle's forward axis. The sign is the direction signal's; without one, and where it
says neither, the speed is an amount.

Source: Groves, 2nd ed., section 6.4, eqs. 6.20 and 6.24.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

from pydantic import PositiveFloat, model_validator

from drivers.base import DriverOptions
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.dbc import (
    ANGLE_UNITS,
    ROTATION_UNITS,
    SPEED_UNITS,
    plan_number,
    plan_quantity,
)
from drivers.can.decoder import CanDecoder, CanOptions, Find, Signals, plan_flags
from drivers.measurements import Stamp, WheelSpeed
from drivers.plausible import SPEED_M_S
from drivers.quantization import rounded_speed

MOST_WHEELS = 4
LARGEST_STEERING_RAD = 0.5 * math.pi
"""Largest steering angle of road wheels."""
_STEERING, _DIRECTION, _ACCURACY, _FLAGS = 4, 5, 6, 7


class CanWheelOptions(CanOptions):
    """Signals of wheel speeds. A signal is "Message.Signal"."""

    wheels: Signals = ()
    """Wheels that do not steer: their mean is the speed at the middle of their axle. Of an axle
    name both wheels: one alone runs on a circle of its own in a bend."""
    steered: Signals = ()
    """Wheels that steer, in the same mean; they need `steering`."""
    steering: str | None = None
    """Angle of the steering wheel or of the steered wheels."""
    steering_ratio: PositiveFloat = 1.0
    """Angle of `steering` over that of the wheels; 14 to 20 for a steering wheel."""
    unit: str | None = None
    """Unit of the wheel signals, instead of the DBC's."""
    radius_m: PositiveFloat | None = None
    """Rolling radius, for signals of the wheels' rotation (rpm, rad/s, ...)."""
    signed: bool = False
    """The wheels themselves count backwards with a negative sign."""
    direction: str | None = None
    """Gear or direction of travel; counts for a second where its message is one of its own."""
    forward: tuple[int, ...] = (1,)
    """Raw values of `direction` that mean forward."""
    backward: tuple[int, ...] = (2,)
    """Values that mean backward; with any other the direction is unknown."""
    accuracy: str | None = None
    """One sigma of the speed, if the vehicle states it."""
    valid: str | Signals = ()
    """Flags: a speed with 0 in one is counted as `not_valid` and dropped."""
    timeout_s: PositiveFloat = 1.0

    @model_validator(mode="after")
    def _wheels_fit(self) -> CanWheelOptions:
        count = len(self.wheels) + len(self.steered)
        if not 1 <= count <= MOST_WHEELS:
            raise ValueError(f"wheels and steered name {count} signals: one to four are needed")
        if bool(self.steered) != (self.steering is not None):
            raise ValueError("steered and steering: both or neither")
        if self.signed and self.direction is not None:
            raise ValueError("signed and direction: the sign comes from one of the two")
        both = set(self.forward) & set(self.backward)
        if both:
            raise ValueError(f"forward and backward both list {min(both)}")
        return self


class CanWheelDecoder(CanDecoder[CanWheelOptions]):
    """CAN frames in, wheel speeds out; no I/O. `counters`: also `not_valid`, `no_steering`.

    Slots: 0 to 3 the wheels, steering angle, direction, accuracy, flags.
    """

    def _plan_values(self, find: Find) -> list[float]:
        o = self._options
        units, times = SPEED_UNITS, 1.0
        if o.radius_m is not None:
            units, times = ROTATION_UNITS, o.radius_m
        steps = []
        for slot, name in enumerate((*o.wheels, *o.steered)):
            what = "wheels" if slot < len(o.wheels) else "steered"
            plan, signal = find(name, what)
            axis = plan_quantity(slot, signal, what, units, -SPEED_M_S, SPEED_M_S, o.unit, times)
            if not o.signed:  # a 0 that an offset makes of a count may come out below it
                axis = replace(axis, low=max(axis.low, -0.5 * axis.step))
            plan.axes.append(axis)
            steps.append(axis.step)
        # Wheels that run alike are rounded alike: the mean is as coarse as one of them.
        self._step_m_s = max(steps)
        if o.steering is not None:
            plan, signal = find(o.steering, "steering", held=True)
            most = LARGEST_STEERING_RAD * o.steering_ratio
            plan.axes.append(plan_quantity(_STEERING, signal, "steering", ANGLE_UNITS, -most, most))
        if o.direction is not None:
            plan, signal = find(o.direction, "direction", held=True)
            plan.axes.append(plan_number(_DIRECTION, signal, "direction"))
        if o.accuracy is not None:
            plan, signal = find(o.accuracy, "accuracy", held=True)
            plan.axes.append(
                plan_quantity(_ACCURACY, signal, "accuracy", SPEED_UNITS, 0.0, SPEED_M_S)
            )
        flags = plan_flags(find, _FLAGS, "valid", o.valid, held=True)
        return [math.nan] * _FLAGS + flags

    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[WheelSpeed]:
        o = self._options
        if not all(values[_FLAGS:]):
            self.counters["not_valid"] += 1
            return ()
        straight = len(o.wheels)
        count = straight + len(o.steered)
        total = math.fsum(values[:straight])
        if o.steered:
            angle = values[_STEERING] / o.steering_ratio
            if math.isnan(angle):
                self.counters["no_steering"] += 1
                return ()
            total += math.fsum(values[straight:count]) * math.cos(angle)
        speed, rounding_sd, _ = rounded_speed(total / count, self._step_m_s)
        # Near zero there is nothing to be wrong about.
        signed = o.signed or speed == 0.0
        if values[_DIRECTION] in o.backward:
            speed, signed = -speed, True
        elif values[_DIRECTION] in o.forward:
            signed = True
        sd = values[_ACCURACY]
        stated = None if math.isnan(sd) or sd == 0.0 else sd
        return (WheelSpeed(self.name, t_seen_ns, stamp, speed, stated, rounding_sd, signed),)


class CanWheelDriver(CanDriver[CanWheelOptions]):
    """The wheel speeds of a vehicle; see `CanDriver` for its counters and events."""

    Options: ClassVar[type[DriverOptions]] = CanWheelOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanWheelDecoder
