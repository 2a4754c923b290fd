"""Forked child processes that run jobs for their side effects, then end.

A job has its caller's memory, and its own memory is freed when its child ends. One child forks the
others and reports the number of finished jobs through a pipe, so that the caller can wait in an
event loop and never forks in it. Children work in parallel, each on one job; one with more than its
share of memory is replaced. A job whose child dies is given to a child alone, once more; a second
failure is left to the caller, who can report the reason.

Children run with normal priority, and the kernel ends them before the caller where memory runs out.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import select
import signal
import socket
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NoReturn

Job = Callable[[], object]

# Children side by side, where there are as many processors.
MOST_CHILDREN = 2
# What a child may hold of its own after a job, in bytes. The first job copies 20 MB of what is
# shared, the largest kernels take 100 MB: two such children, the first one and the caller have been
# seen to take 297 MB (sum of PSS).
SHARE = 45_000_000
# Available memory (bytes) below which one works alone: what two take, and as much for others.
FOR_TWO = 600_000_000
MEMORY = Path("/proc/meminfo")
_PR_SET_PDEATHSIG = 1
_DONE, _LAST = b".", b"!"


class ForkedJobs:
    """Jobs that run in child processes; iteration gives the number of finished ones, to the end.
    `prepare` runs once, before all jobs, in their common parent."""

    def __init__(
        self, jobs: Sequence[Job], prepare: Job = lambda: None, share: int = SHARE
    ) -> None:
        self.total = len(jobs)
        self.done = 0
        self._read, write = os.pipe()
        self._pid = _fork(lambda: _Jobs(jobs, share, write).work(prepare))
        os.close(write)

    def __enter__(self) -> ForkedJobs:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end()

    def __iter__(self) -> Iterator[int]:
        while self.read():
            yield self.done

    def fileno(self) -> int:
        """Descriptor that is readable when a result is available."""
        return self._read

    def read(self) -> bool:
        """Wait until another job is finished; False after the end of all."""
        news = os.read(self._read, 1)
        self.done += len(news)
        return bool(news)

    def end(self) -> None:
        """End the children, also in the middle of a job."""
        if self._pid:
            with suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGTERM)
            os.waitpid(self._pid, 0)
            os.close(self._read)
            self._pid = 0


class _Child:
    """Child process and its job."""

    def __init__(self, jobs: Sequence[Job], share: int) -> None:
        self.connection, theirs = socket.socketpair()
        self.job: int | None = None
        self._pid = _fork(lambda: _work(jobs, share, theirs))
        theirs.close()

    def fileno(self) -> int:
        return self.connection.fileno()

    def give(self, job: int) -> None:
        self.job = job
        with suppress(OSError):  # it died: its end is read
            self.connection.send(job.to_bytes(4, "big"))

    def end(self) -> None:
        with suppress(OSError):  # later children have a copy of it: to close it would not do
            self.connection.shutdown(socket.SHUT_RDWR)
        self.connection.close()
        os.waitpid(self._pid, 0)


class _Jobs:
    """The first child: hands out jobs, in their order."""

    def __init__(self, jobs: Sequence[Job], share: int, done_pipe: int) -> None:
        self._jobs, self._share, self._done_pipe = jobs, share, done_pipe
        self._waiting = deque(range(len(jobs)))
        self._alone: deque[int] = deque()

    def work(self, prepare: Job) -> None:
        """Run all jobs."""
        prepare()
        gc.freeze()  # a collection in a child would copy what they share
        most = 1 if _available_bytes() < FOR_TWO else MOST_CHILDREN
        self._hand_out(self._waiting, min(most, len(os.sched_getaffinity(0))))
        self._hand_out(self._alone, 1)

    def _hand_out(self, waiting: deque[int], most: int) -> None:
        children: list[_Child] = []
        while waiting or children:
            while waiting and len(children) < most:
                child = _Child(self._jobs, self._share)
                child.give(waiting.popleft())
                children.append(child)
            ready, _, _ = select.select(children, [], [])
            for child in ready:
                answer = child.connection.recv(1)
                if not answer and waiting is not self._alone and child.job is not None:
                    self._alone.append(child.job)
                elif answer:
                    os.write(self._done_pipe, b".")
                if answer == _DONE and waiting:
                    child.give(waiting.popleft())
                else:
                    children.remove(child)
                    child.end()


def _work(jobs: Sequence[Job], share: int, connection: socket.socket) -> None:
    """Run, in a child, the jobs that it is given until it holds too much memory."""
    while number := connection.recv(4):
        jobs[int.from_bytes(number, "big")]()
        connection.send(_LAST if _own_bytes() > share else _DONE)


def _available_bytes() -> float:
    """Memory available without swapping (proc(5), MemAvailable); infinite where the kernel does not
    state it."""
    try:
        lines = MEMORY.read_text(encoding="ascii").splitlines()
    except OSError:
        return math.inf
    found = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return found[0] * 1024 if found else math.inf


def _own_bytes() -> int:
    """Private memory of this process (proc(5), smaps_rollup); 0 where the kernel hides it."""
    try:
        lines = Path("/proc/self/smaps_rollup").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) * 1024


def _fork(work: Callable[[], None]) -> int:
    """Fork a child that does `work` and return its pid. The child also ends with its parent."""
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    pid = os.fork()
    if pid == 0:
        _child(work, parent)
    return pid


def _child(work: Callable[[], None], parent: int) -> NoReturn:
    status = 1
    try:
        signal.set_wakeup_fd(-1)  # signals of ours are not our parent's
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever started us
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() == parent:
            _step_back()
            work()
            status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _step_back() -> None:
    """Give up a priority or an OOM score that is better than normal."""
    with suppress(OSError):
        if os.getpriority(os.PRIO_PROCESS, 0) < 0:
            os.setpriority(os.PRIO_PROCESS, 0, 0)
    badness = Path("/proc/self/oom_score_adj")
    with suppress(OSError, ValueError):
        if int(badness.read_text(encoding="ascii")) < 0:
            badness.write_text("0", encoding="ascii")
