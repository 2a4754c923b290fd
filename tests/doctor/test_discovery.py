"""What is found on ports and buses, against the simulated devices; and the file that is written."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import re
import tomllib
from pathlib import Path

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.can.dbc import SHIPPED
from drivers.can.imu import CanImuOptions
from fusiond.commands.app import app
from fusiond.commands.configure import _measured_axes
from fusiond.configuration.doubts import doubts
from fusiond.configuration.load import load_config
from fusiond.configuration.si_units import sensor_to_body
from fusiond.doctor.discovery import Device as Found
from fusiond.doctor.discovery import (
    SilentPort,
    device_on_bus,
    device_on_port,
    down_axis,
    round_rate,
)
from fusiond.doctor.shipped_dbc_options import KNOWN_DEVICES
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from tests.drivers.bestpos.logs import bestpos
from tests.drivers.nmea.sentences import gga, made
from tests.drivers.raw.frames import measurement, rawx
from tests.drivers.sbf.blocks import pvt as sbf_pvt
from tests.drivers.ubx.frames import pvt
from tests.patience import PATIENCE_S, until
from tests.places import REPOSITORY
from tests.pty_device import Device

CONFIG_IMU = load_config(REPOSITORY / "config" / "vehicle.toml").imu
RAWX = rawx(measurement())
HDM, HDT = (f"{made(text)}\r\n".encode() for text in ("HCHDM,101.5,M", "HEHDT,97.2,T"))


async def test_found_devices_become_a_file_that_check_passes(tmp_path: Path) -> None:
    bus = str(tmp_path)  # virtual buses are shared
    car = SimulatedVehicle(
        SCENARIOS["static"],
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update={"channel": bus}),
        gnss_link=tmp_path / "gnss",
        rdss_link=tmp_path / "rdss",
    )
    out = tmp_path / "car.toml"
    running = asyncio.create_task(car.run())
    arguments = ["config", "init", str(out), "--yes", "--vehicle", "truck"]
    arguments += ["--axes=+x,-y,-z", "--antenna=0.5,0,-1.2", "--broker", "broker.lan:8883"]
    arguments += ["--port", str(tmp_path / "gnss"), "--port", str(tmp_path / "rdss")]
    arguments += ["--can", f"virtual:{bus}", "--ask-terminal"]
    await until((tmp_path / "rdss").exists)
    done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert done.exit_code == 0, done.output
    assert "frames of fusiond's simulated IMU" in done.stdout
    assert "NMEA sentences at 115200 baud" in done.stdout
    assert "rdss: an RDSS terminal answers" in done.stdout
    config = load_config(out)
    assert doubts(config) == []
    assert config.vehicle == "truck"
    drivers = {name: source.driver for name, source in config.sources.items()}
    assert drivers == {"imu": "can_imu", "gnss": "nmea", "rdss": "rdss"}
    assert config.sources["imu"].options["dbc"] == "fusiond_sim_imu"
    assert config.aiding["gnss"].lever_arm_m == (0.5, 0.0, -1.2)
    assert (config.mqtt.host, config.mqtt.port) == ("broker.lan", 8883)
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 2
    assert "--force overwrites it" in again.stderr


async def test_unanswered_questions_are_measured_or_named(tmp_path: Path) -> None:
    bus = str(tmp_path)
    car = SimulatedVehicle(
        SCENARIOS["static"],
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update={"channel": bus}),
        gnss_link=tmp_path / "gnss",
    )
    out = tmp_path / "car.toml"
    running = asyncio.create_task(car.run())
    arguments = ["config", "init", str(out), "--yes", "--port", str(tmp_path / "gnss")]
    arguments += ["--can", f"virtual:{bus}"]
    await until((tmp_path / "gnss").exists)
    done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert done.exit_code == 0, done.output
    config = load_config(out)
    assert config.imu.axes == ("+x", "-y", "-z")
    assert "axes: Down is -z, by gravity. That +x points forward is assumed" in done.stdout
    assert "That +x points forward is assumed" in out.read_text()
    # Not given, so that the filter looks for it.
    assert "lever_arm_m" not in config.aiding["gnss"].model_fields_set
    assert "\n# lever_arm_m = " in out.read_text()


@pytest.mark.parametrize("down", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_axes_with_down_measured_are_right_handed(down: str) -> None:
    axes, _ = _measured_axes(Found("can_imu", {}, "", down=down))
    assert axes[2] == down
    section = CONFIG_IMU.model_copy(update={"axes": axes})
    assert np.linalg.det(sensor_to_body(section)) == pytest.approx(1.0)


def test_nothing_plugged_in_gives_a_file_that_check_passes(tmp_path: Path) -> None:
    out = tmp_path / "vehicle.toml"
    gone = str(tmp_path / "ttyUSB0")
    arguments = ["config", "init", str(out), "--port", gone, "--can", f"virtual:{tmp_path}"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "No supported device found on: " in done.stdout
    assert f"found nothing: {gone}: cannot be opened" in done.stdout
    assert f"found nothing: virtual {tmp_path}: no frames: check power" in done.stdout
    assert "! sources: none; `run` needs an IMU" in done.stdout
    assert "# [sources.imu]" in out.read_text()
    uncommented = out.read_text().replace("# [sources.imu]", "[sources.imu]")
    for key in ("driver", "channel", "dbc", "gyro", "accel", "device_time"):
        uncommented = uncommented.replace(f"# {key} =", f"{key} =")
    assert tomllib.loads(uncommented)["sources"]["imu"]["dbc"] == "xsens_mti600"
    assert CliRunner().invoke(app, ["check", str(out)]).exit_code == 0


@pytest.mark.parametrize(
    ("data", "driver", "said"),
    [
        (RAWX * 3, "gnss", "raw observations"),
        (b"$GNVTG,,T,,M,0.0,N,0.0,K,A*3D\r\n" * 4 + RAWX, "gnss", "NMEA sentences, raw"),
        (HDT * 3 + gga(1), "nmea", "NMEA sentences"),  # a receiver of two antennas
        (gga(1) * 9 + RAWX, "gnss", "NMEA sentences, raw"),  # fixes and raw data on one line
        (pvt() * 3, "ubx", "UBX navigation messages"),
        (pvt() * 3 + gga(1), "nmea", "NMEA sentences, UBX navigation messages"),
        (bestpos() * 3, "bestpos", "logs of the BESTPOS family"),
        (sbf_pvt() * 3, "sbf", "SBF blocks"),
        (b"$BDICI,0242286,,,,,,60*00\r\n", None, "none of 9 baud rates makes sense of them"),
        (bytes(range(256)) * 4, None, "none of 9 baud rates makes sense of them"),
    ],
)
async def test_devices_recognised_on_a_port(
    tmp_path: Path, data: bytes, driver: str | None, said: str
) -> None:
    device = Device(tmp_path / "port")
    device.plug()

    async def send() -> None:
        while True:
            with contextlib.suppress(BlockingIOError):
                device.send(data)
            await asyncio.sleep(0.02)

    sending = asyncio.create_task(send())
    listen_s = 0.1 if driver is None else PATIENCE_S
    found = await device_on_port(str(tmp_path / "port"), ask_terminal=False, listen_s=listen_s)
    sending.cancel()
    device.unplug()
    assert (None if isinstance(found, SilentPort) else found.driver) == driver
    assert said in found.text


async def test_a_silent_port_is_told_with_what_may_be_wrong(tmp_path: Path) -> None:
    device = Device(tmp_path / "port")
    device.plug()
    port = str(tmp_path / "port")
    quiet = await device_on_port(port, ask_terminal=False, listen_s=0.1)
    device.unplug()
    assert isinstance(quiet, SilentPort)
    for words in (f"{port}: silent", "powered", "--ask-terminal"):
        assert words in quiet.text
    gone = await device_on_port(str(tmp_path / "none"), ask_terminal=False, listen_s=0.1)
    assert isinstance(gone, SilentPort)
    assert "cannot be opened" in gone.text


@pytest.mark.parametrize(
    ("force", "down"),
    [
        ((0.0, 0.0, 9.81), "-z"),
        ((0.2, -9.8, 0.3), "+y"),
        ((9.7, 1.0, -1.0), "-x"),
        ((7.0, 7.0, 0.0), None),
        ((0.0, 0.0, 1.0), None),  # in g, not in m/s^2
    ],
)
def test_gravity_tells_which_axis_points_down(
    force: tuple[float, float, float], down: str | None
) -> None:
    assert down_axis([force] * 20) == down
    shaken = [(force[0], force[1], force[2] + 4.0 * (-1) ** k) for k in range(20)]
    assert down_axis(shaken) is None
    assert down_axis([]) is None


async def test_compasses_become_sections_that_check_passes(tmp_path: Path) -> None:
    devices = {Device(tmp_path / "magnetic"): HDM + HDT, Device(tmp_path / "gyro"): HDT}
    for device in devices:
        device.plug()

    async def send() -> None:
        while True:
            for device, data in devices.items():
                with contextlib.suppress(BlockingIOError):
                    device.send(data)
            await asyncio.sleep(0.02)

    sending = asyncio.create_task(send())
    out = tmp_path / "boat.toml"
    arguments = ["config", "init", str(out), "--yes", "--class", "marine"]
    arguments += ["--can", f"virtual:{tmp_path}"]
    arguments += [text for device in devices for text in ("--port", str(device.link))]
    done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    sending.cancel()
    for device in devices:
        device.unplug()
    assert done.exit_code == 0, done.output
    config = load_config(out)
    kinds = {source.options["port"]: name for name, source in config.sources.items()}
    told = {str(tmp_path / "magnetic"): "HDM, HDT", str(tmp_path / "gyro"): "HDT"}
    for (port, said), kind in zip(told.items(), ("compass", "heading"), strict=True):
        assert f"{port}: a compass ({said}) at 115200 baud" in done.stdout
        assert config.sources[kinds[port]].driver == "compass"
        assert config.aiding[kinds[port]].kind == kind


async def test_a_quickstarts_set_and_receivers_with_logs_become_a_file_that_check_passes(
    tmp_path: Path,
) -> None:
    """An MTi-600, a UM980 and others that send no NMEA: what is seen is what the page says."""
    data = {"bestpos": bestpos(), "ubx": pvt(), "sbf": sbf_pvt()}
    devices = {name: Device(tmp_path / name) for name in data}
    for device in devices.values():
        device.plug()
    (known,) = (d for d in KNOWN_DEVICES if d.title == "Xsens MTi-600")
    channel = str(tmp_path)
    imu = CanImu(CanImuOptions(**known.options, interface="virtual", channel=channel))

    async def send() -> None:
        with can.Bus(interface="virtual", channel=channel) as bus:
            for number in itertools.count():
                for frame in imu.frames(number, number * 10_000_000, (0, 0, 0), (0, 0, 9.8)):
                    bus.send(frame)
                for name, device in devices.items():
                    with contextlib.suppress(BlockingIOError):
                        device.send(data[name])
                await asyncio.sleep(0.01)

    sending = asyncio.create_task(send())
    out = tmp_path / "pc.toml"
    arguments = ["config", "init", str(out), "--yes", "--can", f"virtual:{channel}"]
    arguments += [text for device in devices.values() for text in ("--port", str(device.link))]
    done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    sending.cancel()
    for device in devices.values():
        device.unplug()
    assert done.exit_code == 0, done.output
    page = (REPOSITORY / "docs" / "quickstart-pc.md").read_text()
    for seen in ("frames of Xsens MTi-600", "logs of the BESTPOS family at 115200 baud"):
        assert seen in page
        assert seen in done.stdout
    config = load_config(out)
    assert {source.driver for source in config.sources.values()} == {"can_imu", *data}
    assert {section.kind for section in config.aiding.values()} == {"gnss"}
    assert doubts(config) == []


async def test_a_bus_without_a_known_unit_is_told_with_the_reason(tmp_path: Path) -> None:
    channel = str(tmp_path)
    looking = asyncio.create_task(device_on_bus("virtual", channel, 0.3))
    with can.Bus(interface="virtual", channel=channel) as bus:
        while not looking.done():
            bus.send(can.Message(arbitration_id=0x7FF, data=b"\x01"))
            await asyncio.sleep(0.01)
    (foreign,) = looking.result()
    assert isinstance(foreign, SilentPort)
    assert re.search(r": [1-9]\d* frames, of no unit with a shipped DBC file: ", foreign.text)
    (absent,) = await device_on_bus("socketcan", "can-of-nobody", 0.1)
    assert absent == SilentPort("socketcan can-of-nobody: there is no interface can-of-nobody")


@pytest.mark.parametrize("page", ["can-imu.md", "can-gnss.md"])
def test_known_devices_are_those_of_the_pages(page: str) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (REPOSITORY / "docs" / page).read_text(), re.S)
    sources = [s for b in blocks for s in tomllib.loads(b).get("sources", {}).values()]
    shown = [s for s in sources if (SHIPPED / f"{s['dbc']}.dbc").is_file()]
    known = [(d.driver, d.options) for d in KNOWN_DEVICES]
    assert len(shown) > 1
    for source in shown:
        source.pop("channel")
        assert (source.pop("driver"), source) in known


@pytest.mark.parametrize("title", ["Bosch MM5.10", "Aceinna OpenIMU300RI"])
async def test_a_device_is_told_from_the_others(tmp_path: Path, title: str) -> None:
    """One that shares identifiers with another, and one that speaks SAE J1939."""
    (known,) = (d for d in KNOWN_DEVICES if d.title == title)
    channel = str(tmp_path)
    options = CanImuOptions(**known.options, interface="virtual", channel=channel)
    imu = CanImu(options)
    looking = asyncio.create_task(device_on_bus("virtual", channel, 0.5))
    with can.Bus(interface="virtual", channel=channel) as bus:
        number = 0
        while not looking.done():
            for frame in imu.frames(number, number * 10_000_000, (0.0, 0.0, 0.1), (0, 0, 9.8)):
                bus.send(frame)
            number += 1
            await asyncio.sleep(0.01)
    (found,) = looking.result()
    assert isinstance(found, Found)
    assert title in found.text
    assert found.options == {"interface": "virtual", "channel": channel, **known.options}


def test_round_rate() -> None:
    assert [round_rate(r) for r in (99.6, 101.9, 9.7, 48.0, 73.3)] == [100, 100, 10, 50, 73]
