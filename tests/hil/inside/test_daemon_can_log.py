"""A recorded bus, replayed onto vcan at its own pace, through the running daemon.

All devices of the drive are on one bus: inertial unit, receiver and the engine's OBD answers. The
same minute goes through `fusiond process --can`: the drivers make the same of it as live.
"""

from __future__ import annotations

import asyncio
import gzip
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import PositionFix
from fusiond.configuration.load import load_config
from fusiond.offline.can_log_reader import messages
from fusiond.offline.can_through_drivers import CanLog, read_can_log
from fusiond.offline.process import process
from fusiond.studies.navigation_error import metres_per_unit
from tests.broker import Broker
from tests.hil.heard import hearing
from tests.hil.processes import DaemonProcess
from tests.places import DATA, REPOSITORY

LOG = DATA / "css_164" / "can.log.gz"
FROM_S, UNTIL_S = 1_627_210_600.0, 1_627_210_660.0
"""POSIX, of the recorder: a minute of driving at 20 m/s."""
MEDIAN_M = 10.0
"""From the way that the module's fixes describe, which state 1 to 3 m. A host that stands still for
a moment stamps what it replays late: that moves the solution along the way, not across it."""


def _minute(path: Path) -> Path:
    """The lines of the log within the minute."""
    with gzip.open(LOG, "rt") as whole, path.open("w") as part:
        for line in whole:
            if FROM_S <= float(line[1 : line.index(")")]) < UNTIL_S:
                part.write(line)
    return path


async def _replay(frames: list[can.Message]) -> None:
    start_s = time.monotonic() - frames[0].timestamp
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        for frame in frames:
            await asyncio.sleep(max(0.0, start_s + frame.timestamp - time.monotonic()))
            bus.send(frame)


def _config(path: Path, port: int) -> Path:
    """The shipped configuration of this drive on the bus of the bench, with a broker."""
    text = (REPOSITORY / "config/css_164.toml").read_text()
    text = text.replace('channel = "can0"', 'channel = "vcan0"')
    mqtt = f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\nnav_rate_hz = 10.0\n'
    text = text.replace("[mqtt]\nenabled = false\n", mqtt)
    assert mqtt in text
    assert text.count("vcan0") == 3
    path.write_text(text)
    return path


def _across_m(log: CanLog, nav: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Horizontal distance of solutions (n,) to the way from fix to fix."""
    fixes = [m for m in (row.measurement for row in log.arrivals) if isinstance(m, PositionFix)]
    north, east, _ = metres_per_unit(fixes[0].lat_rad, 100.0)
    way = np.array([(m.lat_rad * north, m.lon_rad * east) for m in fixes])
    place = np.radians([(m["lat_deg"], m["lon_deg"]) for m in nav]) * (north, east)
    along = np.diff(way, axis=0)
    ahead = place[:, None] - way[:-1]
    share = np.clip((ahead * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(ahead - share[..., None] * along, axis=2).min(axis=1)


@pytest.mark.skipif(not LOG.is_file(), reason=f"{LOG} is missing: set FUSIOND_DATA")
async def test_a_recorded_bus_drives_the_daemon(tmp_path: Path, broker: Broker) -> None:
    path = _minute(tmp_path / "minute.log")
    frames = list(messages(path))
    config = _config(tmp_path / "css_164.toml", broker.port)
    log = read_can_log(path, load_config(config))
    offline = process(load_config(config), None, [], can_log=path)
    assert offline["mode"] == "navigating"

    async with DaemonProcess(config) as daemon:
        await daemon.start()
        async with hearing(broker, "css_164") as heard:
            silent = {"imu", "gnss", "wheel"}
            await heard.until(
                "health", lambda m: {m["sources"][name]["state"] for name in silent} == {"silent"}
            )
            await _replay(frames)
            await heard.until("status", lambda m: m["mode"] == "invalid")  # the minute is over
            await heard.until("health")
        assert await daemon.terminate() == 0
    health = heard.all("health")[-1]["sources"]
    for name, can_id in (("imu", 9), ("gnss", 3), ("wheel", 0x7E8)):
        print(name, health[name])
        assert health[name]["counters"]["frames"] >= sum(f.arbitration_id == can_id for f in frames)
    # Of samples that are alike and came late together, one counts.
    imu = health["imu"]
    assert imu["received"] + imu["counters"].get("duplicates", 0) == len(log.imu.t_s)
    assert health["wheel"]["received"] == sum(r.measurement.source == "wheel" for r in log.arrivals)
    fixes = sum(r.measurement.source == "gnss" for r in log.arrivals)
    assert fixes - 1 <= health["gnss"]["received"] <= fixes
    assert health["wheel"]["fused"] > 60
    assert health["gnss"]["fused"] > 30
    nav = [m for m in heard.all("nav") if m["mode"] == "navigating"]
    across = _across_m(log, nav)
    print(f"{len(nav)} solutions: {np.median(across):.2f} m beside the way, {across.max():.2f}")
    assert np.median(across) < MEDIAN_M
