"""Decoding plan from a DBC file and a mapping of axes; no I/O once the file is loaded.

A signal is named `Message.Signal`. Physical value = raw * scale + offset (DBC), in the signal's
unit. The plan includes sign and unit in scale and offset, so that one multiplication gives an axis
in rad/s or m/s^2.
"""

from __future__ import annotations

import logging
import math
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

from cantools.database.can import Database, Message
from cantools.database.can.signal import Signal

from drivers.base import PermanentDriverError
from drivers.can.dbc_salvage import SoundPart, UnreadableError, read_whole, sound_part, unselected
from drivers.can.signal_bits import AbsentSignalError, Layout
from drivers.shipped_files import shipped

log = logging.getLogger(__name__)

SHIPPED = shipped("dbc")

BOMS = {BOM_UTF8: "utf-8-sig", BOM_UTF16_LE: "utf-16", BOM_UTF16_BE: "utf-16"}
"""Encodings by the byte order mark that begins a file."""

STANDARD_GRAVITY_M_S2 = 9.80665
"""Standard acceleration of gravity: 3rd CGPM (1901), the `g` of every data sheet."""

RATE_UNITS = {
    "rad/s": 1.0,
    "mrad/s": 1e-3,
    "deg/s": math.pi / 180.0,
    "°/s": math.pi / 180.0,
    "dps": math.pi / 180.0,
    "mdps": math.pi / 180e3,
    "deg/h": math.pi / 648e3,
}
FORCE_UNITS = {
    "m/s^2": 1.0,
    "m/s²": 1.0,
    "m/s2": 1.0,
    "m/s/s": 1.0,
    "g": STANDARD_GRAVITY_M_S2,
    "mg": STANDARD_GRAVITY_M_S2 * 1e-3,
}
MOST_RAD_S, MOST_M_S2 = 175.0, 10_000.0
"""Limits beyond any inertial sensor: 10,000 deg/s and 1,000 g; only a damaged float exceeds them.
"""
ANGLE_UNITS = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": math.pi / 180.0,
    "°": math.pi / 180.0,
    "mdeg": math.pi / 180e3,
    "arcmin": math.pi / 10_800.0,
    "arcsec": math.pi / 648e3,
}
SPEED_UNITS = {
    "m/s": 1.0,
    "mm/s": 1e-3,
    "km/h": 1.0 / 3.6,
    "kph": 1.0 / 3.6,
    "kmh": 1.0 / 3.6,
    "km/hr": 1.0 / 3.6,
    "mph": 0.44704,
    "kn": 1852.0 / 3600.0,
    "knots": 1852.0 / 3600.0,
}
"""1 mile (international, 1959) 1609.344 m, 1 nautical mile 1852 m."""
ROTATION_UNITS = {
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "°/s": math.pi / 180.0,
    "rpm": math.pi / 30.0,
    "1/min": math.pi / 30.0,
    "Hz": 2.0 * math.pi,
}
"""A wheel's own turning; the radius makes a speed of it."""
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048}
PRESSURE_UNITS = {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "bar": 1e5}
NO_UNITS = {"": 1.0, "1": 1.0}
TIME_UNITS = {
    "s": Fraction(1),
    "sec": Fraction(1),
    "ms": Fraction(1, 1000),
    "us": Fraction(1, 10**6),
} | {
    "µs": Fraction(1, 10**6),
    "ns": Fraction(1, 10**9),
}

J1939_PDU2 = 240
"""SAE J1939-21: from this PDU format on, the PDU specific byte belongs to the PGN."""


class RefusedFrameError(Exception):
    """Error of a frame that cannot be a sample; its text is the counter's name."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Axis from one signal: SI value = raw * scale + offset, plausible within low..high.

    `step` is the distance of neighbouring values, 0 for a floating-point signal.
    """

    slot: int
    signal: str
    scale: float
    offset: float
    low: float
    high: float
    step: float


@dataclass(frozen=True, slots=True)
class Stamp:
    """Counter or time of a device: raw unsigned integer that wraps at `modulus`."""

    signal: str
    modulus: int
    tick_ns: Fraction = Fraction(0)


@dataclass(slots=True)
class Part:
    """Values of one frame: values by slot (IMU: 0..2 gyro, 3..5 accelerometer), stamps."""

    values: list[tuple[int, float]]
    counter: int | None
    ticks: int | None


