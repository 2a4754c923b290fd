"""The daemon in this process: its real drivers on a virtual CAN bus and pseudo terminals."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import random
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import aiomqtt
import can
import pytest

from drivers.can.imu import CanImuOptions
from drivers.nmea.driver import NmeaDriver
from fusiond.configuration.load import load_config
from fusiond.live.daemon import Daemon
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.saved_state import SavedState, save_state
from fusiond.outputs.commands import COMMANDS
from fusiond.outputs.messages.health import SourceHealth
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.recording.reader import Log
from fusiond.replay.run import Wish, replay
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.gnss.receiver import sentence
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive
from fusiond.simulation.vehicle import SimulatedVehicle
from tests.broker import Broker, Listener, free_port, listening
from tests.patience import PATIENCE_S, until
from tests.pty_device import Device

FUSIOND = Path(sys.executable).with_name("fusiond")
REST = replace(SCENARIOS["drive"], path=partial(drive, rest_s=60.0))
FIRST_COURSE_DEG = 40.0
BASE = """
vehicle = "test"
state_file = "state.json"
[imu]
axes = ["+x", "-y", "-z"]
{imu}
[sources.gnss]
driver = "nmea"
port = "gnss"
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[alignment]
heading = ["saved", "config"]
heading_deg = 40.0
"""
PARKED = Mode.COASTING
"""Of a vehicle that stands, with the heading that was configured."""
RDSS = '[sources.rdss]\ndriver = "rdss"\nport = "rdss"\nbaud = 115200\n'
NO_MQTT = "[mqtt]\nenabled = false\n"
# An IMU of single precision floats, which can say what integers cannot; each frame has the time.
FLOAT_DBC = 'VERSION ""\nNS_ :\nBS_:\nBU_: IMU\n' + "".join(
    f"""
BO_ {512 + k} {name}: 8 IMU
 SG_ VALUE : 0|32@1- (1,0) [0|0] "{unit}" Vector__XXX
 SG_ TIME : 32|32@1+ (1,0) [0|4294967295] "us" Vector__XXX
