"""Jobs in forked children: done once each, elsewhere; what dies is left to the caller."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from fusiond.workers import forked
from fusiond.workers.forked import ForkedJobs
from tests.patience import PATIENCE_S


def _noted(folder: Path, job: int) -> None:
    with (folder / f"{job}").open("a") as file:
        file.write(f"{os.getpid()} ")


def _noted_heavily(folder: Path, job: int, held: list[bytearray]) -> None:
    _noted(folder, job)
    held.append(bytearray(b"x" * 3_000_000))


def _dies(folder: Path, job: int) -> None:
    _noted(folder, job)
    os.kill(os.getpid(), signal.SIGKILL)


def _raises() -> None:
    raise ValueError("a mistake")


def _dies_once(folder: Path, job: int) -> None:
    once = folder / "once"
    if not once.exists():
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    _noted(folder, job)


def _pids(folder: Path, jobs: int) -> list[int]:
    return [int(pid) for k in range(jobs) for pid in (folder / f"{k}").read_text().split()]


def _jobs(folder: Path, count: int) -> list[Callable[[], None]]:
    return [partial(_noted, folder, k) for k in range(count)]


def test_each_job_is_done_once_elsewhere_and_counted(tmp_path: Path) -> None:
    with ForkedJobs(_jobs(tmp_path, 50)) as work:
        counts = list(work)
    assert counts[-1] == work.total == 50
    assert counts == sorted(counts)
    pids = _pids(tmp_path, 50)
    assert len(pids) == 50
    assert os.getpid() not in pids
    assert len(set(pids)) <= forked.MOST_CHILDREN
    assert not any(_lives(pid) for pid in set(pids))


def test_a_child_that_holds_its_share_is_followed_by_another(tmp_path: Path) -> None:
    held: list[bytearray] = []
    share = 10_000_000
    work = ForkedJobs([partial(_noted_heavily, tmp_path, k, held) for k in range(16)], share=share)
    assert list(work)[-1] == 16
    work.end()
    pids = _pids(tmp_path, 16)
    assert all(pids.count(pid) <= share / 3_000_000 + 1 for pid in pids)
    assert held == []


def test_a_job_that_kills_its_child_is_tried_twice_and_left(tmp_path: Path) -> None:
    jobs = _jobs(tmp_path, 6)
    jobs[2] = partial(_dies, tmp_path, 2)
    with ForkedJobs(jobs) as work:
        assert list(work)[-1] == 5
    assert len(_pids(tmp_path, 6)) == 7


def test_a_job_that_dies_once_is_done(tmp_path: Path) -> None:
    jobs = _jobs(tmp_path, 6)
    jobs[0] = partial(_dies_once, tmp_path, 0)
    with ForkedJobs(jobs) as work:
        assert list(work)[-1] == 6


def test_a_job_that_raises_says_why(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with ForkedJobs([_raises, *_jobs(tmp_path, 2)]) as work:
        assert list(work)[-1] == 2
    assert "ValueError: a mistake" in capfd.readouterr().err


def test_a_forked_job_can_be_awaited_and_cancelled(tmp_path: Path) -> None:
    def endless() -> None:
        _noted(tmp_path, 1)
        signal.pause()

    with ForkedJobs([*_jobs(tmp_path, 1), endless]) as work:
        assert select.select([work], [], [], PATIENCE_S)[0]
        assert work.read()
        assert work.done == 1
        _until((tmp_path / "1").exists)
        _until(lambda: (tmp_path / "1").read_text() != "")
        (pid,) = (int(word) for word in (tmp_path / "1").read_text().split())
        assert _lives(pid)
    _until(lambda: not _lives(pid))


def _until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_children_step_back_to_normal_priority(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_to: list[tuple[int, int, int]] = []
    monkeypatch.setattr(forked.os, "getpriority", lambda which, who: -10)
    monkeypatch.setattr(forked.os, "setpriority", lambda *given: set_to.append(given))

    def told() -> None:
        (tmp_path / "set").write_text(repr(set_to[-1]))

    with ForkedJobs([told]) as work:
        assert list(work) == [1]
    assert (tmp_path / "set").read_text() == repr((os.PRIO_PROCESS, 0, 0))


def test_one_child_works_where_memory_is_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "MEMORY", tmp_path / "meminfo")
    for told in ("MemTotal: 512000 kB\nMemAvailable: 400000 kB\n", None):
        (tmp_path / "meminfo").unlink(missing_ok=True)
        if told is not None:
            (tmp_path / "meminfo").write_text(told)
        folder = tmp_path / str(told is None)
        folder.mkdir()
        with ForkedJobs([partial(_slow, folder, k) for k in range(8)]) as work:
            assert list(work)[-1] == 8
        processors = min(forked.MOST_CHILDREN, len(os.sched_getaffinity(0)))
        assert len(set(_pids(folder, 8))) == (1 if told else processors)


def _slow(folder: Path, job: int) -> None:
    _noted(folder, job)
    time.sleep(0.02)
