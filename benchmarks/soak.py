"""The daemon's own process for hours of real time, with a fault now and then, as JSON:

    python benchmarks/soak.py HOURS [--every SECONDS] [--seed S]

A line for each fault and each ten minutes, and last a summary: the slope of the resident memory
(least squares over the second half, for pools fill in the first, with its standard error), what was
told while nothing was wrong, how often an error was beyond five sigma in mode `navigating`, and the
scheduler's overruns. Quiet is what lies `SETTLED_S` after the end of the last fault.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import aiomqtt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fusiond.studies.faults.error_sigma_score import MOST_SIGMA, NAVIGATING
from tests.live.rig import Rig, network_of_its_own, rig, under_way
from tests.live.wire_faults import FAULTS

SETTLED_S = 60.0
FIRST_S = 60.0
"""Time to start, before the first fault."""
WARMED_S = 600.0
EVERY_S = 10.0
FEWEST = 30
REPORT_S = 600.0
LAST_LINES = 40
DAY_S = 86400.0
USED = (
    *("gnss_unplugged", "rdss_unplugged", "gnss_garbage", "gnss_wrong_baud", "gnss_half_frames"),
    *("gnss_late_3s", "gnss_half_open", "imu_unplugged_1s", "imu_counter_jumps"),
    *("imu_frames_lost", "can_error_frames", "can_foreign_frames", "imu_ticks_0.3s_ahead"),
    *("broker_killed", "broker_frozen", "starved", "commands_1000_hz"),
)
ALARMS = (
    *("isolated", "optimistic", "pessimistic", "coloured", "diverged", "protection"),
    *("refused", "imu_"),
)
"""What in an event's code says that something is wrong with a source, the filter or the IMU."""


def resident_mb(pid: int) -> float:
    """Of a process, MB of 10^6 bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


class Watch:
    """What is measured while it runs."""

    def __init__(self, made: Rig) -> None:
        self._rig = made
        self.memory: list[tuple[float, float]] = []
        self.wrong: list[tuple[float, float]] = []
        """From and to when something was wrong, s of the drive."""

    async def memory_for_ever(self) -> None:
        """Resident memory in MB, every ten seconds, while the process is there."""
        while self._rig.daemon.status is None:
            self.memory.append((self._rig.now_s, resident_mb(self._rig.daemon.pid)))
            await asyncio.sleep(EVERY_S)

    def quiet(self, t_s: float) -> bool:
        """Whether nothing was wrong then, nor shortly before; nor had the vehicle stood still."""
        stalls = [(at_s - late_s, at_s) for at_s, late_s in self._rig.stalls]
        return t_s > FIRST_S and not any(
            a <= t_s <= b + SETTLED_S for a, b in (*self.wrong, *stalls)
        )

    def slope(self) -> dict[str, float]:
        """MB a day over the second half, and its standard error; nothing before that is enough."""
        kept = np.array([m for m in self.memory if m[0] > max(WARMED_S, 0.5 * self._rig.now_s)])
        if len(kept) < FEWEST:
            return {}
        t, y = kept.T
        (slope, _), cov = np.polyfit(t / DAY_S, y, 1, cov=True)
        error = float(np.sqrt(cov[0, 0]))
        return {"mb_per_day": round(float(slope), 2), "mb_per_day_error": round(error, 2)}

    def figures(self) -> dict[str, object]:
        """All of it, so far."""
        course = self._rig.course()
        quiet = [s for s in course.samples if self.quiet(s.t_s)]
        told = Counter(e.code for e in course.events if self.quiet(e.t_s))
        alarms = sum(n for code, n in told.items() if any(word in code for word in ALARMS))
        ratios = np.array([max(s.ratios) for s in quiet if s.mode == NAVIGATING and s.ratios])
        hours = len(quiet) / 3600.0
        return {
            "hours": round(self._rig.now_s / 3600.0, 3),
            "faults": len(self.wrong),
            "stalls_of_the_vehicle": len(self._rig.stalls),
            "memory_mb": round(self.memory[-1][1], 2),
            **self.slope(),
            "quiet_hours": round(hours, 3),
            "quiet_events": dict(told),
            "false_alarms_per_24_h": round(24.0 * alarms / max(hours, 1e-9), 2),
            "quiet_beyond_5_sigma_s": int((ratios > MOST_SIGMA).sum()),
            "beyond_5_sigma_s": sum(s.beyond for s in course.samples),
            "modes": dict(Counter(s.mode for s in course.samples)),
        }


async def _faults(made: Rig, watch: Watch, every_s: float, dice: random.Random) -> None:
    await made.until(FIRST_S)
    while True:
        await asyncio.sleep(dice.uniform(0.5, 1.5) * every_s)
        name = dice.choice(USED)
        fault, begin_s = FAULTS[name], made.now_s
        watch.wrong.append((begin_s, begin_s + fault.length_s))
        await fault.begin(made)
        await made.until(begin_s + fault.length_s)
        await fault.end(made)
        watch.wrong[-1] = begin_s, made.now_s
        print(json.dumps({"fault": name, "at_s": round(begin_s, 1)}), flush=True)


async def _subscriber(made: Rig) -> None:
    """Somebody who hears all that is published, and keeps nothing."""
    while True:
        try:
            async with aiomqtt.Client("127.0.0.1", made.broker.port) as client:
                await client.subscribe("fusiond/#")
                async for _ in client.messages:
                    pass
        except aiomqtt.MqttError:
            await asyncio.sleep(1.0)


async def soak(folder: Path, hours: float, every_s: float, seed: int) -> dict[str, object]:
    """Run it; the summary."""
    seconds = hours * 3600.0
    async with rig(folder, seconds + 60.0, seed) as made, under_way(made):
        watch = Watch(made)
        tasks = [
            asyncio.create_task(work)
            for work in (
                watch.memory_for_ever(),
                _faults(made, watch, every_s, random.Random(seed)),
                _subscriber(made),
            )
        ]
        try:
            report_s = REPORT_S
            while made.now_s < seconds and made.ended is None:
                await made.until(made.now_s + EVERY_S)
                if made.now_s >= report_s:
                    report_s += REPORT_S
                    print(json.dumps(watch.figures()), flush=True)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        found = watch.figures() | {"ended": made.ended}
    log = made.daemon.log.read_text()
    ticks = re.search(r"stopped after (\d+) ticks, (\d+) overruns", log)
    if ticks is not None:
        found |= {"ticks": int(ticks[1]), "overruns": int(ticks[2])}
    if made.ended is not None:
        found["last_words"] = log.splitlines()[-LAST_LINES:]
    return found | {"tracebacks": log.count("Traceback")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hours", type=float)
    parser.add_argument("--every", type=float, default=240.0, help="s between faults, the mean")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    subprocess.run([sys.executable, "-c", "import fusiond.live.daemon"], check=True)  # compiles
    network_of_its_own()
    with tempfile.TemporaryDirectory(prefix="fusiond-soak-") as folder:
        figures = asyncio.run(soak(Path(folder), args.hours, args.every, args.seed))
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
