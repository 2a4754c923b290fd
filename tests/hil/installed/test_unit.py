"""Install, a mistake in the configuration, start, watchdog, restart, stop: one life of the unit."""

from __future__ import annotations

import asyncio
import json
import os
import pwd
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.broker import Broker
from tests.hil.heard import Heard, hearing
from tests.hil.installed.installation import (
    CACHE,
    CONFIG,
    PREFIX,
    UNIT,
    carry_out,
    journal,
    put_kernels,
    readme_blocks,
    show,
    show_python,
    systemctl,
)
from tests.hil.processes import PATIENCE_S, SIM_IMU, VehicleProcess

GNSS, RDSS = Path("/dev/gnss"), Path("/dev/rdss")
"""The names that `70-fusiond.rules` gives."""
START = """
[alignment]
heading = ["saved", "config"]
heading_deg = 40.0

[scheduler]
rate_hz = 1.0
"""
"""At rest a solution may be kept for the next start. Few ticks: one on time in the watchdog's 5 s
must be possible on a host that is busy with other things."""
STATE = Path("/var/lib/fusiond/vehicle.json")
"""In the unit's StateDirectory=, named by the vehicle."""


async def _until(condition: Callable[[dict[str, str]], bool]) -> dict[str, str]:
    """The unit's properties once they are so; the service manager is asked again and again."""
    names = "ActiveState", "SubState", "MainPID", "NRestarts", "Result", "ExecMainStatus"
    unit: dict[str, str] = {}
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not condition(unit := await asyncio.to_thread(show, *names)):  # noqa: ASYNC110
                await asyncio.sleep(0.2)
    except TimeoutError:
        raise AssertionError(f"never so: {unit}\n{journal()}") from None
    return unit


def _running(unit: dict[str, str]) -> bool:
    """`active` is only reached by READY=1: the unit is of Type=notify."""
    return (unit["ActiveState"], unit["SubState"]) == ("active", "running")


