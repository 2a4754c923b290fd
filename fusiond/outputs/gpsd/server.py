"""Serves gpsd's clients in the place of gpsd: VERSION on connecting, reports to those who watch."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import chain
from typing import Any

from drivers.base import DriverStatus
from fusiond.configuration.outputs import Gpsd
from fusiond.outputs.base import Surroundings
from fusiond.outputs.gpsd import reports
from fusiond.outputs.gpsd.reports import Report, encoded
from fusiond.outputs.gpsd.requests import Malformed, Request, RequestReader
from fusiond.outputs.latest import Latest
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.health import HealthMessage, SkyHealth
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.nmea import DEFAULT, sentences
from fusiond.outputs.tcp import Client, TcpServer
from fusiond.outputs.topics import HEALTH, NAV, Topic

_READ_BYTES = 4096


@dataclass(slots=True)
class Watch:
    """What a client watches: the object of WATCH."""

    enable: bool = False
    json: bool = False
    nmea: bool = False
    raw: int = 0
    scaled: bool = False
    timing: bool = False
    split24: bool = False
    pps: bool = False

    def ask(self, wanted: dict[str, Any]) -> str | None:
        """Take a client's object over; what is wrong with it, if something is.

        One that says no `enable` wants to watch; one that names no format gets no reports, as from
        gpsd 3.22: clients that then connect again and ask for JSON read the answer first.
        """
        asked = {k: v for k, v in wanted.items() if k in self.__slots__ and k != "raw"}
        wrong = [key for key, value in asked.items() if not isinstance(value, bool)]
        if wrong:
            return f"{wrong[0]} must be true or false"
        for key, value in ({"enable": True} | asked).items():
            setattr(self, key, value)
        return None

    def report(self) -> Report:
        return {"class": "WATCH"} | {key: getattr(self, key) for key in self.__slots__}


@dataclass(slots=True)
class _Asked:
    """A client's own state."""

    watch: Watch = field(default_factory=Watch)
    requests: RequestReader = field(default_factory=RequestReader)


class GpsdServer:
    """gpsd's protocol at `host:port`. Counters: those of `TcpServer`, and `requests`, `malformed`.

    `raw`, `pps` and `timing` are taken and answered, and nothing is sent for them: there is none.
    """

    name = "gpsd"
    sets_clocks = True

    def __init__(self, section: Gpsd, around: Surroundings) -> None:
        self.nav_rate_hz = section.rate_hz
        self.device = f"fusiond://{around.vehicle}"
        self._geoid_m = around.geoid_separation_m
        self._release = version("fusiond")
        self._activated: str | None = None
        self._nav: Latest[NavMessage] = Latest()
        self._sky = SkyHealth()
        self._asked: dict[Client, _Asked] = {}
        self.server = TcpServer(self.name, section.host, section.port, self._serve, around.on_event)
        self.counters = self.server.counters

    @property
    def status(self) -> DriverStatus:
        return self.server.port.status

    def take(self, topic: Topic, message: Message) -> None:
        if topic is NAV and isinstance(message, NavMessage):
            self._activated = self._activated or message.t_utc
            self._nav.put(message)
        elif topic is HEALTH and isinstance(message, HealthMessage):
            seen = [s.sky for s in message.sources.values() if s.sky is not None]
            self._sky = seen[0] if seen else SkyHealth()

    async def run(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self.server.run())
            group.create_task(self._report())

    async def _report(self) -> None:
        while True:
            epoch = _Epoch(await self._nav.next(), self)
            await self.server.send(epoch.wanted)

    def wanted(self, client: Client) -> Watch:
        """What a client watches."""
        return self._asked[client].watch if client in self._asked else Watch()

    def reports(self, nav: NavMessage) -> dict[str, Report]:
        """The reports of an epoch, by class in small letters."""
        made = {
            "tpv": reports.tpv(self.device, nav, self._geoid_m),
            "att": reports.att(self.device, nav),
            "gst": reports.gst(self.device, nav),
            "sky": reports.sky(self.device, nav.t_utc, self._sky),
        }
        return {name: report for name, report in made.items() if report is not None}

    def nmea(self, nav: NavMessage) -> bytes:
        return sentences(nav, DEFAULT, self._geoid_m)

    # ------------------------------------------------------------------ requests

    async def _serve(self, client: Client) -> None:
        client.send(encoded(reports.version(self._release)))
        asked = self._asked[client] = _Asked()
        try:
            while data := await client.reader.read(_READ_BYTES):
                for request in asked.requests.feed(data):
                    client.send(b"".join(map(encoded, self._answers(asked.watch, request))))
        finally:
            del self._asked[client]

    def _answers(self, watch: Watch, request: Request | Malformed) -> list[Report]:
        if isinstance(request, Malformed):
            self.counters["malformed"] += 1
            return [reports.error(request.text)]
        self.counters["requests"] += 1
        answers: dict[str, Callable[[], list[Report]]] = {
            "VERSION": lambda: [reports.version(self._release)],
            "DEVICES": lambda: [self._devices()],
            "DEVICE": lambda: [reports.device(self.device, self._activated)],
            "WATCH": lambda: self._watching(watch, request.argument or {}, request.argument),
            "POLL": lambda: [self._poll()],
        }
        if request.name not in answers:
            self.counters["malformed"] += 1
            return [reports.error(f"Unrecognized request '?{request.name}'")]
        return answers[request.name]()

    def _devices(self) -> Report:
        return {"class": "DEVICES", "devices": [reports.device(self.device, self._activated)]}

    def _watching(
        self, watch: Watch, wanted: dict[str, Any], given: dict[str, Any] | None
    ) -> list[Report]:
        path = wanted.get("device")
        wrong = None
        if path is not None and path != self.device:
            wrong = f"no such device as {path!r}"
        elif given is not None:
            wrong = watch.ask(wanted)
        if wrong is not None:
            self.counters["malformed"] += 1
            return [reports.error(f"Invalid WATCH: {wrong}")]
        return [self._devices(), watch.report()]

    def _poll(self) -> Report:
        nav = self._nav.last
        report: Report = {"class": "POLL", "time": None if nav is None else nav.t_utc}
        report["active"] = 1
        made = {} if nav is None else self.reports(nav)
        for name in ("tpv", "gst", "att", "sky"):
            report[name] = [reports.known_only(made[name])] if name in made else []
        return report


class _Epoch:
    """What one `nav` comes to, made once for all clients, and only if one wants it."""

    def __init__(self, nav: NavMessage, server: GpsdServer) -> None:
        self._nav, self._server = nav, server
        self._made: dict[str, bytes] = {}

    def wanted(self, client: Client) -> bytes:
        watch = self._server.wanted(client)
        if not watch.enable:
            return b""
        formats = chain(["nmea"] if watch.nmea else [], ["json"] if watch.json else [])
        return b"".join(map(self._in, formats))

    def _in(self, form: str) -> bytes:
        if form not in self._made:
            if form == "nmea":
                made = self._server.nmea(self._nav)
            else:
                made = b"".join(map(encoded, self._server.reports(self._nav).values()))
            self._made[form] = made
        return self._made[form]
