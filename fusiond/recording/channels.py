"""The channels of a log, their schemas, and the messages that are made for other tools.

`/fusiond/input` is what a replay needs (`fusiond.recording.records`); all other channels are
derived from it, JSON, and there so that a log opens in Foxglove, Lichtblick and PlotJuggler as it
is. Those named like a topic of MQTT carry the same message.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter

from fusiond.estimators.base import Outcome
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.topics import TOPICS

INPUT = "/fusiond/input"
STATE = "/fusiond/state"
INNOVATION = "/innovation"
LOCATION = "/location"
LOG = "/log"
INPUT_ENCODING = "fusiond.records"
FRAME_ID = "body"
LEVELS = {"info": 2, "warning": 3, "error": 4}
"""Of foxglove.Log: 1 debug to 5 fatal."""

_TIME: dict[str, Any] = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_NUMBER = {"type": ["number", "null"]}
LOCATION_SCHEMA = {
    "title": "foxglove.LocationFix",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "latitude": {"type": "number"},
        "longitude": {"type": "number"},
        "altitude": {"type": "number"},
        "position_covariance": {
            "type": "array",
            "items": {"type": "number"},
            "minItems": 9,
            "maxItems": 9,
        },
        "position_covariance_type": {"type": "integer"},
    },
}
LOG_SCHEMA = {
    "title": "foxglove.Log",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}


@dataclass(frozen=True, slots=True)
class InnovationMessage:
    """How an aid ended when the filter met it, again after a rewind."""

    t_ns: int
    """Of validity, CLOCK_MONOTONIC."""
    source: str
    outcome: str
    """`fused`, `gated`, `too_old`, ... as counted in `health`."""
    nis: float | None
    """nu^T S^-1 nu; null where there was none."""
    degrees: int
    whitened: tuple[float, ...]
    """L^-1 nu with S = L L^T: each is N(0, 1) while filter and measurement agree."""


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel as MCAP has it."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str


def _json_channel(topic: str, name: str, schema: dict[str, Any]) -> Channel:
    return Channel(topic, name, "jsonschema", json.dumps(schema).encode(), "json")


CHANNELS: dict[str, Channel] = {
    channel.topic: channel
    for channel in (
        Channel(
            INPUT,
            "fusiond.Records",
            "text",
            b"little-endian records; see docs/recording.md of fusiond",
            INPUT_ENCODING,
        ),
        _json_channel(STATE, "fusiond.KeptState", {"type": "object"}),
        _json_channel(LOCATION, "foxglove.LocationFix", LOCATION_SCHEMA),
        _json_channel(LOG, "foxglove.Log", LOG_SCHEMA),
        _json_channel(
            INNOVATION, "fusiond.Innovation", TypeAdapter(InnovationMessage).json_schema()
        ),
        *(
            _json_channel(
                f"/{topic.name}",
                f"fusiond.{topic.message.__name__}",
                topic.message.model_json_schema(mode="serialization"),
            )
            for topic in TOPICS
        ),
    )
}


def location(nav: NavMessage, t_ns: int) -> dict[str, Any] | None:
    """foxglove.LocationFix of a solution at `t_ns` of the log; None while nothing is known.

    The covariance is that of east, north, up (m^2), its diagonal alone.
    """
    place = nav.lat_deg, nav.lon_deg, nav.height_m
    if any(figure is None or not math.isfinite(figure) for figure in place):
        return None
    variances = [0.0 if sd is None else sd * sd for sd in (nav.sd_e_m, nav.sd_n_m, nav.sd_d_m)]
    return {
        "timestamp": _time(t_ns),
        "frame_id": FRAME_ID,
        "latitude": place[0],
        "longitude": place[1],
        "altitude": place[2],
        "position_covariance": [
            *(variances[0], 0.0, 0.0),
            *(0.0, variances[1], 0.0),
            *(0.0, 0.0, variances[2]),
        ],
        "position_covariance_type": 2,
    }


def log_line(event: EventMessage, t_ns: int) -> dict[str, Any]:
    """foxglove.Log of an event at `t_ns` of the log."""
    return {
        "timestamp": _time(t_ns),
        "level": LEVELS[event.level],
        "message": f"{event.code}: {event.text}",
        "name": event.source,
        "file": "",
        "line": 0,
    }


def innovation(source: str, t_ns: int, outcome: Outcome) -> InnovationMessage:
    """`/innovation` of an aid valid at `t_ns` (monotonic)."""
    nis = outcome.nis if math.isfinite(outcome.nis) else None
    whitened = tuple(float(v) for v in outcome.whitened)
    return InnovationMessage(t_ns, source, outcome.name, nis, outcome.degrees, whitened)


def _time(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 1_000_000_000, "nsec": t_ns % 1_000_000_000}
