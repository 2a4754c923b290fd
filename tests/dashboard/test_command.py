"""The command `dashboard`: where it serves, whose broker it listens to, what it refuses."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.dashboard import serve
from fusiond.dashboard.broker import Access
from fusiond.dashboard.serve import PageAddress, is_loopback
from tests.patience import PATIENCE_S


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.0.0.9", "::1"])
def test_loopback(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.1.2.3", "truck.local", ""])
def test_not_loopback(host: str) -> None:
    assert not is_loopback(host)


def run_command(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "fusiond", "dashboard", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_command_says_where_it_is_and_ends_when_told() -> None:
    process = run_command("--port", "0", "--mqtt", "127.0.0.1:1", "--commands")
    assert process.stdout is not None
    line = process.stdout.readline()
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/#token=\S{22}\n", line)
    assert found is not None, line
    with socket.create_connection(("127.0.0.1", int(found[1])), PATIENCE_S) as taken:
        second = run_command("--port", found[1])
        _, error = second.communicate(timeout=PATIENCE_S)
        assert second.returncode == 69
        assert "choose another with --host and --port" in error
        taken.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert taken.recv(64).startswith(b"HTTP/1.1 200")
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGTERM
    assert error == ""


@pytest.mark.parametrize("address", ["localhost", "localhost:", ":1883", "h:0", "h:70000", "h:x"])
def test_a_broker_is_host_and_port(address: str) -> None:
    result = CliRunner().invoke(app, ["dashboard", "--mqtt", address])
    assert result.exit_code == 2
    assert "HOST:PORT" in result.output


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Access, PageAddress]]:
    """What the command would serve."""
    calls: list[tuple[Access, PageAddress]] = []
    monkeypatch.setattr(serve, "serve_broker", lambda a, s, report: calls.append((a, s)))
    return calls


def test_the_broker_of_a_configuration(
    served: list[tuple[Access, PageAddress]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "truck.toml"
    path.write_text(
        '[mqtt]\nhost = "broker.example.org"\nport = 8883\ntls = true\nusername = "d"\n'
    )
    monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "open sesame")
    monkeypatch.setenv("FUSIOND_DASHBOARD_TOKEN", "kept")
    result = CliRunner().invoke(app, ["dashboard", "--config", str(path), "--commands"])
    assert result.exit_code == 0, result.output
    ((access, serving),) = served
    assert (access.host, access.port, access.username) == ("broker.example.org", 8883, "d")
    assert access.password == "open sesame"
    assert access.tls is not None
    assert serving.token == "kept"
    assert serving.loopback


def test_serving_beyond_loopback_is_announced(served: list[tuple[Access, PageAddress]]) -> None:
    result = CliRunner().invoke(app, ["dashboard", "--host", "0.0.0.0"])
    assert result.exit_code == 0
    assert "everyone who reaches this address sees the vehicle" in result.output
    ((_, serving),) = served
    assert serving.token is None


def test_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve.importlib.util, "find_spec", lambda name: None)
    result = CliRunner().invoke(app, ["dashboard"])
    assert result.exit_code == 69
    assert "pip install 'starlette>=1.0'" in result.output


def test_a_file_that_is_no_recording_exits_65(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"no log")
    result = CliRunner().invoke(app, ["dashboard", str(path)])
    assert result.exit_code == 65
    assert "no MCAP file" in result.output
