"""Public bug reports through the daemon: what people's receivers send, each on a line of its own.

Files and numbers are those of the cases. One daemon serves all lines and buses at once. Case 10 is
of a recorder's file (`tests.offline.test_can_clock`). What 02, 03, 11, 19 and 22 come to takes
minutes of driving (`tests.offline.test_reported_cases`): here is what is read of their lines, of
which 19 and 22 have none.
"""

from __future__ import annotations

import asyncio
import math
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.measurements import Heading, PositionFix, WheelSpeed
from drivers.raw.messages import RawGnssEpoch
from fusiond.offline.can_log_reader import Refusals, messages
from tests.drivers.nmea.sentences import made, wire
from tests.live.daemon_bench import NO_MQTT, Bench, running
from tests.patience import until
from tests.places import DATA
from tests.pty_device import Device

CASES = DATA.parent / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is missing: set FUSIOND_DATA")

LINES = {
    "case01": ("nmea", "01_rmc_status_d.nmea"),
    "case02": ("nmea", "02_no_separation.nmea"),
    "case03": ("nmea", "03_gsa_2d_14_satellites.nmea"),
    "case04": ("nmea", "04_rmc_only.nmea"),
    "case05": ("nmea", None),
    "case11": ("nmea", "11_ths.nmea"),
    "case14": ("nmea", "14_no_checksum.nmea"),
    "case15": ("nmea", "15_talker_gi.nmea"),
    "case16": ("nmea", "16_quality_9.nmea"),
    "case17": ("nmea", "17_ubx_nav_only.bin"),
    "case17_ubx": ("ubx", "17_ubx_nav_only.bin"),
    "case18": ("gnss", "18_rtcm_of_2016.rtcm3"),
    "case21": ("gnss", None),
}
"""Driver and what is sent, by source."""
BUSES = (
    "06_pretrigger.blf",
    "07_canfd_start_of_measurement.asc",
    "08_nul_block.log",
    "09_cp1252_comment.asc",
    "12_peak.trc",
    "13_candump_view.log",
)
"""Recorded buses of a car whose tester asks for the speed."""
SPEED = b"\x41\x0d"
EPOCHS_WITH_A_PAUSE = 3
B1C_RANGES = 4174


def _sections(folder: Path) -> Iterator[str]:
    for name, (driver, _) in LINES.items():
        yield f'[sources.{name}]\ndriver = "{driver}"\nport = "{folder / name}"\ntimeout_s = 0.1'
        yield "earliest_date = 2000-05-01"
        if driver != "gnss":  # so many receivers' own states are more than a filter has room for
            yield f'[aiding.{name}]\nkind = "gnss"\nlever_arm_m = [0.0, 0.0, 0.0]'
            yield "time_offset_sd_s = 0.0\nbias_sd_m = 0.0"
    yield f'[sources.wheel]\ndriver = "obd_speed"\ninterface = "virtual"\nchannel = "{folder.name}"'
    yield '[aiding.wheel]\n[estimator]\nmodel = "ins15"'


async def _send(device: Device, data: bytes) -> None:
    """A whole file, as fast as it is read."""
    while data:
        try:
            data = data[os.write(device.master, data[:2048]) :]
        except BlockingIOError:
            await asyncio.sleep(0.002)


async def _send_with_pauses(device: Device) -> None:
    """GGA, 120 ms, RMC of the same instant (case 05)."""
    place = "4712.3456,N,00812.3456,E"
    for second in range(EPOCHS_WITH_A_PAUSE):
        at = f"0733{second:02d}.00"
        await _send(device, wire(made(f"GNGGA,{at},{place},1,13,0.9,412.1,M,47.1,M,,")))
        await asyncio.sleep(0.12)
        await _send(device, wire(made(f"GNRMC,{at},A,{place},10.0,87.5,240326,,,A,V")))
        await asyncio.sleep(0.12)


def _b1c(folder: Path) -> bytes:
    """The walk with B1C alone, as `21_b1c_only.py` makes it."""
    subprocess.run([sys.executable, CASES / "21_b1c_only.py"], cwd=folder, check=True)
    return (folder / "b1c.ubx").read_bytes()


