"""Settings that differ from the defaults of this version."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import PydanticUndefined, to_jsonable_python

from fusiond.configuration.aiding import AnyAiding
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config, Imu
from fusiond.report.run import Difference

_AIDING: TypeAdapter[AnyAiding] = TypeAdapter(AnyAiding)


def changed_settings(config: bytes | None) -> list[Difference] | None:
    """Values other than the defaults, by dotted key, in the file's order; None for a log without a
    configuration. An inertial unit's defaults are those of its `sensor_class`."""
    try:
        data = json.loads(config or b"")
    except ValueError:
        return None
    if not isinstance(data, dict):
        return None
    return list(_between("", data, _defaults(data)))


def _between(key: str, data: dict[str, Any], default: dict[str, Any]) -> Iterator[Difference]:
    for name, value in data.items():
        usual = default.get(name)
        if isinstance(value, dict) and (value or isinstance(usual, dict)):
            yield from _between(f"{key}{name}.", value, usual if isinstance(usual, dict) else {})
        elif name not in default:
            yield Difference(f"{key}{name}", json.dumps(value), None)
        elif value != usual:
            yield Difference(f"{key}{name}", json.dumps(value), json.dumps(usual))


def _defaults(data: dict[str, Any]) -> dict[str, Any]:
    defaults = Config().model_dump(mode="json")
    sensor_class = _section(data, "imu").get("sensor_class")
    try:
        imu = Imu.model_validate({"sensor_class": sensor_class})
        defaults["imu"] = {**imu.model_dump(mode="json"), "sensor_class": None}
    except ValidationError:  # a class that a later version knows
        pass
    defaults["aiding"] = {n: _aiding(s) for n, s in _section(data, "aiding").items()}
    defaults["sources"] = {n: _options(s) for n, s in _section(data, "sources").items()}
    return defaults


def _section(data: dict[str, Any], name: str) -> dict[str, Any]:
    found = data.get(name)
    return found if isinstance(found, dict) else {}


def _aiding(section: object) -> dict[str, Any]:
    """Defaults of a section of `aiding`; its kind is always shown."""
    kind = section.get("kind") if isinstance(section, dict) else None
    try:
        default = _AIDING.validate_python({"kind": kind}).model_dump(mode="json")
    except ValidationError:
        return {}
    del default["kind"]
    return default


def _options(section: object) -> dict[str, Any]:
    """Defaults of a driver's options; the driver's name and its required options are always
    shown."""
    driver = section.get("driver") if isinstance(section, dict) else None
    point = driver_entry_points().get(str(driver))
    if point is None:
        return {}
    options: type[BaseModel] = point.load().Options
    found = {
        name: field.get_default(call_default_factory=True, validated_data={})
        for name, field in options.model_fields.items()
    }
    return {
        name: to_jsonable_python(value)
        for name, value in found.items()
        if value is not PydanticUndefined
    }
