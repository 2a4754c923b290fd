"""Who may speak to the broker, and what another client of our name does to us."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Mqtt
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.reconnection import (
    LONGEST_CONTESTED_S,
    PEACE_S,
    TAKEN_COUNT,
    Reconnecting,
)
from tests.broker import Broker
from tests.outputs.publisher import options, running


async def test_user_and_password_from_file_and_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passwords = tmp_path / "passwords"
    run("mosquitto_passwd", "-b", "-c", str(passwords), "truck", "s3cret")
    secret = tmp_path / "secret"
    secret.write_text("s3cret\n")
    secret.chmod(0o644)
    with Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}") as broker:
        async with running(options(broker, username="truck", password_file=secret)) as it:
            await it.until(lambda r: r.publisher.status.state == "running")
            assert it.codes()[0] == "mqtt_password_exposed"
        secret.chmod(0o600)
        monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "wrong")
        async with running(options(broker, username="truck", password_file=secret)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")
            assert "uthori" in it.publisher.status.detail
            assert it.codes() == ["mqtt_absent"]
        monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "s3cret")
        async with running(options(broker, username="truck")) as it:
            await it.until(lambda r: r.publisher.status.state == "running")


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def openssl(*arguments: str) -> None:
    run("openssl", *arguments)


async def test_tls_verifies_the_broker_and_shows_our_certificate(tmp_path: Path) -> None:
    ca, key, request, cert = (str(tmp_path / n) for n in ("ca.pem", "key.pem", "req", "cert.pem"))
    extensions = tmp_path / "extensions"
    extensions.write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    new_key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    ca_key = str(tmp_path / "ca-key.pem")
    openssl("req", "-x509", *new_key, "-keyout", ca_key, "-out", ca, "-subj", "/CN=test-ca")
    openssl("req", *new_key, "-keyout", key, "-out", request, "-subj", "/CN=broker")
    openssl(
        *["x509", "-req", "-in", request, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial"],
        *["-out", cert, "-extfile", str(extensions)],
    )
    lines = ("allow_anonymous true", f"cafile {ca}", f"certfile {cert}", f"keyfile {key}")
    with Broker(tmp_path, *lines, "require_certificate true") as broker:
        good = {"tls": True, "ca_file": ca, "cert_file": cert, "key_file": key}
        async with running(options(broker, **good)) as it:
            await it.until(lambda r: r.publisher.counters["mqtt_published"])
        async with running(options(broker, tls=True)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")
            assert "certificate verify failed" in it.publisher.status.detail
        async with running(options(broker, keepalive_s=2)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"password_file": "/nowhere/secret"}, "mqtt.password_file = '/nowhere/secret'"),
        ({"password_file": "/dev/null"}, "empty"),
        ({"ca_file": "/etc/hostname"}, "set mqtt.tls = true"),
        ({"tls": True, "ca_file": "/nowhere/ca.pem"}, "mqtt.ca_file"),
        ({"tls": True, "cert_file": "/dev/null"}, "mqtt.cert_file"),
        ({"tls": True, "key_file": "/dev/null"}, "mqtt.key_file"),
    ],
)
def test_unusable_files_are_named(section: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words.replace(".", r"\.")):
        MqttPublisher(Mqtt(**section), "truck", on_event=lambda *_: None)


async def test_two_of_one_name_say_so_and_stop_throwing_each_other_out(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker)) as a, running(options(broker)) as b:
            await a.until(lambda r: "client_name_taken" in r.codes() + b.codes())
            told = a if "client_name_taken" in a.codes() else b
            assert told.publisher.counters["mqtt_taken_over"] >= 1
            text = dict(told.events)["client_name_taken"]
            assert "'fusiond-truck'" in text
            assert "mqtt.client_id" in text
            # Whoever is in now stays, until the one that waits comes back: seconds, not 250 ms.
            assert told.publisher.status.state == "absent"
            assert "another client" in told.publisher.status.detail
            ended = a.codes().count("mqtt_lost") + b.codes().count("mqtt_lost")
            assert ended <= 2 * TAKEN_COUNT


def test_a_rival_is_told_from_a_broker_that_restarts() -> None:
    rival = Reconnecting()
    assert [rival.ended(0.3, by_broker=True) for _ in range(4)] == [False, False, True, False]
    waits = [rival.wait_s() for _ in range(6)]
    assert waits == [5.0, 10.0, 20.0, 40.0, LONGEST_CONTESTED_S, LONGEST_CONTESTED_S]
    assert not rival.ended(50.0, by_broker=True)
    assert rival.taken  # a rival waits as long
    rival.ended(PEACE_S + 1.0, by_broker=True)
    assert not rival.taken
    assert rival.wait_s() < 1.0

    restarting = Reconnecting()
    for _ in range(5):
        restarting.ended(0.3, by_broker=True)
        restarting.failed()
    frozen = Reconnecting()
    for _ in range(5):
        frozen.ended(2.0, by_broker=False)
    assert not restarting.taken
    assert not frozen.taken