"""
    for k, (name, unit) in enumerate(
        [(f"G_{a}", "rad/s") for a in "XYZ"] + [(f"A_{a}", "m/s^2") for a in "XYZ"]
    )
)
FLOAT_DBC += "".join(f"\nSIG_VALTYPE_ {512 + k} VALUE : 1;" for k in range(6)) + "\n"


def _imu_section(options: CanImuOptions) -> str:
    given = options.model_dump(exclude_unset=True)
    lines = [
        f"{key} = {json.dumps(value if isinstance(value, str) else list(value))}"
        for key, value in given.items()
    ]
    return "\n".join(["[sources.imu]", 'driver = "can_imu"', *lines])


class Bench:
    """A daemon, the devices it serves, and what it says."""

    def __init__(
        self, folder: Path, log: pytest.LogCaptureFixture, imu: CanImuOptions = SIM_IMU
    ) -> None:
        self.folder = folder
        self.imu = imu.model_copy(update={"channel": f"daemon-{folder.name}"})
        self.seen: list[Solution] = []
        self._log = log

    def daemon(self, *sections: str) -> Daemon:
        """A daemon for the configuration of `BASE` and `sections`."""
        path = self.folder / "test.toml"
        text = BASE.format(imu=_imu_section(self.imu)) + "\n".join(sections)
        for port in ("gnss", "rdss"):
            text = text.replace(f'port = "{port}"', f'port = "{self.folder / port}"')
        path.write_text(text)
        self.made = Daemon(load_config(path), on_solution=self.seen.append)
        return self.made

    def vehicle(self, scenario: Any = REST, **links: Path) -> SimulatedVehicle:
        return SimulatedVehicle(scenario, seed=4, duration_s=60.0, can_imu=self.imu, **links)

    @property
    def health(self) -> dict[str, SourceHealth]:
        return self.made.sources.health(self.made.clock.now_ns())

    def events(self, code: str) -> list[str]:
        """The events with that code, as they were logged."""
        return [r.getMessage() for r in self._log.records if f": {code}: " in r.getMessage()]

    async def mode(self, mode: Mode) -> None:
        """Wait for a solution of that mode from now on."""
        start = len(self.seen)
        await until(lambda: any(s.mode is mode for s in self.seen[start:]))


@pytest.fixture
def bench(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Bench:
    caplog.set_level(logging.INFO, logger="fusiond")
    return Bench(tmp_path, caplog)


@asynccontextmanager
async def running(daemon: Daemon, *vehicles: SimulatedVehicle) -> AsyncIterator[None]:
    """Daemon and vehicles at work; the daemon is stopped as SIGTERM stops it."""
    stop = asyncio.Event()
    async with AsyncExitStack() as stack:
        for vehicle in vehicles:
            task = asyncio.create_task(vehicle.run())
            stack.push_async_callback(_cancelled, task)
        serving = asyncio.create_task(daemon.run(stop))
        try:
            yield
            assert not serving.done(), serving
        finally:
            stop.set()
            await serving


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


# --------------------------------------------------------------------------- navigation and health


async def test_it_aligns_navigates_and_says_how_each_device_is(bench: Bench) -> None:
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss", rdss_link=bench.folder / "rdss")
    daemon = bench.daemon(RDSS, NO_MQTT)
    async with running(daemon, vehicle):
        await bench.mode(PARKED)
        await until(lambda: bench.health["gnss"].fused >= 10)
        await until(lambda: {h.state for h in bench.health.values()} == {"running"})
        health, solution = bench.health, bench.seen[-1]
    modes = list(dict.fromkeys(s.mode for s in bench.seen))
    assert modes[-2:] == [Mode.ALIGNING, PARKED]
    assert modes[:-2] in ([], [Mode.WAITING])  # the first frames may come before the first tick
    why = "heading from configured heading; no motion has confirmed it yet"
    assert solution.reason == why
    true = vehicle.truth_at(solution.t_ns)
    sd = solution.sd_ned_m
    north = (solution.lat_rad - true.position[0, 0]) * 6.36e6
    east = (solution.lon_rad - true.position[0, 1]) * 6.38e6 * math.cos(solution.lat_rad)
    assert abs(north) < 5.0 * sd[0] < 5.0
    assert abs(east) < 5.0 * sd[1] < 5.0
    assert {"imu", "gnss", "rdss", "zero_velocity"} <= health.keys()
    imu, gnss = health["imu"], health["gnss"]
    assert imu.received >= imu.fused > 100
    assert imu.latency_s is not None
    assert imu.latency_s >= 0.0
    assert gnss.fused_age_s is not None
    assert gnss.latency_s is not None
    assert gnss.latency_s >= daemon.config.clock.serial_latency_s - 0.01
    assert gnss.received >= gnss.fused
    assert health["zero_velocity"].fused > 0
    assert daemon.scheduler.ticks == len(bench.seen)


async def test_a_driver_that_raises_is_restarted_and_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve = NmeaDriver.run
    falls = [RuntimeError("a defect"), None]

    async def fall_once(self: NmeaDriver) -> None:
        fault = falls.pop(0)
        if fault is not None:
            raise fault
        await serve(self)

    monkeypatch.setattr(NmeaDriver, "run", fall_once)
    daemon = bench.daemon(NO_MQTT)
    async with running(daemon, bench.vehicle(gnss_link=bench.folder / "gnss")):
        await until(lambda: bench.health["gnss"].received >= 2)
        assert bench.health["gnss"].counters["driver_fault"] == 1
        assert bench.health["imu"].received > 0
    assert bench.events("driver_fault") == [
        "gnss: driver_fault: RuntimeError('a defect'): restarting it"
    ]


# --------------------------------------------------------------------------- bad input


def _epoch(second: int) -> bytes:
    """A fix of that second of the day that this test runs on, and its date."""
    clock, day = f"12{second // 60:02d}{second % 60:02d}.00", time.gmtime()
    where = ("3031.6560000", "N", "11421.3360000", "E")
    gga = ("GNGGA", clock, *where, "1", "12", "0.8", "52.0", "M", "-14.0", "M", "", "")
    rmc = ("GNRMC", clock, "A", *where, "0.0", "", time.strftime("%d%m%y", day), "", "", "A", "V")
    return sentence(gga) + sentence(rmc)


async def test_garbage_on_the_serial_lines_is_counted_and_survived(bench: Bench) -> None:
    gnss, rdss = Device(bench.folder / "gnss"), Device(bench.folder / "rdss")
    gnss.plug()
    rdss.plug()
    dice = random.Random(5)
    noise = [
        dice.randbytes(1500),  # a wrong baud rate
        b"$GNGGA," + b"7" * 2000,  # a frame without an end
        _epoch(1).replace(b"*", b"*0"),  # bad checksums
        _epoch(2)[:50] + _epoch(3)[20:],  # split, and glued
        b"$" * 1500,
        bytes(1500),
        b"\xff" * 1500,
        b"\xb5\x62\x01\x07\xff\xff" * 200,  # UBX headers that announce 64 KiB
        b"$BDTCI," * 200,
    ]
    daemon = bench.daemon(RDSS, NO_MQTT)

    def heard(source: str, size: int) -> bool:
        return bench.health[source].counters.get("bytes_in", 0) == size

    try:
        async with running(daemon, bench.vehicle()):
            await until(lambda: daemon.sources.all["gnss"].driver.counters["opened"] == 1)
            await until(lambda: daemon.sources.all["rdss"].driver.counters["opened"] == 1)
            sent = 0
            for rubbish in noise:
                gnss.send(rubbish)
                rdss.send(rubbish)
                sent += len(rubbish)
                await until(partial(heard, "gnss", sent))
                await until(partial(heard, "rdss", sent))
            assert bench.health["gnss"].received == 0
            # One good frame is enough to be back.
            for second in range(10, 13):
                gnss.send(_epoch(second))
                await asyncio.sleep(0.2)
            await until(lambda: bench.health["gnss"].received == 3)
            counters = bench.health["gnss"].counters
            ticks = daemon.scheduler.ticks
            await until(lambda: daemon.scheduler.ticks > ticks + 20)
    finally:
        gnss.unplug()
        rdss.unplug()
    assert counters["garbage_bytes"] > sent / 2
    assert counters["checksum_bad"] >= 2
    assert counters["sentence_too_long"] >= 1
    assert bench.events("driver_fault") == []
    assert [r for r in bench._log.records if r.exc_info] == []


async def test_samples_that_cannot_be_true_are_named_and_survived(
    bench: Bench, tmp_path: Path
) -> None:
    (tmp_path / "float.dbc").write_text(FLOAT_DBC)
    bench.imu = CanImuOptions(
        interface="virtual",
        channel=bench.imu.channel,
        dbc=str(tmp_path / "float.dbc"),
        gyro=("G_X.VALUE", "G_Y.VALUE", "G_Z.VALUE"),
        accel=("A_X.VALUE", "A_Y.VALUE", "A_Z.VALUE"),
        device_time=tuple(f"{s}_{a}.TIME" for s in "GA" for a in "XYZ"),
    )
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss")
    encoder = CanImu(bench.imu)
    daemon = bench.daemon(NO_MQTT)

    def count(name: str) -> int:
        imu = bench.health["imu"]
        return imu.counters.get(name, 0) + imu.rejected.get(name, 0)

    with can.Bus(interface="virtual", channel=bench.imu.channel) as bus:

        def say(t_ns: int, gyro: list[float], accel: list[float]) -> None:
            for frame in encoder.frames(0, t_ns, gyro, accel):
                bus.send(frame)

        def now_ns() -> int:
            return time.monotonic_ns() - vehicle.start_ns

        async with running(daemon, vehicle):
            await bench.mode(PARKED)
            # Between the samples, with their own times: no number, and beyond any sensor.
            say(now_ns() - 5_000_000, [math.nan] * 3, [math.inf] * 3)
            await until(lambda: count("not_finite") == 6)
            say(now_ns() - 5_000_000, [0.0, 0.0, 1e9], [0.0, 0.0, -9.8])
            await until(lambda: count("out_of_range") >= 1)
            # A device that repeats itself, and one that goes back in time.
            again_ns = now_ns() - 2_000_000
            say(again_ns, [0.0] * 3, [0.0, 0.0, 9.8])
            say(again_ns, [0.0] * 3, [0.0, 0.0, 9.8])
            await until(lambda: count("duplicates") + count("duplicate_stamp") >= 1)
            say(now_ns() - 300_000_000, [0.0] * 3, [0.0, 0.0, 9.8])
            await until(lambda: count("time_backward") + count("backward_stamp") >= 1)
            assert bench.seen[-1].mode is PARKED
            # Silence.
            vehicle.unplug("imu")
            await bench.mode(Mode.INVALID)
            assert bench.seen[-1].reason.startswith("IMU silent for")
            await until(lambda: bench.health["imu"].state == "silent")
            vehicle.plug("imu")
            await bench.mode(PARKED)
            assert count("gap") == 1
            solution = bench.seen[-1]
    true = vehicle.truth_at(solution.t_ns)
    assert all(map(math.isfinite, (solution.lat_rad, *solution.v_ned_m_s, *solution.rpy_rad)))
    assert abs(solution.lat_rad - true.position[0, 0]) * 6.36e6 < 5.0 * solution.sd_ned_m[0]
    assert bench.events("driver_fault") == []


# --------------------------------------------------------------------------- commands and outputs


async def test_commands_of_an_operator(bench: Bench, tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        mqtt = f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        mqtt += f"commands = {json.dumps(list(COMMANDS))}\n"
        recording = f'[recording]\ndirectory = "{tmp_path / "logs"}"\n'
        daemon = bench.daemon(RDSS, mqtt, recording)
        here = {"lat_deg": 30.5276, "lon_deg": 114.3556, "height_m": 38.0, "sd_m": 5.0}
        vehicle = bench.vehicle(rdss_link=bench.folder / "rdss")
        async with (
            listening(broker) as (listener, client),
            running(daemon),
        ):
            ask = partial(_ask, listener, client)
            reply = await ask("set_position", here)
            assert (reply["ok"], reply["text"]) == (False, "no IMU data yet")
            async with _driving(vehicle):
                await bench.mode(Mode.ALIGNING)
                # Told where it is, it can start without any receiver.
                reply = await ask("set_position", here)
                assert reply["ok"], reply
                assert reply["text"].startswith(("position taken: aligning", "position fused"))
                await bench.mode(PARKED)
                payloads = await listener.until(lambda li: li.payloads("fusiond/test/calibration"))
                calibration = json.loads(payloads[0])
                assert calibration["parameters"]["gnss_time_s"]["state"] == "not_observed"
                assert not calibration["settled"]
                await until(lambda: bench.health["rdss"].state == "running")
                reply = await ask("request_fix", {})
                assert reply["ok"], reply
                assert reply["text"]
                reply = await ask("reset_filter", {})
                assert (reply["ok"], reply["text"]) == (True, "aligning anew")
                await bench.mode(Mode.ALIGNING)
                reply = await ask("set_position", here)
                await bench.mode(PARKED)
                reply = await ask("set_position", {**here, "lat_deg": 91.0})
                assert not reply["ok"]
                assert "lat_deg" in reply["text"]
                # While it navigates it is a fix like any other; the reply says how it ended.
                reply = await ask("set_position", here)
                assert reply["ok"], reply
                assert reply["text"].startswith("position fused: it was ")
                far = {**here, "lat_deg": here["lat_deg"] + 2.7}
                reply = await ask("set_position", far)
                assert not reply["ok"]
                assert "position gated: it is 300" in reply["text"]
                assert "force = true" in reply["text"]
                assert abs(math.degrees(bench.seen[-1].lat_rad) - here["lat_deg"]) < 0.01
                reply = await ask("set_position", {**far, "force": True})
                assert reply["ok"], reply
                assert reply["text"] == "position taken: aligning from it"
                await bench.mode(Mode.ALIGNING)
                await ask("set_position", here)
                reply = await ask("inject", {"source": "roof", "fault": "drop", "duration_s": 1.0})
                assert (reply["ok"], "there are imu, gnss, rdss" in reply["text"]) == (False, True)
                reply = await ask("inject", {"source": "imu", "fault": "drop", "duration_s": 1.0})
                assert (reply["ok"], reply["text"]) == (True, "imu: drop for 1 s")
                await bench.mode(Mode.INVALID)
                await until(lambda: bench.events("injection_ended") != [])
                reply = await ask("stop_recording", {})
                assert reply["ok"], reply
                reply = await ask("start_recording", {})
                assert reply["text"].startswith("recording into test_")
    modes = [json.loads(p)["mode"] for p in listener.payloads("fusiond/test/status")]
    assert {"waiting", "aligning", "coasting"} <= set(modes)
    status = [json.loads(p) for p in listener.payloads("fusiond/test/status")]
    assert ["imu: drop for 1 s"] in [m["injected"] for m in status]
    assert {"recording", "off"} >= {m["recording"] for m in status}
    bundles = [json.loads(p) for p in listener.payloads("fusiond/test/innovations")]
    told = [one for bundle in bundles for one in bundle["innovations"]]
    fixes = {one["outcome"]: one for one in told if one["source"] == "operator"}
    assert {"fused", "gated"} <= fixes.keys()
    assert fixes["gated"]["nis"] > 1e6 > fixes["fused"]["nis"] >= 0.0
    assert not any("zero" in one["source"] for one in told)  # constraints are not told
    first, second = sorted((tmp_path / "logs").iterdir(), key=lambda p: p.stat().st_mtime)
    again = replay([first], Wish())  # commands and all
    assert again["identical"] is True, again["first_difference"]
    assert again["outcomes"]["operator"]["gated"] >= 1
    assert replay([second], Wish())["identical"] is None  # it was started on the way
    channels = {message.topic for message in Log([first]).messages()}
    assert "/innovation" in channels
    assert "/innovations" not in channels


@asynccontextmanager
async def _driving(vehicle: SimulatedVehicle) -> AsyncIterator[None]:
    task = asyncio.create_task(vehicle.run())
    try:
        yield
    finally:
        await _cancelled(task)


async def _ask(
    listener: Listener, client: aiomqtt.Client, name: str, fields: dict[str, Any]
) -> dict[str, Any]:
    """Send a command; its reply."""
    number = f"{name}-{len(listener.messages)}"
    await listener.until(lambda heard: heard.payloads("fusiond/test/online"))
    await client.publish(f"fusiond/test/cmd/{name}", json.dumps({"id": number, **fields}), qos=1)

    def reply(heard: Listener) -> dict[str, Any] | None:
        replies = [json.loads(p) for p in heard.payloads("fusiond/test/reply")]
        return next((r for r in replies if r["id"] == number), None)

    found: dict[str, Any] = await listener.until(reply)
    return found


async def test_an_output_that_raises_is_restarted(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve = MqttPublisher.run
    falls = [RuntimeError("a defect"), None]

    async def fall_once(self: MqttPublisher) -> None:
        fault = falls.pop(0)
        if fault is not None:
            raise fault
        await serve(self)

    monkeypatch.setattr(MqttPublisher, "run", fall_once)
    with Broker(tmp_path) as broker:
        daemon = bench.daemon(f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n')
        async with listening(broker) as (listener, _), running(daemon):
            await listener.until(lambda heard: heard.payloads("fusiond/test/nav"))
    assert len(bench.events("output_fault")) == 1


async def test_configured_outputs_are_served_and_nothing_is_time_before_utc_is_settled(
    bench: Bench, tmp_path: Path
) -> None:
    vehicle = bench.vehicle(gnss_link=bench.folder / "gnss")
    ports = free_port(), free_port()
    with Broker(tmp_path) as broker:
        daemon = bench.daemon(
            f'[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}',
            f"[outputs.gpsd]\nport = {ports[0]}\nrate_hz = 10.0",
            f"[outputs.nmea]\nport = {ports[1]}\nrate_hz = 10.0",
        )
        async with listening(broker) as (listener, _), running(daemon):
            await until(lambda: daemon.outputs["gpsd"].status.state == "running")
            reader, writer = await asyncio.open_connection("127.0.0.1", ports[0])
            writer.write(b'?WATCH={"enable":true,"json":true};')
            # The system clock has a date, but no receiver has confirmed it.
            undated = await _report(reader, lambda tpv: True)
            assert (undated["mode"], "time" in undated) == (1, False)
            nav = (await listener.until(lambda heard: heard.payloads("fusiond/test/nav")))[0]
            assert json.loads(nav)["t_utc"] is not None
            async with _driving(vehicle):
                fix = await _report(reader, lambda tpv: tpv["mode"] == 3 and "time" in tpv)
                health = json.loads(
                    await listener.until(
                        lambda heard: next(
                            (p for p in heard.payloads("fusiond/test/health")
                             if b'"requests":1' in p and b'"utc_source":"gnss"' in p),
                            None,
                        )
                    )
                )  # fmt: skip
            writer.close()
    assert fix["device"] == "fusiond://test"
    assert {o["state"] for o in health["outputs"].values()} == {"running"}
    assert list(health["outputs"]) == ["mqtt", "gpsd", "nmea"]
    assert health["utc_settled"]


async def _report(
    reader: asyncio.StreamReader, wanted: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    """The first TPV of gpsd's protocol that is as wanted."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            report: dict[str, Any] = json.loads(await reader.readline())
            if report["class"] == "TPV" and wanted(report):
                return report


