"""Every estimator in the running daemon at 100 Hz: the switch is one line of the configuration.

IMU frames on the bus, a GNSS receiver and an RDSS terminal on serial lines, all the time.
"""

from __future__ import annotations

from pathlib import Path

from tests.broker import Broker
from tests.hil.drives import configuration, drive, section
from tests.hil.heard import hearing, judge, keeps_up
from tests.hil.processes import DaemonProcess, VehicleProcess

RATE_HZ = 100.0
# As in test_daemon: what no error may exceed whatever the sigma.
BOUNDS = {"m": 6.0, "m_s": 1.0}


async def test_every_estimator_keeps_up(tmp_path: Path, broker: Broker) -> None:
    """One drive; the daemon is started anew for each filter, with one line changed (and its name,
    so that what the broker retained is not taken for news)."""
    async with drive(tmp_path, 4, 600, 5) as vehicle:
        await vehicle.start()
        for name in ("kalman", "unscented", "federated", "multiscale"):
            config = tmp_path / f"{name}.toml"
            config.write_text(
                configuration(name, vehicle, broker.port, RATE_HZ)
                + section("estimator", filter=name)
            )
            async with DaemonProcess(config) as daemon:
                await _keeps_up(name, daemon, vehicle, broker)


async def _keeps_up(
    name: str, daemon: DaemonProcess, vehicle: VehicleProcess, broker: Broker
) -> None:
    await daemon.start()
    async with hearing(broker, name) as heard:
        await heard.until("status", lambda m: m["mode"] == "navigating")
        await heard.until("health", lambda m: m["sources"]["rdss"]["fused"] >= 2)
        since = heard.count
        await keeps_up(heard, RATE_HZ)
        solutions = heard.all("nav", since)
        assert len(solutions) > 20
        judge(vehicle, solutions, BOUNDS)
        health = await heard.until("health")
        assert health["sources"]["gnss"]["fused"] > 20
    assert await daemon.terminate() == 0
