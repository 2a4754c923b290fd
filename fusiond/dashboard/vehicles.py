"""Model shared by all viewers: vehicles of a broker or a log, and state of the link."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from fusiond.dashboard.message_parser import RefusedError, topic_parsers
from fusiond.dashboard.vehicle import Vehicle

LARGEST_BYTES = 65536
"""Largest message: `health` of twenty sources with a full sky has some 20 kB."""
MOST_VEHICLES = 32
GIVES_WAY_S = 60.0
"""Age from which a silent vehicle gives way to a new one: a daemon sends its status every second.
So retained messages of former vehicles take no room."""
MOST_NAME = 64
"""Longest name of a vehicle, as in the configuration."""

LARGEST_INTEGER = 2**63 - 1
"""Largest integer: nanoseconds of a recording's clock. Schemas of topics have closer bounds."""
MOST_REASON = 160
"""Letters of the reason that is shown: two lines of the page."""

REFUSALS = ("too_large", "malformed", "not_as_published", "too_many_vehicles")

LinkState = Literal["connecting", "up", "lost", "ended"]


@dataclass(frozen=True, slots=True)
class Link:
    """Link to the source of messages. `ended`: a log has been played to its end."""

    state: LinkState
    text: str
    since_s: float


class Hub:
    """Model of all vehicles, fed with payloads by topic. `now_s` is the clock of the display: the
    host's, or that of the played log, `speed` times as fast.

    A message is used if it fits the published schema of its topic. Otherwise it is refused as a
    whole: the previous message stays and ages.

    Counters: `received`, `other_topic` (none that is shown); refused `too_large`, `malformed`
    (no JSON), `not_as_published`, `too_many_vehicles`.
    """

    def __init__(self, now_s: Callable[[], float], origin: str, speed: float = 1.0) -> None:
        self.now_s = now_s
        self.origin = origin
        self.speed = speed
        self.link = Link("connecting", "", now_s())
        self.vehicles: dict[str, Vehicle] = {}
        self.counters: Counter[str] = Counter()
        self._topics = topic_parsers()
        self._refused_last = ""
        self.send_command: Callable[[str, str, str], None] | None = None
        """Send a command (vehicle, name, id); None where commands are not possible."""

    def linked(self, state: LinkState, text: str = "") -> None:
        """Set the state of the link; the same state again keeps its begin."""
        since_s = self.link.since_s if state == self.link.state else self.now_s()
        self.link = Link(state, text, since_s)

    @property
    def refused(self) -> dict[str, Any]:
        """Rejected messages: number of each kind, and the reason of the last."""
        kinds = {kind: n for kind in REFUSALS if (n := self.counters[kind])}
        return {"count": sum(kinds.values()), "kinds": kinds, "last": self._refused_last}

    def receive(self, vehicle: str, topic: str, payload: bytes, kept: bool = False) -> None:
        """Store a message of `topic` below a vehicle's base; an unusable one is counted."""
        if topic.startswith("fleet/"):  # of each card one
            topic = "fleet"
        if topic not in self._topics and topic != "online":
            self.counters["other_topic"] += 1
            return
        try:
            self._receive(vehicle, topic, payload, kept)
        except _NotTakenError as refused:
            self.counters[refused.kind] += 1
            where = f"{vehicle[:MOST_NAME]}/{topic}"
            self._refused_last = f"{where}: {refused}"[:MOST_REASON]

    def _receive(self, vehicle: str, topic: str, payload: bytes, kept: bool) -> None:
        if len(payload) > LARGEST_BYTES:
            raise _NotTakenError("too_large", f"more than {LARGEST_BYTES} bytes")
        if len(vehicle) > MOST_NAME:
            raise _NotTakenError("too_large", f"a name of more than {MOST_NAME} letters")
        said = self._read(topic, payload)
        now_s = self.now_s()
        one = self.vehicles.get(vehicle)
        if one is None:
            if len(self.vehicles) >= MOST_VEHICLES:
                self._make_room(now_s, kept)
            one = self.vehicles[vehicle] = Vehicle(vehicle)
        self.counters["received"] += 1
        if not kept:
            one.received_s = now_s
        one.receive(topic, said, now_s, kept)

    def _make_room(self, now_s: float, kept: bool) -> None:
        """Remove the vehicle that was silent longest, for a new one."""
        silent = min(self.vehicles.values(), key=lambda one: one.received_s)
        if kept or now_s - silent.received_s < GIVES_WAY_S:
            raise _NotTakenError("too_many_vehicles", f"there are {MOST_VEHICLES} already")
        del self.vehicles[silent.name]

    def _read(self, topic: str, payload: bytes) -> Any:
        """Parse a message by the schema of its topic."""
        if topic == "online":
            if payload not in (b"online", b"offline"):
                raise _NotTakenError("not_as_published", "neither online nor offline")
            return payload.decode()
        try:
            said = _parsed(payload)
        except (ValueError, RecursionError) as error:
            raise _NotTakenError("malformed", f"no JSON: {error}") from None
        try:
            return self._topics[topic](said)
        except RefusedError as error:
            raise _NotTakenError("not_as_published", str(error)) from None


class _NotTakenError(Exception):
    """Rejection of a message; `kind` is its counter."""

    def __init__(self, kind: str, why: str) -> None:
        super().__init__(why)
        self.kind = kind


def _parsed(payload: bytes) -> Any:
    """Parse JSON that can be sent to a browser: without NaN, infinities (1e999 is read as one) and
    integers beyond bounds. Raises ValueError, and RecursionError where it is far too deep."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    return json.loads(payload, parse_constant=refuse, parse_float=_finite, parse_int=_exact)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:MOST_NAME]}: too large")
    return value


def _exact(text: str) -> int:
    # A longer one is refused unread: Python's time goes with the square of the digits.
    value = int(text) if len(text) <= len(str(-LARGEST_INTEGER)) else LARGEST_INTEGER + 1
    if abs(value) > LARGEST_INTEGER:
        raise ValueError(f"{text[:MOST_NAME]}: too large")
    return value
