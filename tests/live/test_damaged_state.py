"""The state on disk is read back whatever lies there, or put aside and told of."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusiond.navigator.saved_state import (
    SAVED_HEADING_SD_RAD,
    SavedState,
    load_state,
    save_state,
)
from fusiond.navigator.state_file import MOST_BYTES, DamagedStateError
from tests.live.kept_state import Kept


@pytest.fixture
def kept(tmp_path: Path) -> Kept:
    return Kept(tmp_path / "state.json")


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
