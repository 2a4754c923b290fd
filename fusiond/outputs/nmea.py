"""NMEA 0183 over TCP: each epoch of sentences to every client.

RMC, GGA, VTG, GST and THS, with the talker GN. Mode letter A while it navigates, E and quality 6
while it coasts (dead reckoning), N, quality 0 and RMC's status V otherwise. Sentences have no field
for a height above the ellipsoid: GGA has the one above the sea, and the geoid's separation.

Source: NMEA 0183 v4.11 as the u-blox ZED-F9P interface manual prints it; THS and PASHR as the
Trimble and u-blox manuals do.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import reduce
from math import floor
from operator import xor

from drivers.base import DriverStatus
from fusiond.configuration.outputs import NmeaServed
from fusiond.navigation.solution import Mode
from fusiond.outputs.base import Surroundings
from fusiond.outputs.derived_figures import known, motion, usable
from fusiond.outputs.geoid import sea_height
from fusiond.outputs.latest_value import Latest
from fusiond.outputs.listening_port import Port
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.tcp import TcpServer, Unheard
from fusiond.outputs.topics import NAV, Topic

SATELLITES = "04"
"""Number of satellites in GGA. The solution has none, but gpsd 3.22 takes fewer than four for no
fix, even for dead reckoning."""
DEFAULT = ("RMC", "GGA", "VTG", "GST", "THS")
KNOT_M_S = 1852.0 / 3600.0
KMH_M_S = 1.0 / 3.6
_MODE = {Mode.NAVIGATING: "A", Mode.COASTING: "E"}
_QUALITY = {Mode.NAVIGATING: "1", Mode.COASTING: "6"}


class NmeaServer:
    """Server of sentences at `host:port`, with the counters of `TcpServer`. Bytes from clients are
    discarded."""

    name = "nmea"
    sets_clocks = True

    def __init__(self, section: NmeaServed, around: Surroundings) -> None:
        self.nav_rate_hz = section.rate_hz
        self._kinds = section.sentences
        self._geoid_m = around.geoid_separation_m
        self._nav: Latest[NavMessage] = Latest()
        port = Port(self.name, section.host, section.port, around.on_event)
        self.server = TcpServer(self.name, port, around.guests, lambda _: Unheard())
        self.counters = self.server.counters

    @property
    def status(self) -> DriverStatus:
        return self.server.port.status

    def publish(self, topic: Topic, message: Message) -> None:
        if topic is NAV and isinstance(message, NavMessage):
            self._nav.put(message)

    async def run(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self.server.run())
            group.create_task(self._send())

    async def _send(self) -> None:
        while True:
            epoch = sentences(await self._nav.next(), self._kinds, self._geoid_m)
            self.server.send(lambda _, epoch=epoch: epoch)  # type: ignore[misc]


def sentences(nav: NavMessage, kinds: Sequence[str], geoid_separation_m: float | None) -> bytes:
    """Sentences of one epoch: those of `kinds`, in an order that gpsd understands.

    GST and PASHR are sent only with a solution: they have no field for its absence.
    """
    epoch = _Epoch(nav, geoid_separation_m)
    makers: dict[str, Callable[[], list[str] | None]] = {
        "PASHR": epoch.pashr,  # as the last of an epoch it keeps gpsd 3.22 from sending TPV
        "RMC": epoch.rmc,
        "GGA": epoch.gga,
        "VTG": epoch.vtg,
        "GST": epoch.gst,
        "THS": epoch.ths,
        "HDT": epoch.hdt,
    }
    made = [(kind, make()) for kind, make in makers.items() if kind in kinds]
    return b"".join(_sentence(kind, fields) for kind, fields in made if fields is not None)


def _sentence(kind: str, fields: list[str]) -> bytes:
    body = ",".join(["PASHR" if kind == "PASHR" else f"GN{kind}", *fields]).encode()
    return b"$%b*%02X\r\n" % (body, reduce(xor, body))


class _Epoch:
    """Solution `nav` as NMEA fields; unknown fields are empty."""

    def __init__(self, nav: NavMessage, geoid_separation_m: float | None) -> None:
        self._nav = nav
        self._usable = usable(nav)
        self._geoid_m = geoid_separation_m
        self._motion = motion(nav) if self._usable else None
        self._mode = _MODE.get(nav.mode, "N")
        self._time = self._date = ""
        if nav.t_ms is not None:
            # Hundredths are cut off: rounding could give 60.00 s.
            at = datetime.fromtimestamp(nav.t_ms // 1000, UTC)
            self._time = f"{at:%H%M%S}.{nav.t_ms % 1000 // 10:02d}"
            self._date = f"{at:%d%m%y}"

    def _of(self, value: float | None, decimals: int, scale: float = 1.0) -> str:
        figure = known(value) if self._usable else None
        return "" if figure is None else f"{figure * scale:.{decimals}f}"

    def _angle(self, value: float | None, decimals: int) -> str:
        """Format an angle of 0 to 360 deg, which rounding must not make 360."""
        figure = known(value) if self._usable else None
        return "" if figure is None else f"{round(figure, decimals) % 360.0:.{decimals}f}"

    def _position(self) -> list[str]:
        nav = self._nav
        return [*self._coordinate(nav.lat_deg, 2, "NS"), *self._coordinate(nav.lon_deg, 3, "EW")]

    def _coordinate(self, value: float | None, digits: int, signs: str) -> list[str]:
        """Format degrees and minutes, to 0.2 mm."""
        figure = known(value) if self._usable else None
        if figure is None:
            return ["", ""]
        units = round(abs(figure) * 60e7)
        degrees = floor(units / 60e7)
        minutes = (units - degrees * 600_000_000) / 1e7
        return [f"{degrees:0{digits}d}{minutes:010.7f}", signs[figure < 0.0]]

    def _course(self) -> float | None:
        return None if self._motion is None else self._motion.course_deg

    def _speed(self, unit_m_s: float) -> str:
        return "" if self._motion is None else f"{self._motion.speed_m_s / unit_m_s:.3f}"

    def rmc(self) -> list[str]:
        status = "A" if self._usable else "V"
        moving = [self._speed(KNOT_M_S), self._angle(self._course(), 2)]
        return [self._time, status, *self._position(), *moving, self._date, "", "", self._mode, "V"]

    def gga(self) -> list[str]:
        quality = _QUALITY.get(self._nav.mode, "0")
        satellites = SATELLITES if self._usable else "00"
        found = sea_height(self._nav, self._geoid_m)
        height = ["", "M", "", "M"]
        if found is not None:
            height = [f"{found.above_sea_m:.3f}", "M", f"{found.separation_m:.3f}", "M"]
        return [self._time, *self._position(), quality, satellites, "", *height, "", ""]

    def vtg(self) -> list[str]:
        course = self._angle(self._course(), 2)
        return [course, "T", "", "M", self._speed(KNOT_M_S), "N", self._speed(KMH_M_S), "K",
                self._mode]  # fmt: skip

    def gst(self) -> list[str] | None:
        nav = self._nav
        if not self._usable:
            return None
        sd = [self._of(x, 3) for x in (nav.sd_n_m, nav.sd_e_m, nav.sd_d_m)]
        return [self._time, "", "", "", "", *sd]

    def ths(self) -> list[str]:
        heading = self._angle(self._nav.yaw_deg, 2)
        return [heading, self._mode if heading else "V"]

    def hdt(self) -> list[str]:
        return [self._angle(self._nav.yaw_deg, 2), "T"]

    def pashr(self) -> list[str] | None:
        nav = self._nav
        # pynmeagps 1.1 takes one without time for another kind of PASHR and raises IndexError.
        if not self._usable or not self._time:
            return None
        tilt = [known(x) for x in (nav.roll_deg, nav.pitch_deg)]
        angles = ["" if x is None else f"{x:+.2f}" for x in tilt]
        sd = [self._of(x, 3) for x in (nav.sd_roll_deg, nav.sd_pitch_deg, nav.sd_yaw_deg)]
        heading = self._angle(nav.yaw_deg, 2)
        return [self._time, heading, "T", *angles, "", *sd, "1", "1"]
