"""The state on disk: written at rest, removed on the move, left alone in between; and read back,
whatever lies there."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import time
from pathlib import Path

import pytest

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.state_keeper import (
    FORGET_SPEED_M_S,
    SAVE_EVERY_S,
    SAVE_MAX_SPEED_M_S,
    StateKeeper,
)
from fusiond.navigation.solution import Mode
from fusiond.navigator.saved_state import (
    SavedState,
    save_state,
)
from tests.live.kept_state import NAVIGATING, Kept
from tests.unprivileged import as_a_user_without_rights


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


async def test_a_place_whose_height_is_not_known_is_kept_without(kept: Kept) -> None:
    unknown = kept.at(0.0)._replace(height_m=math.nan, sd_ned_m=(3.0, 4.0, math.nan))
    await kept.keeper.close(unknown, confirmed=True)
    state = Kept(kept.path).keeper.load()
    assert state is not None
    assert state.position == (NAVIGATING.lat_rad, NAVIGATING.lon_rad, None)
    assert math.isclose(state.sd_position_m, 5.0)


async def test_a_heading_that_nothing_has_shown_is_kept_as_one(kept: Kept) -> None:
    kept.keeper.keep(kept.t_ns, kept.at(0.0, Mode.COASTING), confirmed=False)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    state = Kept(kept.path).keeper.load()
    assert state is not None
    assert not state.confirmed
    await kept.keeper.close(kept.at(0.0), confirmed=True)
    state = Kept(kept.path).keeper.load()
    assert state is not None
    assert state.confirmed


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
    await kept.keeper.close(kept.at(speed_m_s, mode), confirmed=True)
    assert kept.path.exists() is written


async def test_a_disk_that_fails_is_told_and_costs_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, logger="fusiond")
    kept = Kept(tmp_path / "absent" / "state.json")
    await kept.tick(0.0, 0.0)
    await kept.keeper.close(kept.at(0.0), confirmed=True)
    assert [r.getMessage().partition(":")[0] for r in caplog.records] == ["state not saved"] * 2


async def test_a_user_who_may_not_write_there_is_told_and_navigates(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING, logger="fusiond")
    with as_a_user_without_rights() as folder:
        path = folder / "state.json"
        save_state(path, SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.7, 0.05))
        before = path.read_bytes()
        folder.chmod(0o555)
        kept = Kept(path)
        assert kept.keeper.load() is not None
        await kept.tick(0.0, 0.0)
        await kept.tick(0.01, 2.0 * FORGET_SPEED_M_S)
        assert path.read_bytes() == before
        words = [r.getMessage() for r in caplog.records]
        assert [text.partition(":")[0] for text in words] == [
            "state not saved",
            "state not removed",
        ]
        assert all("Permission denied" in text for text in words)
        path.chmod(0o000)
        locked = Kept(path)
        assert locked.keeper.load() is None
        [(code, text)] = locked.events
        assert code == "saved_state_damaged"
        assert "it stays: Permission denied" in text


async def test_a_link_in_its_place_is_read_and_replaced_and_what_it_names_is_left(
    kept: Kept, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere" / "state.json"
    elsewhere.parent.mkdir()
    save_state(elsewhere, SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.1, 0.05))
    before = elsewhere.read_bytes()
    kept.path.symlink_to(elsewhere)
    state = kept.keeper.load()
    assert state is not None
    assert state.yaw_rad == 0.1
    kept.path.with_name("state.json.new").symlink_to(elsewhere)  # what is written first
    await kept.tick(0.0, 0.0)
    assert elsewhere.read_bytes() == before
    assert not kept.path.is_symlink()
    state = Kept(kept.path).keeper.load()
    assert state is not None
    assert state.yaw_rad == NAVIGATING.rpy_rad[2]


async def test_a_link_that_leads_nowhere_is_no_state_and_gives_way(
    kept: Kept, tmp_path: Path
) -> None:
    kept.path.symlink_to(tmp_path / "unplugged" / "state.json")
    assert kept.keeper.load() is None
    assert kept.events == []
    await kept.tick(0.0, 0.0)
    assert not kept.path.is_symlink()
    assert Kept(kept.path).keeper.load() is not None


async def test_what_stands_where_it_is_written_first_gives_way(kept: Kept) -> None:
    """Left by a power cut, or put there: a folder, a pipe that nobody reads, half a state."""
    new = kept.path.with_name("state.json.new")
    for put in (Path.mkdir, os.mkfifo, Path.touch):
        put(new)
        again = Kept(kept.path)
        await again.tick(0.0, 0.0)
        assert again.keeper.load() is not None
        assert not new.exists()
        kept.path.unlink()


def never(code: str, text: str) -> None:
    raise AssertionError((code, text))


async def test_systemd_names_the_folder(tmp_path: Path) -> None:
    config = Config(vehicle="truck")
    clock = Clock(config.clock)
    now = NAVIGATING._replace(t_ns=clock.now_ns())
    await StateKeeper(config, clock, never, {"STATE_DIRECTORY": f"{tmp_path}:/other"}).close(
        now, confirmed=True
    )
    assert os.listdir(tmp_path) == ["truck.json"]
    silent = StateKeeper(config, clock, never, {})
    assert silent.load() is None
    await silent.close(now, confirmed=True)
