"""The messages, their schemas and the documentation of both."""

from __future__ import annotations

import json
import re
from math import nan, radians

import pytest
from pydantic import ValidationError

from fusiond.configuration.schema import Mqtt
from fusiond.files.solution_csv import COLUMNS
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.asyncapi import asyncapi
from fusiond.outputs.commands import COMMANDS, MAX_PAYLOAD_BYTES, BadCommandError, parse
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.nav import NavMessage, nav_message
from fusiond.outputs.topics import TOPICS
from tests.outputs.messages_examples import EXAMPLES, SOLUTION, UTC_NS
from tests.places import REPOSITORY

DOCS = REPOSITORY / "docs" / "mqtt.md"


def test_nav_has_the_columns_of_a_solution_file() -> None:
    figures = set(COLUMNS) - {"t_s", "status"}
    others = {"t_utc", "t_ms", "mode", "protection_horizontal_m", "protection_vertical_m"}
    assert set(NavMessage.model_fields) - others == figures
    message = nav_message(SOLUTION, UTC_NS)
    assert message.lat_deg == 31.025438871
    assert message.yaw_deg == pytest.approx(346.09)
    assert message.sd_roll_deg == pytest.approx(0.08)
    assert message.t_ms == 1_795_217_587_123
    assert message.t_utc == "2026-11-20T23:33:07.123Z"


def test_unknown_is_null_and_parses_back() -> None:
    text = nav_message(Solution(0, Mode.WAITING, "no IMU data yet"), None).model_dump_json()
    values = json.loads(text, parse_constant=pytest.fail)
    assert values.pop("mode") == "waiting"
    assert set(values.values()) == {None}
    back = NavMessage.model_validate_json(text)
    assert back.lat_deg is None


def test_yaw_stays_below_360() -> None:
    solution = Solution(0, Mode.NAVIGATING, "", rpy_rad=(0.0, 0.0, -1e-12), height_m=nan)
    assert nav_message(solution, None).yaw_deg == 0.0
    turned = Solution(0, Mode.NAVIGATING, "", rpy_rad=(0.0, 0.0, radians(-90)))
    assert nav_message(turned, None).yaw_deg == 270.0


@pytest.mark.parametrize(
    ("utc_ns", "text", "t_ms"),
    [
        (None, None, None),
        (0, "1970-01-01T00:00:00.000Z", 0),
        (1_483_228_799_999_999_999, "2016-12-31T23:59:59.999Z", 1_483_228_799_999),
        (1_795_217_587_005_000_000, "2026-11-20T23:33:07.005Z", 1_795_217_587_005),
    ],
)
def test_stamp(utc_ns: int | None, text: str | None, t_ms: int | None) -> None:
    assert stamp(utc_ns) == (text, t_ms)


def test_messages_are_closed_and_immutable() -> None:
    for topic in TOPICS:
        values = EXAMPLES[topic.name].model_dump()
        with pytest.raises(ValidationError, match="extra"):
            topic.message(**values, surplus=1)


def documented() -> dict[str, list[object]]:
    """JSON blocks of the documentation by the topic in the heading above them."""
    found: dict[str, list[object]] = {}
    for section in re.split(r"^### ", DOCS.read_text(), flags=re.M)[1:]:
        topic = section.split("`")[1]
        found[topic.partition("/<")[0]] = [
            json.loads(b) for b in re.findall(r"```json\n(.*?)```", section, re.S)
        ]
    return found


def test_documented_examples_are_what_the_daemon_sends() -> None:
    blocks = documented()
    for topic in TOPICS:
        assert blocks[topic.name] == [json.loads(EXAMPLES[topic.name].model_dump_json())]
        for value in blocks[topic.name]:
            topic.message.model_validate_json(json.dumps(value))


def test_documented_commands_are_accepted() -> None:
    blocks = documented()
    for name in COMMANDS:
        assert blocks[f"cmd/{name}"], name
        for value in blocks[f"cmd/{name}"]:
            assert parse(name, json.dumps(value).encode()).id


def test_every_configurable_command_exists() -> None:
    assert Mqtt(commands=tuple(COMMANDS)).commands == tuple(COMMANDS)


def test_asyncapi_is_complete_and_its_references_resolve() -> None:
    document = json.loads(json.dumps(asyncapi("truck")))
    addresses = {c["address"] for c in document["channels"].values()}
    assert addresses == {
        f"fusiond/truck/{t}"
        for t in ("online", *(t.path for t in TOPICS), *(f"cmd/{n}" for n in COMMANDS))
    }
    qos = {
        o["channel"]["$ref"].rsplit("/", 1)[1]: o["bindings"]["mqtt"]
        for o in document["operations"].values()
    }
    assert qos["status"] == {"qos": 1, "retain": True}
    assert qos["nav"] == {"qos": 0, "retain": False}
    actions = {o["action"] for k, o in document["operations"].items() if "cmd" in k}
    assert actions == {"receive"}
    references = re.findall(r'"\$ref": "#/([^"]+)"', json.dumps(document))
    assert references
    for reference in references:
        node = document
        for part in reference.split("/"):
            node = node[part]
        assert node
    schemas = document["components"]["schemas"]
    assert schemas["NavMessage"]["properties"]["sd_n_m"]["anyOf"][0] == {"type": "number"}


@pytest.mark.parametrize(
    ("payload", "request_id"),
    [
        (b"[]", None),
        (b'{"id": 5}', None),
        (b'{"id": ""}', ""),
        (b'{"id": "x", "more": 1}', "x"),
        (b'{"id": "' + b"y" * 65 + b'"}', None),
        (b" " * (MAX_PAYLOAD_BYTES + 1), None),
    ],
)
def test_bad_commands(payload: bytes, request_id: str | None) -> None:
    with pytest.raises(BadCommandError) as error:
        parse("reset_filter", payload)
    assert error.value.id == request_id
