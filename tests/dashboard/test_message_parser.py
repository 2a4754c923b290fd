"""Messages by the published schemas: which are read, which are refused, and for which field."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.dashboard.message_parser import RefusedError, parser_of_schema, topic_parsers
from tests.dashboard.serving import said
from tests.outputs.messages_examples import EXAMPLES
from tests.places import REPOSITORY
from tools import topic_schemas
from tools.topic_schemas import SHOWN

INNOVATION = {"t_ns": 5, "source": "gnss", "outcome": "fused", "nis": 1.5, "degrees": 3}


def test_the_file_of_schemas_is_of_today() -> None:
    held = (REPOSITORY / topic_schemas.FILE).read_text()
    assert held == topic_schemas.text(), "run python -m tools.topic_schemas"
    assert set(topic_parsers()) == set(SHOWN)


@pytest.mark.parametrize("topic", [topic for topic in SHOWN if topic in EXAMPLES])
def test_messages_of_the_daemon_are_parsed_unchanged(topic: str) -> None:
    assert topic_parsers()[topic](said(topic)) == said(topic)


def test_unknown_fields_of_other_versions_are_ignored() -> None:
    nav = said("nav")
    older = {name: value for name, value in nav.items() if not name.startswith("protection_")}
    assert topic_parsers()["nav"](older) == older
    assert topic_parsers()["nav"]({**nav, "sd_odd_m": {"a": [1]}}) == nav
    assert topic_parsers()["innovation"]({**INNOVATION, "more": 1}) == INNOVATION


WRONG: list[tuple[str, Any, str]] = [
    ("status", {"injected": 5}, "injected: no array"),
    ("status", {"mode": "flying"}, "mode: none of waiting"),
    ("status", {"ticks": -1}, "ticks: below 0"),
    ("status", {"ticks": True}, "ticks: no integer"),
    ("status", {"ticks": 2**53}, "ticks: above"),
    ("status", {"why": None}, "why: no string"),
    ("health", {"sources": {"a": {"verdict": []}}}, "sources.a.verdict: no string"),
    ("health", {"sources": {"a": {"sky": {"used": [1]}}}}, "sources.a.sky.used.[0]: no string"),
    ("health", {"sources": []}, "sources: no object"),
    ("innovations", {"t_ms": 1, "innovations": [{"t_ms": -1}]}, "innovations.[0].t_ms: below 0"),
    ("nav", {"t_ms": 1.5}, "t_ms: no integer"),
    ("nav", {"lat_deg": 91}, "lat_deg: above 90"),
    ("nav", {"sd_n_m": "a"}, "sd_n_m: no number"),
    ("nav", {"yaw_deg": -0.1}, "yaw_deg: below 0"),
    ("nav", {"x" * 500: 1}, "no field of this topic"),
    ("nav", {}, "no field of this topic"),
    ("nav", [], "no object"),
    ("nav", 5, "no object"),
    ("events", {"events": [said("event")] * 21}, "events: 21 items"),
    ("calibration", {"parameters": {"y" * 500: {"sd": "a"}}}, f"parameters.{'y' * 40}.sd: no num"),
]


@pytest.mark.parametrize(("topic", "message", "why"), WRONG)
def test_schema_violations_are_refused_with_their_field(topic: str, message: Any, why: str) -> None:
    with pytest.raises(RefusedError) as refused:
        topic_parsers()[topic](message)
    assert str(refused.value).startswith(why)


def test_a_keyword_that_is_not_known_is_no_schema() -> None:
    with pytest.raises(ValueError, match="pattern"):
        parser_of_schema({"type": "string", "pattern": "a"}, {})


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
ANY = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner))


@given(data=st.data(), topic=st.sampled_from([t for t in SHOWN if t in EXAMPLES]))
def test_a_message_with_anything_in_one_place_is_read_whole_or_refused(
    data: st.DataObject, topic: str
) -> None:
    message = said(topic)
    inside, place = _somewhere(data, message)
    inside[place] = data.draw(ANY, label="instead")
    try:
        read = topic_parsers()[topic](message)
    except RefusedError:
        return
    assert topic_parsers()[topic](read) == read or _has_nan(read)


def _somewhere(data: st.DataObject, message: Any) -> tuple[Any, Any]:
    while True:
        places = list(message) if isinstance(message, dict) else list(range(len(message)))
        place = data.draw(st.sampled_from(places), label="place")
        deeper = message[place]
        if not (isinstance(deeper, dict | list) and deeper and data.draw(st.booleans())):
            return message, place
        message = deeper


def _has_nan(said: Any) -> bool:
    if isinstance(said, float):
        return math.isnan(said)
    inside = said.values() if isinstance(said, dict) else said if isinstance(said, list) else ()
    return any(map(_has_nan, inside))


def test_reading_needs_none_of_the_daemons_numerics() -> None:
    code = "import json, sys, fusiond.dashboard.serve as s; print(json.dumps(list(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert not {"numpy", "numba", "pydantic"} & set(json.loads(out.stdout))
