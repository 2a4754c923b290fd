"""`fusiond status`: state of the running daemon, asked over MQTT.

Retained topics arrive at once; the solution of a working daemon arrives within a second. A daemon
that is `online` and silent has stopped or hangs.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusiond.commands.shared import (
    EXIT_UNAVAILABLE,
    JsonPath,
    config_errors,
    load_or_exit,
    parse_mqtt,
    write_json,
)

if TYPE_CHECKING:
    from fusiond.configuration.schema import Mqtt

EXIT_NO_SOLUTION = 1
USABLE = ("navigating", "coasting")
_CONNECT_S = 5.0
_SETTLE_S = 0.3
"""Time (s) in which the broker sends every vehicle's retained messages."""
_LOOK_EVERY_S = 0.05
_MOST_BYTES = 65_536
"""Largest message: `health` of twenty sources with a full sky has some 20 kB."""
_ASKED = ("status", "nav", "health")
"""Topics that a working daemon sends within a second."""


@dataclass(slots=True)
class VehicleMessages:
    """Last messages of one vehicle by topic; `live` if one was published just now."""

    topics: dict[str, Any] = field(default_factory=dict)
    online: str | None = None
    live: bool = False

    @property
    def complete(self) -> bool:
        """True if every topic that the daemon sends has arrived; before the first tick it sends
        none."""
        compiling = self.topics.get("status", {}).get("ticks") == 0
        asked = ("status",) if compiling else _ASKED
        return self.online == "offline" or (self.live and all(t in self.topics for t in asked))


class UnansweredError(Exception):
    """Error: no vehicle has answered. `state` is a keyword; the text says what to do."""

    def __init__(self, state: str, text: str) -> None:
        super().__init__(text)
        self.state = state


def status(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="CONFIG", help="For broker and vehicle; else localhost."),
    ] = None,
    mqtt: Annotated[
        str | None, typer.Option("--mqtt", metavar="HOST[:PORT]", help="The broker to ask.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="Name, if the broker has several.")] = None,
    wait: Annotated[
        float, typer.Option(min=0.5, help="Seconds to wait for a daemon's answer.")
    ] = 3.0,
    json_path: JsonPath = None,
) -> None:
    """Ask the running daemon for its state, over MQTT.

    Exit codes: 0 a usable solution, 1 none, 69 no answer."""
    import asyncio  # noqa: PLC0415

    access = None
    if config is not None:
        settings = load_or_exit(config)
        access, vehicle = settings.mqtt, vehicle or settings.vehicle
        if not access.enabled:
            typer.echo(
                f"fusiond: {config}: [mqtt] is not enabled: there is no way to ask", err=True
            )
            raise typer.Exit(EXIT_UNAVAILABLE)
    host, port = ("localhost", 1883) if access is None else (access.host, access.port)
    if mqtt is not None:
        host, port = parse_mqtt(mqtt)
    try:
        with config_errors():
            name, messages = selected_vehicle(
                asyncio.run(retained_messages(host, port, access, vehicle, wait)), vehicle, wait
            )
    except UnansweredError as error:
        write_json({"state": error.state, "why": str(error)}, json_path)
        typer.echo(f"fusiond: {error}", err=True)
        raise typer.Exit(EXIT_UNAVAILABLE) from error
    answer = {"state": "online", "vehicle": name, **messages.topics}
    if json_path != "-":
        from fusiond.commands.status_report import status_page  # noqa: PLC0415

        typer.echo("\n".join(status_page(answer)))
    write_json(answer, json_path)
    if answer["status"]["mode"] not in USABLE:
        raise typer.Exit(EXIT_NO_SOLUTION)


async def retained_messages(
    host: str, port: int, access: Mqtt | None, vehicle: str | None, wait_s: float
) -> dict[str, VehicleMessages]:
    """Retained messages of each vehicle, or of `vehicle`, after at most `wait_s`.

    `access`: user, password and TLS. Raises `UnansweredError` where no broker lets us in.
    """
    import asyncio  # noqa: PLC0415

    import aiomqtt  # noqa: PLC0415

    from fusiond.outputs import oversized_packets  # noqa: PLC0415

    vehicles: dict[str, VehicleMessages] = {}
    loop = asyncio.get_running_loop()
    until_s = loop.time() + wait_s

    async def listen(client: aiomqtt.Client) -> None:
        await client.subscribe(f"fusiond/{vehicle or '+'}/+", 1)
        async for message in client.messages:
            name, _, topic = message.topic.value.removeprefix("fusiond/").rpartition("/")
            if isinstance(message.payload, bytes) and len(message.payload) <= _MOST_BYTES:
                _receive(
                    vehicles.setdefault(name, VehicleMessages()),
                    topic,
                    message.payload,
                    message.retain,
                )

    credentials: dict[str, Any] = {}
    if access is not None:
        from fusiond.outputs import broker_access  # noqa: PLC0415

        credentials = {
            "username": access.username,
            "password": broker_access.password(access),
            "tls_context": broker_access.tls_context(access),
        }
    try:
        asking = aiomqtt.Client(host, port, timeout=_CONNECT_S, **credentials)
        oversized_packets.limit(asking, _MOST_BYTES)
        async with asking as client:
            listening = asyncio.create_task(listen(client))
            await asyncio.wait({listening}, timeout=min(_SETTLE_S, wait_s))
            while loop.time() < until_s and not (
                vehicles and all(messages.complete for messages in vehicles.values())
            ):
                await asyncio.wait({listening}, timeout=_LOOK_EVERY_S)
                if listening.done():
                    listening.result()
            listening.cancel()
    except aiomqtt.MqttError as error:
        from fusiond.outputs import broker_access  # noqa: PLC0415

        what = broker_access.advice(error, host, port)
        raise UnansweredError("no_broker", what) from error
    return vehicles


def _receive(messages: VehicleMessages, topic: str, payload: bytes, retained: bool) -> None:
    if topic == "online":
        messages.online = payload.decode(errors="replace")
        return
    with suppress(ValueError, RecursionError):  # another program's message below our topic
        messages.topics[topic] = json.loads(payload)
        messages.live |= topic in _ASKED and not retained


def selected_vehicle(
    vehicles: dict[str, VehicleMessages], vehicle: str | None, wait_s: float
) -> tuple[str, VehicleMessages]:
    """Select the requested vehicle, if it answers. Raises `UnansweredError`."""
    there = {
        name: messages for name, messages in vehicles.items() if messages.online or messages.live
    }
    if not there:
        whose = "no daemon" if vehicle is None else f"no daemon of a vehicle {vehicle!r}"
        raise UnansweredError(
            "no_daemon",
            f"the broker knows of {whose}: start one (systemctl start fusiond, or `fusiond run`), "
            "and look at host, port and vehicle of its configuration",
        )
    running = [name for name, messages in there.items() if messages.online != "offline"]
    if len(running or there) > 1:
        raise UnansweredError(
            "ambiguous", f"--vehicle: which of {', '.join(sorted(running or there))}?"
        )
    (name,) = running or there
    messages = there[name]
    last = messages.topics.get("status", {})
    said = f"; last heard {last['t_utc']}: {last['mode']}, {last['why']}" if last else ""
    if messages.online == "offline":
        raise UnansweredError(
            "offline",
            f"{name} is offline{said}. journalctl -u fusiond says why; systemctl start fusiond",
        )
    if not messages.live or not last:
        raise UnansweredError(
            "silent",
            f"{name} is online, but has said nothing for {wait_s:g} s{said}. "
            "It has stopped, hangs, or its network does: systemctl status fusiond",
        )
    return name, messages
