"""Parser of messages by the published schemas of `fusiond schema`.

`topics.json` holds the schemas of the topics that are shown. `python -m tools.topic_schemas` makes
them from the daemon's models, whose import would load 250 MB of numerics. A message is read field
by field into a copy:

    present    as the schema says, else the whole message is refused
    absent     left absent: a daemon of an earlier version does not say it
    unknown    left out: one of a later version says more

The parser knows the keywords of JSON Schema (draft 2020-12) that pydantic writes for these models;
any other keyword is an error when the file is read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

Read = Callable[[Any], Any]
"""Reader of a message: copies the part that a schema describes. Raises `RefusedError`."""

_SHOWN = 40
"""Letters repeated of a name in a message: known names have 29 at most."""
_TYPES: dict[str, tuple[type, ...]] = {
    "null": (type(None),),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "string": (str,),
    "array": (list,),
    "object": (dict,),
}
_WORDS = {"enum", "const", "minimum", "maximum", "maxItems", "items", "prefixItems", "minItems"} | {
    *("type", "anyOf", "$ref", "properties", "additionalProperties", "required", "default")
}


class RefusedError(ValueError):
    """Error: a message that does not fit its topic. `why` is the reason, with the field."""

    def __init__(self, why: str, where: str = "") -> None:
        super().__init__(f"{where}: {why}" if where else why)
        self.why, self.where = why, where

    def below(self, name: str) -> RefusedError:
        """Refusal with `name` prefixed to the path of its field."""
        rest = f".{self.where}" if self.where else ""
        return RefusedError(self.why, name[:_SHOWN] + rest)


@cache
def topic_parsers() -> dict[str, Read]:
    """Readers of messages by topic."""
    published = json.loads(files("fusiond.dashboard").joinpath("topics.json").read_bytes())
    shared: dict[str, Read] = {}
    shared |= {name: _later(shared, name) for name in published["$defs"]}
    shared |= {
        name: parser_of_schema(schema, shared) for name, schema in published["$defs"].items()
    }
    return {topic: _message(schema, shared) for topic, schema in published["topics"].items()}


def _later(shared: Mapping[str, Read], name: str) -> Read:
    """Placeholder for a schema that another one names before it is built."""

    def later(said: Any) -> Any:
        return shared[name](said)

    return later


def _message(schema: Mapping[str, Any], shared: Mapping[str, Read]) -> Read:
    """Reader of an object. It requires at least one field of its topic, since each may be
    absent."""
    read = parser_of_schema(schema, shared)

    def message(said: Any) -> Any:
        kept = read(said)
        if not kept:
            raise RefusedError("no field of this topic")
        return kept

    return message


def parser_of_schema(schema: Mapping[str, Any], shared: Mapping[str, Read]) -> Read:
    """Make the reader of a schema; `shared` has the readers of the schemas it refers to. Raises
    ValueError for an unknown keyword."""
    unknown = schema.keys() - _WORDS
    if unknown:
        raise ValueError(f"keywords of JSON Schema that are not known here: {sorted(unknown)}")
    if "$ref" in schema:
        return shared[schema["$ref"].rpartition("/")[2]]
    if "anyOf" in schema:
        return _any_of(
            [parser_of_schema(each, shared) for each in schema["anyOf"]], schema["anyOf"]
        )
    kind = schema["type"]
    if kind == "object":
        return _object(schema, shared)
    if kind == "array":
        return _array(schema, shared)
    return _scalar(kind, schema)


def _kind(said: Any, kind: str) -> bool:
    return isinstance(said, _TYPES[kind]) and (kind == "boolean" or not isinstance(said, bool))


def _scalar(kind: str, schema: Mapping[str, Any]) -> Read:
    allowed = (schema["const"],) if "const" in schema else schema.get("enum")
    low, high = schema.get("minimum"), schema.get("maximum")

    def scalar(said: Any) -> Any:
        if not _kind(said, kind):
            raise RefusedError(f"no {kind}")
        if allowed is not None and said not in allowed:
            raise RefusedError(f"none of {', '.join(map(str, allowed))}")
        if low is not None and said < low:
            raise RefusedError(f"below {low:g}")
        if high is not None and said > high:
            raise RefusedError(f"above {high:g}")
        return said

    return scalar


def _any_of(readers: list[Read], schemas: list[Mapping[str, Any]]) -> Read:
    """Reader of alternatives: the first that accepts; otherwise the last reason."""
    ordered = sorted(
        zip(readers, schemas, strict=True), key=lambda pair: pair[1].get("type") != "null"
    )

    def any_of(said: Any) -> Any:
        why = RefusedError("nothing that it may be")
        for read, _ in ordered:
            try:
                return read(said)
            except RefusedError as refused:
                why = refused
        raise why

    return any_of


def _array(schema: Mapping[str, Any], shared: Mapping[str, Read]) -> Read:
    each = parser_of_schema(schema["items"], shared) if "items" in schema else None
    first = [parser_of_schema(one, shared) for one in schema.get("prefixItems", ())]
    least, most = schema.get("minItems", 0), schema.get("maxItems")

    def array(said: Any) -> Any:
        if not isinstance(said, list):
            raise RefusedError("no array")
        if len(said) < least or (most is not None and len(said) > most):
            raise RefusedError(f"{len(said)} items")
        return [
            _inside(f"[{place}]", first[place] if place < len(first) else each, one)
            for place, one in enumerate(said)
        ]

    return array


def _object(schema: Mapping[str, Any], shared: Mapping[str, Read]) -> Read:
    named = {
        name: parser_of_schema(one, shared) for name, one in schema.get("properties", {}).items()
    }
    more = schema.get("additionalProperties", False)
    others = parser_of_schema(more, shared) if isinstance(more, Mapping) else None

    def of_object(said: Any) -> Any:
        if not isinstance(said, dict):
            raise RefusedError("no object")
        kept = {}
        for name, one in said.items():
            read = named.get(name, others)
            if read is not None:
                kept[name] = _inside(name, read, one)
        return kept

    return of_object


def _inside(name: str, read: Read | None, said: Any) -> Any:
    """Parse a part; a refusal names the part before the reason."""
    if read is None:
        raise RefusedError("one too many", name)
    try:
        return read(said)
    except RefusedError as refused:
        raise refused.below(name) from None
