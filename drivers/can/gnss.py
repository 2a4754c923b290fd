"""Driver `can_gnss`: fixes, headings and time from a receiver on a CAN bus, by any DBC.

Position, height, velocity (north, east, down, or speed and course), heading and time come in
several messages of one epoch, which are combined. Each quantity has its own flags; invalid ones are
left out of the fix. Of a speed s with course c:

    v = s (cos c, sin c),    sd_n^2 = (a cos c)^2 + (b sin c)^2,    b = s sd_c, or a without one

a one sigma of the speed, b across it; sd_e likewise with sine and cosine changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import ClassVar

from pydantic import Field, PositiveFloat, model_validator

from drivers.base import DriverOptions
from drivers.can.base_driver import CanDriver, Codec
from drivers.can.dbc import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    SPEED_UNITS,
    TIME_UNITS,
    plan_number,
    plan_quantity,
)
from drivers.can.decoder import CanDecoder, CanOptions, Find, Signals, plan_flags
from drivers.measurements import (
    Heading,
    Measurement,
    PositionFix,
    Stamp,
    TimeReport,
    UtcStamp,
    Vector3,
)
from drivers.plausible import SIGMA_M, SPEED_M_S
from drivers.quantization import NEAREST_SD

NAN = math.nan
HALF_TURN, TURN = math.pi, 2.0 * math.pi
SECONDS = {name: float(factor) for name, factor in TIME_UNITS.items()}
CALENDAR = ("year", "month", "day", "hour", "minute", "second")
TWO_DIGITS = 100
"""Year below which a two-digit year counts from 2000."""
EARTH_RADIUS_M = 6_378_137.0
"""Earth radius of WGS 84, to convert a step of an angle to metres."""

Triple = tuple[str, str, str]


class CanGnssOptions(CanOptions):
    """Signals of a receiver, each as "Message.Signal". All messages must come at the rate of the
    fixes, except one that carries only `quality` or `satellites`."""

    lat: str
    lon: str
    horizontal_accuracy: str | None = None
    """One sigma of the position, north and east each."""
    position_valid: str | Signals = ()
    """Flags, all of which a valid fix needs."""
    height: str | None = None
    geoid_m: float = 0.0
    """Added to `height`: the geoid's height above the ellipsoid, where the receiver gives the
    height above mean sea level."""
    vertical_accuracy: str | None = None
    height_valid: str | Signals = ()
    velocity: Triple | None = None
    """North, east, down; "" for a down that it does not measure. Or `speed` and `course`."""
    speed: str | None = None
    course: str | None = None
    """Course over ground. A heading will do for a vehicle that does not reverse."""
    speed_accuracy: str | None = None
    """One sigma of the speed, and of each axis of `velocity`."""
    course_accuracy: str | None = None
    velocity_valid: str | Signals = ()
    heading: str | None = None
    """Heading of the vehicle's forward axis, as measured by two antennas."""
    heading_accuracy: str | None = None
    heading_valid: str | Signals = ()
    utc: str | tuple[str, str, str, str, str, str] | None = None
    """UTC of the fix: POSIX seconds, or year, month, day, hour, minute, second. It stamps the fix,
    unless `timestamp` selects another source."""
    utc_valid: str | Signals = ()
    quality: str | None = None
    """Kind of fix, as a number; `qualities` says what it means."""
    qualities: dict[int, int] = Field(default_factory=dict)
    """Quality of NMEA's GGA by the receiver's number (1 autonomous, 2 differential, 4 RTK fixed, 5
    RTK float); any other number is not a fix."""
    satellites: str | None = None
    timeout_s: PositiveFloat = 3.0

    @model_validator(mode="after")
    def _goes_together(self) -> CanGnssOptions:
        if (self.speed is None) != (self.course is None):
            raise ValueError("speed and course: both or neither")
        if self.speed is not None and self.velocity is not None:
            raise ValueError("velocity, or speed and course: not both")
        if self.velocity is not None and not all(self.velocity[:2]):
            raise ValueError("velocity: north and east must be signals")
        if (self.quality is None) != (not self.qualities):
            raise ValueError("quality and qualities: both or neither")
        needs: dict[str, tuple[object, object]] = {
            "vertical_accuracy": (self.vertical_accuracy, self.height),
            "height_valid": (self.height_valid, self.height),
            "speed_accuracy": (self.speed_accuracy, self.velocity or self.speed),
            "course_accuracy": (self.course_accuracy, self.course),
            "velocity_valid": (self.velocity_valid, self.velocity or self.speed),
            "heading_accuracy": (self.heading_accuracy, self.heading),
            "heading_valid": (self.heading_valid, self.heading),
            "utc_valid": (self.utc_valid, self.utc),
        }
        for name, (given, of) in needs.items():
            if given and not of:
                raise ValueError(f"{name}: what it belongs to is not mapped")
        return self


