"""Every estimator in the running daemon at 100 Hz: the switch is one line of the configuration.

IMU frames on the bus, a GNSS receiver and an RDSS terminal on serial lines, all the time.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.broker import Broker, listening
from tests.hil.processes import (
    SIM_IMU,
    DaemonProcess,
    Heard,
    VehicleProcess,
    judge,
    stretch_without_overrun,
)

VEHICLE = "estimators"
RATE_HZ = 100.0
CONFIG = """
vehicle = "estimators"
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


@pytest.mark.parametrize("name", ["kalman", "unscented", "federated", "multiscale"])
async def test_estimator_keeps_up(name: str, tmp_path: Path, broker: Broker) -> None:
    vehicle = VehicleProcess(
        tmp_path,
        *("--scenario", "drive", "--rest", "4", "--duration", "200", "--seed", "5"),
        *("--can", "socketcan:vcan0", "--service-frequency", "2"),
    )
    config = tmp_path / "estimators.toml"
    imu = SIM_IMU.format(interface="socketcan", channel="vcan0")
    devices = {"gnss": vehicle.gnss, "rdss": vehicle.rdss, "port": broker.port}
    config.write_text(CONFIG.format(imu=imu, filter=name, rate=RATE_HZ, **devices))
    daemon = DaemonProcess(config)
    try:
        await vehicle.start()
        await daemon.start()
        async with listening(broker) as (listener, _):
            heard = Heard(listener, VEHICLE)
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
        await vehicle.quit()
