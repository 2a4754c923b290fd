"""TLS against a real Mosquitto: who is not the broker that is meant hears nothing."""

from __future__ import annotations

import asyncio
import ssl
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusiond.dashboard.broker import Access
from fusiond.dashboard.broker import Broker as DashboardBroker
from fusiond.dashboard.vehicles import Hub
from tests.broker import Broker
from tests.outputs.publisher import Running, options, running
from tests.patience import until

NEW_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
SERVER = "subjectAltName=IP:127.0.0.1,DNS:localhost"


def openssl(*arguments: str | Path) -> None:
    subprocess.run(("openssl", *arguments), check=True, capture_output=True)


class Authority:
    """Signs certificates in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        self.ca, self._key = folder / "ca.pem", folder / "ca.key"
        openssl("req", "-x509", *NEW_KEY, "-keyout", self._key, "-out", self.ca, "-subj", "/CN=a")

    def issue(self, name: str, extension: str = SERVER, days: int = 10) -> tuple[Path, Path]:
        """Certificate and key."""
        key, request, cert, more = (self.folder / f"{name}.{n}" for n in ("key", "csr", "pem", "x"))
        more.write_text(extension + "\n")
        openssl("req", *NEW_KEY, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
        openssl(
            *("x509", "-req", "-in", request, "-CA", self.ca, "-CAkey", self._key),
            *("-CAcreateserial", "-days", str(days), "-extfile", more, "-out", cert),
        )
        return cert, key


@pytest.fixture
def ours(tmp_path: Path) -> Authority:
    return Authority(tmp_path / "ours")


def served(folder: Path, cert: Path, key: Path, *lines: str) -> Broker:
    tls = (f"certfile {cert}", f"keyfile {key}")
    return Broker(folder, "allow_anonymous true", *tls, *lines)


def absent(words: str) -> Callable[[Running], bool]:
    return lambda r: r.publisher.status.state == "absent" and words in r.publisher.status.detail


WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "another name": (
        {"extension": "subjectAltName=DNS:broker.example.org"},
        "IP address mismatch",
        "mqtt.host must be a name that the broker's certificate has",
    ),
    "a name in its subject alone": (
        {"extension": "keyUsage=digitalSignature"},
        "mismatch",
        "mqtt.host must be a name that the broker's certificate has",
    ),
    "run out": ({"days": 0}, "certificate has expired", "renew the broker's certificate"),
    "for clients alone": (
        {"extension": f"extendedKeyUsage=clientAuth\n{SERVER}"},
        "unsuitable certificate purpose",
        "",
    ),
}


@pytest.mark.parametrize("case", WRONG)
async def test_a_broker_whose_certificate_is_not_right_is_told_apart(
    case: str, ours: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "s3cret")
    more, why, what = WRONG[case]
    cert, key = ours.issue("127.0.0.1", **more)
    await asyncio.sleep(1.1 if case == "run out" else 0.0)
    with served(tmp_path, cert, key) as broker:
        section = options(broker, tls=True, ca_file=ours.ca, username="truck")
        async with running(section) as it:
            await it.until(absent(why))
            assert what in it.publisher.status.detail
            assert it.publisher.counters["mqtt_published"] == 0
            assert it.codes() == ["mqtt_absent"]
        assert "truck" not in broker.log  # no client of that name has spoken


async def test_a_broker_of_another_authority_is_refused_and_so_is_one_without_tls(
    ours: Authority, tmp_path: Path
) -> None:
    other = Authority(tmp_path / "other")
    with served(tmp_path, *other.issue("localhost")) as broker:
        async with running(options(broker, tls=True, ca_file=ours.ca)) as it:
            await it.until(absent("set mqtt.ca_file to the authority that signed"))
        async with running(options(broker, tls=True, ca_file=other.ca)) as it:
            await it.until(lambda r: r.publisher.counters["mqtt_published"])
    with Broker(tmp_path) as plain:
        async with running(options(plain, tls=True, ca_file=ours.ca)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")
            assert it.publisher.counters["mqtt_published"] == 0


async def test_a_broker_whose_certificate_is_replaced_is_left_and_met_again(
    ours: Authority, tmp_path: Path
) -> None:
    """On the way: the broker restarts as a stranger, then as itself."""
    good, bad = ours.issue("good"), Authority(tmp_path / "other").issue("bad")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"

    def show(pair: tuple[Path, Path]) -> None:
        for source, target in zip(pair, (cert, key), strict=True):
            target.write_bytes(source.read_bytes())

    show(good)
    with served(tmp_path, cert, key) as broker:
        async with running(options(broker, tls=True, ca_file=ours.ca)) as it:
            await it.until(lambda r: r.publisher.status.state == "running")
            broker.kill()
            show(bad)
            broker.start()
            await it.until(absent("CERTIFICATE_VERIFY_FAILED"))
            broker.kill()
            show(good)
            broker.start()
            await it.until(lambda r: r.publisher.status.state == "running")
            assert it.codes() == ["mqtt_connected", "mqtt_lost", "mqtt_connected"]


async def test_the_dashboard_verifies_its_broker_too(ours: Authority, tmp_path: Path) -> None:
    hub = Hub(asyncio.get_running_loop().time, "test")
    with served(tmp_path, *ours.issue("localhost")) as broker:
        stranger = ssl.create_default_context(cafile=str(Authority(tmp_path / "other").ca))
        access = Access("127.0.0.1", broker.port, tls=stranger)
        listens = asyncio.create_task(DashboardBroker(access, hub).listen())
        await until(lambda: hub.link.state == "lost")
        assert "CERTIFICATE_VERIFY_FAILED" in hub.link.text
        listens.cancel()
        await asyncio.gather(listens, return_exceptions=True)
        known = ssl.create_default_context(cafile=str(ours.ca))
        access = Access("127.0.0.1", broker.port, tls=known)
        listens = asyncio.create_task(DashboardBroker(access, hub).listen())
        await until(lambda: hub.link.state == "up")
        section = options(broker, tls=True, ca_file=ours.ca)
        async with running(section) as it:
            await it.until(lambda r: r.publisher.status.state == "running")
            await until(lambda: "truck" in hub.vehicles)
        listens.cancel()
        await asyncio.gather(listens, return_exceptions=True)
