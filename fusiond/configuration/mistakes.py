"""Mistakes of a configuration as text: dotted key, value as written, remedy.

Works on pydantic models and the data that was read for them; reads no file. Beyond pydantic's own
checks it rejects values that pydantic would convert (`"100"` or `true` for a number), nan and inf.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

_SECRET = re.compile("passw|secret|token", re.IGNORECASE)
"""Keys whose values must not be logged; none of fusiond's own matches."""
Location = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)


def validate(model: type[M], data: dict[str, Any], at: Location = ()) -> tuple[M | None, list[str]]:
    """Validate data: the model, or None and one line for each mistake.

    `at` is where `data` stands in the file, to name its keys.
    """
    mistakes = dict(_converted(model, data, ()))
    try:
        valid = model.model_validate(data)
    except ValidationError as error:
        valid = None
        for detail in error.errors(include_url=False):
            location = _in_data(detail, data)
            mistakes.setdefault(location, _wrong(model, data, detail, location))
    lines = [f"{_key((*at, *location))}{what}" for location, what in mistakes.items()]
    return (None if lines else valid), lines


def mistake(location: Location, value: object, what: str) -> str:
    """One line with key, value and remedy."""
    return f"{_key(location)}{_equals(value)}: {what}"


def did_you_mean(given: object, allowed: Iterable[str]) -> str:
    """List of the allowed values, the nearest to `given` first."""
    known = sorted(allowed)
    near = get_close_matches(str(given), known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}allowed: {', '.join(known)}"


# --------------------------------------------------------------------------- wording


def _key(location: Location) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _equals(value: object) -> str:
    """` = value` as TOML writes it, cut at 60 characters; nothing for a section."""
    if isinstance(value, dict):
        return ""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return f" = {text if len(text) <= 60 else text[:57] + '...'}"


def _wrong(model: type[BaseModel], data: Any, detail: ErrorDetails, at: Location) -> str:
    """The line's end for one error of pydantic."""
    value = detail["input"]
    if detail["type"] == "extra_forbidden":
        arms = _arms(_annotation(model, data, at[:-1]))  # a section, or none
        known = {key for arm in arms if _is_model(arm) for key in arm.model_fields}
        shown = "" if _SECRET.search(str(at[-1])) else _equals(value)
        return f"{shown}: no such key; {did_you_mean(at[-1], known)}"
    if detail["type"] == "union_tag_not_found":
        kinds = _kinds(_annotation(model, data, at))
        return f": lacks the key kind; allowed: {', '.join(kinds)}"
    if detail["type"] == "union_tag_invalid":
        kinds = _kinds(_annotation(model, data, at))
        return f".kind{_equals(value['kind'])}: {did_you_mean(value['kind'], kinds)}"
    if detail["type"] in ("value_error", "assertion_error"):
        return f"{_equals(value)}: {detail['msg'].partition(', ')[2]}"
    annotation = _annotation(model, data, at)
    expected = described(annotation)
    if detail["type"] == "missing":
        return f": missing; expected {expected}"
    arms = _arms(annotation)
    if isinstance(value, str) and all(get_origin(arm) is Literal for arm in arms):
        choices = [str(choice) for arm in arms for choice in get_args(arm)]
        return f"{_equals(value)}: {did_you_mean(value, choices)}"
    return f"{_equals(value)}: expected {expected}"


def described(annotation: Any) -> str:
    """Description of a value of this type in the file."""
    base, constraints = _unpacked(annotation)
    origin = get_origin(base)
    if origin in (Union, UnionType):
        arms = [arm for arm in get_args(base) if arm is not NoneType]
        return " or ".join(dict.fromkeys(map(described, arms)))
    if origin is Literal:
        choices = [json.dumps(choice) for choice in get_args(base)]
        return choices[0] if len(choices) == 1 else "one of " + ", ".join(choices)
    if origin in (tuple, list):
        args = get_args(base)
        if origin is list or args[-1] is Ellipsis:
            return f"a list, each {described(args[0])}"
        return f"a list of {len(args)}, each {described(args[0])}"
    if base is bool:
        return "true or false"
    if base in (int, float):
        return ("an integer" if base is int else "a number") + _range(constraints)
    if base is str:
        patterns = [p for c in constraints if (p := getattr(c, "pattern", None))]
        return "text in quotes" + "".join(f" that matches {p}" for p in patterns)
    if base is Path:
        return "a path in quotes"
    if _is_model(base) or origin is dict:
        return "a section"
    return "another type of value" if base is Any else f"a {getattr(base, '__name__', base)}"


_BOUNDS = ((Gt, "gt", "above"), (Ge, "ge", "at least"), (Lt, "lt", "below"), (Le, "le", "at most"))


