"""Schedule of `tracker`: every 10 s or after 20 m, at most once a second."""

from __future__ import annotations

from math import cos, hypot, radians

from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.messages.tracker import TrackerMessage, tracker_message

SECOND_NS = 1_000_000_000
LONGEST_NS = 10 * SECOND_NS
SHORTEST_NS = SECOND_NS
"""Recorders of such positions (Home Assistant's) keep every one."""
MOVED_M = 20.0
_METRES_A_DEGREE = 111_195.0
"""Metres a degree on a sphere of 6371 km."""


class Tracking:
    """Decision on the next `tracker`, by the last one published and the tick's time."""

    def __init__(self) -> None:
        self._sent: TrackerMessage | None = None
        self._sent_ns = 0

    def due(self, t_ns: int, nav: NavMessage) -> TrackerMessage | None:
        """Message to send at `t_ns`; None if none is due."""
        since_ns = t_ns - self._sent_ns
        if self._sent is not None and since_ns < SHORTEST_NS:
            return None
        message = tracker_message(nav)
        if message is None:
            return None
        if (
            self._sent is not None
            and since_ns < LONGEST_NS
            and _distance_m(self._sent, message) < MOVED_M
        ):
            return None
        self._sent, self._sent_ns = message, t_ns
        return message


def _distance_m(one: TrackerMessage, other: TrackerMessage) -> float:
    north = other.latitude - one.latitude
    east = (other.longitude - one.longitude + 180.0) % 360.0 - 180.0
    return _METRES_A_DEGREE * hypot(north, east * cos(radians(one.latitude)))