@dataclass(slots=True)
class MessagePlan:
    """Signals of one message; `paired`: its frames wait for those of other messages."""

    message: Message
    paired: bool = False
    axes: list[Axis] = field(default_factory=list)
    counter: Stamp | None = None
    time: Stamp | None = None
    _layout: Layout | None = None
    _values: list[tuple[int, float, float, float, float]] = field(default_factory=list)

    def decode(self, data: bytes) -> Part:
        """Decode one frame's data into the planned slots, from the first on.

        RefusedFrameError: `wrong_length` (shorter than the DBC says; padding is accepted),
        `undecodable` (a planned signal is not in it), `not_finite` (NaN or infinite float),
        `out_of_range` (beyond any sensor, or outside the DBC's minimum and maximum: SAE J1939-71
        says "not available" so).
        """
        if len(data) < self.message.length:
            raise RefusedFrameError("wrong_length")
        if self._layout is None:
            stamps = [stamp.signal for stamp in (self.counter, self.time) if stamp is not None]
            self._layout = Layout(self.message, [axis.signal for axis in self.axes] + stamps)
            self._values = [(a.slot, a.scale, a.offset, a.low, a.high) for a in self.axes]
        try:
            raw = self._layout.raw(data)
        except AbsentSignalError as error:
            raise RefusedFrameError("undecodable") from error
        values = []
        for (slot, scale, offset, low, high), number in zip(self._values, raw, strict=False):
            value = number * scale + offset
            if not low <= value <= high:
                raise RefusedFrameError("out_of_range" if math.isfinite(value) else "not_finite")
            values.append((slot, value))
        ticks = None if self.time is None else raw.pop()
        counter = None if self.counter is None else raw.pop()
        return Part(values, counter, ticks)


def find_dbc(name: str) -> Path:
    """Path of a DBC file: `path` itself, else the shipped file of that name."""
    for path in (Path(name), SHIPPED / name, SHIPPED / f"{name}.dbc"):
        if path.is_file():
            return path
    names = sorted(path.stem for path in SHIPPED.glob("*.dbc"))
    raise PermanentDriverError(
        f"dbc: there is no file {name!r}, neither here ({Path.cwd()}) nor among the shipped ones: "
        f"{', '.join(names)}"
    )


def load_dbc(name: str) -> Database:
    """Load a DBC file; PermanentDriverError when there is none or it cannot be read.

    A flawed message is left out and logged; a mapping that uses it raises an error with the reason.
    """
    path = find_dbc(name)
    try:
        return _parsed(path, path.stat().st_mtime_ns)
    except OSError as error:
        raise PermanentDriverError(f"dbc: {path}: {error}") from error


@lru_cache(maxsize=16)
def _parsed(path: Path, changed_ns: int) -> Database:
    """Parsed file, cached by its time of change, so that the sources of one bus share it."""
    content = path.read_bytes()
    # cantools's encoding, unless the file has a byte order mark.
    marked = (encoding for mark, encoding in BOMS.items() if content.startswith(mark))
    text = content.decode(next(marked, "cp1252"), "replace")
    flaw: Exception | str = "there is no message in it"
    try:
        if (database := read_whole(text)).messages and not unselected(text):
            return database
    except Exception as error:  # the parser also lets KeyError and bitstruct.Error through
        flaw = error
    try:
        sound = sound_part(text)
    except UnreadableError as error:
        raise PermanentDriverError(f"dbc: {path}: {flaw}") from error
    if sound.extended:
        names = ", ".join(sound.extended)
        log.warning("%s: identifiers of more than 11 bits are read as extended: %s", path, names)
    for left_out, reason in sound.left_out.items():
        log.warning("%s: %s is left out: %s", path, left_out, reason)
    return sound


def find_signal(database: Database, name: str, what: str) -> tuple[Message, Signal]:
    """Find the signal `Message.Signal`. Raises PermanentDriverError with a list of those that
    exist."""
    message_name, dot, signal_name = name.partition(".")
    messages = [message for message in database.messages if message.name == message_name]
    if not dot or not messages:
        _refuse_flawed(database, message_name, what)
        names = [f"{m.name}.{s.name}" for m in database.messages for s in m.signals]
        raise _unknown(what, name, "Message.Signal", names)
    found = [(m, s) for m in messages for s in m.signals if s.name == signal_name]
    if not found:
        _refuse_flawed(database, name, what)
        there = [signal.name for message in messages for signal in message.signals]
        raise _unknown(what, signal_name, f"signal of {message_name}", there)
    different = {(m.frame_id, s.start, s.length, s.byte_order, s.scale, s.offset) for m, s in found}
    if len(different) > 1:
        identifiers = ", ".join(f"0x{message.frame_id:X}" for message, _ in found)
        raise PermanentDriverError(
            f"{what}: {name} stands in the DBC file more than once (in {identifiers}), and not "
            "alike: rename all but the one that is meant"
        )
    return found[0]


