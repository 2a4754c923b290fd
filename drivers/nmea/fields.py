"""Typed fields of a sentence by name, by pynmeagps's tables but without its objects.

The tables have the fields of each sentence in order, with their types. A field of a wrong type
refuses the whole sentence (ValueError); an empty one stays an empty text; fields of later versions
of the standard may be missing. The values are those of pynmeagps, which takes 70 us a sentence (an
object with an attribute for each field, dates by `strptime`); this takes 5.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from typing import Any, NamedTuple, cast

from pynmeagps.nmeahelpers import dmm2ddd
from pynmeagps.nmeatypes_core import DE, DT, GROUP, IN, LA, LN
from pynmeagps.nmeatypes_get import NMEA_PAYLOADS_GET

Fields = Mapping[str, Any]
"""Values by pynmeagps' field names: float, int, date, or text; `lat` and `lon` degrees with the
sign of their hemisphere. `printed`: the texts of all."""


def _date(printed: str) -> date | str:
    """Date of ddmmyy; years 69 to 99 are 1969 to 1999, as in POSIX. Empty for an invalid one."""
    if len(printed) != 6 or not printed.isdecimal():
        return ""
    year = int(printed[4:])
    try:
        return date(year + (1900 if year >= 69 else 2000), int(printed[2:4]), int(printed[:2]))
    except ValueError:
        return ""


Convert = Callable[[str], Any]


def _degrees(printed: str) -> float:
    """Degrees of dddmm.mm. ValueError for invalid text, which pynmeagps passes as empty."""
    found = dmm2ddd("0" + printed if printed.find(".") == 3 else printed)  # 812.5 of small devices
    if found == "":
        raise ValueError(f"not an angle: {printed!r}")
    return cast(float, found)


_CONVERT: dict[str, Convert] = {DE: float, IN: int, LA: _degrees, LN: _degrees, DT: _date}


def _plan(table: Mapping[str, object]) -> list[tuple[str, Convert | None]]:
    planned: list[tuple[str, Convert | None]] = []
    for name, kind in table.items():
        if name.endswith(GROUP):
            count, members = cast(tuple[int, Mapping[str, str]], kind)
            planned += _plan(members) * count
        else:
            planned.append((name, _CONVERT.get(str(kind))))
    return planned


_PLANS: dict[str, list[tuple[str, Convert | None]]] = {}


def typed_fields(formatter: str, printed: Sequence[str]) -> Fields:
    """Fields of a sentence. ValueError for one of a wrong type."""
    plan = _PLANS.get(formatter)
    if plan is None:
        table = cast(Mapping[str, object], NMEA_PAYLOADS_GET[formatter])
        plan = _PLANS[formatter] = _plan(table)
    fields: dict[str, Any] = {"printed": printed}
    for (name, convert), text in zip(plan, printed, strict=False):
        fields[name] = convert(text) if convert is not None and text else text
    for axis, side, negative in (("lat", "NS", "S"), ("lon", "EW", "W")):
        if side in fields and fields[axis] != "":
            amount = abs(fields[axis])
            fields[axis] = -amount if fields[side] == negative else amount
    return fields


# --------------------------------------------------------------------------- plausibility

NO_DOP = 99.0
"""Receivers without a solution print 99.99."""
MINUTE_M = 1852.0
"""Metres of a minute of latitude."""
_PRINTED_POSITION = re.compile(r"\d{1,2}[0-5]\d\.\d*,[NS],\d{1,3}[0-5]\d\.\d*,[EW]\Z")


class PrintedPosition(NamedTuple):
    """Latitude and longitude (deg) of a sentence, and one step (m) of their last digits, for the
    longitude at the equator."""

    lat_deg: float
    lon_deg: float
    lat_step_m: float
    lon_step_m: float


class BadFieldError(ValueError):
    """Error: an implausible field in a verified sentence."""


def number(fields: Fields, name: str, least: float = -math.inf) -> float | None:
    """Number, not below the least; None for an empty field. BadFieldError."""
    value = fields.get(name, "")
    if not isinstance(value, float | int):
        return None
    if not math.isfinite(value) or value < least:
        raise BadFieldError(f"{name} = {value}")
    return float(value)


def count(fields: Fields, name: str) -> int | None:
    """Count, without sign."""
    value = number(fields, name, 0.0)
    return None if value is None else int(value)


def sigma(fields: Fields, name: str) -> float | None:
    """Sigma; infinite if it is no number, since None would mean that it is not given."""
    value = fields.get(name, "")
    if isinstance(value, float) and not math.isfinite(value):
        return math.inf
    return number(fields, name, 0.0)


def letter(fields: Fields, name: str) -> str:
    """Text of a field."""
    return str(fields.get(name, ""))


def dop(fields: Fields, name: str) -> float | None:
    """Dilution of precision; None without a solution."""
    value = number(fields, name, 0.0)
    return value if value is not None and 0.0 < value < NO_DOP else None


def angle(fields: Fields, name: str) -> float | None:
    """Angle of a circle, in degrees."""
    value = number(fields, name, 0.0)
    if value is not None and value > 360.0:
        raise BadFieldError(f"{name} = {value} deg")
    return value


def step(printed: str) -> float:
    """Step of the last digit."""
    return 10.0 ** -len(printed.partition(".")[2])


def position(fields: Fields, first: int = 1) -> PrintedPosition | None:
    """Position from the fields `lat`, `NS`, `lon`, `EW`, consecutive from number `first` on."""
    lat, lon = number(fields, "lat"), number(fields, "lon")
    if lat is None or lon is None:
        return None
    parts = fields["printed"][first : first + 4]
    printed = ",".join(parts)
    if not _PRINTED_POSITION.match(printed):  # no hemisphere, 60 minutes, signs
        raise BadFieldError(f"not a position: {printed}")
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        raise BadFieldError(f"no such place: {lat} {lon}")
    return PrintedPosition(lat, lon, MINUTE_M * step(parts[0]), MINUTE_M * step(parts[2]))
