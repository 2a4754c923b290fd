"""Channels for Foxglove: every topic, and Foxglove's own schemas for map, attitude and log.

Position covariance is east-north-up (m^2), with zeros off the diagonal. The attitude turns the body
axes (x forward, y left, z up) into east-north-up: roll, minus pitch and 90 deg minus yaw, 3-2-1.

Source: JSON schemas `foxglove.LocationFix`, `foxglove.FrameTransforms`, `foxglove.Log`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import pi, radians
from typing import Any

from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.outputs.derived_figures import known, usable
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.topics import EVENT, EVENTS, NAV, REPLY, TOPICS, Topic

_DIAGONAL_KNOWN = 2
NO_HEIGHT_SD_M = 3464.0
"""Sigma of an altitude of 0 where no height is known: roads are within 6 km of it."""
_LEVELS = {"info": 2, "warning": 3, "error": 4}
_NUMBER = {"type": "number"}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_LOCATION = _object(
    timestamp=_TIME,
    frame_id={"type": "string"},
    latitude=_NUMBER,
    longitude=_NUMBER,
    altitude=_NUMBER,
    position_covariance={"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
    position_covariance_type={"type": "integer"},
)
_TRANSFORM = _object(
    timestamp=_TIME,
    parent_frame_id={"type": "string"},
    child_frame_id={"type": "string"},
    translation=_VECTOR,
    rotation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
_TRANSFORMS = _object(transforms={"type": "array", "items": _TRANSFORM})
_LOG = _object(
    timestamp=_TIME,
    level={"type": "integer"},
    message={"type": "string"},
    name={"type": "string"},
    file={"type": "string"},
    line={"type": "integer"},
)


@dataclass(frozen=True, slots=True)
class Channel:
    """Channel to viewers: `payload(message)` converts a message of `topic`, or is None to send
    nothing.

    `schema()` is made on demand: those of all topics take 0.05 s.
    """

    id: int
    name: str
    schema_name: str
    schema: Callable[[], dict[str, Any]]
    topic: Topic
    payload: Callable[[Message], bytes | None]

    def advertised(self) -> dict[str, Any]:
        return {
            "id": self.id,
            "topic": self.name,
            "encoding": "json",
            "schemaName": self.schema_name,
            "schema": json.dumps(self.schema()),
            "schemaEncoding": "jsonschema",
        }


def _time(t_ms: int) -> dict[str, int]:
    return {"sec": t_ms // 1000, "nsec": t_ms % 1000 * 1_000_000}


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def location_fix(message: Message) -> bytes | None:
    """Convert `nav` to `foxglove.LocationFix`; None without a dated position."""
    if not isinstance(message, NavMessage) or not usable(message) or message.t_ms is None:
        return None
    sd = [known(x) for x in (message.sd_e_m, message.sd_n_m, message.sd_d_m)]
    covariance = [0.0] * 9
    covariance[::4] = [0.0 if x is None else x * x for x in sd]
    height = known(message.height_m)
    if height is None:
        height, covariance[8] = 0.0, NO_HEIGHT_SD_M**2  # the schema requires a number
    return _json(
        {
            "timestamp": _time(message.t_ms),
            "frame_id": "body",
            "latitude": message.lat_deg,
            "longitude": message.lon_deg,
            "altitude": height,
            "position_covariance": covariance,
            "position_covariance_type": _DIAGONAL_KNOWN,
        }
    )


def frame_transforms(message: Message) -> bytes | None:
    """Convert `nav` to `foxglove.FrameTransforms`: attitude in a frame that moves with the body."""
    if not isinstance(message, NavMessage) or not usable(message) or message.t_ms is None:
        return None
    angles = [known(x) for x in (message.roll_deg, message.pitch_deg, message.yaw_deg)]
    if any(x is None for x in angles):
        return None
    roll, pitch, yaw = (radians(x) for x in angles if x is not None)
    w, x, y, z = quaternion_from_rpy(roll, -pitch, 0.5 * pi - yaw).tolist()
    transform = {
        "timestamp": _time(message.t_ms),
        "parent_frame_id": "east_north_up",
        "child_frame_id": "body",
        "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    return _json({"transforms": [transform]})


def log(message: Message) -> bytes | None:
    """`foxglove.Log` of an event; None before UTC is settled."""
    if not isinstance(message, EventMessage) or message.t_ms is None:
        return None
    return _json(
        {
            "timestamp": _time(message.t_ms),
            "level": _LEVELS[message.level],
            "message": f"{message.code}: {message.text}",
            "name": message.source,
            "file": "",
            "line": 0,
        }
    )


def _as_it_is(message: Message) -> bytes:
    return message.model_dump_json().encode()


def _channels() -> Iterator[Channel]:
    yield Channel(1, "/location", "foxglove.LocationFix", lambda: _LOCATION, NAV, location_fix)
    yield Channel(2, "/tf", "foxglove.FrameTransforms", lambda: _TRANSFORMS, NAV, frame_transforms)
    yield Channel(3, "/log", "foxglove.Log", lambda: _LOG, EVENT, log)
    served = (t for t in TOPICS if t not in (EVENTS, REPLY))
    for number, topic in enumerate(served, start=4):
        model = topic.message
        name = f"fusiond.{model.__name__}"
        schema = partial(model.model_json_schema, mode="serialization")
        yield Channel(number, f"/{topic.name}", name, schema, topic, _as_it_is)


CHANNELS = tuple(_channels())