def _refuse_flawed(database: Database, name: str, what: str) -> None:
    """Refuse a request for a damaged message. Raises PermanentDriverError."""
    left_out = database.left_out if isinstance(database, SoundPart) else {}
    if name in left_out:
        raise PermanentDriverError(
            f"{what}: {name} cannot be read of the DBC file: {left_out[name]}"
        )


def _unknown(what: str, name: str, kind: str, names: Sequence[str]) -> PermanentDriverError:
    close = get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    return PermanentDriverError(
        f"{what}: {name!r} is no {kind} of the DBC file; {hint}there are: {', '.join(names)}"
    )


def _unit(units: Mapping[str, Any], signal: Signal, override: str | None, what: str) -> Any:
    unit = override if override is not None else (signal.unit or "").replace("Â", "").strip()
    if unit not in units:
        raise PermanentDriverError(
            f"{what}: the unit of {signal.name} is {unit!r}; known are {', '.join(units)}"
        )
    return units[unit]


def plan_axis(
    slot: int, signal: Signal, negative: bool, units: Mapping[str, float], override: str | None
) -> Axis:
    """Plan of one IMU axis, slots 0 to 2 gyro, 3 to 5 accelerometer."""
    what, most = ("gyro", MOST_RAD_S) if slot < 3 else ("accel", MOST_M_S2)
    factor = _unit(units, signal, override, what)
    return plan_value(slot, signal, -factor if negative else factor, -most, most)


def plan_value(slot: int, signal: Signal, factor: float, low: float, high: float) -> Axis:
    """Plan of one value: physical value of the DBC times `factor`, plausible within low..high.

    Minimum and maximum of the DBC are limits, too, if they differ; half a step is added for
    rounding.
    """
    least, most = signal.minimum, signal.maximum
    if least is not None and most is not None and least < most:
        slack = 0.5 * abs(signal.scale)
        ends = sorted(((least - slack) * factor, (most + slack) * factor))
        low, high = max(low, ends[0]), min(high, ends[1])
    scale, offset = signal.scale * factor, signal.offset * factor
    step = 0.0 if signal.is_float else abs(scale)
    return Axis(slot, signal.name, scale, offset, low, high, step)


def plan_angle(slot: int, signal: Signal, what: str, low: float, high: float) -> Axis:
    """Plan of an angle within low..high (rad), in the DBC's unit."""
    return plan_quantity(slot, signal, what, ANGLE_UNITS, low, high)


def plan_quantity(
    slot: int,
    signal: Signal,
    what: str,
    units: Mapping[str, float],
    low: float,
    high: float,
    override: str | None = None,
    times: float = 1.0,
) -> Axis:
    """Plan of a quantity within low..high (SI) in one of `units`, by the DBC or `override`; its SI
    value is multiplied by `times`."""
    return plan_value(slot, signal, _unit(units, signal, override, what) * times, low, high)


def plan_number(slot: int, signal: Signal, what: str) -> Axis:
    """Plan of a whole number without unit: a flag or an identifier."""
    if signal.is_float or float(signal.scale) != 1.0 or float(signal.offset) % 1.0:
        raise PermanentDriverError(f"{what}: {signal.name} must be an integer, one a step")
    factor = _unit(NO_UNITS, signal, None, what)
    return plan_value(slot, signal, factor, -math.inf, math.inf)


def plan_counter(signal: Signal) -> Stamp:
    """Plan of a sample counter; it wraps by the signal's length."""
    if signal.is_float or signal.is_signed:
        raise PermanentDriverError(f"counter: {signal.name} must be an unsigned integer")
    return Stamp(signal.name, 1 << signal.length)


def plan_time(signal: Signal) -> Stamp:
    """Plan of the device's free-running time; it wraps by the signal's length, unit and scale of
    the DBC."""
    if signal.is_float or signal.is_signed:
        raise PermanentDriverError(f"device_time: {signal.name} must be an unsigned integer")
    unit: Fraction = _unit(TIME_UNITS, signal, None, "device_time")
    tick_ns = Fraction(str(signal.scale)) * unit * 10**9
    if tick_ns <= 0:
        raise PermanentDriverError(f"device_time: the scale of {signal.name} must be positive")
    return Stamp(signal.name, 1 << signal.length, tick_ns)


def parameter_group(can_id: int) -> int:
    """PGN of a 29-bit identifier, data page included (SAE J1939-21)."""
    pgn = (can_id >> 8) & 0x3FFFF
    return pgn if (pgn >> 8) & 0xFF >= J1939_PDU2 else pgn & 0x3FF00
