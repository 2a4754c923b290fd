"""Recorded CAN buses through the drivers: formats, damage, channels, and a real drive."""

from __future__ import annotations

import gzip
import importlib.util
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.can.python_can_import import with_mf4
from drivers.measurements import Heading, MonotonicStamp, PositionFix, WheelSpeed
from drivers.quantization import rounded_speed
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import MissingPackageError, TableError
from fusiond.files.measurement_csv import read_gnss, read_imu, read_wheel
from fusiond.offline.can_through_drivers import CanLog, read_can_log
from fusiond.offline.measurement_files import READERS, Arrival
from fusiond.offline.process import process
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from tests.places import DATA, REPOSITORY

START_S = 1_760_000_000.0
SAMPLES = 200
KM_H = 1.0 / 3.6
DRIVE = DATA / "css_164"


def configuration(folder: Path, wheel_channel: str = "can0") -> Config:
    """An IMU and OBD speed; a receiver on a serial line, which no log of a bus concerns."""
    path = folder / "vehicle.toml"
    counter = list(SIM_IMU.counter)
    path.write_text(
        f"""
[sources.imu]
driver = "can_imu"
dbc = "fusiond_sim_imu"
gyro = ["SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"]
accel = ["SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"]
counter = {counter}
latency_s = 0.002
[sources.wheel]
driver = "obd_speed"
channel = "{wheel_channel}"
rounding = "nearest"
[sources.gnss]
driver = "nmea"
port = "/dev/ttyUSB0"
"""
    )
    return load_config(path)


def recorded(
    imu_channel: str | int = "can0", wheel_channel: str | int = "can0"
) -> list[can.Message]:
    """Samples at 100 Hz, a speed of k km/h at each tenth of them, and frames of no device."""
    encoder = CanImu()
    messages = []
    for k in range(SAMPLES):
        t_s = START_S + 0.01 * k
        for message in encoder.frames(k, 10_000_000 * k, (1e-3 * k, 0.0, 0.0), (0.0, 0.0, -9.8)):
            message.timestamp, message.channel = t_s, imu_channel
            messages.append(message)
        if k % 10 == 0:
            data = bytes([3, 0x41, 0x0D, k, 0, 0, 0, 0])
            answer = can.Message(arbitration_id=0x7E8, data=data, is_extended_id=False)
            answer.timestamp, answer.channel = t_s + 0.005, wheel_channel
            messages.append(answer)
    return messages


def written(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in messages:
            logger(message)
    return path


def check(log: CanLog, resolution_s: float) -> None:
    """What `recorded` holds, at its times."""
    assert len(log.imu.t_s) == SAMPLES
    expected_s = START_S - 0.002 + 0.01 * np.arange(SAMPLES)
    assert np.abs(log.imu.t_s - expected_s).max() <= resolution_s
    assert np.abs(log.imu.gyro[:, 0] - 1e-3 * np.arange(SAMPLES)).max() < 1e-5
    assert log.imu.accel[7, 2] == pytest.approx(-9.8, abs=2e-4)
    speeds = [row.measurement for row in log.arrivals]
    assert len(speeds) == SAMPLES // 10
    for k, m in enumerate(speeds):
        assert isinstance(m, WheelSpeed)
        assert isinstance(m.stamp, MonotonicStamp)
        assert m.speed_m_s == pytest.approx(10 * k * KM_H)
        assert m.stamp.t_ns * 1e-9 == pytest.approx(START_S + 0.1 * k + 0.005, abs=resolution_s)
    assert log.rejected == {"can": [], "wheel": []}
    assert log.imu.rejected == []


@pytest.mark.parametrize("name", ["bus.log", "bus.asc", "bus.blf", "bus.log.gz", "bus.asc.gz"])
def test_formats(tmp_path: Path, name: str) -> None:
    # An ASC file dates its beginning to the millisecond.
    log = read_can_log(written(tmp_path / name, recorded(0, 0)), configuration(tmp_path))
    check(log, 1e-3 if ".asc" in name else 2e-6)


def test_blf_that_is_zipped(tmp_path: Path) -> None:
    plain = written(tmp_path / "bus.blf", recorded(0, 0))
    path = tmp_path / "bus.blf.gz"
    path.write_bytes(gzip.compress(plain.read_bytes()))
    check(read_can_log(path, configuration(tmp_path)), 2e-6)


@pytest.mark.skipif(
    importlib.util.find_spec("asammdf") is None,
    reason="the package asammdf is not installed",
)
def test_mf4(tmp_path: Path) -> None:
    with_mf4()
    path = written(tmp_path / "bus.mf4", recorded(0, 0))
    check(read_can_log(path, configuration(tmp_path)), 2e-6)


def test_mf4_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bus.mf4"
    path.write_bytes(b"MDF")
    whole: Callable[..., object] = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "asammdf" else whole(name)
    )
    with pytest.raises(MissingPackageError, match=r"asammdf: .* -m pip install 'asammdf>="):
        read_can_log(path, configuration(tmp_path))