# --------------------------------------------------------------------------- the state on disk


async def test_a_saved_heading_serves_the_start_and_goes_when_the_vehicle_drives(
    bench: Bench,
) -> None:
    state = bench.folder / "state.json"
    lat, lon = map(math.radians, REST.origin_deg_m[:2])
    yaw = math.radians(FIRST_COURSE_DEG)
    save_state(state, SavedState(time.time() - 60.0, (lat, lon, 38.0), 1.0, yaw, 0.01))
    scenario = replace(REST, path=partial(drive, rest_s=8.0))
    daemon = bench.daemon(NO_MQTT)
    async with running(daemon, bench.vehicle(scenario, gnss_link=bench.folder / "gnss")):
        await bench.mode(Mode.NAVIGATING)
        assert bench.seen[-1].reason == "heading from saved state"
        assert state.exists()
        # A power cut from here on must not bring the old heading back.
        await until(lambda: not state.exists())
        assert math.hypot(*bench.seen[-1].v_ned_m_s) > 0.9
    assert not state.exists()


# --------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('vehicle = "x"\n', "sources"),
        ('[mqtt]\nusername = "u"\npassword_file = "none"\n', "password_file"),
    ],
)
def test_what_cannot_run_exits_78(tmp_path: Path, text: str, word: str) -> None:
    config = tmp_path / "test.toml"
    if "mqtt" in text:
        text += _imu_section(SIM_IMU)
    config.write_text(text)
    ended = subprocess.run(
        [FUSIOND, "run", config], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert ended.returncode == 78, ended.stderr
    assert str(config) in ended.stderr
    assert word in ended.stderr
    assert "Traceback" not in ended.stderr