class CanGnssDecoder(CanDecoder[CanGnssOptions]):
    """Decoder of CAN frames into fixes, headings and time reports; no I/O.

    `counters`: also `not_valid` (no position), `no_fix` (by its quality), `bad_date`.
    """

    def _plan_values(self, find: Find) -> list[float]:
        o = self._options
        self._slots: dict[str, int] = {}
        self._steps: dict[str, float] = {}
        self._flags: dict[str, slice] = {}
        self._size = 0

        def value(
            what: str,
            name: str | None,
            units: Mapping[str, float] | None,
            low: float = 0.0,
            high: float = math.inf,
            held: bool = False,
        ) -> None:
            """Plan a quantity, or a number where it has no unit."""
            if not name:
                return
            slot = self._slots[what] = self._size
            self._size += 1
            plan, signal = find(name, what.partition(".")[0], held)
            if units is None:
                axis = plan_number(slot, signal, what)
            else:
                axis = plan_quantity(slot, signal, what, units, low, high)
            plan.axes.append(axis)
            self._steps[what] = axis.step

        value("lat", o.lat, ANGLE_UNITS, -0.25 * TURN, 0.25 * TURN)
        value("lon", o.lon, ANGLE_UNITS, -HALF_TURN, TURN)
        value("horizontal_accuracy", o.horizontal_accuracy, LENGTH_UNITS, high=SIGMA_M[1])
        value("height", o.height, LENGTH_UNITS, -math.inf)
        value("vertical_accuracy", o.vertical_accuracy, LENGTH_UNITS, high=SIGMA_M[1])
        for axis, name in zip("ned", o.velocity or (), strict=False):
            value(f"velocity.{axis}", name, SPEED_UNITS, -SPEED_M_S, SPEED_M_S)
        value("speed", o.speed, SPEED_UNITS, high=SPEED_M_S)
        value("course", o.course, ANGLE_UNITS, -TURN, TURN)
        value("speed_accuracy", o.speed_accuracy, SPEED_UNITS, high=SPEED_M_S)
        value("course_accuracy", o.course_accuracy, ANGLE_UNITS, high=TURN)
        value("heading", o.heading, ANGLE_UNITS, -TURN, TURN)
        value("heading_accuracy", o.heading_accuracy, ANGLE_UNITS, high=TURN)
        if isinstance(o.utc, str):
            value("utc", o.utc, SECONDS)
        for part, name in zip(CALENDAR, o.utc if isinstance(o.utc, tuple) else (), strict=False):
            self._plan_calendar(value, part, name)
        value("quality", o.quality, None, held=True)
        value("satellites", o.satellites, None, held=True)
        constants = [NAN] * self._size
        for what in ("position_valid", "height_valid", "velocity_valid", "heading_valid"):
            constants += self._plan_flags(find, what, getattr(o, what), len(constants))
        return constants + self._plan_flags(find, "utc_valid", o.utc_valid, len(constants))

    @staticmethod
    def _plan_calendar(value: Callable[..., None], part: str, name: str) -> None:
        """Plan a part of a date, in units of a calendar or none; a second may have a fraction."""
        units = {"": 1.0, "1": 1.0, part: 1.0, part[0]: 1.0, part[:3]: 1.0}
        if part == "second":
            units |= SECONDS
        value(f"utc.{part}", name, units)

    def _plan_flags(self, find: Find, what: str, names: str | Signals, first: int) -> list[float]:
        flags = plan_flags(find, first, what, names)
        self._flags[what] = slice(first, first + len(flags))
        return flags

    # ------------------------------------------------------------------ values

    def _measurements(
        self, values: list[float], t_seen_ns: int, stamp: Stamp
    ) -> Sequence[Measurement]:
        found: list[Measurement] = []
        utc_ns = self._utc_ns(values)
        if utc_ns is not None:
            trusted = self._valid("utc_valid", values)
            found.append(TimeReport(self.name, t_seen_ns, utc_ns, trusted))
            if trusted and self._options.timestamp is None:
                stamp = UtcStamp(utc_ns)
        fix = self._fix(values, t_seen_ns, stamp)
        if fix is not None:
            found.append(fix)
        yaw = self._value("heading", values)
        if yaw is not None and self._valid("heading_valid", values):
            sd = self._value("heading_accuracy", values) or None
            rounding = self._rounding("heading")
            found.append(Heading(self.name, t_seen_ns, stamp, yaw % TURN, sd, rounding))
        return found

    def _fix(self, values: list[float], t_seen_ns: int, stamp: Stamp) -> PositionFix | None:
        if not self._valid("position_valid", values):
            self.counters["not_valid"] += 1
            return None
        quality = 1
        if self._options.quality is not None:
            raw = self._value("quality", values)
            stated = None if raw is None else self._options.qualities.get(round(raw))
            if stated is None:
                self.counters["no_fix"] += 1
                return None
            quality = stated
        lat, lon = values[self._slots["lat"]], values[self._slots["lon"]]
        height = self._value("height", values)
        if height is not None:
            valid = self._valid("height_valid", values)
            height = height + self._options.geoid_m if valid else None
        satellites = self._value("satellites", values)
        v, sd_v, rounding_v = self._velocity(values)
        return PositionFix(
            self.name,
            t_seen_ns,
            stamp,
            lat,
            lon,
            height,
            quality,
            satellites=None if satellites is None else round(satellites),
            sd_ned_m=self._position_sd(values),
            v_ned_m_s=v,
            sd_v_ned_m_s=sd_v,
            rounding_sd_ned_m=(
                self._rounding("lat") * EARTH_RADIUS_M,
                self._rounding("lon") * EARTH_RADIUS_M * math.cos(lat),
                self._rounding("height"),
            ),
            rounding_sd_v_m_s=rounding_v,
        )

    def _position_sd(self, values: list[float]) -> Vector3 | None:
        """Stated sigma; without a vertical sigma twice the horizontal one, as the geometry of
        satellites above the horizon makes it (GPS SPS Performance Standard, 2020)."""
        level = self._value("horizontal_accuracy", values)
        if not level:
            return None
        down = self._value("vertical_accuracy", values) or 2.0 * level
        return level, level, down

    def _velocity(
        self, values: list[float]
    ) -> tuple[
        tuple[float, float, float | None] | None,
        tuple[float, float, float | None] | None,
        float,
    ]:
        """Velocity, its sigma, and one sigma of its rounding on each axis."""
        if not self._valid("velocity_valid", values):
            return None, None, 0.0
        sd = self._value("speed_accuracy", values) or None
        north, east = self._value("velocity.n", values), self._value("velocity.e", values)
        if north is not None and east is not None:
            down = self._value("velocity.d", values)
            rounding = self._rounding("velocity.n")
            stated = None if sd is None else (sd, sd, None if down is None else sd)
            return (north, east, down), stated, rounding
        speed, course = self._value("speed", values), self._value("course", values)
        if speed is None or course is None:
            return None, None, 0.0
        c, s = math.cos(course), math.sin(course)
        rounding = max(self._rounding("speed"), speed * self._rounding("course"))
        if sd is None:
            return (speed * c, speed * s, None), None, rounding
        sd_course = self._value("course_accuracy", values)
        across = sd if sd_course is None else speed * sd_course
        stated = (math.hypot(sd * c, across * s), math.hypot(sd * s, across * c), None)
        return (speed * c, speed * s, None), stated, rounding

    def _utc_ns(self, values: list[float]) -> int | None:
        seconds = self._value("utc", values)
        if seconds is not None:
            return round(seconds * 1e9)
        parts = [self._value(f"utc.{part}", values) for part in CALENDAR]
        known = [p for p in parts if p is not None]
        if len(known) < len(CALENDAR):
            return None
        year, month, day, hour, minute = (round(p) for p in known[:5])
        year += 2000 if year < TWO_DIGITS else 0
        try:  # a leap second, 60, becomes the next minute, as in POSIX time
            start = datetime(year, month, day, hour, minute, tzinfo=UTC)
        except ValueError:
            self.counters["bad_date"] += 1
            return None
        return round(start.timestamp()) * 1_000_000_000 + round(known[5] * 1e9)

    # ------------------------------------------------------------------ inside

    def _value(self, what: str, values: list[float]) -> float | None:
        """Value of a signal; None without a mapping or a received held value."""
        slot = self._slots.get(what)
        if slot is None or math.isnan(values[slot]):
            return None
        return values[slot]

    def _valid(self, what: str, values: Sequence[float]) -> bool:
        flags: Iterable[float] = values[self._flags[what]]
        return all(flags)

    def _rounding(self, what: str) -> float:
        return self._steps.get(what, 0.0) * NEAREST_SD


class CanGnssDriver(CanDriver[CanGnssOptions]):
    """A receiver on a CAN bus; see `CanDriver` for its counters and events."""

    Options: ClassVar[type[DriverOptions]] = CanGnssOptions
    Decoder: ClassVar[Callable[..., Codec]] = CanGnssDecoder
