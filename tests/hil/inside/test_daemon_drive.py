"""A recorded drive, as CAN frames and NMEA bytes, through the running daemon.

The same rows go through `fusiond process`; both must end at the same place. What the live way adds:

* NMEA prints 1e-7 minutes (0.2 mm), 1e-4 knots and 1e-3 deg; DBC steps are 1e-5 rad/s, 2e-4 m/s^2;
* clocks: frames and bytes are mapped to the host's clock by their least delay, some 0.5 ms each in
  the guest, 1 cm at 20 m/s; `nav` carries whole milliseconds, another 2 cm at most;
* the daemon adds the clock's own sigma (3 ms) to that of a fix, which changes its weight;
* the solution is carried from the newest sample, 0.13 s old here, to the tick: with the engine
  shaking the box by 0.5 m/s^2 and 2 deg/s in each sample, 1 cm and 0.3 deg.
"""

from __future__ import annotations

import asyncio
import csv
import math
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import read_solution
from fusiond.offline.process import process
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.gnss.receiver import KNOT_M_S, latitude, longitude, sentence
from fusiond.simulation.pty_line import PtyLine
from fusiond.studies.navigation_error import metres_per_unit
from tests.broker import Broker
from tests.hil.drives import imu_section
from tests.hil.heard import hearing
from tests.hil.processes import DaemonProcess
from tests.places import DATA, REPOSITORY

DRIVE = DATA / "drive_0708"
FROM_S, UNTIL_S = 243288.0, 243333.0
"""GPS second of week: 10 s of rest, then 35 s of driving."""
GPS_WEEK_UTC = datetime(2025, 7, 6, tzinfo=UTC) - timedelta(seconds=18)  # less the leap seconds
SERIAL_LATENCY_S = 0.05
QUALITY = {"1": "4", "2": "5"}  # fixed and float, as GGA has them
SHARED = ("t_s", "lat_deg", "lon_deg", "height_m", "quality", "sd_n_m", "sd_e_m", "sd_d_m")
LAST_S = 5.0
MEDIAN_M, LARGEST_M, YAW_DEG = 0.03, 0.08, 1.0


class _Event(NamedTuple):
    """Something that a device says at `t_s`: frames for the bus, or bytes for the line."""

    t_s: float
    frames: list[can.Message]
    line: bytes


def _rows(name: str) -> list[dict[str, str]]:
    with (DRIVE / name).open(newline="") as stream:
        return [r for r in csv.DictReader(stream) if FROM_S <= float(r["t_s"]) < UNTIL_S]


def _write(path: Path, columns: tuple[str, ...], rows: list[dict[str, str]]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


def _nmea(row: dict[str, str]) -> bytes:
    """An epoch of a receiver: position, velocity over ground, sigma, date."""
    utc = GPS_WEEK_UTC + timedelta(milliseconds=round(float(row["t_s"]) * 1000))
    clock = f"{utc:%H%M%S}.{utc.microsecond // 1000:03d}"
    where = (*latitude(float(row["lat_deg"])), *longitude(float(row["lon_deg"])))
    north, east = float(row["v_n_m_s"]), float(row["v_e_m_s"])
    knots = f"{math.hypot(north, east) / KNOT_M_S:.4f}"
    course = f"{math.degrees(math.atan2(east, north)) % 360.0:.3f}"
    quality, used = QUALITY[row["quality"]], row["satellites"]
    sd = (row["sd_n_m"], row["sd_e_m"], row["sd_d_m"])
    mode = "R" if quality == "4" else "F"
    gga = ("GNGGA", clock, *where, quality, used, "0.6", row["height_m"], "M", "0.0", "M", "", "")
    rmc = ("GNRMC", clock, "A", *where, knots, course, f"{utc:%d%m%y}", "", "", mode, "V")
    gst = ("GNGST", clock, "0.01", "", "", "", *sd)
    zda = ("GNZDA", clock, f"{utc:%d}", f"{utc:%m}", f"{utc:%Y}", "00", "00")
    return b"".join(sentence(fields) for fields in (gga, rmc, gst, zda))


def _events(imu: list[dict[str, str]], gnss: list[dict[str, str]]) -> list[_Event]:
    encoder = CanImu(SIM_IMU)
    events = []
    for number, row in enumerate(imu):
        t_s, *values = (float(v) for v in row.values())
        frames = encoder.frames(number, round(t_s * 1e9), values[:3], values[3:])
        events.append(_Event(t_s, frames, b""))
    for row in gnss:
        events.append(_Event(float(row["t_s"]) + SERIAL_LATENCY_S, [], _nmea(row)))
    return sorted(events, key=lambda e: e.t_s)


async def _feed(events: list[_Event], bus: can.BusABC, line: PtyLine) -> None:
    """Say everything in its time."""
    start_s = time.monotonic() - events[0].t_s
    for t_s, frames, text in events:
        await asyncio.sleep(max(0.0, start_s + t_s - time.monotonic()))
        for frame in frames:
            bus.send(frame)
        if text:
            assert line.write(text)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PtyLine]:
    line = PtyLine(tmp_path / "gnss")
    line.plug()
    yield line
    line.unplug()


