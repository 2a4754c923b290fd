"""The state on disk: written at rest, removed on the move, left alone in between."""

from __future__ import annotations

import asyncio
import logging
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from fusiond.clock.clock import Clock
from fusiond.configuration.schema import Config
from fusiond.live.state_keeper import (
    FORGET_SPEED_M_S,
    SAVE_EVERY_S,
    SAVE_MAX_SPEED_M_S,
    StateKeeper,
)
from fusiond.navigation.solution import Mode, Solution

S = 1_000_000_000
NAVIGATING = Solution(
    0,
    Mode.NAVIGATING,
    "aided by gnss",
    lat_rad=0.53,
    lon_rad=1.99,
    height_m=38.0,
    v_ned_m_s=(0.0, 0.0, 0.0),
    rpy_rad=(0.0, 0.0, 0.7),
    sd_ned_m=(3.0, 4.0, 2.0),
    sd_v_ned_m_s=(0.05, 0.05, 0.05),
    sd_rpy_rad=(0.001, 0.001, 0.05),
)


class Kept:
    """A keeper at the daemon's clock, and its file."""

    def __init__(self, path: Path) -> None:
        config = Config(state_file=path)
        self.path = path
        self.clock = Clock(config.clock)
        self.keeper = StateKeeper(config, self.clock)
        self.t_ns = self.clock.now_ns()

    def at(self, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> Solution:
        return replace(NAVIGATING, t_ns=self.t_ns, mode=mode, v_ned_m_s=(speed_m_s, 0.0, 0.0))

    async def tick(self, after_s: float, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> None:
        """A tick some time later, and what it started in the background."""
        self.t_ns += round(after_s * S)
        self.keeper.keep(self.t_ns, self.at(speed_m_s, mode))
        await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})


@pytest.fixture
def kept(tmp_path: Path) -> Kept:
    return Kept(tmp_path / "state.json")


async def test_rest_is_kept_and_serves_the_next_start(kept: Kept) -> None:
    assert kept.keeper.load() is None
    await kept.tick(0.0, 0.0)
    state = Kept(kept.path).keeper.load()
    assert state is not None
    assert state.position == (NAVIGATING.lat_rad, NAVIGATING.lon_rad, NAVIGATING.height_m)
    assert (state.yaw_rad, state.sd_yaw_rad) == (0.7, 0.05)
    assert math.isclose(state.sd_position_m, 5.0)


async def test_the_file_is_renewed_once_a_minute(kept: Kept) -> None:
    await kept.tick(0.0, 0.0)
    kept.path.unlink()
    await kept.tick(SAVE_EVERY_S - 1.0, 0.0)
    assert not kept.path.exists()
    await kept.tick(1.0, 0.0)
    assert kept.path.exists()


async def test_a_vehicle_that_drives_is_forgotten_at_once(kept: Kept) -> None:
    await kept.tick(0.0, 0.0)
    await kept.tick(0.01, 0.5 * (SAVE_MAX_SPEED_M_S + FORGET_SPEED_M_S))
    assert kept.path.exists()  # perhaps only the velocity's error
    await kept.tick(0.01, 2.0, Mode.ALIGNING)
    assert kept.path.exists()  # no velocity to be believed
    await kept.tick(0.01, 1.01 * FORGET_SPEED_M_S)
    assert not kept.path.exists()
    await kept.tick(SAVE_EVERY_S, 10.0)
    assert not kept.path.exists()


async def test_a_state_of_the_last_run_is_forgotten_too(kept: Kept) -> None:
    await kept.tick(0.0, 0.0)
    again = Kept(kept.path)
    assert again.keeper.load() is not None
    await again.tick(0.0, 10.0)  # due to be written, but it drives
    await again.tick(0.01, 10.0)
    assert not kept.path.exists()


@pytest.mark.parametrize(
    ("speed_m_s", "mode", "written"),
    [(0.0, Mode.COASTING, True), (1.0, Mode.NAVIGATING, False), (0.0, Mode.ALIGNING, False)],
)
async def test_the_end_keeps_a_solution_at_rest(
    kept: Kept, speed_m_s: float, mode: Mode, written: bool
) -> None:
    await kept.keeper.close(kept.at(speed_m_s, mode))
    assert kept.path.exists() is written


async def test_a_disk_that_fails_is_told_and_costs_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, logger="fusiond")
    kept = Kept(tmp_path / "absent" / "state.json")
    await kept.tick(0.0, 0.0)
    await kept.keeper.close(kept.at(0.0))
    assert [r.getMessage().partition(":")[0] for r in caplog.records] == ["state not saved"] * 2


async def test_systemd_names_the_folder(tmp_path: Path) -> None:
    config = Config(vehicle="truck")
    clock = Clock(config.clock)
    now = replace(NAVIGATING, t_ns=clock.now_ns())
    await StateKeeper(config, clock, {"STATE_DIRECTORY": f"{tmp_path}:/other"}).close(now)
    assert os.listdir(tmp_path) == ["truck.json"]
    silent = StateKeeper(config, clock, {})
    assert silent.load() is None
    await silent.close(now)
