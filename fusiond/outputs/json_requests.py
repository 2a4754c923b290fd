"""Parser of clients' JSON with one error for all invalid input.

It also refuses excessive nesting, half a surrogate pair (which no text can encode), NaN and
infinities.

Source: RFC 8259, sections 8.2 and 9 (a parser may limit the depth).
"""

from __future__ import annotations

import json
from math import isfinite
from typing import Any, NoReturn

DEEPEST = 16
"""gpsd's and Foxglove's requests have three levels."""


class NotUnderstoodError(ValueError):
    """Error of invalid JSON; its text is a short reason in ASCII."""


def parsed(text: str | bytes) -> Any:
    """Value of a JSON text. Raises `NotUnderstoodError`."""
    try:
        value = json.loads(text, parse_constant=_refuse_constant, parse_float=_finite)
    except RecursionError:
        raise NotUnderstoodError("nested too deep") from None
    except NotUnderstoodError:
        raise
    except ValueError:
        raise NotUnderstoodError("no JSON") from None
    _look_through(value)
    return value


def _look_through(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST):
        below: list[Any] = []
        for each in level:
            match each:
                case str():
                    _look_at(each)
                case list():
                    below += each
                case dict():
                    below += each.keys()
                    below += each.values()
        if not below:
            return
        level = below
    raise NotUnderstoodError("nested too deep")


def _look_at(text: str) -> None:
    if text.isascii():
        return
    try:
        text.encode()
    except UnicodeEncodeError:
        raise NotUnderstoodError("half a surrogate pair") from None


def _finite(text: str) -> float:
    value = float(text)
    return value if isfinite(value) else _refuse_constant(text[:20])


def _refuse_constant(name: str) -> NoReturn:
    raise NotUnderstoodError(f"{name} is no JSON")
