"""The schemas by which the dashboard reads messages: `python -m tools.topic_schemas`.

Made of the daemon's models, as `fusiond schema` prints them, without titles and descriptions. A
test holds that the file is of today.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import JsonSchemaMode, models_json_schema

from fusiond.outputs.topics import TOPICS
from fusiond.recording.channels import InnovationMessage

SHOWN = (
    *("nav", "status", "health", "consistency", "calibration"),
    *("innovation", "innovations", "event", "events", "reply", "message", "fleet"),
)
"""What `fusiond.dashboard.vehicle` takes, beside `online`; `innovation` is a recording's."""
FILE = Path("fusiond/dashboard/topics.json")
_MODE: JsonSchemaMode = "serialization"


def schemas() -> dict[str, Any]:
    """`topics` by name, and `$defs` that they refer to."""
    shown = [topic for topic in TOPICS if topic.name in SHOWN]
    names, definitions = models_json_schema([(topic.message, _MODE) for topic in shown])
    by_name = {topic.name: names[topic.message, _MODE] for topic in shown}
    # One by one, as a recording has them.
    by_name["innovation"] = TypeAdapter(InnovationMessage).json_schema(mode=_MODE)
    return {"topics": _bare(by_name), "$defs": _bare(definitions["$defs"])}


def _bare(schemas: dict[str, Any]) -> dict[str, Any]:
    return {name: _without_words(schema) for name, schema in sorted(schemas.items())}


def _without_words(schema: Any) -> Any:
    """Without what is for people."""
    if isinstance(schema, list):
        return [_without_words(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {k: v for k, v in schema.items() if k not in ("title", "description", "default")}
    fields = kept.pop("properties", None)
    kept = {key: _without_words(value) for key, value in kept.items()}
    return kept if fields is None else {**kept, "properties": _bare_in_order(fields)}


def _bare_in_order(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: _without_words(schema) for name, schema in fields.items()}


def text() -> str:
    """What the file holds."""
    return json.dumps(schemas(), indent=1) + "\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
    sys.exit()
