"""The container's files against the tree that they are built from: no Docker daemon is needed."""

from __future__ import annotations

import re
import shlex
import subprocess
import time
from pathlib import Path

import pytest
import typer.main
import yaml

from fusiond.commands.app import app
from fusiond.configuration.load import load_config
from tests.broker import _PATH, free_port
from tests.places import REPOSITORY

FOLDER = REPOSITORY / "container"
DOCKERFILE = FOLDER / "Dockerfile"


def _steps() -> list[tuple[str, str]]:
    """Instructions with their arguments, continued lines joined."""
    text = re.sub(r"(?m)^#.*\n", "", DOCKERFILE.read_text()).replace("\\\n", " ")
    lines = [line.partition(" ") for line in text.splitlines() if line.strip()]
    return [(word, rest.strip()) for word, _, rest in lines]


def test_copied_files_exist_and_pass_the_ignore_list() -> None:
    copied = [
        source
        for word, rest in _steps()
        if word == "COPY" and not rest.startswith("--from")
        for source in rest.split()[:-1]
    ]
    assert {"fusiond", "drivers", "config", "tools", "requirements.lock"} <= set(copied)
    ignored = (REPOSITORY / ".dockerignore").read_text().splitlines()
    let_through = {line[1:] for line in ignored if line.startswith("!")}
    assert set(copied) == let_through
    for name in copied:
        assert (REPOSITORY / name).exists(), name


def test_dependencies_are_the_locked_ones() -> None:
    installs = [part for word, rest in _steps() if word == "RUN" for part in rest.split("&&")]
    pip = [shlex.split(part) for part in installs if "pip install" in part]
    assert pip[0][-3:] == ["--require-hashes", "-r", "requirements.lock"]
    assert {"--no-deps", "--no-build-isolation"} <= set(pip[1])
    assert len(pip) == 2


def test_kernels_go_where_the_second_stage_finds_them() -> None:
    steps = _steps()
    images = [rest.split()[0] for word, rest in steps if word == "FROM"]
    assert len(images) == 2
    assert len(set(images)) == 1  # the environment runs the Python that it was made with
    (python,) = re.findall(r"^python:(\d+\.\d+)-", images[0])
    (prebuilt,) = [rest for word, rest in steps if word == "RUN" and "tools.prebuilt" in rest]
    packages = f"/opt/fusiond/lib/python{python}/site-packages"
    assert shlex.split(prebuilt)[-2:] == ["--package", packages]
    assert ("COPY", "--from=build /opt/fusiond /opt/fusiond") in steps


def test_no_kernel_is_compiled_at_the_start_and_nobody_is_root() -> None:
    steps = _steps()
    assert any("tools.prebuilt" in rest for word, rest in steps if word == "RUN")
    assert ("USER", "fusiond") in steps
    assert ("ENTRYPOINT", '["fusiond"]') in steps


def test_services_run_commands_that_there_are_on_files_that_there_are() -> None:
    services = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]
    assert set(services) == {"broker", "fusiond", "dashboard"}
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    (default,) = [rest for word, rest in _steps() if word == "CMD"]
    assert yaml.safe_load(default)[0] in commands
    for service in services.values():
        assert service["network_mode"] == "host"  # SocketCAN
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            assert source == "state" or (FOLDER / source).exists(), source
    name, *options = services["dashboard"]["command"]
    known = {one for option in commands[name].params for one in option.opts}
    assert {option for option in options if option.startswith("--")} <= known
    config = load_config((FOLDER / services["fusiond"]["volumes"][0].split(":")[0]).resolve())
    ports = {s.options["port"] for s in config.sources.values() if "port" in s.options}
    assert ports == {device.split(":")[1] for device in services["fusiond"]["devices"]}
    assert options[options.index("--mqtt") + 1] == f"127.0.0.1:{config.mqtt.port}"


def test_mosquitto_takes_its_configuration(tmp_path: Path) -> None:
    text = (FOLDER / "mosquitto.conf").read_text()
    assert "listener 1883 127.0.0.1" in text
    here = tmp_path / "mosquitto.conf"
    here.write_text(text.replace("1883", str(free_port())))
    broker = subprocess.Popen(
        ["mosquitto", "-c", str(here), "-v"],
        env={"PATH": _PATH},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert broker.stderr is not None
        end_s = time.monotonic() + 60.0
        for line in broker.stderr:
            assert "Error" not in line
            assert time.monotonic() < end_s
            if "running" in line:
                return
        pytest.fail("it ended")
    finally:
        # A signal that asks comes too early for a broker that has just said that it runs.
        broker.kill()
        broker.wait()
