"""All vehicles of a broker or a log, and how the link to it is: what the viewers look at."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from fusiond.dashboard.vehicle import Vehicle

LARGEST_BYTES = 65536
"""`health` of twenty sources with a full sky has some 20 kB; what is larger is not ours."""
MOST_VEHICLES = 32
MOST_NAME = 64
"""Letters of a vehicle's name, as the configuration has it."""

DEEPEST = 16
"""Levels of a message; ours have five. What can just be read could not be written in a frame."""

LinkState = Literal["connecting", "up", "lost", "ended"]


@dataclass(frozen=True, slots=True)
class Link:
    """The way to what is shown. `ended`: a log has been played to its end."""

    state: LinkState
    text: str
    since_s: float


class Hub:
    """Takes payloads in by topic. `now_s` is the clock of all that is shown: the host's, or that of
    the log that is played, `speed` times as fast as the host's.

    Counters: `received`; refused `too_large`, `malformed`, `too_many_vehicles`.
    """

    def __init__(self, now_s: Callable[[], float], origin: str, speed: float = 1.0) -> None:
        self.now_s = now_s
        self.origin = origin
        self.speed = speed
        self.link = Link("connecting", "", now_s())
        self.vehicles: dict[str, Vehicle] = {}
        self.counters: Counter[str] = Counter()
        self.send_command: Callable[[str, str, str], None] | None = None
        """Puts a command (vehicle, name, id) on its way; None where none is possible."""

    def linked(self, state: LinkState, text: str = "") -> None:
        """The link has changed; the same state again keeps its beginning."""
        since_s = self.link.since_s if state == self.link.state else self.now_s()
        self.link = Link(state, text, since_s)

    def take(self, vehicle: str, topic: str, payload: bytes, kept: bool = False) -> None:
        """A message of `topic` below a vehicle's base; what cannot be read is counted."""
        if len(payload) > LARGEST_BYTES or len(vehicle) > MOST_NAME:
            self.counters["too_large"] += 1
            return
        try:
            said = payload.decode() if topic == "online" else _parsed(payload)
        except (ValueError, RecursionError):
            self.counters["malformed"] += 1
            return
        one = self.vehicles.get(vehicle)
        if one is None:
            if len(self.vehicles) >= MOST_VEHICLES:
                self.counters["too_many_vehicles"] += 1
                return
            one = self.vehicles[vehicle] = Vehicle(vehicle)
        self.counters["received"] += 1
        one.take(topic, said, self.now_s(), kept)


def _parsed(payload: bytes) -> Any:
    """JSON that can be written again for a browser: no NaN, nothing infinite, which 1e999 would be
    read as. Raises ValueError, and RecursionError where it is far too deep."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    said = json.loads(payload, parse_constant=refuse, parse_float=_finite)
    if _deeper(said, DEEPEST):
        raise ValueError(f"nested deeper than {DEEPEST}")
    return said


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text}: too large")
    return value


def _deeper(said: Any, levels: int) -> bool:
    inside = said.values() if isinstance(said, dict) else said if isinstance(said, list) else ()
    return any(levels == 0 or _deeper(each, levels - 1) for each in inside)
