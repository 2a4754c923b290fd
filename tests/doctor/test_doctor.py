"""The doctor against simulated devices on ptys and virtual CAN: all well, and each fault."""

from __future__ import annotations

import asyncio
import io
import os
import re
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.rdss.messages import BeamPower
from fusiond.clock.host import SystemTime
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.doctor import devices as doctor_devices
from fusiond.doctor.doctor import _beams_line, doctor, examine
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from tests.broker import Broker, free_port
from tests.pty_device import Device

SECONDS = 2.0
PATIENCE_S = (2.0, 8.0, 32.0)
"""What a terminal says comes after what it is asked, and on a busy host not within two seconds."""


def config(tmp_path: Path, port: int | None = None, **changes: Any) -> Config:
    """A car on virtual CAN and ptys; its own channel, since virtual buses are shared."""
    imu = {"driver": "can_imu", **SIM_IMU.model_dump(), "channel": str(tmp_path)}
    gnss = {"driver": "nmea", "port": str(tmp_path / "gnss")}
    rdss = {"driver": "rdss", "port": str(tmp_path / "rdss")}
    data = {
        "imu": {"axes": ["+x", "-y", "-z"], "rate_hz": 100.0},
        "sources": {"imu": imu, "gnss": gnss, "rdss": rdss},
        "mqtt": {"enabled": port is not None, "host": "127.0.0.1", "port": port or 1883},
    }
    return Config.model_validate({**data, **changes})


@asynccontextmanager
async def vehicle(tmp_path: Path) -> AsyncIterator[SimulatedVehicle]:
    scenario = SCENARIOS["static"]
    car = SimulatedVehicle(
        replace(scenario, rdss=replace(scenario.rdss, service_frequency_s=1)),
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update={"channel": str(tmp_path)}),
        gnss_link=tmp_path / "gnss",
        rdss_link=tmp_path / "rdss",
    )
    task = asyncio.create_task(car.run())
    await asyncio.sleep(0)
    try:
        yield car
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def report(
    config: Config, seconds: float = SECONDS, *, transmit: bool = False
) -> tuple[int, str]:
    out = io.StringIO()
    code = await examine(config, seconds, out, transmit)
    return code, out.getvalue()


def without(config: Config, *names: str) -> Config:
    sources = {k: v for k, v in config.sources.items() if k not in names}
    return config.model_copy(update={"sources": sources})


async def test_all_is_well(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with vehicle(tmp_path):
            code, text = await report(config(tmp_path, broker.port))
    findings = [line for line in text.splitlines() if line.lstrip().startswith("! ")]
    # A busy host serves the simulated devices in bursts, and the doctor rightly says so.
    assert all("samples a second" in f or "old on arrival" in f for f in findings), text
    assert code == (1 if findings else 0), text
    assert findings or text.endswith("No findings\n")
    (rate,) = (line.split(", ")[1] for line in text.splitlines() if "ImuSample" in line)
    in_time = 80.0 < float(rate.removesuffix(" Hz")) < 120.0
    assert in_time or any("samples a second" in f for f in findings), text
    assert f"imu: can_imu on virtual {tmp_path}: running" in text
    assert "ImuSample: " in text
    # x forward, y left, z up, at rest: every figure with its spread.
    (force,) = re.findall(
        r"^ +force x (\S+) \+- (\S+), y (\S+) \+- .*, z (\S+) \+- .* m/s2$", text, re.M
    )
    assert abs(float(force[0])) < 0.5
    assert 0.0 < float(force[1]) < 0.1
    assert abs(float(force[3]) - 9.8) < 0.1
    assert re.search(r"^ +\|force\| 9\.\d{3} \+- 0\.\d{3} m/s2$", text, re.M)
    assert re.search(r"^ +position lat 30\.\d{7} \+- 0\.\d{7}, lon 114\.\d{7} \+- ", text, re.M)
    assert "read only, no fix is requested" in text
    assert "Fix requested" not in text
    assert "at rest: specific force 9.8" in text
    assert "PositionFix: " in text
    assert "gnss: nmea on " in text
    assert "rdss_card: family 4.0" in text
    assert "beams 0 3 4 0 2 0: beam 3 serves" in text
    assert "system clock minus GNSS" in text
    assert "connected" in text


async def test_ports_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ttyUSB7").touch()
    monkeypatch.setattr(doctor_devices, "SERIAL_PATTERNS", (str(tmp_path / "ttyUSB*"),))
    code, text = await report(without(config(tmp_path), "imu"), 0.5)
    assert code == 1
    assert f"! {tmp_path}/gnss does not exist" in text
    assert f"! {tmp_path}/rdss does not exist" in text
    assert "correct port in [sources.gnss]" in text
    assert f"there are {tmp_path}/ttyUSB7" in text
    assert text.endswith("2 findings\n")


def test_no_port_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_devices, "SERIAL_PATTERNS", ())
    assert "this computer has no serial port" in doctor_devices.absent_port("gnss", "/dev/no", "")


