"""OwnTracks output: the vehicle's location for phones, through the broker of `[mqtt]`.

Each `tracker` makes one location, with speed, course and height of the last `nav`. A location has a
date, so none is sent before UTC is settled.

Source: OwnTracks booklet, "JSON", _type=location: acc and vac m, alt m, cog deg, vel km/h, tst and
created_at POSIX seconds.
"""

from __future__ import annotations

import asyncio
from collections import Counter

from pydantic import RootModel

from drivers.base import DriverStatus
from fusiond.configuration.outputs import OwnTracks
from fusiond.outputs.base import Surroundings
from fusiond.outputs.derived_figures import known, motion
from fusiond.outputs.geoid import sea_height
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.messages.tracker import TrackerMessage
from fusiond.outputs.topics import NAV, TRACKER, Topic

_KMH_M_S = 1.0 / 3.6


class Location(RootModel[dict[str, str | int | float]]):
    """Message of `_type` location; unknown values are omitted."""


class OwnTracksLocations:
    """Publisher of `owntracks/<user>/<vehicle>`, retained. Counters: `locations`, and `undated`,
    those not sent because UTC is not settled."""

    name = "owntracks"
    sets_clocks = True
    nav_rate_hz = 1.0

    def __init__(self, section: OwnTracks, around: Surroundings) -> None:
        self._mqtt = around.broker()
        self._geoid_m = around.geoid_separation_m
        self._tid = section.tid or around.vehicle[-2:]
        address = f"owntracks/{section.user}/{around.vehicle}"
        self._topic = Topic(address, Location, 1, True, absolute=True)
        self._nav: NavMessage | None = None
        self.counters: Counter[str] = Counter()

    @property
    def status(self) -> DriverStatus:
        return self._mqtt.status

    def publish(self, topic: Topic, message: Message) -> None:
        if topic is NAV and isinstance(message, NavMessage):
            self._nav = message
        elif topic is TRACKER and isinstance(message, TrackerMessage):
            nav = self._nav
            if nav is None or nav.t_ms is None or message.t_ms is None:
                self.counters["undated"] += 1
                return
            self.counters["locations"] += 1
            self._mqtt.publish(self._topic, self._location(message, message.t_ms, nav))

    async def run(self) -> None:
        await asyncio.get_running_loop().create_future()

    def _location(self, tracker: TrackerMessage, t_ms: int, nav: NavMessage) -> Location:
        moving = motion(nav)
        above_sea, sd_d = sea_height(nav, self._geoid_m), known(nav.sd_d_m)
        course = None if moving is None else moving.course_deg
        figures: dict[str, str | int | float | None] = {
            "_type": "location",
            "lat": tracker.latitude,
            "lon": tracker.longitude,
            "tst": t_ms // 1000,
            "tid": self._tid,
            "acc": max(1, round(tracker.gps_accuracy)),
            "alt": None if above_sea is None else round(above_sea.above_sea_m),
            "vac": None if sd_d is None or above_sea is None else max(1, round(sd_d)),
            "vel": None if moving is None else round(moving.speed_m_s / _KMH_M_S),
            "cog": None if course is None else round(course) % 360,
        }
        return Location({key: value for key, value in figures.items() if value is not None})
