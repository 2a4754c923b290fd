"""MF4 in a process of its own: what that raises, and how it dies, ends the log and nothing else."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
from pathlib import Path

import can
import pytest

from drivers.can.python_can_import import with_mf4
from fusiond.offline.mf4_frames import Mf4Error, frames
from tests.offline.can_files import read, same, written


def test_every_kind_of_frame_comes_through(tmp_path: Path) -> None:
    with_mf4()
    kinds = [
        can.Message(timestamp=1e9, arbitration_id=0x18FEF100, data=b"\1\2", channel=3),
        can.Message(timestamp=1e9 + 1, arbitration_id=5, is_extended_id=False, channel=1),
        can.Message(timestamp=1e9 + 2, arbitration_id=5, is_fd=True, data=bytes(64), channel=1),
    ]
    found = list(frames(written(tmp_path / "bus.mf4", kinds)))
    same(found, kinds)
    assert [m.is_fd for m in found] == [False, False, True]
    expected = [m.channel for m in can.MF4Reader(tmp_path / "bus.mf4")]
    assert [m.channel for m in found] == expected


@pytest.mark.parametrize(
    ("does", "count", "words"),
    [
        ("kill -SEGV $$", 0, "dies of it"),
        ("cat FRAMES; kill -SEGV $$", 2, "dies of it"),
        ("head -c 20 FRAMES", 0, "dies of it"),
        ("exit 1", 0, "dies of it"),
    ],
)
def test_a_reader_that_dies_ends_the_log(
    does: str, count: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = b"M" + struct.pack("<dqBqBB", 1.5, 0x7E8, 0, 0, 2, 2) + b"\1\2"
    (tmp_path / "frames").write_bytes(record * 2)
    script = tmp_path / "python"
    script.write_text(f"#!/bin/sh\n{does.replace('FRAMES', str(tmp_path / 'frames'))}\n")
    script.chmod(0o755)
    path = tmp_path / "bus.mf4"
    path.write_bytes(b"MDF     ")
    monkeypatch.setattr(sys, "executable", str(script))
    found: list[can.Message] = []
    with pytest.raises(Mf4Error, match=words):
        found.extend(frames(path))
    if count:
        messages, refused, _ = read(path)
        assert [(m.arbitration_id, bytes(m.data)) for m in messages] == [(0x7E8, b"\1\2")] * count
        assert [each.reason for each in refused.all()] == ["cut"]


def test_one_that_never_ends_is_ended() -> None:
    does = "import fusiond.offline.mf4_frames as m; m._CPU_S = 3; m._limit_to(0)\nwhile True: pass"
    done = subprocess.run([sys.executable, "-c", does], check=False, timeout=600)
    assert done.returncode in (-signal.SIGXCPU, -signal.SIGKILL)
