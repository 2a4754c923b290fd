"""Disks and folders that are not as they should be: full in the middle of a chunk, read-only, with
links in them. A recording ends by its own name, and what was synced reads back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fusiond.recording.edit import recover
from fusiond.recording.log_writer import logs_of
from fusiond.recording.reader import Log
from tests.patience import until
from tests.recording.test_hostile_logs import ABOUT
from tests.recording.test_recorder import Bench
from tests.unprivileged import as_a_user_without_rights

FULL = """
import json, random, resource, shutil, subprocess, sys
from pathlib import Path
from fusiond.recording.channels import CHANNELS
from fusiond.recording.mcap_writer import About, LogFile

folder, about, limits, kind = Path(sys.argv[1]), *map(json.loads, sys.argv[2:4]), sys.argv[4]
disk = folder / "disk"
disk.mkdir()
told = {}
for most in limits:
    random.seed(1)
    path = disk / f"{most}.mcap"
    if kind == "disk":
        size = f"size={most // 4096 * 4096}"
        subprocess.run(["mount", "-t", "tmpfs", "-o", size, "full", disk], check=True)
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    synced = why = 0
    try:
        file = LogFile(path, About(about), 1)
        for k in range(10_000):
            data = json.dumps({"k": k, "text": random.randbytes(400).hex()}).encode()
            file.write(CHANNELS["/event"], k, data)
            if k % 25 == 24:
                file.sync()
                synced = k + 1
    except OSError as error:
        why = error.strerror
        file.abandon()
    told[path.name] = [synced, why]
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    shutil.copy(path, folder)
    if kind == "disk":
        subprocess.run(["umount", disk], check=True)
print(json.dumps(told))
"""
LIMITS = [*range(30_000, 60_000, 1_777), 150_000, 200_001, 400_000, 1_200_000]
"""Bytes a file may have, at all places of a chunk of 25 messages (11 kB) and beyond the buffer."""
MOUNTS = ("unshare", "--mount", *(() if os.geteuid() == 0 else ("--user", "--map-root-user")))
"""unshare(1): what is mounted goes with the process."""


@pytest.mark.parametrize(
    ("kind", "reason"), [("limit", "File too large"), ("disk", "No space left on device")]
)
def test_a_file_that_may_grow_no_more_is_read_up_to_what_was_synced(
    tmp_path: Path, kind: str, reason: str
) -> None:
    """A limit of the file's size, and a disk (tmpfs) that is full: a write fails in part, then with
    an error, in the middle of a chunk."""
    command = (sys.executable, "-c", FULL, tmp_path, json.dumps(ABOUT), json.dumps(LIMITS), kind)
    within = MOUNTS if kind == "disk" else ()
    done = subprocess.run((*within, *command), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert len(told) == len(LIMITS)
    cut = 0
    for name, (synced, why) in told.items():
        assert why == reason
        assert synced > 0
        log = Log([tmp_path / name])
        found = [message.json()["k"] for message in log.messages()]
        assert found == list(range(len(found)))
        assert len(found) >= synced
        cut += any("cut off" in text for text in log.problems)
        recover(tmp_path / name, tmp_path / "mended.mcap")
        mended = Log([tmp_path / "mended.mcap"])
        assert [m.json()["k"] for m in mended.messages()] == found
        assert mended.problems == []
        (tmp_path / "mended.mcap").unlink()
    assert cut > len(LIMITS) / 2  # in the middle of something


async def test_a_user_who_may_not_write_there_records_nothing_and_says_why() -> None:
    with as_a_user_without_rights() as folder:
        logs = folder / "logs"
        logs.mkdir()
        logs.chmod(0o555)
        bench = Bench(logs)
        bench.recorder.arm({})

        def failed() -> bool:
            bench.tick()
            return bench.recorder.recording.state == "failed"

        await until(failed)
        codes = [code for code, _ in bench.events]
        assert codes[-1] == "recording_failed"
        assert "Permission denied" in bench.events[-1][1]
        assert list(logs.iterdir()) == []
        bench.recorder.close()


@pytest.mark.parametrize("what", ["a link", "a folder"])
async def test_foreign_files_are_neither_counted_nor_removed(tmp_path: Path, what: str) -> None:
    """By the form of its name a log, and the oldest of all: a link to somebody's gigabytes."""
    elsewhere = tmp_path / "somebodys.mcap"
    elsewhere.write_bytes(bytes(5_000_000))
    logs = tmp_path / "logs"
    logs.mkdir()
    named = logs / "test_20200101T000000Z_0123abcd_0000.mcap"
    if what == "a link":
        named.symlink_to(elsewhere)
    else:
        named.mkdir()
    bench = Bench(logs, keep_mb=1.0, split_mb=1.0)
    bench.recorder.arm({})
    bench.tick(100)
    bench.recorder.close()
    (kept,) = logs_of(logs, "test")
    assert kept != named
    assert named.is_symlink() == (what == "a link")
    assert named.exists()
    assert elsewhere.stat().st_size == 5_000_000


async def test_a_link_to_the_folder_is_the_folder(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "logs").symlink_to(tmp_path / "disk")
    bench = Bench(tmp_path / "logs")
    bench.recorder.arm({})
    bench.tick(10)
    bench.recorder.close()
    assert [path.parent for path in (tmp_path / "disk").iterdir()] == [tmp_path / "disk"]
    assert len(bench.ticks()) == 10


async def test_a_link_that_leads_nowhere_is_told(tmp_path: Path) -> None:
    (tmp_path / "logs").symlink_to(tmp_path / "unplugged")
    bench = Bench(tmp_path / "logs")
    bench.recorder.arm({})

    def failed() -> bool:
        bench.tick()
        return bench.recorder.recording.state == "failed"

    await until(failed)
    assert "File exists" in bench.events[-1][1]
    bench.recorder.close()
