"""Simulated vehicle in real time: its devices on a CAN bus and on pseudo terminals.

    python -m fusiond.simulation.live_devices --scenario drive --can socketcan:vcan0 \\
        --gnss-link /run/x/gnss --rdss-link /run/x/rdss --truth truth.csv --start-file start.json

All random numbers are drawn before the start; while the vehicle runs, it only looks up, formats and
writes. Instant 0 of the trajectory is `start_ns` of the host's monotonic clock. Commands on
standard input, a line each: `unplug NAME`, `plug NAME` (imu, gnss, rdss, star_tracker, sar);
`suppress`, `silence`, `lift` for the RDSS terminal; `quit`. Each is answered; the last line is the
counters, as JSON.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from drivers.base import monotonic_ns
from drivers.can.imu import CanImuOptions
from drivers.can.python_can_import import can
from fusiond.configuration.load import load_config
from fusiond.navigation.gps_time import utc_ns_to_gps
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.can.star_tracker_radar import CanSensor, can_sensors
from fusiond.simulation.files import write_truth
from fusiond.simulation.gnss.masks import parse_mask
from fusiond.simulation.gnss.raw import START, GnssRaw
from fusiond.simulation.gnss.raw_stream import GnssRawStream, RawFormat
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import States
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.rdss.short_messages import ConvoyVehicle
from fusiond.simulation.rdss.terminal import RdssTerminal
from fusiond.simulation.scenarios import SCENARIOS, Scenario, random_streams
from fusiond.simulation.trajectories import drive

Device = Literal["imu", "gnss", "rdss", "star_tracker", "sar"]

SERIAL_POLL_S = 0.01
"""Interval of reads of the terminal's line: far below the 50 ms that its answers take."""


class SimulatedVehicle:
    """The devices of a scenario, driven in real time by `run`.

    `gnss` and `terminal` are the simulated devices; `counters` holds frames, epochs and bytes sent
    and lost. A link that is None leaves that device out. `can_imu` are the options of the driver
    that will read the IMU: bus, DBC and signals. Bytes pass `lines`, samples pass `encoder`; a test
    replaces them to put a fault on the wire.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        duration_s: float | None = None,
        can_imu: CanImuOptions = SIM_IMU,
        gnss_link: Path | None = None,
        rdss_link: Path | None = None,
        gnss_raw: RawFormat | None = None,
    ) -> None:
        imu_rng, gnss_rng, rdss_rng, raw_rng = random_streams(seed)
        self.scenario = scenario
        self.truth = scenario.truth(duration_s)
        self.imu = scenario.imu_output(self.truth, imu_rng)
        self.gnss = GnssReceiver(self.truth, scenario.gnss, gnss_rng)
        self.terminal = RdssTerminal(self.truth, scenario.rdss, rdss_rng, 0)
        self.convoy = ConvoyVehicle(self.truth, self.terminal) if scenario.rdss.convoy else None
        self.raw: GnssRawStream | None = None
        if gnss_raw is not None:
            receiver = GnssRaw(self.truth, scenario.gnss_raw, raw_rng)
            self.raw = GnssRawStream(receiver, gnss_raw)
        self._start_clock()
        self.counters: Counter[str] = Counter()
        self.encoder = CanImu(can_imu)
        self._can = (can_imu.interface, can_imu.channel)
        self._bus: can.BusABC | None = None
        self.can_sensors: dict[str, CanSensor] = can_sensors(
            self.truth, scenario.star_tracker, scenario.sar, seed, self._can
        )
        self.lines: dict[Device, PtyLine] = {}
        if gnss_link is not None:
            self.lines["gnss"] = PtyLine(gnss_link)
        if rdss_link is not None:
            self.lines["rdss"] = PtyLine(rdss_link)
        self._next_imu = 0
        self._next_gnss = 0
        self._next_raw = 0

    def _start_clock(self) -> None:
        """Start at the next full tenth of a UTC second, where receivers have their epochs.

        The sky is the one of `fusiond simulate`: a seed has the same satellites at any hour."""
        utc_ns, now_ns = time.time_ns(), monotonic_ns()
        wait_ns = -utc_ns % 100_000_000
        self.start_ns = now_ns + wait_ns
        self.utc_start_ns = self.terminal.utc_start_ns = utc_ns + wait_ns
        if self.raw is not None:
            self.raw.receiver.begin(*utc_ns_to_gps(self.utc_start_ns), sky=START)

    # ------------------------------------------------------------------ truth

    def truth_at(self, t_ns: int) -> States:
        """True state (n = 1) at an instant of the monotonic clock, clipped to the trajectory."""
        return self.truth.at(np.array([(t_ns - self.start_ns) * 1e-9]))

    # ------------------------------------------------------------------ plugs

    def plug(self, device: Device) -> None:
        """Connect a device to its line. Raises OSError, can.CanError."""
        if device == "imu":
            if self._bus is None:
                interface, channel = self._can
                # Datagrams of a bus over UDP stay on this computer.
                here: dict[str, Any] = {"hop_limit": 0} if interface == "udp_multicast" else {}
                self._bus = can.Bus(interface=interface, channel=channel, **here)
        elif device in self.can_sensors:
            self.can_sensors[device].plug()
        elif device in self.lines:
            self.lines[device].plug()

    def unplug(self, device: Device) -> None:
        """Disconnect a device from its line: the IMU falls silent, a serial port vanishes."""
        if device == "imu":
            if self._bus is not None:
                self._bus.shutdown()
                self._bus = None
        elif device in self.can_sensors:
            self.can_sensors[device].unplug()
        elif device in self.lines:
            self.lines[device].unplug()

    def lift(self) -> None:
        """End the terminal's suppression or silence, with its report."""
        self.terminal.lift(self._now_s())

    # ------------------------------------------------------------------ real time

    async def run(self) -> None:
        """Connect all devices and drive to the end of the trajectory, or until cancelled."""
        try:
            for device in get_args(Device):
                self.plug(device)
            self._start_clock()
            while (t_s := self._now_s()) < self.truth.duration_s:
                self._serve(t_s)
                await asyncio.sleep(max(0.0, self._next_s(t_s) - self._now_s()))
        finally:
            for device in get_args(Device):
                self.unplug(device)

    def _now_s(self) -> float:
        return (monotonic_ns() - self.start_ns) * 1e-9

    def _next_s(self, t_s: float) -> float:
        """Next instant of work."""
        due = [
            self.truth.duration_s,
            t_s + SERIAL_POLL_S,
            *(a.next_s for a in self.can_sensors.values()),
        ]
        if self._next_imu < len(self.imu.gyro):
            due.append(float(self.truth.t_s[self._next_imu + 1]))
        if self._next_gnss < len(self.gnss):
            due.append(float(self.gnss.t_arrival_s[self._next_gnss]))
        if self.raw is not None and self._next_raw < len(self.raw.receiver):
            due.append(float(self.raw.receiver.t_arrival_s[self._next_raw]))
        return min(due)

    def _serve(self, t_s: float) -> None:
        """Do everything that is due at `t_s`."""
        while self._next_imu < len(self.imu.gyro):
            k = self._next_imu
            if self.truth.t_s[k + 1] > t_s:
                break
            self._next_imu += 1
            self._send_sample(k)
        for sensor in self.can_sensors.values():
            sensor.serve(t_s, self.counters)
        while self._next_gnss < len(self.gnss):
            k = self._next_gnss
            if self.gnss.t_arrival_s[k] > t_s:
                break
            self._next_gnss += 1
            if "gnss" in self.lines:
                self._write("gnss", self.gnss.nmea(k, self.utc_start_ns))
        if self.raw is not None:
            self._serve_raw(self.raw, t_s)
        if "rdss" in self.lines:
            if data := self.lines["rdss"].read():
                self.terminal.receive(data, t_s)
            if self.convoy is not None:
                self.convoy.tick(t_s)
            if data := self.terminal.read(t_s):
                self._write("rdss", data)

    def _serve_raw(self, raw: GnssRawStream, t_s: float) -> None:
        while self._next_raw < len(raw.receiver):
            if raw.receiver.t_arrival_s[self._next_raw] > t_s:
                break
            data = raw.bytes_of(self._next_raw)
            self._next_raw += 1
            if "gnss" in self.lines:
                sent = self.lines["gnss"].write(data)
                self.counters[f"gnss_raw_{'sent' if sent else 'lost'}"] += 1
                if not sent:
                    raw.repeat()

    def _send_sample(self, k: int) -> None:
        if self._bus is None:
            self.counters["imu_unplugged"] += 1
            return
        t_ns = round(float(self.truth.t_s[k + 1]) * 1e9)
        gyro, accel = self.imu.gyro[k].tolist(), self.imu.accel[k].tolist()
        for frame in self.encoder.frames(k + 1, t_ns, gyro, accel):
            try:
                self._bus.send(frame)
                self.counters["imu_frames"] += 1
            except (can.CanError, OSError):
                self.counters["imu_lost"] += 1

    def _write(self, device: Device, data: bytes) -> None:
        sent = self.lines[device].write(data)
        self.counters[f"{device}_{'sent' if sent else 'lost'}"] += 1


# ---------------------------------------------------------------------- as a process


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="fusiond.simulation.live_devices")
    parser.add_argument("--scenario", choices=sorted(SCENARIOS), default="drive")
    parser.add_argument("--config", type=Path, help="fit IMU and lever arms to this configuration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, help="s; the scenario's own by default")
    parser.add_argument("--rest", type=float, help="s at rest before the drive; 60 by default")
    parser.add_argument("--can", default="socketcan:vcan0", help="INTERFACE:CHANNEL")
    parser.add_argument("--gnss-link", type=Path)
    parser.add_argument(
        "--gnss-raw", choices=("ubx", "rtcm3", "none"), default="none", help="on the GNSS line too"
    )
    parser.add_argument(
        "--gnss-mask",
        type=parse_mask,
        action="append",
        default=[],
        metavar="KIND:START:LENGTH",
        help="canyon, canyon2 to canyon4, tunnel; s; repeatable",
    )
    parser.add_argument("--rdss-link", type=Path)
    parser.add_argument("--rdss-family", choices=("4.0", "2.1"), default="4.0")
    parser.add_argument("--service-frequency", type=int, default=10, help="of the RDSS card, s")
    parser.add_argument(
        "--rdss-delay", type=float, nargs=2, metavar=("LEAST", "GREATEST"), help="uniform, s"
    )
    parser.add_argument(
        "--rdss-refuse", type=float, default=0.0, metavar="P", help="no beam, or a stated wait"
    )
    parser.add_argument(
        "--rdss-drop", type=float, default=0.0, metavar="P", help="accepted, but no fix comes"
    )
    parser.add_argument("--truth", type=Path, help="write truth.csv here")
    parser.add_argument(
        "--start-file", type=Path, help="write start_monotonic_ns and start_utc_ns here (JSON)"
    )
    return parser.parse_args()


def _watch_commands(vehicle: SimulatedVehicle, main: asyncio.Task[None]) -> None:
    """Read commands from standard input in a thread and execute them in the loop."""
    loop = asyncio.get_running_loop()

    def obey(line: str) -> None:
        match line.split():
            case ["quit"]:
                main.cancel()
            case ["suppress"]:
                vehicle.terminal.suppressed = True
                print("suppressed", flush=True)
            case ["silence"]:
                vehicle.terminal.silent = True
                print("silenced", flush=True)
            case ["lift"]:
                vehicle.lift()
                print("lifted", flush=True)
            case [
                ("plug" | "unplug") as verb,
                ("imu" | "gnss" | "rdss" | "star_tracker" | "sar") as device,
            ]:
                try:
                    vehicle.plug(device) if verb == "plug" else vehicle.unplug(device)
                    print(f"{verb}ged {device}", flush=True)
                except (OSError, can.CanError) as error:
                    print(f"cannot {verb} {device}: {error}", flush=True)
            case _:
                print(f"unknown command: {line.strip()}", flush=True)

    def read() -> None:
        for line in sys.stdin:
            loop.call_soon_threadsafe(obey, line)

    threading.Thread(target=read, daemon=True, name="commands").start()


async def _main(args: argparse.Namespace) -> None:
    interface, _, channel = args.can.partition(":")
    scenario = SCENARIOS[args.scenario]
    if args.config is not None:
        scenario = scenario.fitted(load_config(args.config))
    if args.rest is not None:
        scenario = replace(scenario, path=partial(drive, rest_s=args.rest))
    scenario = scenario.masked(args.gnss_mask)
    rdss = replace(
        scenario.rdss,
        family=args.rdss_family,
        service_frequency_s=args.service_frequency,
        refuse_probability=args.rdss_refuse,
        drop_probability=args.rdss_drop,
    )
    if args.rdss_delay is not None:
        rdss = replace(rdss, delay_s=tuple(args.rdss_delay), mean_delay_s=None)
    vehicle = SimulatedVehicle(
        replace(scenario, rdss=rdss),
        seed=args.seed,
        duration_s=args.duration,
        can_imu=SIM_IMU.model_copy(update={"interface": interface, "channel": channel}),
        gnss_link=args.gnss_link,
        rdss_link=args.rdss_link,
        gnss_raw=None if args.gnss_raw == "none" else args.gnss_raw,
    )
    if args.truth:
        write_truth(args.truth, vehicle.truth)
    task = asyncio.create_task(vehicle.run())
    await asyncio.sleep(0)  # `run` has taken its start instant, or has failed, when this returns
    if not task.done():
        if args.start_file:
            start = {
                "start_monotonic_ns": vehicle.start_ns,
                "start_utc_ns": vehicle.utc_start_ns,
            }
            fresh = args.start_file.with_name(args.start_file.name + ".new")
            fresh.write_text(json.dumps(start) + "\n")
            fresh.replace(args.start_file)
        _watch_commands(vehicle, task)
        print("ready", flush=True)
    with contextlib.suppress(asyncio.CancelledError):
        await task
    terminal = {f"terminal_{name}": n for name, n in vehicle.terminal.counters.items()}
    print(json.dumps({**vehicle.counters, **terminal}), flush=True)


if __name__ == "__main__":
    asyncio.run(_main(_arguments()))
