"""Tight coupling in the running daemon at 100 Hz: a receiver's UBX and NMEA on one serial line.

RDSS fixes come beside it; for a while a street canyon leaves two satellites, so no fix.
"""

from __future__ import annotations

from pathlib import Path

from tests.broker import Broker
from tests.hil.drives import configuration, drive
from tests.hil.heard import hearing, judge, keeps_up
from tests.hil.processes import DaemonProcess

VEHICLE = "raw"
RATE_HZ = 100.0
CANYON_S = (35.0, 30.0)
"""Start and length on the trajectory, which begins when the daemon is up; it moves from 4 s on."""
BOUNDS = {"m": 15.0, "m_s": 1.0}
"""What no error may exceed whatever the sigma: ranges with errors of metres, downwards more."""


async def test_ranges_carry_the_daemon_through_a_canyon(tmp_path: Path, broker: Broker) -> None:
    start_s, length_s = CANYON_S
    vehicle = drive(
        *(tmp_path, 4, 120, 5),
        *("--gnss-raw", "ubx", "--gnss-mask", f"canyon2:{start_s}:{length_s}"),
    )
    config = tmp_path / "raw.toml"
    receiver = {"driver": "gnss", "allow_simulator": True}
    config.write_text(
        configuration(VEHICLE, vehicle, broker.port, RATE_HZ, receiver, {"kind": "raw"})
    )
    async with vehicle, DaemonProcess(config) as daemon:
        await daemon.start()
        async with hearing(broker, VEHICLE) as heard:
            await heard.online(b"online")
            await vehicle.start()
            await heard.until("status", lambda m: m["mode"] == "navigating")
            await heard.until("health", lambda m: m["sources"]["rdss"]["fused"] >= 1)
            # Just after the start, and where the host has stood still, there may be fewer.
            health = await heard.until(
                "health", lambda m: len(m["sources"]["gnss"]["sky"]["used"]) >= 8
            )
            sky = health["sources"]["gnss"]["sky"]
            assert {name[0] for name in sky["used"]} == {"G", "C"}
            assert 0.5 < sky["hdop"] < 3.0
            assert sky["innovation_rms"] < 3.0
            since = heard.count
            await keeps_up(heard, RATE_HZ)
            judge(vehicle, heard.all("nav", since), BOUNDS)

            await heard.until("health", lambda m: len(m["sources"]["gnss"]["sky"]["used"]) == 2)
            since, before = heard.count, await heard.until("health")
            await heard.until("nav", lambda m: vehicle.t_s(m["t_ms"]) > start_s + length_s)
            after = await heard.until("health")
            judge(vehicle, heard.all("nav", since), BOUNDS)
            fused = [h["sources"]["gnss"]["fused"] for h in (before, after)]
            assert fused[1] - fused[0] > 20
            verdicts = (await heard.until("consistency"))["sources"]
            assert {"gnss_G", "gnss_C"} <= set(verdicts)
        assert await daemon.terminate() == 0