async def test_a_file_is_no_port(tmp_path: Path) -> None:
    (tmp_path / "gnss").write_text("no terminal")
    code, text = await report(without(config(tmp_path), "imu", "rdss"), 0.5)
    assert code == 1
    assert "gnss is not a serial port" in text


def test_no_permission_names_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may open everything, so access(2) is told to refuse."""
    monkeypatch.setattr(doctor_devices.os, "access", lambda path, mode: False)
    text = doctor_devices.absent_port("gnss", "/dev/tty", "Permission denied")
    group = doctor_devices.grp.getgrgid(os.stat("/dev/tty").st_gid).gr_name
    assert "No permission for /dev/tty (crw" in text
    assert f"usermod -aG {group} USER" in text


async def test_port_in_use(tmp_path: Path) -> None:
    async with vehicle(tmp_path):
        both = config(tmp_path)
        twice = {"gnss": both.sources["gnss"], "other": both.sources["gnss"]}
        code, text = await report(both.model_copy(update={"sources": twice}))
    assert code == 1
    assert "is in use by another program" in text


async def _sending(device: Device, data: Callable[[], bytes]) -> None:
    while True:
        await asyncio.sleep(0.05)
        try:
            device.send(data())
        except BlockingIOError:
            continue


async def test_wrong_baud_rate(tmp_path: Path) -> None:
    """NMEA read at another rate is bytes with broken framing."""
    device = Device(tmp_path / "gnss")
    device.plug()
    sender = asyncio.create_task(_sending(device, lambda: bytes(range(128, 192))))
    code, text = await report(without(config(tmp_path), "imu", "rdss"))
    sender.cancel()
    device.unplug()
    assert code == 1
    assert "115200 baud is probably not the device's rate" in text


SENTENCE = b"$%bGGA,104000.00,4712.34567,N,00812.34567,E,1,07,2.31,115.4,M,%b,M,,"
UBX = b"\xb5\x62\x05\x01\x02\x00\x06\x01\x0f\x38"


def summed(sentence: bytes) -> bytes:
    return b"%b*%02X\r\n" % (sentence, reduce(xor, sentence[1:], 0))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (SENTENCE % (b"GP", b"33.3") + b"\r\n", "without a checksum"),
        (UBX, "UBX frames arrive, but no NMEA: switch on NMEA output"),
        (summed(SENTENCE % (b"LC", b"33.3")), "positions of talker LC"),
        (summed(b"$GPGSV,1,1,00"), "(GSV), but none that counts"),
        (b'{"class":"VERSION","release":"3.22"}\r\n', "set port to gpsd://HOST"),
        (summed(SENTENCE % (b"GP", b"")), "one sigma of 62 m"),
        (
            summed(b"$GPRMC,104000.00,A,4712.34,N,00812.34,E,5.2,87.5,110807,,,A"),
            "if 2027-03-27 is right, 1024 weeks later, its GPS week has rolled over",
        ),
    ],
    ids=["no_checksum", "ubx", "talker", "formatter", "gpsd", "geoid", "rollover"],
)
async def test_the_right_cause_is_named(tmp_path: Path, data: bytes, words: str) -> None:
    device = Device(tmp_path / "gnss")
    device.plug()
    sender = asyncio.create_task(_sending(device, lambda: data))
    code, text = await report(without(config(tmp_path), "imu", "rdss"))
    sender.cancel()
    device.unplug()
    findings = [line for line in text.splitlines() if line.lstrip().startswith("! ")]
    assert code == 1
    assert any(words in finding for finding in findings), text
    assert "115200 baud is probably not" not in text


async def test_the_driver_of_raw_data_names_missing_checksums_too(tmp_path: Path) -> None:
    device = Device(tmp_path / "gnss")
    device.plug()
    data = SENTENCE % (b"GP", b"33.3") + b"\r\n"
    sender = asyncio.create_task(_sending(device, lambda: data))
    base = without(config(tmp_path), "imu", "rdss")
    raw = base.sources["gnss"].model_copy(update={"driver": "gnss"})
    code, text = await report(base.model_copy(update={"sources": {"gnss": raw}}))
    sender.cancel()
    device.unplug()
    assert code == 1
    assert "without a checksum" in text
    assert "115200 baud is probably not" not in text


async def test_silent_line(tmp_path: Path) -> None:
    device = Device(tmp_path / "gnss")
    device.plug()
    code, text = await report(without(config(tmp_path), "imu", "rdss"))
    device.unplug()
    assert code == 1
    assert "No bytes in 2 s" in text


async def test_terminal_that_does_not_answer(tmp_path: Path) -> None:
    device = Device(tmp_path / "rdss")
    device.plug()
    sender = asyncio.create_task(_sending(device, lambda: b"\x00\xff" * 8))
    code, text = await report(without(config(tmp_path), "imu", "gnss"))
    sender.cancel()
    device.unplug()
    assert code == 1
    assert "no terminal has answered yet" in text


async def test_suppressed_terminal(tmp_path: Path) -> None:
    async with vehicle(tmp_path) as car:
        car.terminal.suppressed = True
        for seconds in PATIENCE_S:
            asked = without(config(tmp_path), "imu", "gnss")
            code, text = await report(asked, seconds, transmit=True)
            if code:
                break
    assert code == 1
    assert "the RDSS centre suppresses the transmitter" in text


async def test_damaged_sentences(tmp_path: Path) -> None:
    device = Device(tmp_path / "gnss")
    device.plug()
    sender = asyncio.create_task(_sending(device, lambda: b"$GNVTG,,T,,M,0.0,N,0.0,K,A*00\r\n"))
    code, text = await report(without(config(tmp_path), "imu", "rdss"))
    sender.cancel()
    device.unplug()
    assert code == 1
    assert "wrong checksums against 0 sound" in text


async def test_imu_that_says_nothing(tmp_path: Path) -> None:
    code, text = await report(without(config(tmp_path), "gnss", "rdss"))
    assert code == 1
    assert "SIM_GYRO" in text
    assert "check that the unit sends" in text
    assert "ip -d link" not in text  # the bus is no SocketCAN interface


def test_silent_socketcan_interface_names_its_own_commands() -> None:
    status = SimpleNamespace(state="silent", detail="silent (nothing heard of SIM_GYRO)")
    driver: Any = SimpleNamespace(status=status, counters=Counter())
    options = SimpleNamespace(interface="socketcan", channel="can3")
    (found,) = doctor_devices.open_findings("imu", driver, options, SECONDS)
    assert "check bit rate (ip -d link show can3)" in found
    assert "`candump can3`" in found
    assert "SIM_GYRO" in found


async def test_can_interface_that_does_not_exist(tmp_path: Path) -> None:
    base = config(tmp_path)
    imu = base.sources["imu"].model_copy(update={"interface": "socketcan", "channel": "nocan7"})
    code, text = await report(base.model_copy(update={"sources": {"imu": imu}}), 0.5)
    assert code == 1
    # A host without CAN in its kernel says so instead.
    assert "nocan7 does not exist" in text or "no CAN" in text


def test_can_interface_that_is_down() -> None:
    options = SIM_IMU.model_copy(update={"interface": "socketcan", "channel": "can0"})
    text = doctor_devices.absent_interface("imu", options, "can0 is down (ip link set can0 up)")
    assert text.startswith("can0 is down: ip link set can0 up")


def test_can_interfaces_are_listed_by_type(tmp_path: Path) -> None:
    for name, kind in (("can1", "280"), ("eth0", "1"), ("vcan0", "280")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind + "\n")
    assert doctor_devices.can_interfaces(tmp_path) == ["can1", "vcan0"]


async def test_axes_that_do_not_fit_gravity(tmp_path: Path) -> None:
    """The simulated unit has x forward, y left, z up; the configuration says z down."""
    async with vehicle(tmp_path):
        wrong = config(tmp_path, imu={"axes": ["+x", "+y", "+z"], "rate_hz": 100.0})
        code, text = await report(without(wrong, "gnss", "rdss"))
    assert code == 1
    assert re.search(r"Gravity lies 1[78]\d deg off", text)
    assert "axes must end with '-z' (now '+z')" in text


async def test_unit_and_rate_that_do_not_fit(tmp_path: Path) -> None:
    async with vehicle(tmp_path):
        base = config(tmp_path, imu={"axes": ["+x", "-y", "-z"], "rate_hz": 400.0})
        # The device speaks m/s^2; read as g, rest would be 9.8 g.
        imu = base.sources["imu"].model_copy(update={"accel_unit": "g"})
        code, text = await report(base.model_copy(update={"sources": {"imu": imu}}))
    assert code == 1
    assert "[imu] rate_hz = 400" in text
    assert "Specific force at rest is 96." in text
    assert "accel_unit" in text


async def test_broker_that_is_not_there(tmp_path: Path) -> None:
    port = free_port()
    code, text = await report(config(tmp_path, port, sources={}), 0.5)
    assert code == 1
    assert f"no broker answers at 127.0.0.1:{port}" in text
    assert "No [sources]: add a [sources.NAME] section" in text


async def test_broker_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusiond.doctor.doctor._BROKER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        code, text = await report(config(tmp_path, mute.getsockname()[1], sources={}), 0.5)
    assert code == 1
    assert "no broker answers at" in text


async def test_broker_that_wants_a_password(tmp_path: Path) -> None:
    (tmp_path / "passwords").write_text("")
    lines = ("allow_anonymous false", f"password_file {tmp_path / 'passwords'}")
    with Broker(tmp_path, *lines) as broker:
        code, text = await report(config(tmp_path, broker.port, sources={}), 0.5)
    assert code == 1
    assert "FUSIOND_MQTT_PASSWORD" in text


@pytest.mark.parametrize(
    ("behind_s", "words"),
    [
        (3600, "The system clock is -3600.0 s off GNSS"),
        (1024 * 604_800, "The receiver's date is +1024 weeks off the system clock's: its GPS week"),
    ],
)
async def test_system_clock_that_is_off(
    behind_s: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Late(SystemTime):
        """The system clock, so far behind."""

        @staticmethod
        def realtime_ns() -> int:
            return time.time_ns() - behind_s * 1_000_000_000

    monkeypatch.setattr("fusiond.doctor.doctor.Clock", lambda options: Clock(options, Late()))
    async with vehicle(tmp_path):
        code, text = await report(without(config(tmp_path), "imu", "rdss"))
    assert code == 1
    assert words in text


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(config(tmp_path, sources={}), 0.1) == 1
    assert "1 finding\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("beams", "line"),
    [
        (BeamPower((0, 3, 4)), "beams 0 3 4: beam 3 serves"),
        (BeamPower((0, 3, 4), 0, 2, 3), "beams 0 3 4: beam 2 serves, with beam 3"),
        (BeamPower((0, 0)), "beams 0 0: none is heard"),
    ],
)
def test_beams_of_a_terminal_in_words(beams: BeamPower, line: str) -> None:
    assert _beams_line(beams) == line
