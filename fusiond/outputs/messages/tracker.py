"""Message `tracker`: the vehicle's position at intervals, in Home Assistant's terms.

It is due every 10 s or after 20 m, at most once a second.
"""

from __future__ import annotations

from math import cos, hypot, inf, radians

from pydantic import Field

from fusiond.outputs.derived_figures import horizontal_rms_m, usable
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.nav import NavMessage

SECOND_NS = 1_000_000_000
LONGEST_NS = 10 * SECOND_NS
SHORTEST_NS = SECOND_NS
"""Recorders of such positions (Home Assistant's) keep every one."""
MOVED_M = 20.0
DIGITS = 7
"""Decimals of a degree: 1 cm."""
_METRES_A_DEGREE = 111_195.0
"""Metres a degree on a sphere of 6371 km."""


class TrackerMessage(Message):
    """A position that may be used: WGS 84, degrees."""

    latitude: float
    longitude: float
    gps_accuracy: float = Field(
        description="m: root of the sum of both variances, about 65 % of errors are smaller"
    )


def tracker_message(nav: NavMessage) -> TrackerMessage | None:
    """Build `tracker` of a solution; None if the solution may not be used."""
    accuracy_m = horizontal_rms_m(nav)
    if not usable(nav) or accuracy_m is None or nav.lat_deg is None or nav.lon_deg is None:
        return None
    return TrackerMessage(
        t_utc=nav.t_utc,
        t_ms=nav.t_ms,
        latitude=round(nav.lat_deg, DIGITS),
        longitude=round(nav.lon_deg, DIGITS),
        gps_accuracy=round(accuracy_m, 2),
    )


class Tracking:
    """Decision on the next `tracker`, by the last one published and the tick's time."""

    def __init__(self) -> None:
        self._sent: TrackerMessage | None = None
        self._sent_ns = self.earliest_ns = 0
        """Instant of the last position, and of the earliest next."""

    def due(self, t_ns: int, nav: NavMessage) -> TrackerMessage | None:
        """Message to send at `t_ns`; None if none is due."""
        since_ns, sent = t_ns - self._sent_ns, self._sent
        if sent is not None and (
            since_ns < SHORTEST_NS or (since_ns < LONGEST_NS and _distance_m(sent, nav) < MOVED_M)
        ):
            return None
        message = tracker_message(nav)
        if message is not None:
            self._sent, self._sent_ns = message, t_ns
            self.earliest_ns = t_ns + SHORTEST_NS
        return message


def _distance_m(sent: TrackerMessage, nav: NavMessage) -> float:
    """Distance from the place sent; infinite from no place."""
    if nav.lat_deg is None or nav.lon_deg is None:
        return inf
    north = round(nav.lat_deg, DIGITS) - sent.latitude
    east = (round(nav.lon_deg, DIGITS) - sent.longitude + 180.0) % 360.0 - 180.0
    return _METRES_A_DEGREE * hypot(north, east * cos(radians(sent.latitude)))
