"""State of one vehicle: latest message of each topic with its arrival, and ten minutes of history.

Every stored item has a number of one growing count. Viewers ask for items after a number: a slow
viewer gets the newest ones and never a queue of old ones.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from fusiond.dashboard.advice import advice
from fusiond.dashboard.counter_window import CounterWindow
from fusiond.dashboard.history import LatestRows, LatestRowsByKey

Said = Mapping[str, Any]

LIMITS_S = {"nav": 1.0, "status": 3.0, "health": 3.0, "consistency": 3.0, "calibration": 90.0}
"""Age from which a value is stale: three missed messages of a topic with an interval of a second
(`status`, `health` by default) or 30 s (`calibration`); a second for `nav`, which has ten a second
by default. docs/mqtt.md lists the rates."""
MISSED = 3
"""Missed messages from which a slower topic is stale."""
INTERVALS = 8
"""Intervals whose median is a topic's rate; one long silence does not change it."""
ROW_EVERY_S = 0.5
"""Spacing of the rows of a solution: ten minutes are 1200 points, about a plot's pixels."""
MOST_ROWS = {"nav": 1200, "nis": 4800, "delay": 500, "event": 200, "message": 200}
"""Most rows by kind; `nis`: eight sources for ten minutes at 1 Hz."""
KINDS = {"nav": "ddo" + 10 * "d", "nis": "doddd", "delay": "dod", "event": "do", "message": "do"}
"""Kinds of rows by column, as in `history`; those of `nav` come from `nav_row`."""
MOST_INNOVATIONS = 12000
"""20 a second for ten minutes: position and velocity of a receiver at 10 Hz."""
MOST_CARDS = 256
"""Other vehicles that are kept: as many as a daemon tells."""
CARRIED = ("nav", "status", "health", "consistency", "calibration")


@dataclass
class LatestMessage:
    """Last message of a topic. `at_s` is its arrival, None for a retained message."""

    number: int
    at_s: float | None
    said: Any
    intervals: deque[float] = field(default_factory=lambda: deque(maxlen=INTERVALS))


