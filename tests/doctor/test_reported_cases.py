"""Public bug reports before `fusiond doctor`: each line has its cause by name, and no other."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from fusiond.configuration.schema import Config
from tests.doctor.test_doctor import report
from tests.places import DATA
from tests.pty_device import Device

CASES = DATA.parent / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is missing: set FUSIOND_DATA")
SAID = {
    "01_rmc_status_d.nmea": "PositionFix",
    "02_no_separation.nmea": "! the receiver does not say how high the geoid is",
    "03_gsa_2d_14_satellites.nmea": "height 450.00",
    "04_rmc_only.nmea": "! only RMC has a position",
    "11_ths.nmea": "heading 30.00",
    "14_no_checksum.nmea": "! NMEA sentences come without a checksum",
    "15_talker_gi.nmea": "PositionFix",
    "16_quality_9.nmea": "PositionFix",
    "17_ubx_nav_only.bin": "! UBX frames arrive, but no NMEA",
    "18_rtcm_of_2016.rtcm3": "RawGnssEpoch",
}
"""What doctor says of each line, by file; a finding begins with an exclamation mark."""
SECONDS = 4.0
LOOPED = "Fixes are up to"
"""Finding that is the test's: a file that begins again is late."""


async def _send(device: Device, data: bytes) -> None:
    """A file over and over, in pieces of a sentence or so."""
    size = 80 if data.startswith(b"$") else 400
    while True:
        for at in range(0, len(data), size):
            await asyncio.sleep(0.02)
            try:
                device.send(data[at : at + size])
            except BlockingIOError:
                await asyncio.sleep(0.1)


def _of_source(text: str, name: str) -> str:
    """The paragraph of a source."""
    part = text.partition(f"{name}: ")[2]
    lines = part.splitlines()
    end = next((k for k, line in enumerate(lines) if k and line[:1] != " "), len(lines))
    return "\n".join(lines[:end])


async def test_each_line_has_its_cause(tmp_path: Path) -> None:
    names = {file: f"case{file[:2]}" for file in SAID}
    devices = {file: Device(tmp_path / name) for file, name in names.items()}
    sources = {
        name: {
            "driver": "gnss" if file.endswith("rtcm3") else "nmea",
            "port": str(tmp_path / name),
            "earliest_date": "2000-05-01",
        }
        for file, name in names.items()
    }
    config = Config.model_validate(
        {
            "imu": {"axes": ["+x", "-y", "-z"], "rate_hz": 100.0},
            "sources": sources,
            "mqtt": {"enabled": False},
        }
    )
    for device in devices.values():
        device.plug()
    sending = [
        asyncio.create_task(_send(device, (CASES / file).read_bytes()))
        for file, device in devices.items()
    ]
    _, text = await report(config, SECONDS)
    for task in sending:
        task.cancel()
    for device in devices.values():
        device.unplug()
    for file, words in SAID.items():
        said = _of_source(text, names[file])
        assert words in said, text
        findings = [line for line in said.splitlines() if line.strip().startswith("! ")]
        findings = [line for line in findings if LOOPED not in line]
        assert len(findings) == words.startswith("! "), said
