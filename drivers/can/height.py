"""Driver `can_height`: a height, or an air pressure, from a CAN bus by any DBC.

A pressure is converted to a height in the standard atmosphere (drivers.standard_atmosphere).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

from pydantic import PositiveFloat, model_validator

from drivers.base import DriverOptions
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.dbc import LENGTH_UNITS, PRESSURE_UNITS, plan_quantity
from drivers.can.decoder import CanDecoder, CanOptions, Find, Signals, plan_flags
from drivers.measurements import Height, Stamp
from drivers.plausible import HEIGHT_M, SIGMA_M
from drivers.quantization import NEAREST_SD
from drivers.standard_atmosphere import PRESSURE_PA, metres_a_pascal, pressure_height_m

_ACCURACY, _FLAGS = 1, 2


class CanHeightOptions(CanOptions):
    """Signal of a height or of the ambient pressure. A signal is "Message.Signal"."""

    height: str | None = None
    """Metres or feet. Of a barometer's own, say `barometric`."""
    pressure: str | None = None
    """Air pressure instead of a height; an engine's intake pressure is lower while the engine runs.
    """
    barometric: bool = False
    """`height` comes of a pressure: it is off by the weather. A `pressure` always is."""
    accuracy: str | None = None
    """One sigma of the height, if the device states it."""
    valid: str | Signals = ()
    """Flags: a height with 0 in one is counted as `not_valid` and dropped."""
    timeout_s: PositiveFloat = 5.0

    @model_validator(mode="after")
    def _one_of_two(self) -> CanHeightOptions:
        if (self.height is None) == (self.pressure is None):
            raise ValueError("height or pressure: one of the two")
        return self


class CanHeightDecoder(CanDecoder[CanHeightOptions]):
    """Decoder of CAN frames into heights; no I/O. Slots: height or pressure, accuracy, flags."""

    def _plan_values(self, find: Find) -> list[float]:
        o = self._options
        what, name, units, limits = (
            ("height", o.height, LENGTH_UNITS, HEIGHT_M)
            if o.height is not None
            else ("pressure", o.pressure or "", PRESSURE_UNITS, PRESSURE_PA)
        )
        plan, signal = find(name, what)
        axis = plan_quantity(0, signal, what, units, *limits)
        plan.axes.append(axis)
        self._step = axis.step
        if o.accuracy is not None:
            plan, signal = find(o.accuracy, "accuracy", held=True)
            plan.axes.append(
                plan_quantity(_ACCURACY, signal, "accuracy", LENGTH_UNITS, 0.0, SIGMA_M[1])
            )
        return [math.nan] * _FLAGS + plan_flags(find, _FLAGS, "valid", o.valid, held=True)

    def _measurements(self, values: list[float], t_seen_ns: int, stamp: Stamp) -> Sequence[Height]:
        value, sd, *valid = values
        if not all(valid):
            self.counters["not_valid"] += 1
            return ()
        by_pressure = self._options.height is None
        height, step = value, self._step
        if by_pressure:
            height, step = pressure_height_m(value), step * metres_a_pascal(value)
        stated = None if math.isnan(sd) or sd == 0.0 else sd
        barometric = by_pressure or self._options.barometric
        rounding = step * NEAREST_SD
        return (Height(self.name, t_seen_ns, stamp, height, stated, rounding, barometric),)


class CanHeightDriver(CanDriver[CanHeightOptions]):
    """A barometer or another altimeter on a CAN bus; see `CanDriver`."""

    Options: ClassVar[type[DriverOptions]] = CanHeightOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanHeightDecoder
