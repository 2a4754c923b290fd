"""What the daemon takes of a machine, as JSON:

    python benchmarks/daemon_load.py [--seconds S] [--filter kalman] [--raw] [--record]
                                      [--clients N]

The daemon's own process serves a simulated vehicle in another: IMU 200 Hz, ticks 100 Hz, GNSS
10 Hz (`--raw`: UBX of two systems as well, 10 Hz, fused tightly), RDSS, `nav` 20 Hz to a Mosquitto
that one client listens to. CPU and memory are the kernel's account of the process (/proc/PID/stat,
/proc/PID/statm) over the time after alignment; `first_tick_s` counts from the start of the process,
on a primed cache of compiled kernels.

The IMU is on `vcan0` where that interface is up, else on python-can's `udp_multicast`, whose frames
cost more: UDP, msgpack and a Python object for each.

`--record` records all of it, and not, in turns of 10 s within the one run, by MQTT commands:
`recording_percent` is the mean of the differences between neighbours and its standard error, each
turn without its first second, in which a log is opened or ended. `--clients` has N
clients of MQTT, gpsd and NMEA each listen, at 10 Hz, and of Foxglove and Prometheus 32 at most.
`age_ms` is the time from the instant of a
solution, that of its newest CAN frame, to the arrival of its `nav` at a client of the broker:
median, 99 % and most. With many clients that is a matter of the machine as well, of which they
(`clients_cpu_percent`) and the broker take a part.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.daemon_bench import (
    SETTLE_S,
    compile_kernels,
    cpu_s,
    daemon_bench,
    resident_mb,
    running_s,
)
from tests.broker import Broker, listening
from tests.hil.heard import Heard
from tests.hil.processes import DaemonProcess
from tests.live.rig import network_of_its_own

NAV_HZ = 20.0
TURN_S, SKIPPED_S = 10.0, 1.0


def _recorded_mb(folder: Path) -> float:
    return round(sum(path.stat().st_size for path in folder.glob("logs/*")) * 1e-6, 2)


async def _in_turns(pid: int, port: int, seconds: float) -> list[float]:
    """Percent of a core of each turn: with the recording that is under way first, then without."""
    shares: list[float] = []
    async with aiomqtt.Client("127.0.0.1", port) as client:
        for turn in range(round(seconds / TURN_S)):
            if turn:
                name = "stop_recording" if turn % 2 else "start_recording"
                await client.publish(f"fusiond/load/cmd/{name}", json.dumps({"id": str(turn)}), 1)
            await asyncio.sleep(SKIPPED_S)
            start_s, used_s = time.monotonic(), running_s(pid)
            await asyncio.sleep(TURN_S - SKIPPED_S)
            shares.append(100.0 * (running_s(pid) - used_s) / (time.monotonic() - start_s))
    return shares


def _difference(shares: list[float]) -> list[float]:
    """With less without: each turn against the mean of its neighbours; mean and standard error."""
    sign = np.where(np.arange(1, len(shares) - 1) % 2 == 0, 1.0, -1.0)
    more = sign * (np.array(shares[1:-1]) - 0.5 * (np.array(shares[:-2]) + np.array(shares[2:])))
    return [round(float(more.mean()), 2), round(float(more.std(ddof=1) / np.sqrt(len(more))), 2)]


@asynccontextmanager
async def _ages_ms(broker: Broker) -> AsyncIterator[list[float]]:
    """How old each `nav` is when a client has it, up to 1 ms too old: `t_ms` is cut to it."""
    ages: list[float] = []

    async def listen() -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.subscribe("fusiond/load/nav")
            async for message in client.messages:
                now_ms = time.time_ns() * 1e-6
                ages.append(now_ms - json.loads(bytes(message.payload))["t_ms"])

    task = asyncio.create_task(listen())
    try:
        yield ages
    finally:
        task.cancel()


@asynccontextmanager
async def _clients(count: int, broker: int, ports: dict[str, int]) -> AsyncIterator[dict[str, Any]]:
    """That many of each kind, in a process of their own; what they heard is there afterwards."""
    heard: dict[str, Any] = {}
    if not count:
        yield heard
        return
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, str(Path(__file__).with_name("clients.py"))),
        *(str(count), str(broker)),
        *(str(ports[name]) for name in ("gpsd", "nmea", "foxglove", "prometheus")),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    await process.stdout.readline()
    yield heard
    told, _ = await process.communicate(b"\n")  # and the end of its input
    heard |= json.loads(told)


async def measure(
    folder: Path, seconds: float, name: str, raw: bool, record: bool, clients: int
) -> dict[str, object]:
    """Run both processes for `seconds` after alignment; the figures."""
    async with (
        daemon_bench(
            folder,
            seconds + 300.0,
            nav_hz=NAV_HZ,
            raw=raw,
            name=name,
            commands=("start_recording", "stop_recording") if record else (),
            servers=bool(clients),
            recording=record,
        ) as bench,
        DaemonProcess(bench.config) as daemon,
    ):
        broker = bench.broker
        start_s = time.monotonic()
        await daemon.start()
        while ": mode_" not in daemon.log:  # noqa: ASYNC110 - the first tick logs its mode
            await asyncio.sleep(0.01)
        first_tick_s = time.monotonic() - start_s
        bench.vehicle.start()
        async with listening(broker) as (listener, _):
            heard = Heard(listener, "load")
            await heard.until("nav", lambda m: m["mode"] == "navigating")
            await asyncio.sleep(SETTLE_S)
            async with (
                _clients(clients, broker.port, bench.ports) as served,
                _ages_ms(broker) as ages_ms,
            ):
                since, before = heard.count, await heard.until("health")
                start_s, used_s = time.monotonic(), cpu_s(daemon.pid)
                first_mb = resident_mb(daemon.pid)
                shares: list[float] = []
                if record:
                    shares = await _in_turns(daemon.pid, broker.port, seconds)
                else:
                    await asyncio.sleep(seconds)
                elapsed_s, used_s = time.monotonic() - start_s, cpu_s(daemon.pid) - used_s
                memory_mb = resident_mb(daemon.pid)
                after = await heard.until("health")
                nav = len(heard.all("nav", since))
        await daemon.terminate()
    return {
        "filter": name,
        "raw": raw,
        "recorded_mb": _recorded_mb(folder),
        "recording_percent": _difference(shares) if shares else None,
        "recording_and_not_percent": [round(share, 1) for share in shares],
        "cpu_percent": round(100.0 * used_s / elapsed_s, 1),
        "resident_mb": round(memory_mb, 1),
        "resident_before_mb": round(first_mb, 1),
        "first_tick_s": round(first_tick_s, 2),
        "seconds": round(elapsed_s, 1),
        "interface": bench.interface,
        "imu_received": after["sources"]["imu"]["received"] - before["sources"]["imu"]["received"],
        "gnss_fused": after["sources"]["gnss"]["fused"] - before["sources"]["gnss"]["fused"],
        "nav_messages": nav,
        "ticks": after["ticks"] - before["ticks"],
        "overruns": after["overruns"] - before["overruns"],
        "lateness_p99_ms": after["lateness_p99_ms"],
        "age_ms": [round(float(np.percentile(ages_ms, q)), 1) for q in (50, 99, 100)],
        "clients": clients,
        "clients_cpu_percent": served.pop("cpu_percent", 0.0),
        "received_least_and_most": served,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--filter", default="kalman")
    parser.add_argument("--raw", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--clients", type=int, default=0)
    args = parser.parse_args()
    network_of_its_own()
    compile_kernels()
    with tempfile.TemporaryDirectory(prefix="fusiond-load-") as folder:
        wish = args.seconds, args.filter, args.raw, args.record, args.clients
        figures = asyncio.run(measure(Path(folder), *wish))
        print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
