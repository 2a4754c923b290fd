"""Every estimator in the running daemon at 100 Hz: the switch is one line of the configuration.

IMU frames on the bus, a GNSS receiver and an RDSS terminal on serial lines, all the time.
"""

from __future__ import annotations

from pathlib import Path

from tests.broker import Broker, listening
from tests.hil.processes import (
    SIM_IMU,
    DaemonProcess,
    Heard,
    VehicleProcess,
    judge,
    stretch_without_overrun,
)

RATE_HZ = 100.0
CONFIG = """
vehicle = "{filter}"
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = 100.0
{imu}
[sources.gnss]
driver = "nmea"
port = "{gnss}"
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[sources.rdss]
driver = "rdss"
port = "{rdss}"
baud = 115200
family = "4.0"
[aiding.rdss]
lever_arm_m = [0.0, 0.0, -1.0]
[estimator]
filter = "{filter}"
[scheduler]
rate_hz = {rate}
[mqtt]
host = "127.0.0.1"
port = {port}
nav_rate_hz = 10.0
"""
# As in test_daemon: what no error may exceed whatever the sigma.
BOUNDS = {"m": 6.0, "m_s": 1.0}


async def test_every_estimator_keeps_up(tmp_path: Path, broker: Broker) -> None:
    """One drive; the daemon is started anew for each filter, with one line changed (and its name,
    so that what the broker retained is not taken for news)."""
    vehicle = VehicleProcess(
        tmp_path,
        *("--scenario", "drive", "--rest", "4", "--duration", "600", "--seed", "5"),
        *("--can", "socketcan:vcan0", "--service-frequency", "2"),
    )
    imu = SIM_IMU.format(interface="socketcan", channel="vcan0")
    devices = {"gnss": vehicle.gnss, "rdss": vehicle.rdss, "port": broker.port}
    try:
        await vehicle.start()
        for name in ("kalman", "unscented", "federated", "multiscale"):
            config = tmp_path / f"{name}.toml"
            config.write_text(CONFIG.format(imu=imu, filter=name, rate=RATE_HZ, **devices))
            await _keeps_up(name, DaemonProcess(config), vehicle, broker)
    finally:
        await vehicle.quit()


async def _keeps_up(
    name: str, daemon: DaemonProcess, vehicle: VehicleProcess, broker: Broker
) -> None:
    try:
        await daemon.start()
        async with listening(broker) as (listener, _):
            heard = Heard(listener, name)
            await heard.until("status", lambda m: m["mode"] == "navigating")
            await heard.until("health", lambda m: m["sources"]["rdss"]["fused"] >= 2)
            since = heard.count
            await stretch_without_overrun(heard, RATE_HZ)
            solutions = heard.all("nav", since)
            assert len(solutions) > 20
            judge(vehicle, solutions, BOUNDS)
            health = await heard.until("health")
            assert health["sources"]["gnss"]["fused"] > 20
        assert await daemon.terminate() == 0
    except BaseException:
        print(daemon.log)
        raise
    finally:
        await daemon.kill()
