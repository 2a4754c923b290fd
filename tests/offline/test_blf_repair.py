"""Binary logs of Vector: damage costs what it hit, and what came before the trigger is early."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import can
import pytest

from tests.offline.can_files import read, same, written
from tests.offline.recorded_bus import bus


def containers(path: Path) -> list[tuple[int, int]]:
    """Where each begins and ends."""
    data, at, found = path.read_bytes(), 144, []
    while at < len(data):
        size = struct.unpack_from("<L", data, at + 8)[0]
        found.append((at, at + size + size % 4))
        at = found[-1][1]
    return found


@pytest.fixture
def long_blf(tmp_path: Path) -> tuple[Path, list[can.Message]]:
    """Several containers, objects that go on from one to the next."""
    frames = list(bus(90))
    return written(tmp_path / "bus.blf", frames), frames


def test_blf_as_it_is(long_blf: tuple[Path, list[can.Message]]) -> None:
    path, frames = long_blf
    assert len(containers(path)) > 3
    found, refused, told = read(path)
    same(found, frames)
    assert refused.all() == []
    assert told == ["the date of a BLF log has no zone: taken as UTC"]


def test_frames_before_the_trigger_are_before_the_beginning(
    long_blf: tuple[Path, list[can.Message]],
) -> None:
    path, frames = long_blf
    header = bytearray(path.read_bytes())
    begin, end = containers(path)[0]
    content = bytearray(zlib.decompress(header[begin + 32 : end]))
    at = content.find(b"LOBJ")
    early = 0
    while 0 <= at < len(content) - 48 and early < 40:
        (ns,) = struct.unpack_from("<Q", content, at + 24)
        struct.pack_into("<q", content, at + 24, ns - 3 * 10**9)
        early += 1
        at = content.find(b"LOBJ", at + 4)
    packed = zlib.compress(bytes(content))
    size = 32 + len(packed)
    head = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, size, 10, 2, len(content))
    path.write_bytes(header[:begin] + head + packed + bytes(size % 4) + header[end:])
    found, refused, _ = read(path)
    assert refused.all() == []
    assert len(found) == len(frames)
    moved = [f.timestamp - m.timestamp for f, m in zip(found, frames, strict=True)]
    assert moved[1:40] == pytest.approx([-3.0] * 39, abs=1e-5)
    assert moved[40:] == pytest.approx([0.0] * len(moved[40:]), abs=1e-5)


@pytest.mark.parametrize("damage", ["zeros", "a byte", "cut out", "the signature"])
def test_a_damaged_container_costs_itself(
    damage: str, long_blf: tuple[Path, list[can.Message]]
) -> None:
    path, frames = long_blf
    data = bytearray(path.read_bytes())
    begin, end = containers(path)[1]
    if damage == "zeros":
        data[begin:end] = bytes(end - begin)
    elif damage == "a byte":
        data[begin + 1000] ^= 0x40
    elif damage == "cut out":
        del data[begin + 100 : begin + 5000]
    else:
        data[begin] = 0
    path.write_bytes(data)
    found, refused, _ = read(path)
    share = 1.0 / len(containers(written(path.with_name("whole.blf"), frames)))
    assert (1.0 - 1.2 * share) * len(frames) < len(found) < len(frames)
    assert 1 <= len(refused.all()) <= 2
    assert {each.reason for each in refused.all()} == {"unreadable"}
    stamps = {round(m.timestamp, 5) for m in frames}
    assert sum(round(m.timestamp, 5) in stamps for m in found) > 0.99 * len(found)
    assert found[-1].timestamp == pytest.approx(frames[-1].timestamp, abs=1e-5)


def test_blf_that_is_cut(long_blf: tuple[Path, list[can.Message]]) -> None:
    path, frames = long_blf
    path.write_bytes(path.read_bytes()[:-5000])
    found, refused, _ = read(path)
    assert 0.5 * len(frames) < len(found) < len(frames)
    same(found, frames[: len(found)])
    assert [each.reason for each in refused.all()] == ["cut"]
