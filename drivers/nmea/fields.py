"""The fields of a sentence by name, typed: by the tables of pynmeagps, without its objects.

The tables say which fields a sentence has, in which order, and what each is. A field that is not of
its type refuses the whole sentence (ValueError), one that is empty stays an empty text, those of
later versions of the standard may be missing. pynmeagps makes an object with an attribute a field,
and dates by `strptime`: 70 us a sentence, where this takes 5; the values are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import date
from typing import Any, cast

from pynmeagps.nmeahelpers import dmm2ddd
from pynmeagps.nmeatypes_core import DE, DT, GROUP, IN, LA, LN
from pynmeagps.nmeatypes_get import NMEA_PAYLOADS_GET

Fields = Mapping[str, Any]
"""By the name that pynmeagps gives a field: float, int, date, or text; `lat` and `lon` degrees with
the sign of their hemisphere. `printed`: the texts of all."""


def _date(printed: str) -> date | str:
    """Of ddmmyy; years 69 to 99 are 1969 to 1999, as POSIX has them. Empty when there is none."""
    if len(printed) != 6 or not printed.isdecimal():
        return ""
    year = int(printed[4:])
    try:
        return date(year + (1900 if year >= 69 else 2000), int(printed[2:4]), int(printed[:2]))
    except ValueError:
        return ""


Convert = Callable[[str], Any]
_CONVERT: dict[str, Convert] = {DE: float, IN: int, LA: dmm2ddd, LN: dmm2ddd, DT: _date}


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


def typed(formatter: str, printed: Sequence[str]) -> Fields:
    """The fields of a sentence. ValueError for one that is not of its type."""
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