def _edit(port: int) -> None:
    """What the README asks a person to do: the vehicle's devices, bus and broker."""
    text = CONFIG.read_text()
    imu = SIM_IMU.format(interface="socketcan", channel="vcan0")
    text, sections = re.subn(r"\[sources\.imu\]\n.*?(?=\n\[)", lambda _: imu, text, flags=re.DOTALL)
    for old, new in (
        ('port = "/dev/ttyUSB0"', f'port = "{GNSS}"'),
        ('port = "/dev/ttyUSB1"', f'port = "{RDSS}"\nbaud = 115200\nfamily = "4.0"'),
        ('host = "localhost"', f'host = "127.0.0.1"\nport = {port}'),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    assert sections == 1
    CONFIG.write_text(text + START)


async def test_a_life_of_the_unit(tmp_path: Path) -> None:
    show_python()
    install, start = readme_blocks()
    carry_out(install)
    carry_out(start[:1])  # `check`
    await _mistake(start)

    kernels = put_kernels(Path(os.environ["FUSIOND_TEST_KERNELS"]))
    with Broker(tmp_path) as broker:
        _edit(broker.port)
        vehicle = VehicleProcess(
            tmp_path,
            *("--scenario", "drive", "--rest", "900", "--duration", "900", "--seed", "7"),
            *("--can", "socketcan:vcan0", "--service-frequency", "2"),
        )
        async with vehicle, hearing(broker, "vehicle") as heard:
            await vehicle.start()
            for link, name in ((vehicle.gnss, GNSS), (vehicle.rdss, RDSS)):
                shutil.chown(link.resolve(), "root", "dialout")  # as udev does for a ttyUSB
                link.resolve().chmod(0o660)
                name.symlink_to(link.resolve())
            await _live(heard, start)
    assert sorted(path.name for path in CACHE.glob("*/*")) == kernels, "something was compiled"


async def _mistake(start: list[str]) -> None:
    """A mistake in the configuration: what the README starts fails with 78, once."""
    good = CONFIG.read_text()
    CONFIG.write_text(good.replace("rate_hz = 100.0", 'rate_hz = "fast"'))
    printed = carry_out([*start[1:-1], start[-1] + " || true"])
    assert "Job for fusiond.service failed" in printed
    failed = await _until(lambda unit: unit["ActiveState"] == "failed")
    assert (failed["Result"], failed["ExecMainStatus"]) == ("exit-code", "78"), journal()
    assert failed["NRestarts"] == "0"
    assert "rate_hz" in journal()
    CONFIG.write_text(good)


async def _live(heard: Heard, start: list[str]) -> None:
    # Returns when the daemon has said READY=1. In a thread, as all that takes long: the subscriber
    # must answer the broker meanwhile.
    await asyncio.to_thread(carry_out, start[-1:])
    first = await _until(_running)
    assert first["NRestarts"] == "0"
    _check_process(int(first["MainPID"]))
    await _aligned(heard)
    await _reload(int(first["MainPID"]))

    # Frozen: the watchdog kills it, and it comes back.
    os.kill(int(first["MainPID"]), signal.SIGSTOP)
    second = await _until(lambda unit: unit["NRestarts"] == "1" and _running(unit))
    assert second["MainPID"] != first["MainPID"]
    assert "Watchdog timeout" in journal()
    await _aligned(heard)

    await asyncio.to_thread(systemctl, "restart", UNIT)
    third = await _until(_running)
    assert third["MainPID"] not in ("0", second["MainPID"])
    assert third["NRestarts"] == "0"  # asked for, not needed
    await _aligned(heard)

    stands = await heard.until("nav")
    await asyncio.to_thread(systemctl, "stop", UNIT)
    stopped = await _until(lambda unit: unit["ActiveState"] == "inactive")
    assert (stopped["Result"], stopped["MainPID"]) == ("success", "0"), journal()
    await heard.online(b"offline")
    _check_state(stands)


async def _reload(pid: int) -> None:
    """Taken from the file while it runs; a mistake fails the reload and changes nothing."""
    good = CONFIG.read_text()
    CONFIG.write_text(good.replace("nav_rate_hz = 10.0", "nav_rate_hz = 5.0"))
    await asyncio.to_thread(systemctl, "reload", UNIT)
    await _told("daemon: reloaded: changed: mqtt.nav_rate_hz")
    CONFIG.write_text(good.replace("nav_rate_hz = 10.0", 'nav_rate_hz = "fast"'))
    asked = ["systemctl", "reload", UNIT]
    refused = await asyncio.to_thread(subprocess.run, asked, check=False, capture_output=True)
    assert refused.returncode != 0
    await _told("daemon: reload_refused: ")
    CONFIG.write_text(good)
    await asyncio.to_thread(systemctl, "reload", UNIT)
    assert (await _until(_running))["MainPID"] == str(pid)


async def _told(text: str) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while text not in await asyncio.to_thread(journal):  # noqa: ASYNC110
            await asyncio.sleep(0.2)


async def _aligned(heard: Heard) -> None:
    await heard.online(b"online")
    # At rest no motion has confirmed the configured heading: a solution, and the mode says so.
    await heard.until("status", lambda status: status["mode"] == "coasting")


def _check_process(pid: int) -> None:
    """It is the installed program, and all its user may be is `fusiond` without a capability."""
    entry = pwd.getpwnam("fusiond")
    status = dict(
        line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    assert entry.pw_uid != 0
    assert status["Uid"].split() == [str(entry.pw_uid)] * 4
    assert status["Gid"].split() == [str(entry.pw_gid)] * 4
    assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
    program = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    # The interpreter by the name that the installed script has for it.
    script = (PREFIX / "bin" / "fusiond").read_text().splitlines()[0]
    assert program[0] == script.removeprefix("#!")
    assert program[0].startswith(str(PREFIX / "bin" / "python"))
    assert program[1:4] == ["-P", "-m", "fusiond.live"]


def _check_state(stands: dict[str, Any]) -> None:
    """Kept at the stop: no older than what was published before it, however busy the host is."""
    state = json.loads(STATE.read_text())
    assert state["utc_s"] > stands["t_ms"] * 1e-3 - 1.0
    assert STATE.owner() == "fusiond"
