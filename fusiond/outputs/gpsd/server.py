"""Server for gpsd's clients, in place of gpsd: VERSION on connection, reports to watchers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from itertools import chain
from typing import Any

from drivers.base import DriverStatus
from fusiond.configuration.outputs import Gpsd
from fusiond.outputs.base import Surroundings
from fusiond.outputs.gpsd import reports
from fusiond.outputs.gpsd.reports import Report, encoded
from fusiond.outputs.gpsd.requests import Malformed, Request, RequestReader
from fusiond.outputs.latest_value import Latest
from fusiond.outputs.listening_port import Port
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.health import HealthMessage, SkyHealth
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.nmea import DEFAULT, sentences
from fusiond.outputs.tcp import Client, TcpServer
from fusiond.outputs.topics import HEALTH, NAV, Topic


@dataclass(slots=True)
class Watch:
    """Options of WATCH for a client."""

    enable: bool = False
    json: bool = False
    nmea: bool = False
    raw: int = 0
    scaled: bool = False
    timing: bool = False
    split24: bool = False
    pps: bool = False

    def ask(self, wanted: dict[str, Any]) -> str | None:
        """Apply a client's object; return the reason if it is invalid.

        Without `enable` the client starts watching; without a format it gets no reports. gpsd 3.22
        does the same: a client can then read the reply before it asks for JSON.
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


class _Asking:
    """State of one client."""

    def __init__(self, server: GpsdServer, client: Client) -> None:
        self.watch = Watch()
        self._server, self._client = server, client
        self._requests = RequestReader()

    def receive(self, data: bytes) -> None:
        for request in self._requests.feed(data):
            if not self._client.charge():
                return
            self._client.send(self._server.answer(self.watch, request))

    def end(self) -> None:
        pass


class GpsdServer:
    """gpsd's protocol at `host:port`. Counters: those of `TcpServer`, and `requests`, `malformed`.

    `raw`, `pps` and `timing` are accepted, but nothing is sent for them.
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
        self._epoch: _Epoch | None = None
        port = Port(self.name, section.host, section.port, around.on_event)
        self.server = TcpServer(self.name, port, around.guests, self._greet)
        self.counters = self.server.counters

    @property
    def status(self) -> DriverStatus:
        return self.server.port.status

    def publish(self, topic: Topic, message: Message) -> None:
        if topic is NAV and isinstance(message, NavMessage):
            self._activated = self._activated or message.t_utc
            self._epoch = _Epoch(message, self)
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
            await self._nav.next()
            assert self._epoch is not None, "made of the same message"
            self.server.send(self._epoch.wanted)

    def wanted(self, client: Client) -> Watch:
        """Options of a client's WATCH."""
        return client.session.watch if isinstance(client.session, _Asking) else Watch()

    def reports(self, nav: NavMessage) -> dict[str, Report]:
        """Reports of an epoch, by class in lower case."""
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

    def _greet(self, client: Client) -> _Asking:
        client.send(encoded(reports.version(self._release)))
        return _Asking(self, client)

    def answer(self, watch: Watch, request: Request | Malformed) -> bytes:
        """Reply to a request; WATCH changes `watch`, the client's options."""
        if isinstance(request, Request) and request.name == "POLL":
            self.counters["requests"] += 1
            return self._epoch.polled() if self._epoch is not None else encoded(_poll(None, {}))
        return b"".join(map(encoded, self._replies(watch, request)))

    def _replies(self, watch: Watch, request: Request | Malformed) -> list[Report]:
        if isinstance(request, Malformed):
            self.counters["malformed"] += 1
            return [reports.error(request.text)]
        self.counters["requests"] += 1
        replies: dict[str, Callable[[], list[Report]]] = {
            "VERSION": lambda: [reports.version(self._release)],
            "DEVICES": lambda: [self._devices()],
            "DEVICE": lambda: [reports.device(self.device, self._activated)],
            "WATCH": lambda: self._watching(watch, request.argument or {}, request.argument),
        }
        if request.name not in replies:
            self.counters["malformed"] += 1
            return [reports.error(f"Unrecognized request '?{request.name}'")]
        return replies[request.name]()

    def _devices(self) -> Report:
        return {"class": "DEVICES", "devices": [reports.device(self.device, self._activated)]}

    def _watching(
        self, watch: Watch, wanted: dict[str, Any], given: dict[str, Any] | None
    ) -> list[Report]:
        path = wanted.get("device")
        wrong = None
        if path is not None and path != self.device:
            wrong = f"no such device as {str(path)[:80]!r}"
        elif given is not None:
            wrong = watch.ask(wanted)
        if wrong is not None:
            self.counters["malformed"] += 1
            return [reports.error(f"Invalid WATCH: {wrong}")]
        return [self._devices(), watch.report()]


def _poll(t_utc: str | None, made: dict[str, Report]) -> Report:
    report: Report = {"class": "POLL", "time": t_utc, "active": 1}
    for name in ("tpv", "gst", "att", "sky"):
        report[name] = [reports.known_only(made[name])] if name in made else []
    return report


class _Epoch:
    """Reports of one `nav` with the satellites of that time, made once for all clients when the
    first client needs them."""

    def __init__(self, nav: NavMessage, server: GpsdServer) -> None:
        self._nav, self._server = nav, server
        self._made: dict[str, bytes] = {}

    def wanted(self, client: Client) -> bytes:
        watch = self._server.wanted(client)
        if not watch.enable:
            return b""
        formats = chain(["nmea"] if watch.nmea else [], ["json"] if watch.json else [])
        return b"".join(map(self._in, formats))

    def polled(self) -> bytes:
        """Reply to POLL."""
        return self._in("poll")

    def _in(self, form: str) -> bytes:
        if form not in self._made:
            self._made[form] = self._make(form)
        return self._made[form]

    def _make(self, form: str) -> bytes:
        if form == "nmea":
            return self._server.nmea(self._nav)
        made = self._server.reports(self._nav)
        if form == "poll":
            return encoded(_poll(self._nav.t_utc, made))
        return b"".join(map(encoded, made.values()))
