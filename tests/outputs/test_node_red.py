"""The Node-RED flow asks for topics and fields that there are."""

from __future__ import annotations

import json
import re
from typing import Any

from fusiond.outputs.topics import TOPICS
from tests.places import REPOSITORY

FLOW: list[dict[str, Any]] = json.loads((REPOSITORY / "config" / "node-red.json").read_text())
BY_ID = {node["id"]: node for node in FLOW}
MODELS = {topic.name: topic.message for topic in TOPICS}


def below(node: dict[str, Any]) -> list[dict[str, Any]]:
    """The node and all that its messages reach."""
    wired = [BY_ID[i] for output in node.get("wires", []) for i in output]
    return [node, *(n for w in wired for n in below(w))]


def test_every_node_is_wired_to_one_that_there_is() -> None:
    assert len(BY_ID) == len(FLOW)
    entered = [node for node in FLOW if node["type"] == "mqtt in"]
    reached = {n["id"] for node in entered for n in below(node)}
    assert reached == {node["id"] for node in FLOW if "z" in node}
    for node in FLOW:
        for key in ("group", "page", "ui", "theme", "broker", "z"):
            assert node.get(key, "fusiond_base") in {*BY_ID, "localhost"}, node["id"]


def test_the_flow_reads_published_topics_and_fields() -> None:
    asked = 0
    for node in FLOW:
        if node["type"] != "mqtt in":
            continue
        name = node["topic"].removeprefix("fusiond/+/")
        if name == "online":
            continue
        fields = set(MODELS[name].model_fields)
        for function in (n for n in below(node) if n["type"] == "function"):
            used = set(re.findall(r"\b(?:nav|status|e)\.(\w+)", function["func"]))
            assert used <= fields, function["name"]
            asked += len(used)
    assert asked > 15