def _range(constraints: list[Any]) -> str:
    words = [
        f"{word} {getattr(c, name):.12g}"
        for kind, name, word in _BOUNDS
        for c in constraints
        if isinstance(c, kind)
    ]
    return " " + " and ".join(words) if words else ""


# --------------------------------------------------------------------------- types of the schema


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _unpacked(annotation: Any) -> tuple[Any, list[Any]]:
    """Type without `Annotated`, and its constraints."""
    constraints: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
        for item in metadata:
            constraints.extend(item.metadata if isinstance(item, FieldInfo) else [item])
    return annotation, constraints


def _arms(annotation: Any) -> list[Any]:
    """Types that a value may have, without None."""
    base, _ = _unpacked(annotation)
    if get_origin(base) in (Union, UnionType):
        return [arm for part in get_args(base) for arm in _arms(part)]
    return [] if base is NoneType else [base]


def _kinds(annotation: Any) -> list[str]:
    return [str(a.model_fields["kind"].default) for a in _arms(annotation) if _is_model(a)]


def _descend(annotation: Any, data: Any, name: str | int, key: str | int) -> Any:
    """The type of `data[key]`; `name` is the key of `data` itself, which may stand for its kind."""
    arms = _arms(annotation)
    models = [arm for arm in arms if _is_model(arm)]
    if len(models) > 1 and isinstance(data, dict):
        kind = data.get("kind", name)
        models = [m for m in models if "kind" in m.model_fields and kind in _kinds(m)]
    for arm in [*models, *(a for a in arms if not _is_model(a))]:
        args = get_args(arm)
        if _is_model(arm) and key in arm.model_fields:
            field = arm.model_fields[key]
            return (
                Annotated[(field.annotation, *field.metadata)]
                if field.metadata
                else (field.annotation)
            )
        if get_origin(arm) is dict:
            return args[1]
        if get_origin(arm) in (tuple, list) and isinstance(key, int):
            fixed = get_origin(arm) is tuple and args[-1] is not Ellipsis
            return args[key] if fixed and key < len(args) else args[0]
    return Any


def _annotation(model: type[BaseModel], data: Any, at: Location) -> Any:
    """The type that the schema wants at a place; a section of several kinds becomes its own."""
    annotation: Any = model
    name: str | int = ""
    for key in at:
        annotation = _descend(annotation, data, name, key)
        data = data[key] if _holds(data, key) else None
        name = key
    matching = [a for a in _arms(annotation) if _is_model(a)]
    if len(matching) > 1 and isinstance(data, dict):
        own = [a for a in matching if data.get("kind", name) in _kinds(a)]
        return own[0] if own else annotation
    return annotation


# --------------------------------------------------------------------------- data against schema


def _holds(data: Any, key: str | int) -> bool:
    if isinstance(data, dict):
        return key in data
    return isinstance(data, list) and isinstance(key, int) and key < len(data)


def _in_data(detail: ErrorDetails, data: Any) -> Location:
    """Location in the file: pydantic's without the names of union members."""
    at: list[str | int] = []
    for part in detail["loc"]:
        if _holds(data, part):
            at.append(part)
            data = data[part]
    if detail["type"] == "missing":
        at.append(detail["loc"][-1])
    return tuple(at)


def _converted(model: type[BaseModel], data: Any, at: Location) -> Iterator[tuple[Location, str]]:
    """Values that pydantic would convert without a message, and numbers that are not finite."""

    def walk(annotation: Any, value: Any, at: Location) -> Iterator[tuple[Location, str]]:
        if isinstance(value, dict):
            for key, item in value.items():
                name = at[-1] if at else ""
                yield from walk(_descend(annotation, value, name, key), item, (*at, key))
        elif isinstance(value, list):
            for i, item in enumerate(value):
                yield from walk(_descend(annotation, value, "", i), item, (*at, i))
        elif isinstance(value, float) and not isfinite(value):
            yield at, f"{_equals(value).lower()}: expected a finite number"
        elif _is_converted(annotation, value):
            yield at, f"{_equals(value)}: expected {described(annotation)}"

    yield from walk(model, data, at)


def _is_converted(annotation: Any, value: Any) -> bool:
    """True if pydantic would silently convert a value of one basic type into another."""
    arms = _arms(annotation)
    if any(value in get_args(arm) for arm in arms if get_origin(arm) is Literal):
        return False
    types = {arm for arm in arms if get_origin(arm) is not Literal}
    if not types or not types <= {int, float, bool}:
        return False
    if isinstance(value, bool):
        return bool not in types
    if isinstance(value, int | float):
        return types == {bool}
    return isinstance(value, str)
