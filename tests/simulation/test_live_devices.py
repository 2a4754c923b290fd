"""The simulated vehicle in real time: pseudo terminals, CAN, plugs, and the process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
import serial

from drivers.base import monotonic_ns
from drivers.can.bus import CanFrame
from drivers.can.imu import CanImuDecoder
from drivers.measurements import DeviceStamp, ImuSample, UtcStamp
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import RawGnssEpoch
from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import Fix, Identity, IdentityRequest, PositionRequest
from fusiond.files.measurement_csv import read_truth
from fusiond.gnss.ecef import to_ecef
from fusiond.gnss.ranges import RangeModel
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.simulation import live_devices as vehicle_module
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.gnss.raw_stream import RawFormat
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.scenarios import SCENARIOS
from tests.patience import PATIENCE_S, until


def test_what_nobody_listens_to_is_lost(tmp_path: Path) -> None:
    line = PtyLine(tmp_path / "gnss")
    assert not line.write(b"before the plug")
    line.plug()
    line.plug()
    assert not line.write(b"nobody listens")
    with serial.Serial(str(line.link), 115200, timeout=PATIENCE_S) as port:
        assert line.write(b"\x00\r\n\x11$")
        assert port.read(5) == b"\x00\r\n\x11$"
        port.write(b"\n\x13\r\xff")
        assert line.read() == b"\n\x13\r\xff"
        assert line.read() == b""
        written = sum(line.write(bytes(1000)) for _ in range(100))
        assert 0 < written < 100  # the host does not read: a line does not wait
    assert not line.write(b"closed again")
    assert line.read() == b""


def test_unplugging_hangs_up_and_replugging_makes_a_new_port(tmp_path: Path) -> None:
    line = PtyLine(tmp_path / "rdss")
    line.plug()
    descriptor = os.open(line.link, os.O_RDWR | os.O_NOCTTY)
    line.unplug()
    line.unplug()
    assert not line.link.is_symlink()
    with contextlib.suppress(OSError):
        assert os.read(descriptor, 10) == b""
    os.close(descriptor)
    line.plug()
    with serial.Serial(str(line.link), 115200, timeout=PATIENCE_S) as port:
        assert line.write(b"again")
        assert port.read(5) == b"again"
    line.unplug()


@pytest.fixture
async def vehicle(tmp_path: Path) -> AsyncIterator[SimulatedVehicle]:
    scenario = SCENARIOS["drive"]
    quick = replace(scenario.rdss, delay_s=(0.1, 0.2), mean_delay_s=0.15, service_frequency_s=1)
    made = SimulatedVehicle(
        replace(scenario, rdss=quick),
        seed=2,
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update={"channel": f"test-{tmp_path.name}"}),
        gnss_link=tmp_path / "gnss",
        rdss_link=tmp_path / "rdss",
    )
    task = asyncio.create_task(made.run())
    await asyncio.sleep(0)
    yield made
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert not (tmp_path / "gnss").is_symlink()


async def test_all_devices_speak_in_real_time(vehicle: SimulatedVehicle, tmp_path: Path) -> None:
    decoder = CanImuDecoder("imu", SIM_IMU)
    samples: list[ImuSample] = []
    said = bytearray()
    rdss = binary_4_0.Decoder()
    replies: list[object] = []

    def take(bus: can.BusABC, gnss: serial.Serial, terminal: serial.Serial) -> bool:
        while (frame := bus.recv(timeout=0.0)) is not None:
            data = bytes(frame.data)
            found = decoder.feed(CanFrame(frame.arbitration_id, False, data, monotonic_ns()))
            samples.extend(s for s in found if isinstance(s, ImuSample))
        said.extend(gnss.read(4096))
        replies.extend(rdss.feed(terminal.read(4096)))
        fixes = any(isinstance(r, Fix) for r in replies)
        return len(samples) >= 60 and said.count(b"GGA") >= 4 and fixes

    with (
        can.Bus(interface="virtual", channel=f"test-{tmp_path.name}") as bus,
        serial.Serial(str(tmp_path / "gnss"), 115200, timeout=0) as gnss,
        serial.Serial(str(tmp_path / "rdss"), 115200, timeout=0) as terminal,
    ):
        terminal.write(binary_4_0.encode(IdentityRequest()))
        terminal.write(binary_4_0.encode(PositionRequest()))
        await until(lambda: take(bus, gnss, terminal))
        assert isinstance(replies[0], Identity)
        # The samples are the precomputed ones: the device's time says which.
        for sample in samples:
            assert isinstance(sample.stamp, DeviceStamp)
            k = round(sample.stamp.ticks_ns * 1e-9 * vehicle.truth.rate_hz) - 1
            assert sample.gyro_rad_s == pytest.approx(vehicle.imu.gyro[k], abs=0.6e-5)
            assert sample.accel_m_s2 == pytest.approx(vehicle.imu.accel[k], abs=1.1e-4)
            lead_s = sample.t_seen_ns * 1e-9 - (vehicle.start_ns + sample.stamp.ticks_ns) * 1e-9
            assert lead_s >= 0.0  # never before it was true
        assert decoder.counters["lost_samples"] == 0

        vehicle.unplug("imu")
        before = vehicle.counters["imu_frames"]
        await until(lambda: vehicle.counters["imu_unplugged"] > 20)
        assert vehicle.counters["imu_frames"] == before
        vehicle.plug("imu")
        await until(lambda: vehicle.counters["imu_frames"] > before)


@pytest.mark.parametrize("raw_format", ["ubx", "rtcm3"])
async def test_raw_gnss_beside_nmea_gives_the_true_position(
    tmp_path: Path, raw_format: RawFormat
) -> None:
    """What comes out of the port, through splitter and decoder, solved as a single point."""
    made = SimulatedVehicle(
        SCENARIOS["drive"],
        seed=3,
        duration_s=30.0,
        can_imu=SIM_IMU.model_copy(update={"channel": f"test-{tmp_path.name}"}),
        gnss_link=tmp_path / "gnss",
        gnss_raw=raw_format,
    )
    decoder = RawDecoder("gnss")
    decoder.note_utc(made.utc_start_ns)
    store = EphemerisStore()
    epochs: list[RawGnssEpoch] = []
    task = asyncio.create_task(made.run())
    try:
        # The port is opened late: the messages have to wait for it.
        await until(lambda: made.counters["gnss_raw_lost"] >= 2)
        with serial.Serial(str(tmp_path / "gnss"), 115200, timeout=0) as port:

            def take() -> bool:
                for event in decoder.feed(port.read(65536), monotonic_ns()):
                    if isinstance(event, RawGnssEpoch):
                        epochs.append(event)
                    else:
                        store.add(event)
                return len(epochs) >= 10 and decoder.counters["sentences"] >= 10

            await until(take)
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert len(store) >= 12
    solved = single_point(RangeModel(store), epochs[-1])
    assert isinstance(solved, SinglePoint)
    stamp = epochs[-1].stamp
    assert isinstance(stamp, UtcStamp)
    t_ns = made.start_ns + stamp.utc_ns - made.utc_start_ns
    assert made.start_ns <= t_ns <= monotonic_ns()
    lat, lon, height = (float(x) for x in made.truth_at(t_ns).position[0])
    # Ionosphere of whatever time of day it is: 20 m of zenith delay are half modelled.
    assert np.linalg.norm(solved.position - np.array(to_ecef(lat, lon, height))) < 25.0
    assert solved.velocity is not None
    assert np.linalg.norm(solved.velocity) < 0.5  # it stands still for the first minute


async def test_truth_on_the_monotonic_clock(vehicle: SimulatedVehicle) -> None:
    assert vehicle.utc_start_ns % 100_000_000 == 0
    state = vehicle.truth_at(vehicle.start_ns + 12_345_000_000)
    assert state.t_s[0] == pytest.approx(12.345)
    np.testing.assert_allclose(state.position[0], vehicle.truth.position[1234], atol=1e-9)


async def test_both_clocks_are_read_at_one_instant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    utc_ns, now_ns = 1_795_478_400_012_345_678, 7_000_000_000_001
    made = SimulatedVehicle(
        SCENARIOS["static"],
        seed=2,
        duration_s=10.0,
        can_imu=SIM_IMU.model_copy(update={"channel": f"test-{tmp_path.name}"}),
    )
    monkeypatch.setattr(vehicle_module, "time", SimpleNamespace(time_ns=lambda: utc_ns))
    monkeypatch.setattr(vehicle_module, "monotonic_ns", lambda: now_ns)
    task = asyncio.create_task(made.run())
    await asyncio.sleep(0)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert made.utc_start_ns == 1_795_478_400_100_000_000
    assert made.start_ns - now_ns == made.utc_start_ns - utc_ns


async def test_the_vehicle_as_a_process(tmp_path: Path) -> None:
    """The way hardware-in-the-loop tests use it; UDP multicast stands in for a CAN interface."""
    before_ns = monotonic_ns()
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "fusiond.simulation.live_devices",
        *("--scenario", "static", "--seed", "3", "--duration", "120"),
        *("--can", "udp_multicast:239.74.163.2", "--rdss-family", "2.1"),
        *("--gnss-link", str(tmp_path / "gnss"), "--rdss-link", str(tmp_path / "rdss")),
        *("--truth", str(tmp_path / "truth.csv"), "--start-file", str(tmp_path / "start.json")),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            assert await process.stdout.readline() == b"ready\n"
            start = json.loads((tmp_path / "start.json").read_text())
            # At the next tenth of a second, once it was told to start.
            assert before_ns < start["start_monotonic_ns"] < monotonic_ns() + 100_000_000
            assert len(read_truth(tmp_path / "truth.csv").t_s) == 2401
            assert (tmp_path / "gnss").is_symlink()
            with serial.Serial(str(tmp_path / "rdss"), 115200, timeout=PATIENCE_S) as port:
                port.write(text_2_1.encode(IdentityRequest()))
                assert port.read(6) == b"$BDICI"
            process.stdin.write(b"unplug gnss\n")
            assert await process.stdout.readline() == b"unplugged gnss\n"
            assert not (tmp_path / "gnss").is_symlink()
            process.stdin.write(b"plug gnss\nwhat\n")
            assert await process.stdout.readline() == b"plugged gnss\n"
            assert await process.stdout.readline() == b"unknown command: what\n"
            assert (tmp_path / "gnss").is_symlink()
            process.stdin.write(b"suppress\nsilence\nlift\nquit\n")
            said = [await process.stdout.readline() for _ in range(4)]
            assert said[:3] == [b"suppressed\n", b"silenced\n", b"lifted\n"]
            assert json.loads(said[3])["terminal_IdentityRequest"] == 1
            assert await process.wait() == 0
            assert not (tmp_path / "rdss").is_symlink()
    finally:
        if process.returncode is None:
            process.kill()
