"""The daemon while guests attack its servers, a row for each attack:

    python benchmarks/attack.py [--seconds S] [--rest S] [--ahead] [--only NAME ...] [--json F]
                                [--probe]
    python benchmarks/attack.py --kill TIMES [--ahead] [--json F]

The daemon's own process, all its servers on, records a simulated vehicle in another: IMU 200 Hz,
raw GNSS 10 Hz (UBX, fused tightly), RDSS; ticks and `nav` 100 Hz, to a Mosquitto that one client
listens to. One daemon takes all attacks (`benchmarks/attackers.py`) one after another, each for
`--seconds`; `peace` is as long without one. Columns:

* `ticks`, `overruns`: of the scheduler meanwhile;
* largest gap between two `nav`: `nav_ms` at a client of the broker that does nothing else,
  `sent_ms` as they reach the broker, `tick_ms` between the instants they are of; `bare_ms` that of
  a loop that wakes every 10 ms and does nothing: the computer's own (`benchmarks/probes.py`);
* `guest_ms`: largest gap between two epochs (10 Hz) at a gpsd client that reads all the while;
  `scrape_ms`: longest answer to a scrape, of one a second;
* `before`, `most`, `after`: resident memory, MB; `after` is `--rest` seconds later;
* `fds`: descriptors before, at most and after;
* `log`: lines of the cause that has most of them, a minute; all causes that have more than one
  line are in the JSON.

With `--probe` the daemon's loop is watched (`benchmarks/loop_probe.py`), and below each row stand
the three longest of the turns and waits that held it up meanwhile, those of the start below the
first: what they spent their time on. The JSON has all of them.

With `--kill` the daemon is killed (SIGKILL) so many times while three attacks go on, and a row says
what its recording lacks.

The attackers yield the processor (nice 19): each has its own in truth. The daemon has nice -10, as
its unit gives it, where that is allowed (root), and so have the vehicle and this process, which in
truth are no work of this computer; the broker has 0, as Debian's unit of Mosquitto gives it. On a
computer that others use as well the gaps are also those of the computer: compare with `peace`, or
take `--ahead`, by which all but the attackers run at SCHED_FIFO, before all others.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.attackers import ATTACKS, Ports
from benchmarks.daemon_bench import (
    SETTLE_S,
    DaemonBench,
    compile_kernels,
    daemon_bench,
    descriptors,
    resident_mb,
)
from benchmarks.probes import gap_ms, probing
from fusiond.recording.reader import Log
from tests.broker import listening
from tests.hil.heard import Heard
from tests.hil.processes import FUSIOND, DaemonProcess
from tests.live.rig import network_of_its_own

NAV = "fusiond/load/nav"
MORE = """
[outputs.home_assistant]
[outputs.owntracks]
"""
BETWEEN_S = 15.0
"""Of a row, beside its attack and its rest: probes that start, and two rounds of `health`."""
KILL_S = 30.0
"""A start of the daemon, some seconds under way, and its recording read."""
COLUMNS = (
    ("attack", "attack", 18), ("ticks", "ticks", 6), ("overruns", "overruns", 9),
    ("nav_ms", "nav_ms", 8), ("sent_ms", "sent_ms", 8), ("tick_ms", "tick_ms", 8),
    ("bare_ms", "bare_ms", 8), ("guest_ms", "guest_ms", 9),
    ("scrape_ms", "scrape_ms", 10), ("before", "before_mb", 7), ("most", "most_mb", 7),
    ("after", "after_mb", 7), ("fds", "fds", 14), ("log", "log_lines_a_minute", 6),
)  # fmt: skip


@dataclass
class Watch:
    """What is seen from outside while it lasts."""

    guest_s: list[float] = field(default_factory=list)
    scrape_s: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)


async def _read_gpsd(port: int, watch: Watch) -> None:
    """A guest as it should be; it comes back when it is sent away."""
    while True:
        with contextlib.suppress(OSError):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(b'?WATCH={"enable":true,"json":true};\n')
            try:
                while line := await reader.readline():
                    if b'"TPV"' in line:
                        watch.guest_s.append(time.monotonic())
            finally:
                writer.close()
        await asyncio.sleep(0.1)


async def _scrape(port: int, watch: Watch) -> None:
    while True:
        start_s = time.monotonic()
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(10.0):
                body = b""
                while b"fusiond_mode" not in body:
                    with contextlib.suppress(OSError):
                        reader, writer = await asyncio.open_connection("127.0.0.1", port)
                        writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
                        body = await reader.read()
                        writer.close()
                    await asyncio.sleep(0.01)
        watch.scrape_s.append(time.monotonic() - start_s)
        await asyncio.sleep(1.0)


async def _sample(pid: int, watch: Watch) -> None:
    while True:
        watch.memory_mb.append(resident_mb(pid))
        watch.descriptors.append(descriptors(pid))
        await asyncio.sleep(0.1)


@asynccontextmanager
async def _watching(pid: int, ports: Ports) -> AsyncIterator[Watch]:
    watch = Watch()
    tasks = [
        asyncio.create_task(_read_gpsd(ports.gpsd, watch)),
        asyncio.create_task(_scrape(ports.prometheus, watch)),
        asyncio.create_task(_sample(pid, watch)),
    ]
    try:
        await asyncio.sleep(1.0)
        yield watch
        for task in tasks:
            if task.done():
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _causes(log: str) -> dict[str, int]:
    """Lines by their text without figures; the lines of a traceback by themselves."""
    lines = (re.sub(r"[\d.]+", "#", line)[:100] for line in log.splitlines())
    return {line: count for line, count in Counter(lines).most_common(20) if count > 1}


async def _attack(name: str, seconds: float, ports: Ports) -> dict[str, Any]:
    if name == "peace":
        await asyncio.sleep(seconds)
        return {}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, str(Path(__file__).with_name("attackers.py"))),
        *map(str, (name, seconds, *ports)),
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        told, _ = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    found: dict[str, Any] = json.loads(told.splitlines()[-1])
    return found


class LoopLog:
    """What the probe in the daemon's loop writes, where there is one."""

    def __init__(self, folder: Path, wanted: bool) -> None:
        self._path = folder / "loop.jsonl"
        self.program: tuple[str | Path, ...] = (FUSIOND,)
        self._read = 0
        if wanted:
            probe = Path(__file__).with_name("loop_probe.py")
            self.program = (sys.executable, probe, self._path)

    def news(self) -> list[dict[str, Any]]:
        """Whole lines since the last call."""
        if not self._path.exists():
            return []
        lines, _, _ = self._path.read_text()[self._read :].rpartition("\n")
        self._read += len(lines) + bool(lines)
        return [json.loads(line) for line in lines.splitlines() if line]


