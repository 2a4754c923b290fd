"""Mean and spread of a device's measurements: scale and byte order show in them.

A wrong scale shows as |f| other than 9.8 m/s^2 at rest, a wrong byte order as a spread as large as
the range, a shifted field as a value that jumps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from math import degrees, hypot
from typing import Any, NamedTuple

import numpy as np

from drivers.base import Emitted
from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    ImuSample,
    MagneticHeading,
    PositionFix,
    WheelSpeed,
)
from drivers.raw.messages import RawGnssEpoch

KEPT = 20_000
"""Measurements of a kind remembered: 20 s of an IMU at 1 kHz."""
_AXES = ("x", "y", "z")


class Quantity(NamedTuple):
    """Quantity of a measurement: labels of its parts, their unit, digits to show."""

    name: str
    parts: tuple[str, ...]
    unit: str
    digits: int
    of: Callable[[Any], tuple[float, ...] | None]
    """Function for the values of a measurement; None where it has none."""


def _velocity(m: PositionFix) -> tuple[float, ...] | None:
    return None if m.v_ned_m_s is None else m.v_ned_m_s[:2]


_PLACE = Quantity(
    "position",
    ("lat", "lon"),
    "deg",
    7,
    lambda m: (degrees(m.lat_rad), degrees(m.lon_rad)),
)
_HEIGHT = Quantity("height", ("",), "m", 2, lambda m: None if m.height_m is None else (m.height_m,))
QUANTITIES: Mapping[type, tuple[Quantity, ...]] = {
    ImuSample: (
        Quantity("rate", _AXES, "deg/s", 3, lambda m: tuple(map(degrees, m.gyro_rad_s))),
        Quantity("force", _AXES, "m/s2", 3, lambda m: m.accel_m_s2),
        Quantity("|force|", ("",), "m/s2", 3, lambda m: (hypot(*m.accel_m_s2),)),
    ),
    PositionFix: (
        _PLACE,
        _HEIGHT,
        Quantity("velocity", ("north", "east"), "m/s", 2, _velocity),
    ),
    DelayedFix: (_PLACE, _HEIGHT),
    Attitude: (
        Quantity(
            "attitude",
            ("roll", "pitch", "yaw"),
            "deg",
            3,
            lambda m: tuple(map(degrees, m.rpy_rad)),
        ),
    ),
    Bearing: (
        Quantity(
            "bearing",
            ("azimuth", "elevation"),
            "deg",
            3,
            lambda m: (degrees(m.azimuth_rad), degrees(m.elevation_rad)),
        ),
    ),
    Heading: (Quantity("heading", ("",), "deg", 2, lambda m: (degrees(m.yaw_rad),)),),
    MagneticHeading: (
        Quantity("magnetic heading", ("",), "deg", 2, lambda m: (degrees(m.yaw_rad),)),
    ),
    Height: (_HEIGHT,),
    WheelSpeed: (Quantity("speed", ("",), "m/s", 2, lambda m: (m.speed_m_s,)),),
    RawGnssEpoch: (Quantity("signals", ("",), "an epoch", 1, lambda m: (float(len(m.signals)),)),),
}


class MeasurementStatistics:
    """Values of one kind of measurement."""

    def __init__(self, kind: type) -> None:
        self._quantities = QUANTITIES.get(kind, ())
        self._kept: dict[str, deque[tuple[float, ...]]] = {
            quantity.name: deque(maxlen=KEPT) for quantity in self._quantities
        }

    def add(self, measurement: Emitted) -> None:
        """Add a measurement."""
        for quantity in self._quantities:
            values = quantity.of(measurement)
            if values is not None:
                self._kept[quantity.name].append(values)

    def lines(self) -> Iterator[str]:
        """Mean and standard deviation of each quantity, one line each."""
        for quantity in self._quantities:
            kept = self._kept[quantity.name]
            if not kept:
                continue
            table = np.array(kept)
            digits = quantity.digits
            parts = (
                f"{part} {mean:.{digits}f} +- {sd:.{digits}f}".strip()
                for part, mean, sd in zip(
                    quantity.parts, table.mean(axis=0), table.std(axis=0), strict=True
                )
            )
            yield f"{quantity.name} {', '.join(parts)} {quantity.unit}"
