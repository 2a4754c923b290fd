"""A daemon in a process of its own that is killed while the vehicle drives, and what comes after.

The vehicle is simulated here, on a multicast bus and a pseudo terminal. The next process is there,
with Python and the kernels loaded, before the last is killed, and begins after a pause that is
drawn: how long a gap is does not hang on how busy this computer is. `spoilt` does something to the
state files in between, and gives some of the daemons folders that they cannot write into.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import random
import re
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.restart_from_memory import LONGEST_GAP_S, RESTARTED
from fusiond.simulation.can.imu import SIM_IMU as SIM_IMU_OPTIONS
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive
from tests.hil.processes import SIM_IMU
from tests.live.conditions import CONDITIONS, spoil
from tests.live.told import ToldDaemon

CONFIG = """
vehicle = "killed"
[imu]
axes = ["+x", "-y", "-z"]
{imu}
[sources.gnss]
driver = "nmea"
port = "{folder}/gnss"
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[alignment]
heading = ["gnss_course"]
[mqtt]
enabled = false
"""
NAVIGATED = (Mode.NAVIGATING, Mode.COASTING)
WATCHED_S = 2.0
"""How long position and sigma are compared after each restart."""
UNWRITABLE = "/proc"
"""Even for root."""
UNWRITABLE_SHARE = 0.1
UNTOUCHED_SHARE = 0.5
"""Of the warm states, so that many starts are warm ones."""


@dataclass(frozen=True, slots=True)
class Restart:
    """What came of one kill. `load_s` from the new process's start to its code being loaded, on the
    clock and of processor; `first_output_s` from when it may begin, likewise; `solution_s` from
    the first data to the first solution, `first_ratio` its error north or east in sigmas, `ratio`
    the greatest until `WATCHED_S` later. `gap_s` is NaN if the restart was not a warm one, and
    `cold` says why. `warm` and `saved` are the conditions of the two state files."""

    load_s: float
    load_cpu_s: float
    speed_m_s: float
    first_output_s: float
    first_output_cpu_s: float
    solution_s: float
    gap_s: float
    first_sd_m: float
    first_error_m: float
    first_ratio: float
    ratio: float
    warm: str = "untouched"
    saved: str = "untouched"
    cold: str = ""


@asynccontextmanager
async def driving(folder: Path, seconds: float, seed: int) -> AsyncIterator[SimulatedVehicle]:
    """A vehicle under way, and the configuration of a daemon for it."""
    dice = random.Random(os.getpid() * 1000 + seed)
    bus = {"interface": "udp_multicast", "channel": f"239.{dice.randrange(64, 250)}.163.2"}
    (folder / "killed.toml").write_text(CONFIG.format(imu=SIM_IMU.format(**bus), folder=folder))
    scenario = replace(SCENARIOS["drive"], path=partial(drive, rest_s=5.0))
    vehicle = SimulatedVehicle(
        scenario,
        seed=seed,
        duration_s=seconds,
        can_imu=SIM_IMU_OPTIONS.model_copy(update=bus),
        gnss_link=folder / "gnss",
    )
    task = asyncio.create_task(vehicle.run())
    try:
        yield vehicle
        assert not task.done(), task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def _daemon(folder: Path, at: str = "") -> ToldDaemon:
    """One that keeps its states in `folder`, or `at` another place."""
    place = at or str(folder)
    environment = {"RUNTIME_DIRECTORY": place, "STATE_DIRECTORY": place}
    return ToldDaemon(folder / "killed.toml", environment=environment)


async def killed(
    folder: Path, vehicle: SimulatedVehicle, times: int, seed: int, spoilt: bool = False
) -> AsyncIterator[Restart]:
    """Kill it at `times` random instants of its navigation; what came of each."""
    dice = random.Random(seed)
    daemon, spare = await _daemon(folder).load(), _daemon(folder)
    try:
        await daemon.begin()
        before = await daemon.said()
        for _ in range(times):
            loading = asyncio.create_task(_loaded(spare))
            # On a busy computer the first state is on disk seconds after navigation has begun.
            kept = folder / "killed.warm.json"
            while before.mode is not Mode.NAVIGATING or not loading.done() or not kept.exists():
                before = await daemon.said()
            until_ns = before.t_ns + round(dice.uniform(0.0, 3.0) * 1e9)
            while before.t_ns < until_ns or before.mode not in NAVIGATED:
                before = await daemon.said()
            await daemon.kill()
            warm, saved = _spoil(folder, dice) if spoilt else ("untouched", "untouched")
            await asyncio.sleep(dice.uniform(0.0, LONGEST_GAP_S - 1.5))
            elsewhere = spoilt and dice.random() < UNWRITABLE_SHARE
            daemon, spare = spare, _daemon(folder, UNWRITABLE if elsewhere else "")
            begun_s, speed = time.monotonic(), math.hypot(*before.v_ned_m_s[:2])
            await daemon.begin()
            restart, before = await _watched(daemon, vehicle, begun_s)
            load_s, load_cpu_s = await loading
            yield replace(
                restart,
                speed_m_s=speed,
                load_s=load_s,
                load_cpu_s=load_cpu_s,
                warm=warm,
                saved=saved,
                cold="" if restart.gap_s >= 0.0 else _why_cold(daemon, elsewhere),
            )
    finally:
        await daemon.kill()
        await spare.kill()


def _spoil(folder: Path, dice: random.Random) -> tuple[str, str]:
    """Conditions of the warm state and of the saved one, brought about."""
    names = list(CONDITIONS)
    warm = "untouched" if dice.random() < UNTOUCHED_SHARE else dice.choice(names)
    saved = dice.choice(names)
    for path, name in ((folder / "killed.warm.json", warm), (folder / "killed.json", saved)):
        spoil(name, path, dice)
    return warm, saved


def _why_cold(daemon: ToldDaemon, elsewhere: bool) -> str:
    """Why a start went on from no state; figures and paths are left out, to be counted."""
    if elsewhere:
        return "its folders cannot be read"
    told = [e for e in daemon.events if e.code in ("warm_state_refused", "warm_state_damaged")]
    if not told:
        return "nothing was kept"
    if told[0].code == "warm_state_damaged":
        return "damaged"
    return re.sub(r"^[\d.]+ s", "too many s", told[0].text)


async def _loaded(daemon: ToldDaemon) -> tuple[float, float]:
    """Load it; how long that took, on the clock and of processor."""
    began_s = time.monotonic()
    await daemon.load()
    return time.monotonic() - began_s, daemon.cpu_s


async def _watched(
    daemon: ToldDaemon, vehicle: SimulatedVehicle, begun_s: float
) -> tuple[Restart, Solution]:
    begun_cpu_s = daemon.cpu_s
    said = await daemon.said()
    first_output_s, first_output_cpu_s = time.monotonic() - begun_s, daemon.cpu_s - begun_cpu_s
    while said.mode is Mode.WAITING:
        said = await daemon.said()
    data_ns = said.t_ns
    while said.mode not in NAVIGATED:
        said = await daemon.said()
    first, gap = said, said.reason.partition(RESTARTED)[2].partition(" s")[0]
    first_error_m, first_ratio = _error(said, vehicle)
    ratio = first_ratio
    while said.t_ns - first.t_ns < WATCHED_S * 1e9:
        if said.mode in NAVIGATED:
            ratio = max(ratio, _error(said, vehicle)[1])
        said = await daemon.said()
    result = Restart(
        load_s=math.nan,
        load_cpu_s=math.nan,
        speed_m_s=math.nan,
        first_output_s=first_output_s,
        first_output_cpu_s=first_output_cpu_s,
        solution_s=(first.t_ns - data_ns) * 1e-9,
        gap_s=float(gap) if gap else math.nan,
        first_sd_m=math.hypot(*first.sd_ned_m[:2]),
        first_error_m=first_error_m,
        first_ratio=first_ratio,
        ratio=ratio,
    )
    return result, said


def _error(said: Solution, vehicle: SimulatedVehicle) -> tuple[float, float]:
    """How far off it is (m), and the greater of north and east in sigmas."""
    lat, lon, height = (float(x) for x in vehicle.truth_at(said.t_ns).position[0])
    north = (said.lat_rad - lat) * (meridian_radius(lat) + height)
    east = (said.lon_rad - lon) * (transverse_radius(lat) + height) * math.cos(lat)
    sd_n, sd_e, _ = said.sd_ned_m
    return math.hypot(north, east), max(abs(north) / sd_n, abs(east) / sd_e)


def as_row(restart: Restart) -> str:
    """One line of JSON; a figure that there is not is null."""
    row = {k: v if isinstance(v, str) else _rounded(v) for k, v in asdict(restart).items()}
    return json.dumps(row)


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)
