"""A real Mosquitto with the configuration, access list and certificates of `docs/mqtt.md`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import ssl
import subprocess
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiomqtt
import pytest

from fusiond.configuration.schema import Mqtt
from fusiond.dashboard import broker as dashboard_broker
from fusiond.dashboard.broker import Access
from fusiond.dashboard.vehicles import Hub
from fusiond.outputs.commands import Command
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import (
    CALIBRATION,
    CONSISTENCY,
    EVENT,
    HEALTH,
    INNOVATIONS,
    NAV,
    STATUS,
)
from tests.broker import Broker, Listener, listening
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S, until
from tests.places import REPOSITORY

HOST = "broker.example.org"
"""The broker's name in the text; the tests reach theirs by a loopback address."""
COMMAND = "fusiond/truck/cmd/reset_filter"


def _blocks(language: str) -> list[str]:
    """The blocks of this language in the section on the broker's security."""
    section = (REPOSITORY / "docs" / "mqtt.md").read_text().split("## Securing the broker")[1]
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
    return [text for name, text in blocks if name == language]


def _issue(folder: Path) -> Path:
    """What the documented commands make, for a broker on the loopback."""
    commands = _blocks("sh")[0]
    names = "subjectAltName=DNS:" + HOST
    assert commands.count(names) == 1
    commands = commands.replace(names, "subjectAltName=IP:127.0.0.1")
    subprocess.run(["sh", "-ec", commands], cwd=folder, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _issue(tmp_path_factory.mktemp("certificates"))


@pytest.fixture
def stranger(tmp_path_factory: pytest.TempPathFactory, certificates: Path) -> ssl.SSLContext:
    """Trusts our broker, and shows a certificate of the same name by another authority."""
    other = _issue(tmp_path_factory.mktemp("other"))
    context = _shown(certificates, None)
    context.load_cert_chain(other / "operator.pem", other / "operator.key")
    return context


@pytest.fixture
def broker(certificates: Path, tmp_path: Path) -> Broker:
    """Mosquitto with the documented text; only port and paths are the test's own."""
    text, access = _blocks("")
    acl = tmp_path / "acl"
    acl.write_text(access)
    acl.chmod(0o600)
    lines = [line for line in text.splitlines() if not line.startswith(("#", "listener "))]
    assert len(text.splitlines()) - len(lines) == 2
    configuration = (
        "\n".join(lines)
        .replace("/etc/mosquitto/certs", str(certificates))
        .replace("/etc/mosquitto/acl", str(acl))
    )
    assert "/etc/" not in configuration
    return Broker(tmp_path, *configuration.splitlines())


def _shown(certificates: Path, user: str | None) -> ssl.SSLContext:
    """What a client shows to the broker, whom it verifies."""
    context = ssl.create_default_context(cafile=str(certificates / "ca.pem"))
    if user is not None:
        context.load_cert_chain(certificates / f"{user}.pem", certificates / f"{user}.key")
    return context


@asynccontextmanager
async def _daemon(
    broker: Broker, certificates: Path, taken: list[Command]
) -> AsyncIterator[MqttPublisher]:
    """The daemon's side, with the documented section of its configuration."""
    section = tomllib.loads(_blocks("toml")[0].replace("/etc/fusiond", str(certificates)))["mqtt"]
    section |= {"host": "127.0.0.1", "port": broker.port}

    def take(command: Command) -> str:
        taken.append(command)
        return "done"

    publisher = MqttPublisher(
        Mqtt.model_validate(section),
        "truck",
        on_event=lambda code, text: None,
        on_command=take,
        utc_now=lambda: None,
    )
    task = asyncio.create_task(publisher.run())
    try:
        yield publisher
    finally:
        task.cancel()
        await asyncio.wait({task})


async def test_each_user_may_do_what_is_its_business(broker: Broker, certificates: Path) -> None:
    taken: list[Command] = []
    operator, dashboard = (_shown(certificates, user) for user in ("operator", "dashboard"))
    with broker:
        async with (
            listening(broker, tls_context=dashboard) as (seen, dashboard_client),
            listening(broker, tls_context=operator) as (heard, operator_client),
            _daemon(broker, certificates, taken) as publisher,
        ):
            for listener in (seen, heard):
                await listener.until(lambda li: li.payloads("fusiond/truck/online") == [b"online"])
            publisher.publish(NAV, EXAMPLES["nav"])
            publisher.publish(STATUS, EXAMPLES["status"])
            publisher.publish(HEALTH, EXAMPLES["health"])
            publisher.publish(CONSISTENCY, EXAMPLES["consistency"])
            publisher.publish(INNOVATIONS, EXAMPLES["innovations"])
            publisher.publish(CALIBRATION, EXAMPLES["calibration"])
            publisher.publish(EVENT, EXAMPLES["event"])
            figures = ("nav", "status", "health", "consistency", "innovations", "calibration")
            for topic in (*figures, "event"):
                await seen.until(lambda li, name=topic: li.payloads(f"fusiond/truck/{name}"))
            # The broker has confirmed, and dropped, the dashboard's command before the operator's.
            await dashboard_client.publish(COMMAND, b'{"id": "dashboard"}', qos=1)
            await dashboard_client.publish("fusiond/truck/nav", b"{}", qos=1)
            await operator_client.publish("fusiond/truck/nav", b"{}", qos=1)
            await operator_client.publish(COMMAND, b'{"id": "operator"}', qos=1)
            await seen.until(lambda li: li.payloads("fusiond/truck/reply"))
            assert _replies(seen) == [("operator", True)]
            assert [command.id for command in taken] == ["operator"]
            assert b"{}" not in seen.payloads("fusiond/truck/nav")
    assert "Denied PUBLISH" in broker.log


def _replies(listener: Listener) -> list[tuple[str, bool]]:
    replies = map(json.loads, listener.payloads("fusiond/truck/reply"))
    return [(reply["id"], reply["ok"]) for reply in replies]


async def test_a_vehicle_speaks_for_itself_only(broker: Broker, certificates: Path) -> None:
    truck, dashboard = (_shown(certificates, user) for user in ("truck", "dashboard"))
    with broker:
        async with (
            listening(broker, tls_context=dashboard) as (seen, _),
            aiomqtt.Client(
                "127.0.0.1", broker.port, tls_context=truck, timeout=PATIENCE_S
            ) as client,
        ):
            await client.publish("fusiond/other/nav", b"false", qos=1)
            await client.publish("fusiond/truck/nav", b"true", qos=1)
            await seen.until(lambda li: li.payloads("fusiond/truck/nav"))
            assert [message.topic.value for message in seen.messages] == ["fusiond/truck/nav"]


async def test_the_dashboard_listens_as_its_own_user(broker: Broker, certificates: Path) -> None:
    hub = Hub(asyncio.get_running_loop().time, "test")
    tls = _shown(certificates, "dashboard")
    with broker:
        listener = dashboard_broker.Broker(Access("127.0.0.1", broker.port, tls=tls), hub)
        listens = asyncio.create_task(listener.listen())
        async with _daemon(broker, certificates, []) as publisher:
            publisher.publish(STATUS, EXAMPLES["status"])
            await until(lambda: "truck" in hub.vehicles and hub.vehicles["truck"].said("status"))
        assert hub.link.state == "up"
        listens.cancel()
        await asyncio.gather(listens, return_exceptions=True)


# MQTT 3.1.1, section 3.1: CONNECT of protocol level 4, clean session, 60 s, identifier "x"; and
# section 3.2: CONNACK, connection accepted.
CONNECT = bytes.fromhex("100d 0004 4d515454 04 02 003c 0001 78")
ACCEPTED = bytes.fromhex("20020000")


async def _answer(port: int, context: ssl.SSLContext | None) -> bytes:
    """What the broker says to a client that connects: CONNACK, or nothing before it hangs up.

    A client library would wait for its own timeout, since TLS 1.3 lets a client speak before its
    certificate has been looked at.
    """
    async with asyncio.timeout(PATIENCE_S):
        with contextlib.suppress(ssl.SSLError, ConnectionError):
            reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=context)
            writer.write(CONNECT)
            answer = await reader.read(4)
            writer.transport.abort()
            return answer
    return b""


async def test_a_client_without_our_certificate_is_refused(
    broker: Broker, certificates: Path, stranger: ssl.SSLContext
) -> None:
    with broker:
        for context in (_shown(certificates, None), stranger, None):
            assert await _answer(broker.port, context) == b""
        # It is the certificate that was missing: the same broker takes one of its own authority.
        operator = _shown(certificates, "operator")
        assert await _answer(broker.port, operator) == ACCEPTED
