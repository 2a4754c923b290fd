"""The papers' models in the running daemon, on virtual CAN and ptys, as `fusiond demo --paper`."""

from __future__ import annotations

import asyncio
import json
import math
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.demo.demo import ned_error
from fusiond.demo.papers import paper_setup
from fusiond.demo.scenario import Unplugged
from fusiond.live.daemon import Daemon
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.messages.health import SourceHealth
from fusiond.simulation.papers import PAPERS, settings
from tests.live.daemon_bench import running
from tests.patience import PATIENCE_S, until
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "papers.md").read_text(encoding="utf-8")
MEASUREMENTS = {
    "000": ("rdss",),
    "001": ("gnss", "gnss_velocity", "star_tracker"),
    "002": ("gnss", "star_tracker", "sar"),
    "003": ("gnss",),
    "004": ("gnss", "rdss"),
}


class Run:
    """A paper's daemon and vehicle in this process, and what the daemon says."""

    def __init__(self, number: str, folder: Path) -> None:
        play = paper_setup(number)
        # A host that stands still for a second is not what is looked at.
        slow = play.config.imu.model_copy(update={"rate_hz": 50.0, "gap_s": 2.0})
        config = play.config.model_copy(update={"imu": slow})
        play = replace(play, config=config, scenario=play.scenario.fitted(config))
        config = play.served(1, folder)
        off = config.mqtt.model_copy(update={"enabled": False})
        config = config.model_copy(
            update={"mqtt": off, "state_file": folder / "state.json", "vehicle": "paper"}
        )
        self.seen: list[Solution] = []
        self.daemon = Daemon(config, on_solution=self.seen.append)
        self.vehicle = play.vehicle(PATIENCE_S, folder)

    @property
    def health(self) -> dict[str, SourceHealth]:
        return self.daemon.sources.health(self.daemon.clock.now_ns())

    def fused(self, name: str) -> int:
        return self.health[name].fused if name in self.health else 0

    @property
    def used(self) -> tuple[str, ...]:
        """Satellites of the receiver's last epoch."""
        sky = self.health["gnss"].sky
        return () if sky is None else sky.used

    @property
    def usable(self) -> bool:
        return bool(self.seen) and self.seen[-1].mode in (Mode.NAVIGATING, Mode.COASTING)

    def judge(self) -> None:
        """The last solution lies within five of its sigmas."""
        s = self.seen[-1]
        assert self.usable, s
        true = self.vehicle.truth_at(s.t_ns)
        error = ned_error(np.array([[s.lat_rad, s.lon_rad, s.height_m]]), true.position)[0]
        assert abs(error[0]) < 5.0 * s.sd_ned_m[0], (error, s)
        assert abs(error[1]) < 5.0 * s.sd_ned_m[1], (error, s)


@pytest.mark.parametrize("number", ["000", "001", "002", "003"])
async def test_the_papers_model_navigates_by_its_devices(number: str, tmp_path: Path) -> None:
    run = Run(number, tmp_path)
    estimator = PAPERS[number].lines["estimator"]
    assert run.daemon.navigator.model.name == estimator["model"]
    async with running(run.daemon, run.vehicle):
        await until(lambda: all(run.fused(name) >= 5 for name in MEASUREMENTS[number]))
        await until(lambda: run.usable)
        run.judge()
        if number == "003":
            await until(lambda: bool(run.used))
            assert {name[0] for name in run.used} == {"C"}
        if number == "000":  # fed back at the instants of arrival: the fifth may be under way
            await until(lambda: run.health["rdss_feedback"].rejected.get("fed_back", 0) >= 5)
        health = run.health
    assert set(PAPERS[number].devices) <= set(health)
    for name in MEASUREMENTS[number]:
        assert health[name].rejected.get("isolated", 0) == 0, (name, health[name])
    if number == "003":
        (drift,) = run.daemon.navigator.model.slots_of("clock_drift")
        assert run.daemon.navigator.model.noise[0, drift] == pytest.approx(1.0 / 300.0)


async def test_two_receivers_navigate_until_the_inertial_unit_comes(tmp_path: Path) -> None:
    run = Run("004", tmp_path)
    async with running(run.daemon, run.vehicle):
        await asyncio.sleep(0)  # the vehicle plugs all in with its first step
        run.vehicle.unplug("imu")
        await until(
            lambda: run.usable and all(run.fused(name) >= 3 for name in MEASUREMENTS["004"])
        )
        s = run.seen[-1]
        assert "no inertial unit" in s.reason
        assert math.isnan(s.rpy_rad[2])
        assert run.daemon.navigator.active_filter.isolates
        run.judge()
        run.vehicle.plug("imu")
        await until(lambda: run.usable and not math.isnan(run.seen[-1].rpy_rad[2]))
        before = run.fused("gnss")
        await until(lambda: run.fused("gnss") >= before + 5)
        run.judge()
    assert not run.daemon.navigator.without_imu.active
    assert run.health["imu"].fused > 0


def test_the_page_has_the_lines_of_each_paper() -> None:
    """As they are in the demo, and such that a shipped configuration takes them."""
    found = dict(re.findall(r"^### (00\d).*?\n```toml\n(.*?)```", PAGE, flags=re.M | re.S))
    assert set(found) == set(PAPERS)
    for number, text in found.items():
        assert tomllib.loads(text) == PAPERS[number].lines, number
        assert PAPERS[number].config in PAGE.split(f"### {number}")[1].split("###")[0]
        assert f"\n| {number} | " in PAGE.split("| `--paper` |")[1]


def test_a_papers_configuration_is_the_shipped_one_with_its_lines() -> None:
    for number, paper in PAPERS.items():
        made = settings(number)
        path = REPOSITORY / "config" / paper.config
        assert made["imu"] == tomllib.loads(path.read_text(encoding="utf-8"))["imu"], number
        assert paper.lines["estimator"].items() <= made["estimator"].items()
        assert load_config(path).imu.rate_hz == paper_setup(number).scenario.imu.rate_hz


def test_plugs_are_pulled_once_or_over_and_over() -> None:
    assert list(Unplugged("imu", 0.0, 25.0).times(60.0)) == [(0.0, 25.0)]
    assert list(Unplugged("gnss", 18.0, 12.0, 60.0).times(100.0)) == [(18.0, 30.0), (78.0, 90.0)]
    assert list(Unplugged("gnss", 18.0, 12.0).times(10.0)) == []


def test_the_command_runs_a_paper_and_names_those_that_there_are() -> None:
    fusiond = str(Path(sys.executable).with_name("fusiond"))
    command = [fusiond, "demo", "--headless", "--duration", "2", "--paper"]

    def ran(number: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, number], capture_output=True, text=True, check=False, timeout=PATIENCE_S
        )

    done = ran("002")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert list(summary)[:3] == ["paper", "filter", "model"]
    assert (summary["paper"], summary["model"]) == ("002", "ins23")
    assert "Traceback" not in done.stderr
    wrong = ran("005")
    assert wrong.returncode == 2
    assert "000, 001, 002, 003, 004" in re.sub(r"[│\s]+", " ", wrong.stderr)