def _answers() -> Iterator[can.Message]:
    """The speeds of every recorded bus, 20 to 50 each."""
    for file in BUSES:
        found = messages(CASES / file, Refusals(), lambda code, text: None)
        yield from (m for m in found if bytes(m.data[1:3]) == SPEED)


async def test_what_people_report_is_read_or_named_by_the_daemon(bench: Bench) -> None:
    devices = {name: Device(bench.folder / name) for name in LINES}
    for device in devices.values():
        device.plug()
    b1c = _b1c(bench.folder)
    daemon = bench.daemon(*_sections(bench.folder), NO_MQTT)
    arrived: dict[str, list[Any]] = defaultdict(list)
    daemon.sources.on_arrival = lambda m, instant: arrived[m.source].append(m)

    def of(name: str, kind: type = PositionFix) -> list[Any]:
        return [m for m in arrived[name] if isinstance(m, kind)]

    def detail(name: str) -> str:
        return bench.health[name].detail

    async with running(daemon):
        await until(lambda: {bench.health[name].state for name in LINES} == {"silent"})  # open
        with can.Bus(interface="virtual", channel=bench.folder.name) as bus:
            for answer in _answers():
                bus.send(answer)
            async with asyncio.TaskGroup() as sending:
                sending.create_task(_send_with_pauses(devices["case05"]))
                sending.create_task(_send(devices["case21"], b1c))
                for name, (_, file) in LINES.items():
                    if file is not None:
                        sending.create_task(_send(devices[name], (CASES / file).read_bytes()))
            await until(lambda: len(of("wheel", WheelSpeed)) == 20 + 5 * 50)
        await until(lambda: len(of("case05")) >= EPOCHS_WITH_A_PAUSE)
        await until(lambda: len(of("case18", RawGnssEpoch)) >= 12)  # from the first week on
        await until(lambda: len(of("case11", Heading)) == 60)
        await until(lambda: sum(len(e.signals) for e in of("case21", RawGnssEpoch)) == B1C_RANGES)
        await until(lambda: "without a checksum" in detail("case14"))
        await until(lambda: 'driver = "ubx"' in detail("case17"))
        await until(lambda: all(arrived[n] for n in LINES if n not in ("case14", "case17")))
        for device in devices.values():
            device.unplug()
        await until(lambda: len(of("case16")) == 6)  # the last epochs end with their lines

    assert [fix.quality for fix in of("case01")] == [4, 4, 4, 4, 1, 1]
    assert all(fix.v_ned_m_s is not None for fix in of("case01"))
    assert {(fix.height_m, fix.geoid_sd_m > 60.0) for fix in of("case02")} == {(403.0, True)}
    assert {fix.height_m for fix in of("case03")} == {450.0}
    assert len(of("case02")) == len(of("case03")) == 60
    assert {fix.height_m for fix in of("case04")} == {None}
    assert len(of("case04")) >= 5  # the first waits for a GGA
    assert of("case05")[-1].v_ned_m_s == pytest.approx((0.224, 5.139, None), abs=1e-3)
    assert all(math.isclose(h.yaw_rad, math.radians(30.0)) for h in of("case11", Heading))
    assert arrived["case14"] == arrived["case17"] == []
    # Pilots of B1C, and B-CNAV1 with the delays of each satellite: nothing else is needed.
    assert {(s.system, s.signal) for e in of("case21", RawGnssEpoch) for s in e.signals} == {
        ("C", "1P")
    }
    counters = bench.health["case21"].counters
    assert counters["subframes_bcnav1"] == 148
    assert counters["measured_C"] == B1C_RANGES
    assert len(of("case15")) == 6
    assert {fix.quality for fix in of("case16")} == {2}
    assert len(of("case17_ubx")) >= 7
    assert all(None not in fix.v_ned_m_s for fix in of("case17_ubx"))  # down, too
    assert {code for code in ("height_above_sea", "rmc_alone") if bench.events(code)} == {
        "height_above_sea",
        "rmc_alone",
    }