async def _row(
    name: str, daemon: DaemonProcess, heard: Heard, ports: Ports, args: Any
) -> dict[str, Any]:
    async with probing(ports.mqtt, NAV) as probed, _watching(daemon.pid, ports) as watch:
        before = await heard.until("health")
        log_at = len(daemon.log)
        memory_mb, before_fds = watch.memory_mb[-1], watch.descriptors[-1]
        came = await _attack(name, args.seconds, ports)
        after = await heard.until("health")
        log = daemon.log[log_at:]
    await asyncio.sleep(args.rest)
    causes = _causes(log)
    most = max(causes.values(), default=min(1, len(log)))
    mode = (await heard.until("status"))["mode"]
    return {
        "attack": name,
        "ticks": after["ticks"] - before["ticks"],
        "overruns": after["overruns"] - before["overruns"],
        **probed.row(),
        "guest_ms": gap_ms(watch.guest_s),
        "scrape_ms": round(1000.0 * max(watch.scrape_s, default=float("inf")), 1),
        "before_mb": round(memory_mb, 1),
        "most_mb": round(max(watch.memory_mb), 1),
        "after_mb": round(resident_mb(daemon.pid), 1),
        "fds": f"{before_fds}/{max(watch.descriptors)}/{descriptors(daemon.pid)}",
        "log_lines_a_minute": round(most * 60.0 / max(60.0, args.seconds)),
        "log_causes": causes,
        "cpu_percent": after["cpu_percent"],
        "gc_max_ms": after["gc_max_ms"],
        "mode_after": mode,
        "outputs": {n: after["outputs"][n]["counters"] for n in Ports._fields},
        "recording": after["outputs"]["recording"]["state"],
        **came,
    }


async def measure(folder: Path, args: Any) -> list[dict[str, Any]]:
    """Run the attacks; their rows, told as they come."""
    rows: list[dict[str, Any]] = []
    names = args.only or ("peace", *ATTACKS)
    lasts_s = 120.0 + len(names) * (args.seconds + args.rest + BETWEEN_S)
    loop_log = LoopLog(folder, args.probe)
    async with (
        _bench(folder, lasts_s) as (bench, ports),
        DaemonProcess(bench.config, loop_log.program) as daemon,
    ):
        await daemon.start()
        await daemon.ready()
        async with listening(bench.broker, "fusiond/load/+") as (listener, _):
            heard = Heard(listener, "load")
            await heard.until("nav", lambda m: m["mode"] == "navigating")
            await asyncio.sleep(SETTLE_S)
            for name in names:
                row = await _row(name, daemon, heard, ports, args)
                row["loop"] = loop_log.news()
                if not rows:
                    print("".join(title.rjust(width) for title, _, width in COLUMNS))
                print("".join(str(row[key]).rjust(width) for _, key, width in COLUMNS))
                for held in sorted(row["loop"], key=lambda held: -float(held["wall_ms"]))[:3]:
                    print("   ", json.dumps(held))
                sys.stdout.flush()
                rows.append(row)
        await daemon.terminate()
        if args.probe:
            print("   ", json.dumps(loop_log.news()[-1]))
    return rows


async def kill(folder: Path, args: Any) -> list[dict[str, Any]]:
    """Kill the daemon (SIGKILL) so many times while three attacks go on; a row a kill: how much of
    what its broker's client had heard is not in the recording, and what is wrong with that."""
    dice, rows = random.Random(1), []
    async with _bench(folder, 120.0 + args.kill * KILL_S) as (bench, ports):
        attacks = [
            asyncio.create_task(_attack(name, 3600.0, ports))
            for name in ("poll_8_unread", "deaf_1100", "subscribe_138000")
        ]
        for number in range(args.kill):
            async with probing(ports.mqtt, NAV) as probed:
                async with DaemonProcess(bench.config) as daemon:
                    await daemon.start()
                    await daemon.ready()
                    await asyncio.sleep(dice.uniform(1.0, 3.0))
                await asyncio.sleep(0.2)
            log = Log([_newest(folder)])
            kept_ms = [m.json()["t_ms"] for m in log.messages("/nav")]
            heard_ms = [t_ms for _, t_ms in probed.heard]
            lost_s = (heard_ms[-1] - max(kept_ms, default=heard_ms[0])) * 1e-3
            rows.append({"lost_s": round(lost_s, 3), "kept": len(kept_ms), "log": log.problems})
            print(number, rows[-1], flush=True)
        for attack in attacks:
            attack.cancel()
        await asyncio.gather(*attacks, return_exceptions=True)
    return rows


def _newest(folder: Path) -> Path:
    return max(folder.glob("logs/*"), key=lambda path: path.stat().st_mtime)


@asynccontextmanager
async def _bench(folder: Path, duration_s: float) -> AsyncIterator[tuple[DaemonBench, Ports]]:
    """A vehicle under way for so long and a broker; the configuration of a daemon for them."""
    commands = ("request_fix",)
    async with daemon_bench(
        folder, duration_s, nav_hz=100.0, raw=True, commands=commands, more=MORE
    ) as bench:
        if os.getpriority(os.PRIO_PROCESS, 0) < 0:
            bench.broker.set_nice(0)
        bench.vehicle.start()
        yield bench, Ports(**bench.ports, mqtt=bench.broker.port)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rest", type=float, default=5.0)
    parser.add_argument("--only", nargs="*", choices=("peace", *ATTACKS))
    parser.add_argument("--kill", type=int, default=0)
    parser.add_argument("--ahead", action="store_true")
    parser.add_argument("--probe", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with contextlib.suppress(PermissionError):
        if args.ahead:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    network_of_its_own()
    compile_kernels()
    with tempfile.TemporaryDirectory(prefix="fusiond-attack-") as folder:
        rows = asyncio.run((kill if args.kill else measure)(Path(folder), args))
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
