"""The daemon as systemd starts it, on a real CAN bus, serial lines and broker, through its faults.

Truth is the simulated vehicle's; the daemon sees only its frames and bytes.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import time
from math import hypot
from pathlib import Path
from typing import Any

import pytest

from tests.broker import Broker
from tests.hil.drives import configuration, drive, section
from tests.hil.heard import Heard, hearing, judge
from tests.hil.logs import STEP_S, hand_over
from tests.hil.processes import FUSIOND, PATIENCE_S, DaemonProcess, VehicleProcess

VEHICLE = "bench"
RATE_HZ = 50.0
# What no error may exceed whatever the stated sigma: the receiver's white noise is 0.8 m and 1.5 m
# (fusiond.simulation.gnss.receiver).

BOUNDS = {"m": 4.0, "m_s": 1.0, "deg": 5.0}


def _link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True)


async def _check_against_truth(heard: Heard, vehicle: VehicleProcess, messages: int = 20) -> None:
    """The next solutions lie within their sigma, and within reason."""
    since = heard.count
    while len(heard.all("nav", since)) < messages:
        await heard.until("nav")
    judge(vehicle, heard.all("nav", since), BOUNDS)


async def _start_with_nothing(daemon: DaemonProcess, broker: Broker) -> None:
    """No bus, no receiver, no terminal, no broker: the daemon starts and says so."""
    _link("down")
    await daemon.start()
    while "bus_open_failed" not in daemon.log and "vcan0 is down" not in daemon.log:  # noqa: ASYNC110
        await asyncio.sleep(0.05)
    broker.start()
    async with hearing(broker, VEHICLE) as heard:
        await heard.online(b"online")
        status = await heard.until("status")
        assert (status["mode"], status["why"]) == ("waiting", "Waiting for IMU data")
        health = await heard.until("health", lambda m: m["sources"]["rdss"]["state"] == "absent")
        assert health["sources"]["imu"]["state"] == "absent"
        assert "vcan0 is down" in health["sources"]["imu"]["detail"]
        assert health["sources"]["gnss"]["state"] == "absent"
        # Not all devices send, but what waits for this service need not wait for ever.
        await daemon.ready()
    _link("up")


async def _align(heard: Heard, vehicle: VehicleProcess) -> None:
    """Everything appears; level at rest, heading on first motion."""
    status = await heard.until("status", lambda m: m["mode"] == "navigating")
    assert status["why"] == "Heading from GNSS course"
    said = heard.all("status")
    assert list(dict.fromkeys(m["mode"] for m in said)) == ["waiting", "aligning", "navigating"]
    assert any("No heading" in m["why"] for m in said)
    await heard.until("health", lambda m: m["sources"]["rdss"]["fused"] >= 1)
    await _check_against_truth(heard, vehicle)


async def _lose_position(heard: Heard, vehicle: VehicleProcess) -> None:
    """Receiver and terminal are unplugged: coasting; each is taken up again when it is back."""
    await vehicle.unplug("gnss")
    health = await heard.until("health", lambda m: m["sources"]["gnss"]["state"] == "absent")
    assert "gnss" in health["sources"]["gnss"]["detail"]  # names the port
    await vehicle.unplug("rdss")
    await heard.until("health", lambda m: m["sources"]["rdss"]["state"] == "absent")
    status = await heard.until("status", lambda m: m["mode"] == "coasting")
    assert status["why"].startswith("No position fused for")
    fused = heard.all("health")[-1]["sources"]
    await vehicle.plug("gnss")
    await heard.until("status", lambda m: m["mode"] == "navigating")
    await heard.until(
        "health", lambda m: m["sources"]["gnss"]["fused"] > fused["gnss"]["fused"] + 10
    )
    await vehicle.plug("rdss")
    await _check_against_truth(heard, vehicle)
    await heard.until("health", lambda m: m["sources"]["rdss"]["fused"] > fused["rdss"]["fused"])


async def _step_the_system_clock(heard: Heard, vehicle: VehicleProcess) -> None:
    """Somebody sets the computer's clock: it is told, and moves nothing."""
    time.clock_settime(time.CLOCK_REALTIME, time.time() + STEP_S)
    await heard.until("event", lambda m: m["code"] == "system_clock_stepped")
    await _check_against_truth(heard, vehicle)


def _inertial(status: dict[str, Any]) -> bool:
    """Whether it navigates by the inertial unit."""
    return bool(status["mode"] == "navigating" and "no inertial unit" not in status["why"].lower())