class Vehicle:
    """Messages of one vehicle, added in order of arrival (`at_s`, seconds of one clock)."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.count = 0
        self.received_s = float("-inf")
        """Instant of its last message; a retained message does not count."""
        self._latest: dict[str, LatestMessage] = {}
        self._rows = {kind: LatestRows(most, KINDS[kind]) for kind, most in MOST_ROWS.items()}
        self._innovations = LatestRowsByKey(MOST_INNOVATIONS, "doodd")
        self._next_row_s = float("-inf")
        self._received: dict[str, int] = {}
        self._recent = {
            "health": CounterWindow("ticks", "overruns"),
            "status": CounterWindow("mqtt_taken_over"),
        }
        self._lately: dict[str, Said] = {}

    def receive(self, topic: str, said: Any, at_s: float, kept: bool = False) -> None:
        """Store a message of `topic`. `kept` marks a retained one, whose age is unknown."""
        if topic == "online":
            if said in ("online", "offline"):
                self._put(topic, said, None if kept else at_s)
        elif not isinstance(said, Mapping):
            return
        elif topic == "event":
            self._row("event", [None if kept else at_s, said])
        elif topic == "events":
            self._earlier_events(said.get("events"), kept)
        elif topic == "innovation":  # of a recording: one by one
            self._innovation(said, number(said, "t_ns"), at_s)
        elif topic == "innovations":
            self._bundle(said, at_s)
        elif topic == "message":
            self._row("message", [None if kept else at_s, said])
        elif topic == "fleet":
            self._other(said, None if kept else at_s)
        elif topic == "reply":
            self._put(topic, said, at_s)
        elif topic in CARRIED:
            self._put(topic, said, None if kept else at_s)
            self._remember(topic, said, at_s, kept)

    # ------------------------------------------------------------------ what is asked

    def since(self, count: int) -> dict[str, Any]:
        """Changes after `count`: `messages` by topic, `rows` by kind."""
        messages = {
            topic: {"at": latest.at_s, "limit": self.limit_s(topic), "said": latest.said}
            for topic, latest in self._latest.items()
            if latest.number > count
        }
        kinds: dict[str, LatestRows | LatestRowsByKey] = {
            **self._rows,
            "innovation": self._innovations,
        }
        newer = {kind: kept.newer(count) for kind, kept in kinds.items()}
        return {"messages": messages, "rows": {kind: rows for kind, rows in newer.items() if rows}}

    def limit_s(self, topic: str) -> float | None:
        """Age (s) from which a message of `topic` is stale; None for a topic without a limit."""
        least = LIMITS_S.get(topic)
        if least is None:
            return None
        intervals = self._latest[topic].intervals if topic in self._latest else ()
        return max(least, MISSED * median(intervals)) if intervals else least

    def said(self, topic: str) -> Any:
        """The last message of a topic, an empty one before the first."""
        latest = self._latest.get(topic)
        return {} if latest is None else latest.said

    # ------------------------------------------------------------------ inside

    def _put(self, topic: str, said: Any, at_s: float | None) -> None:
        self.count += 1
        before = self._latest.get(topic)
        latest = LatestMessage(self.count, at_s, said)
        if before is not None:
            latest.intervals = before.intervals
            if at_s is not None and before.at_s is not None:
                latest.intervals.append(at_s - before.at_s)
        self._latest[topic] = latest

    def _other(self, said: Said, at_s: float | None) -> None:
        """Store the position of another vehicle, which has a message for each card."""
        topic = f"fleet/{said.get('card')}"
        others = sum(name.startswith("fleet/") for name in self._latest)
        if topic in self._latest or others < MOST_CARDS:
            self._put(topic, said, at_s)

    def _row(self, kind: str, row: list[Any]) -> None:
        self.count += 1
        self._rows[kind].add(self.count, row)

    def _earlier_events(self, events: object, kept: bool) -> None:
        """Add earlier events from a retained message."""
        if kept and isinstance(events, list) and not self._rows["event"]:
            for one in events:
                if isinstance(one, Mapping):
                    self._row("event", [None, one])

    def _remember(self, topic: str, said: Said, at_s: float, kept: bool) -> None:
        if topic == "nav":
            if at_s >= self._next_row_s:
                self._next_row_s = at_s + ROW_EVERY_S
                self._row("nav", nav_row(said, at_s))
            return
        if topic == "consistency" and not kept:
            for source, tests in _mappings(said, "sources"):
                row = [number(tests, key) for key in ("nis_average", "nis_low", "nis_high")]
                if row[0] is not None:
                    self._row("nis", [at_s, source, *row])
        if topic == "health":
            self._delays(said, None if kept else at_s)
        if topic in ("status", "health"):
            self._lately[topic] = self._recent[topic].of(said, at_s)
            said_now = advice(self._lately.get("status", {}), self._lately.get("health", {}))
            if said_now != self.said("advice"):
                self._put("advice", said_now, at_s)

    def _delays(self, said: Said, at_s: float | None) -> None:
        """Store the delay of each requested fix. A source that counts requests is a terminal."""
        for source, health in _mappings(said, "sources"):
            counters = health.get("counters")
            if not isinstance(counters, Mapping) or "requested" not in counters:
                continue
            received, delay_s = health.get("received"), number(health, "latency_s")
            if received != self._received.get(source) and delay_s is not None:
                self._row("delay", [at_s, source, delay_s])
            self._received[source] = received if isinstance(received, int) else 0

    def _bundle(self, said: Said, at_s: float) -> None:
        """Split `innovations` into rows, each at its instant of validity."""
        innovations, now_ms = said.get("innovations"), number(said, "t_ms")
        for place, one in enumerate(innovations if isinstance(innovations, list) else ()):
            if not isinstance(one, Mapping):
                continue
            t_ms = number(one, "t_ms")
            if t_ms is None or now_ms is None:  # no UTC yet: a rewind cannot be told
                self._innovation(one, -at_s - 1e-6 * place, at_s)
            else:
                self._innovation(one, t_ms, at_s - (now_ms - t_ms) / 1000.0)

    def _innovation(self, said: Said, key: float | None, at_s: float) -> None:
        """Store an innovation. After a rewind it replaces the earlier one of its instant of
        validity, `key`."""
        source, outcome = said.get("source"), said.get("outcome")
        if not (isinstance(source, str) and isinstance(outcome, str) and key is not None):
            return
        place = sys.intern(source), key
        first_s = (self._innovations.get(place) or [at_s])[0]
        self.count += 1
        row = [first_s, source, outcome, number(said, "nis"), number(said, "degrees")]
        self._innovations.put(place, self.count, row)


NAV_COLUMNS = (
    *("lat_deg", "lon_deg", "height_m", "sd_n_m", "sd_e_m", "sd_d_m", "sd_yaw_deg"),
    *("v_n_m_s", "v_e_m_s", "yaw_deg"),
)


def nav_row(said: Said, at_s: float) -> list[Any]:
    """Row of history: arrival, instant of validity, mode, then `NAV_COLUMNS`."""
    mode = said.get("mode")
    head = [at_s, number(said, "t_ms"), mode if isinstance(mode, str) else None]
    return [*head, *(number(said, name) for name in NAV_COLUMNS)]


def number(said: Said, name: str) -> float | None:
    """Numeric field of a message, else None."""
    value = said.get(name)
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def _mappings(said: Said, name: str) -> list[tuple[str, Said]]:
    inner = said.get(name)
    if not isinstance(inner, Mapping):
        return []
    return [(key, value) for key, value in inner.items() if isinstance(value, Mapping)]