def test_a_log_that_ends_in_the_middle_of_a_line(tmp_path: Path) -> None:
    path = written(tmp_path / "bus.log", recorded())
    text = path.read_text()
    path.write_text(text[: text.index("#", len(text) // 2)])
    log = read_can_log(path, configuration(tmp_path))
    assert 0.4 * SAMPLES < len(log.imu.t_s) < 0.6 * SAMPLES
    (cut,) = log.rejected["can"]
    assert cut.reason == "unreadable"
    assert cut.line == len(path.read_text().splitlines())


def test_frames_of_no_device_and_times_that_run_backwards(tmp_path: Path) -> None:
    messages = recorded()
    end_s = messages[-1].timestamp
    error = can.Message(timestamp=end_s, is_error_frame=True, channel="can0")
    remote = can.Message(
        timestamp=end_s, arbitration_id=9, is_remote_frame=True, is_extended_id=False
    )
    path = written(tmp_path / "bus.asc", [*messages, error, remote])
    log = read_can_log(path, configuration(tmp_path))
    counted = {r.reason: r.detail for r in log.rejected["can"]}
    assert counted == {"error_frames": "1 times", "remote_frames": "1 times"}
    text = written(tmp_path / "bus.log", recorded()).read_text().splitlines()
    text[300] = text[300].replace("(1760000", "(1750000")
    text[400] = text[400].replace("(1760000", "(1770000")
    (tmp_path / "bus.log").write_text("\n".join(text))
    log = read_can_log(tmp_path / "bus.log", configuration(tmp_path))
    counted = {r.reason: r.detail for r in log.rejected["can"]}
    assert counted == {"time_backwards": "1 times", "time_ahead": "1 times"}
    assert len(log.imu.t_s) >= SAMPLES - 2


def test_each_source_has_the_channel_of_its_name(tmp_path: Path) -> None:
    config = configuration(tmp_path, wheel_channel="can1")
    named = written(tmp_path / "bus.log", recorded("can0", "can1"))
    check(read_can_log(named, config), 2e-6)
    numbered = written(tmp_path / "bus.blf", recorded(0, 1))
    check(read_can_log(numbered, config), 2e-6)
    swapped = written(tmp_path / "swapped.log", recorded("can1", "can0"))
    assert not len(read_can_log(swapped, config).imu.t_s)
    with pytest.raises(
        TableError, match=r"channels can0, can1, and none is can7 of \[sources.wheel"
    ):
        read_can_log(named, configuration(tmp_path, wheel_channel="can7"))


def test_a_channel_whose_clock_is_a_little_behind(tmp_path: Path) -> None:
    """As live: its frames have come by now, and are as old as their stamps say."""
    messages = recorded("can0", "can1")
    for m in messages:
        m.timestamp -= 0.3 if m.channel == "can1" else 0.0
    lines = [
        f"({m.timestamp:.6f}) {m.channel} {m.arbitration_id:03X}#{m.data.hex()}" for m in messages
    ]
    path = tmp_path / "bus.log"
    path.write_text("\n".join(lines))
    log = read_can_log(path, configuration(tmp_path, wheel_channel="can1"))
    assert log.rejected["can"] == []
    assert len(log.imu.t_s) == SAMPLES
    times = [m.stamp.t_ns * 1e-9 for m in (row.measurement for row in log.arrivals)]  # type: ignore[union-attr]
    expected = START_S - 0.3 + 0.1 * np.arange(SAMPLES // 10) + 0.005
    assert np.abs(np.array(times) - expected).max() < 2e-6
    assert not [code for code, _ in log.events if code == "system_clock_stepped"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("bus.txt", b"x", r"no CAN log by its name: .log, .asc, .blf, .trc, .mf4 are read"),
        ("bus.mf4.gz", b"x", "no CAN log by its name"),
        ("bus.log", b"something else\n", "cannot be read as .log"),
        ("bus.log.gz", b"not zipped", "cannot be read as .log|Not a gzipped file"),
        ("bus.blf", b"not binary", "cannot be read as .blf"),
        ("bus.log", b"", "no CAN frame"),
    ],
)
def test_files_that_are_none(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises((TableError, OSError), match=words):
        read_can_log(tmp_path / name, configuration(tmp_path))


def test_a_configuration_without_a_bus(tmp_path: Path) -> None:
    path = written(tmp_path / "bus.log", recorded()[:9])
    with pytest.raises(TableError, match="the configuration has no source on a CAN bus"):
        read_can_log(path, Config())


# --------------------------------------------------------------------------- a real drive


@pytest.fixture(scope="module")
def drive() -> CanLog:
    if not DRIVE.is_dir():
        pytest.skip(f"real drive css_164 is absent: {DRIVE} (set FUSIOND_DATA)")
    config = load_config(REPOSITORY / "config" / "css_164.toml")
    return read_can_log(DRIVE / "can.log.gz", config)


EPOCH_S = 1_627_210_000.0
"""What the tables of the drive count from."""


def of(log: CanLog, source: str) -> list[Arrival]:
    return [row for row in log.arrivals if row.measurement.source == source]


def nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices (n,) into sorted times of those nearest to the wanted ones."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return after - (wanted - times[after - 1] < times[after] - wanted)


def test_the_drives_samples_are_those_of_its_table(drive: CanLog, tmp_path: Path) -> None:
    plain = tmp_path / "imu.csv"
    plain.write_bytes(gzip.decompress((DRIVE / "imu.csv.gz").read_bytes()))
    table = read_imu(plain)
    # Of 240,211 three came twice within a millisecond.
    assert len(table.t_s) - len(drive.imu.t_s) == 3
    rows = nearest(drive.imu.t_s - EPOCH_S, table.t_s)
    found = np.abs(drive.imu.t_s[rows] - EPOCH_S - table.t_s) < 1e-4
    assert found.sum() == len(drive.imu.t_s)
    assert np.abs(drive.imu.gyro[rows] - table.gyro)[found].max() < 1e-6
    assert np.abs(drive.imu.accel[rows] - table.accel)[found].max() < 1e-4


def test_the_drives_speeds_are_those_of_its_table(drive: CanLog) -> None:
    table = read_wheel(DRIVE / "wheel.csv")
    speeds = [row.measurement for row in of(drive, "wheel")]
    assert len(speeds) == len(table.t_s) + 3  # as many answers are not in the table
    times = np.array([row.t_arrival_ns * 1e-9 for row in of(drive, "wheel")]) - EPOCH_S
    rows = nearest(times, table.t_s)
    assert np.abs(times[rows] - table.t_s).max() < 6e-4
    for row, speed_m_s in zip(rows, table.speed_m_s, strict=True):
        m = speeds[row]
        assert isinstance(m, WheelSpeed)
        r = rounded_speed(float(speed_m_s), KM_H, "unknown")
        assert m.speed_m_s == pytest.approx(r.mean_m_s, abs=1e-3)
        assert (m.rounding_sd_m_s, m.shared_step_m_s) == pytest.approx(r[1:])
    # The table does not say that its speeds are whole km/h: they show it.
    tabled, _ = READERS["wheel"](DRIVE / "wheel.csv", drive.imu, "wheel")
    moving = [m for m in (row.measurement for row in tabled) if getattr(m, "speed_m_s", 0.0)]
    (seen,) = {getattr(m, "shared_step_m_s", 0.0) for m in moving}
    assert seen == pytest.approx(KM_H, abs=1e-3)


def test_the_drives_fixes_are_those_of_its_table(drive: CanLog) -> None:
    table = read_gnss(DRIVE / "gnss.csv")
    fixes = [row.measurement for row in of(drive, "gnss")]
    assert not [m for m in fixes if isinstance(m, Heading)]
    assert len(fixes) == len(table.t_s) == 2161
    behind_s = []
    for k, m in enumerate(fixes):
        assert isinstance(m, PositionFix)
        assert isinstance(m.stamp, MonotonicStamp)
        behind_s.append(m.t_seen_ns * 1e-9 - m.stamp.t_ns * 1e-9)
        # The table counts on from the first fix; the recorder's clock runs by 77 ppm.
        assert -0.01 < m.stamp.t_ns * 1e-9 - EPOCH_S - table.t_s[k] < 0.18
        assert m.lat_rad == pytest.approx(table.lat_rad[k], abs=1e-10)
        assert m.lon_rad == pytest.approx(table.lon_rad[k], abs=1e-10)
        assert m.sd_ned_m == pytest.approx(tuple(table.sd_position[k]))
        if k < 2:  # here the table is not of the module's valid height, and once of no course
            continue
        assert m.height_m == pytest.approx(table.height_m[k], abs=0.06)  # half a step
        assert m.v_ned_m_s is not None
        north, east, down = m.v_ned_m_s
        assert (north, east) == pytest.approx(tuple(table.v[k, :2]), abs=6e-3)
        assert down is None
    # The module takes 0.1 s by the configuration, and its bus no more than jitter beside it.
    assert min(behind_s) > 0.099
    assert np.median(behind_s) < 0.15


def test_stamps_of_samples_that_go_back_a_little(tmp_path: Path) -> None:
    """As a reader of two queues writes them: the run ends, and what goes back is named."""
    lines = []
    for k, m in enumerate(recorded()):
        t_s = m.timestamp - (0.05 if k % 7 == 0 else 0.0)
        lines.append(f"({t_s:.6f}) can0 {m.arbitration_id:03X}#{m.data.hex()}")
    path = tmp_path / "bus.log"
    path.write_text("\n".join(lines))
    config = configuration(tmp_path)
    log = read_can_log(path, config)
    assert log.rejected["can"] == []
    assert len(log.imu.t_s) > 0.9 * SAMPLES
    for heading in (["gnss_course"], ["config"]):
        section = {"heading": heading, "heading_deg": 10.0, "position_deg_m": (56.0, 10.0, 20.0)}
        alignment = Config.model_validate({"alignment": section}).alignment
        found = process(config.model_copy(update={"alignment": alignment}), None, [], can_log=path)
        assert found["mode"] in {"aligning", "coasting", "navigating"}