async def _lose_imu(heard: Heard, vehicle: VehicleProcess) -> None:
    """The IMU falls silent, then its interface goes down: invalid at once, and back again."""
    await vehicle.unplug("imu")
    status = await heard.until("status", lambda m: m["mode"] == "invalid")
    assert status["why"].startswith("IMU silent for")
    health = await heard.until("health", lambda m: m["sources"]["imu"]["state"] == "silent")
    assert "nothing heard" in health["sources"]["imu"]["detail"]
    await vehicle.plug("imu")
    await heard.until("status", _inertial)
    _link("down")
    health = await heard.until("health", lambda m: m["sources"]["imu"]["state"] == "absent")
    assert "vcan0 is down" in health["sources"]["imu"]["detail"]
    # Invalid at first; after 2.2 s the fixes alone go on.
    await heard.until("status", lambda m: m["why"].startswith("IMU silent for"))
    _link("up")
    await heard.until("status", _inertial)
    health = await heard.until("health", lambda m: m["sources"]["imu"]["state"] == "running")
    assert health["sources"]["imu"]["counters"]["gap"] >= 2
    await _check_against_truth(heard, vehicle)
    codes = [(m["source"], m["code"]) for m in heard.all("event")]
    assert ("imu", "interface_down") in codes
    assert ("imu", "interface_up") in codes
    assert ("gnss", "device_absent") in codes


async def _lose_broker(broker: Broker, before: dict[str, float]) -> None:
    """The broker dies and returns: messages resume, and no tick was missed for it."""
    broker.kill()
    await asyncio.sleep(3.0)
    broker.start()
    async with hearing(broker, VEHICLE) as heard:
        await heard.online(b"online")
        await heard.until("nav", lambda m: m["mode"] == "navigating")
        status = await heard.until("status", lambda m: m["mqtt_reconnects"] == 1)
    # Every period of the scheduler is a tick or a counted overrun; overruns only if the guest lags.
    periods = status["ticks"] + status["overruns"] - before["ticks"] - before["overruns"]
    elapsed_s = status["uptime_s"] - before["uptime_s"]
    assert periods == pytest.approx(elapsed_s * RATE_HZ, abs=2)
    assert status["ticks"] - before["ticks"] > 0.5 * periods


STANDS_S = 20.0
"""Of the vehicle's second stop."""


async def _restart_at_rest(
    heard: Heard, daemon: DaemonProcess, vehicle: VehicleProcess, folder: Path
) -> None:
    """Stopped where the vehicle stands, it starts again with the heading it had."""
    stands = await heard.until(
        "nav", lambda m: hypot(m["v_n_m_s"], m["v_e_m_s"]) < 0.05, patience_s=400.0
    )
    print(f"stands at t_s = {vehicle.t_s(stands['t_ms']):.1f}")
    assert await daemon.terminate() == 0
    await heard.online(b"offline")
    assert "STOPPING=1" in daemon.told
    state = json.loads((folder / "state.json").read_text())
    assert state["utc_s"] > stands["t_ms"] * 1e-3 - 1.0
    await daemon.start()
    await daemon.ready()
    await heard.online(b"online")
    status = await heard.until("status", lambda m: m["mode"] == "navigating")
    new = [m for m in heard.all("status") if m["uptime_s"] <= status["uptime_s"]]
    seen = [(vehicle.t_s(m["t_ms"]), m["mode"], m["why"]) for m in new]
    # On a busy host a process takes longer to begin than the vehicle stands: then the saved heading
    # is of no use, and its course counts.
    if seen[0][0] < vehicle.t_s(stands["t_ms"]) + STANDS_S - 2.0:
        assert status["why"] == "Heading from saved state", seen
    print(f"navigates {status['uptime_s']:.1f} s after the restart")
    await _check_against_truth(heard, vehicle)


async def test_a_drive_through_every_fault(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    vehicle = drive(tmp_path, 8, 420, 7)  # stops again for 20 s at 101 s
    config = tmp_path / "bench.toml"
    no_slip = {"enabled": True, "lever_arm_m": [-1.0, 0.0, 0.5]}
    config.write_text(
        'state_file = "state.json"\n'
        + configuration(VEHICLE, vehicle, broker.port, RATE_HZ, {"timeout_s": 2.0})
        + section("constraints.non_holonomic", **no_slip)
        + section("estimator", coast_after_s=6.0)
        + section("recording", directory="logs")
    )
    try:
        async with vehicle, DaemonProcess(config) as daemon:
            await _start_with_nothing(daemon, broker)
            async with hearing(broker, VEHICLE) as heard:
                await vehicle.start()
                await _align(heard, vehicle)
                await _lose_position(heard, vehicle)
                await _step_the_system_clock(heard, vehicle)
                await _lose_imu(heard, vehicle)
                before = await heard.until("status")
            await _lose_broker(broker, before)
            async with hearing(broker, VEHICLE) as heard:
                await _restart_at_rest(heard, daemon, vehicle, tmp_path)
            assert await daemon.terminate() == 0
    finally:
        broker.stop()
        _link("up")
    hand_over(tmp_path / "logs")


def test_a_config_mistake_exits_78(tmp_path: Path) -> None:
    config = tmp_path / "bench.toml"
    config.write_text('[scheduler]\nrate_hz = 0\n[sources.imu]\ndriver = "can_imy"\n')
    ended = subprocess.run(
        [FUSIOND, "run", config], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert ended.returncode == 78
    for word in (str(config), "rate_hz", "0", "can_imy", "can_imu"):
        assert word in ended.stderr