def _config(path: Path, line: PtyLine, port: int) -> Path:
    """The shipped configuration of this drive with devices and a broker."""
    text = (REPOSITORY / "config/drive_0708.toml").read_text()
    mqtt = f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\nnav_rate_hz = 20.0\n'
    text = text.replace("[mqtt]\nenabled = false\n", mqtt)
    assert mqtt in text
    # What two starts make of the error that fixes share parts them by centimetres for minutes.
    lever = "lever_arm_m = [0.0, -0.05, 0.0]\n"
    assert lever in text
    text = text.replace(lever, lever + "bias_sd_m = 0.0\n")
    text += imu_section()
    # The recording is older than the program, which refuses such dates unless told otherwise.
    text += f'[sources.gnss]\ndriver = "nmea"\nport = "{line.link}"\nearliest_date = 2025-01-01\n'
    text += "[scheduler]\nrate_hz = 50.0\n"
    path.write_text(text)
    return path


def _differences(messages: list[dict[str, Any]], solution: Path) -> tuple[Any, Any]:
    """Horizontal distance (m) and difference in yaw (deg) to the file, over its last seconds."""
    table = read_solution(solution)
    week_ms = GPS_WEEK_UTC.timestamp() * 1e3
    end_s = float(table.t_s[-1])
    last_ms = (week_ms + (end_s - LAST_S) * 1e3, week_ms + end_s * 1e3)
    nav = [m for m in messages if last_ms[0] <= m["t_ms"] <= last_ms[1]]
    assert len(nav) > 10 * LAST_S
    assert {m["mode"] for m in nav} == {"navigating"}
    t_s = np.array([(m["t_ms"] - week_ms) * 1e-3 for m in nav])
    lat, lon, height, yaw = (
        np.interp(t_s, table.t_s, column)
        for column in (table.lat_rad, table.lon_rad, table.height_m, np.unwrap(table.rpy[:, 2]))
    )
    north, east, _ = metres_per_unit(float(lat[0]), float(height[0]))
    d_north = (np.radians([m["lat_deg"] for m in nav]) - lat) * north
    d_east = (np.radians([m["lon_deg"] for m in nav]) - lon) * east
    d_yaw = ([m["yaw_deg"] for m in nav] - np.degrees(yaw) + 180.0) % 360.0 - 180.0
    return np.hypot(d_north, d_east), d_yaw


@pytest.mark.skipif(not DRIVE.is_dir(), reason=f"{DRIVE} is missing: set FUSIOND_DATA")
async def test_the_drive_ends_where_the_offline_run_ends(
    tmp_path: Path, line: PtyLine, broker: Broker
) -> None:
    imu, gnss = _rows("imu.csv"), _rows("gnss.csv")
    config = _config(tmp_path / "drive_0708.toml", line, broker.port)
    solution = tmp_path / "solution.csv"
    velocity = ("v_n_m_s", "v_e_m_s")  # NMEA has neither the third nor a sigma
    offline = process(
        load_config(config),
        _write(tmp_path / "imu.csv", tuple(imu[0]), imu),
        [("gnss", _write(tmp_path / "gnss.csv", (*SHARED, *velocity), gnss))],
        out=solution,
    )
    assert offline["aligned"] == "GNSS course, on the move"
    events = _events(imu, gnss)

    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        async with DaemonProcess(config) as daemon:
            await daemon.start()
            async with hearing(broker, "drive_0708") as heard:
                await heard.until("health", lambda m: m["sources"]["gnss"]["state"] != "absent")
                await _feed(events, bus, line)
                await heard.until("status", lambda m: m["mode"] == "invalid")  # the drive is over
                await heard.until("health")
            assert await daemon.terminate() == 0
    health = heard.all("health")[-1]["sources"]
    whys = [(m["mode"], m["why"]) for m in heard.all("status")]
    assert health["imu"]["received"] == len(imu), (whys, heard.all("event"))
    assert health["gnss"]["received"] == len(gnss)
    fused = health["gnss"]["fused"]
    assert abs(fused - offline["sources"]["gnss"]["fused"]) <= 3
    distance, yaw = _differences(heard.all("nav"), solution)
    print(f"last {LAST_S:g} s: {np.median(distance):.3f} m, at most {distance.max():.3f} m;")
    print(f"yaw {np.abs(yaw).max():.3f} deg; fused {fused}, {offline['sources']['gnss']}")
    assert np.median(distance) < MEDIAN_M
    assert distance.max() < LARGEST_M
    assert np.abs(yaw).max() < YAW_DEG
