"""The state on disk: written at rest, removed on the move, left alone in between; and read back,
whatever lies there."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusiond.clock.clock import Clock
from fusiond.configuration.schema import Config
from fusiond.live.state_keeper import (
    FORGET_SPEED_M_S,
    SAVE_EVERY_S,
    SAVE_MAX_SPEED_M_S,
    StateKeeper,
)
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.saved_state import (
    SAVED_HEADING_SD_RAD,
    SavedState,
    load_state,
    save_state,
)
from fusiond.navigator.state_file import MOST_BYTES, DamagedStateError
from tests.unprivileged import as_a_user_without_rights

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
        self.events: list[tuple[str, str]] = []
        self.keeper = StateKeeper(config, self.clock, lambda *event: self.events.append(event))
        self.t_ns = self.clock.now_ns()

    def at(self, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> Solution:
        return replace(NAVIGATING, t_ns=self.t_ns, mode=mode, v_ned_m_s=(speed_m_s, 0.0, 0.0))

    async def tick(self, after_s: float, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> None:
        """A tick some time later, and what it started in the background."""
        self.t_ns += round(after_s * S)
        self.keeper.keep(self.t_ns, self.at(speed_m_s, mode), confirmed=True)
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


async def test_a_place_whose_height_is_not_known_is_kept_without(kept: Kept) -> None:
    unknown = replace(kept.at(0.0), height_m=math.nan, sd_ned_m=(3.0, 4.0, math.nan))
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
    now = replace(NAVIGATING, t_ns=clock.now_ns())
    await StateKeeper(config, clock, never, {"STATE_DIRECTORY": f"{tmp_path}:/other"}).close(
        now, confirmed=True
    )
    assert os.listdir(tmp_path) == ["truck.json"]
    silent = StateKeeper(config, clock, never, {})
    assert silent.load() is None
    await silent.close(now, confirmed=True)


def _deep(path: Path) -> None:
    path.write_text("[" * 60_000)


def _huge_integer(path: Path) -> None:
    path.write_text('{"utc_s": 1' + "0" * 60_000 + "}")


def _with(**values: object) -> Callable[[Path], None]:
    """A sound state but for these."""

    def write(path: Path) -> None:
        state = SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.7, 0.05)
        path.write_text(json.dumps({**asdict(state), **values}))

    return write


def _link_to_itself(path: Path) -> None:
    path.symlink_to(path)


DAMAGED: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_text('{"utc_s": 1795217587.1, "posi'),
    "deep": _deep,
    "huge integer": _huge_integer,
    "huge": lambda path: path.write_bytes(b"0" * (MOST_BYTES + 1)),
    "not UTF-8": lambda path: path.write_bytes(b"\xff\xfe{}"),
    "directory": Path.mkdir,
    "pipe": os.mkfifo,
    "link to itself": _link_to_itself,
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "another layout": _with(version=2),
    "a field too many": _with(speed=1.0),
    "negative sigma": _with(sd_position_m=-1.0),
    "heading sigma of nothing": _with(sd_yaw_rad=0.0),
    "infinite sigma": _with(sd_position_m=math.inf),
    "no number": _with(yaw_rad=math.nan),
    "longitude of a million": _with(position=(0.5, 1e6, 0.0)),
    "position as text": _with(position="123"),
    "number as text": _with(yaw_rad="0.7"),
    "null": _with(position=None),
    "true": _with(sd_position_m=True),
}


@pytest.mark.parametrize("condition", DAMAGED)
async def test_a_state_that_cannot_be_read_is_put_aside_and_told(
    kept: Kept, condition: str
) -> None:
    DAMAGED[condition](kept.path)
    assert kept.keeper.load() is None
    assert [code for code, _ in kept.events] == ["saved_state_damaged"]
    assert os.listdir(kept.path.parent) == ["state.json.bad"]
    # The next start does not meet it again, and the place is free for what it keeps.
    again = Kept(kept.path)
    assert again.keeper.load() is None
    assert again.events == []
    await again.tick(0.0, 0.0)
    assert Kept(kept.path).keeper.load() is not None


async def test_a_folder_in_its_place_gives_way_though_a_file_was_put_aside_before(
    kept: Kept,
) -> None:
    kept.path.write_text("{")
    assert kept.keeper.load() is None
    kept.path.mkdir()
    again = Kept(kept.path)
    assert again.keeper.load() is None
    assert [code for code, _ in again.events] == ["saved_state_damaged"]
    await again.tick(0.0, 0.0)
    assert Kept(kept.path).keeper.load() is not None


def test_what_cannot_be_put_aside_stays_and_is_told(kept: Kept) -> None:
    kept.path.write_text("{")
    Path(f"{kept.path}.bad").mkdir()
    assert kept.keeper.load() is None
    [(code, text)] = kept.events
    assert code == "saved_state_damaged"
    assert "it stays" in text


@pytest.mark.parametrize(
    ("age_s", "words"),
    [(-3600.0, "ahead of this computer's clock"), (2.0 * 86400.0, "s old (limit 86400 s)")],
)
def test_a_state_of_the_wrong_time_is_refused_and_stays(
    kept: Kept, age_s: float, words: str
) -> None:
    save_state(kept.path, SavedState(time.time() - age_s, (0.53, 1.99, 38.0), 3.0, 0.7, 0.05))
    assert kept.keeper.load() is None
    [(code, text)] = kept.events
    assert code == "saved_state_refused"
    assert words in text
    assert kept.path.exists()


def test_the_layout_of_before_is_read_and_its_heading_never_taken_for_better(kept: Kept) -> None:
    state = asdict(SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.7, 0.001))
    del state["version"]
    kept.path.write_text(json.dumps(state))
    read = kept.keeper.load()
    assert read is not None
    assert (read.yaw_rad, read.sd_yaw_rad) == (0.7, SAVED_HEADING_SD_RAD)


def test_a_write_cut_short_at_any_byte_leaves_a_state_or_none(kept: Kept) -> None:
    """As a disk may leave it that does not keep the order of writing and renaming."""
    state = SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.7, 0.05)
    save_state(kept.path, state)
    whole = kept.path.read_bytes()
    for length in range(len(whole)):
        kept.path.write_bytes(whole[:length])
        with pytest.raises(DamagedStateError):
            load_state(kept.path, state.utc_s, 60.0)
    kept.path.write_bytes(whole)
    assert load_state(kept.path, state.utc_s, 60.0) == state


def test_a_bit_turned_anywhere_is_noticed(kept: Kept) -> None:
    """Of a heading, too, that would be as possible as the one that was written."""
    state = SavedState(time.time(), (0.53, 1.99, 38.0), 3.0, 0.7, 0.05)
    save_state(kept.path, state)
    whole = kept.path.read_bytes()
    for bit in range(8 * len(whole)):
        turned = bytearray(whole)
        turned[bit // 8] ^= 1 << bit % 8
        kept.path.write_bytes(turned)
        with pytest.raises(DamagedStateError):
            load_state(kept.path, state.utc_s, 60.0)


@given(st.one_of(st.binary(max_size=300), st.from_type(dict).map(repr).map(str.encode)))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_bytes_end_the_start(kept: Kept, content: bytes) -> None:
    kept.path.write_bytes(content)
    assert kept.keeper.load() is None
    assert kept.events.pop()[0] == "saved_state_damaged"


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from([f.name for f in fields(SavedState)]), JSON))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_a_field_holds_a_state_that_is_taken_is_possible(
    kept: Kept, values: dict[str, object]
) -> None:
    kept.events.clear()
    _with(**values)(kept.path)
    state = kept.keeper.load()
    if state is None:
        assert kept.events[0][0] in ("saved_state_damaged", "saved_state_refused")
        return
    lat, lon, height = state.position
    assert max(abs(lat) / (math.pi / 2), abs(lon) / math.pi, abs(height) / 1e5) <= 1.0
    assert 0.0 < state.sd_position_m < math.inf
    assert SAVED_HEADING_SD_RAD <= state.sd_yaw_rad <= 2.0 * math.pi
