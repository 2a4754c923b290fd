"""Channels of a log with their schemas, and messages for other tools.

A replay needs `/fusiond/input` alone (`fusiond.recording.records`). All other channels are derived
from it, as JSON, so that Foxglove, Lichtblick and PlotJuggler open a log as it is. A channel with
the name of an MQTT topic carries the same message.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from pydantic import TypeAdapter

from fusiond.estimators.base import Outcome
from fusiond.navigator.timeline import Entry
from fusiond.outputs.foxglove import channels as foxglove
from fusiond.outputs.topics import EVENTS, TOPICS

INPUT = "/fusiond/input"
STATE = "/fusiond/state"
INNOVATION = "/innovation"
LOCATION = "/location"
INPUT_ENCODING = "fusiond.records"


@dataclass(frozen=True, slots=True)
class InnovationMessage:
    """Outcome of a measurement in the filter, repeated after a rewind."""

    t_ns: int
    """Instant of validity, CLOCK_MONOTONIC."""
    source: str
    outcome: str
    """`fused`, `gated`, `too_old`, ... as counted in `health`."""
    nis: float | None
    """nu^T S^-1 nu; null without an innovation."""
    degrees: int
    whitened: tuple[float, ...]
    """L^-1 nu with S = L L^T: each is N(0, 1) while filter and measurement agree."""
    raw: tuple[float, ...]
    """Estimate minus measurement in `unit`, before the gate, to a micrometre. Empty for a
    measurement of neither position nor velocity, or one that was not applied."""
    unit: Literal["m", "m/s"] | None
    axes: str
    """A letter for each of `raw`, of `ned`; empty where each is along a direction of its own."""


@dataclass(frozen=True, slots=True)
class Channel:
    """MCAP channel; `schema()` is built on demand."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: Callable[[], bytes]
    encoding: str


def _json_channel(topic: str, name: str, schema: Callable[[], dict[str, Any]]) -> Channel:
    return Channel(topic, name, "jsonschema", lambda: json.dumps(schema()).encode(), "json")


OF_FOXGLOVE = tuple(c for c in foxglove.CHANNELS if c.schema_name.startswith("foxglove."))
"""Channels for Foxglove: map, attitude, log."""
CHANNELS: dict[str, Channel] = {
    channel.topic: channel
    for channel in (
        Channel(
            INPUT,
            "fusiond.Records",
            "text",
            lambda: b"little-endian records; see docs/recording.md of fusiond",
            INPUT_ENCODING,
        ),
        _json_channel(STATE, "fusiond.KeptState", lambda: {"type": "object"}),
        *(_json_channel(c.name, c.schema_name, c.schema) for c in OF_FOXGLOVE),
        _json_channel(INNOVATION, "fusiond.Innovation", TypeAdapter(InnovationMessage).json_schema),
        *(
            _json_channel(
                f"/{topic.name}",
                f"fusiond.{topic.message.__name__}",
                partial(topic.message.model_json_schema, mode="serialization"),
            )
            for topic in TOPICS
            if topic is not EVENTS  # a log has each event at its own time
        ),
    )
}


def innovation(entry: Entry, outcome: Outcome) -> InnovationMessage:
    """Message `/innovation` of a measurement with this outcome."""
    nis = outcome.nis if math.isfinite(outcome.nis) else None
    whitened = tuple(float(v) for v in outcome.whitened)
    raw = entry.raw
    values = () if raw is None else tuple(round(v, 6) for v in raw.values)
    return InnovationMessage(
        entry.key[0],
        entry.measurement.source,
        outcome.name,
        nis,
        outcome.degrees,
        whitened,
        values,
        None if raw is None else raw.unit,
        "" if raw is None else raw.axes,
    )
