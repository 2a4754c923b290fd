"""AsyncAPI document of a vehicle's topics, printed by `fusiond schema`."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from fusiond.outputs.commands import COMMANDS
from fusiond.outputs.topics import TOPICS, Topic, base_topic

PARAMETER = re.compile(r"\{(\w+)\}")


def asyncapi(vehicle: str) -> dict[str, Any]:
    """AsyncAPI 3.0 document of a vehicle's topics, with the schemas of the models."""
    base = base_topic(vehicle)
    received = [Topic(f"cmd/{name}", model, 1, False) for name, model in COMMANDS.items()]
    models: list[tuple[type[BaseModel], Literal["validation", "serialization"]]] = [
        *((t.message, "serialization") for t in TOPICS),
        *((t.message, "validation") for t in received),
    ]
    names, definitions = models_json_schema(models, ref_template="#/components/schemas/{model}")
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    messages: dict[str, Any] = {
        "Online": {"contentType": "text/plain", "payload": {"enum": ["online", "offline"]}}
    }

    def add(topic: str, message: str, action: str, qos: int, retained: bool) -> None:
        key = PARAMETER.sub(r"\1", topic).replace("/", "_")
        channels[key] = {
            "address": f"{base}/{topic}",
            **({"parameters": {n: {} for n in PARAMETER.findall(topic)}} if "{" in topic else {}),
            "messages": {message: {"$ref": f"#/components/messages/{message}"}},
        }
        operations[f"{action}_{key}"] = {
            "action": action,
            "channel": {"$ref": f"#/channels/{key}"},
            "bindings": {"mqtt": {"qos": qos, "retain": retained}},
        }

    add("online", "Online", "send", 1, True)
    for topic, mode, action in [
        *((t, "serialization", "send") for t in TOPICS),
        *((t, "validation", "receive") for t in received),
    ]:
        name = topic.message.__name__
        payload = next(v for (m, k), v in names.items() if m is topic.message and k == mode)
        messages[name] = {"contentType": "application/json", "payload": payload}
        add(topic.path, name, action, topic.qos, topic.retained)
    return {
        "asyncapi": "3.0.0",
        "info": {"title": "fusiond", "version": "1", "description": f"Vehicle {vehicle}"},
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": definitions["$defs"]},
    }
