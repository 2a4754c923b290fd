"""Pool of warm worker processes that survives the failure of any run.

Each worker is a new interpreter (a fork would copy threads and locks) that loads the kernels once,
has one thread for linear algebra, and is used again. It answers item by item: a worker that dies,
or is killed because an item takes too long, costs this one item, and the others of its chunk go to
another worker.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from fusiond.workers.process import STARTED, serve_items
from fusiond.workers.runner_interface import Ended, Outcome, R, T

ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""A worker has a processor for itself: threads of one would fight with the other workers."""
MOST_FALSE_STARTS = 3
"""Deaths in a row before the first item of a chunk: a machine on which nothing can be loaded."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    f"from {serve_items.__module__} import {serve_items.__name__}; "
    f"{serve_items.__name__}({{fd}})"
)


class PoolError(Exception):
    """Error: no worker can be started."""


def processor_count() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


class Pool:
    """Pool of up to `workers` processes, started on demand; an item may take `timeout_s`."""

    def __init__(self, workers: int, timeout_s: float | None = None) -> None:
        self.workers = workers
        self.timeout_s = timeout_s
        self._idle: list[_Worker] = []
        self._false_starts = 0

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._idle:
            self._idle.pop().kill()

    def outcomes(
        self, work: Callable[[T], R], items: Sequence[T], chunk: int = 1
    ) -> Iterator[Outcome[R]]:
        """Outcomes of `items`, as in `Runner`. Raises `PoolError`."""
        numbered = list(enumerate(items))
        waiting = deque(numbered[k : k + chunk] for k in range(0, len(numbered), chunk))
        busy: list[_Worker] = []
        try:
            while waiting or busy:
                while waiting and len(busy) < self.workers:
                    worker = self._idle.pop() if self._idle else _Worker(self.timeout_s)
                    busy.append(worker)
                    worker.give(work, waiting.popleft())
                ready = wait([w.connection for w in busy], _least_s(busy))
                for worker in list(busy):
                    outcome = worker.receive(worker.connection in ready)
                    if outcome is not None:
                        yield outcome
                    if worker.dead:
                        self._count_false_start(worker)
                    if worker.dead or not worker.todo:
                        busy.remove(worker)
                        if worker.todo:
                            waiting.appendleft(list(worker.todo))
                        if not worker.dead:
                            self._idle.append(worker)
        finally:
            for worker in busy:  # their answers would be taken for those of other items
                worker.kill()

    def _count_false_start(self, worker: _Worker) -> None:
        self._false_starts = 0 if worker.began else self._false_starts + 1
        if self._false_starts >= MOST_FALSE_STARTS:
            raise PoolError(f"{MOST_FALSE_STARTS} workers in a row ended before their first run")


def _least_s(busy: Sequence[_Worker]) -> float | None:
    """Time (s) until the first running item is overdue."""
    deadlines = [w.deadline_s for w in busy if w.deadline_s is not None]
    return max(0.0, min(deadlines) - time.monotonic()) if deadlines else None


class _Worker:
    """Worker process; `todo`: items without a result."""

    def __init__(self, timeout_s: float | None) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            fd = theirs.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START.format(path=sys.path, fd=fd)],
                env=os.environ | ONE_THREAD,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(fd,),
            )
        self.connection = Connection(ours.detach())
        self._timeout_s = timeout_s
        self.deadline_s: float | None = None
        self.todo: deque[tuple[int, Any]] = deque()
        self.began = self.dead = False

    def give(self, work: Callable[[Any], Any], items: Sequence[tuple[int, Any]]) -> None:
        self.todo, self.began = deque(items), False
        try:
            self.connection.send_bytes(pickle.dumps((work, items)))
        except OSError:  # it has died since its last answer: `receive` will find out
            return

    def receive(self, ready: bool) -> Outcome[Any] | None:
        """Receive the outcome of the first item, if complete."""
        if not ready:
            if self.deadline_s is None or time.monotonic() < self.deadline_s:
                return None
            return self._lost("timeout", f"no end after {self._timeout_s:g} s")
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            return self._lost("died", "")
        if self._timeout_s is not None:
            self.deadline_s = time.monotonic() + self._timeout_s
        if answer == STARTED:
            self.began = True
            return None
        self.todo.popleft()
        if not self.todo:
            self.deadline_s = None
        return Outcome(*answer)

    def _lost(self, ended: Ended, reason: str) -> Outcome[Any] | None:
        self.dead = True
        if ended == "died":
            reason = _ending(self._process.wait())
        self.kill()
        if not self.began:  # not the item's fault: another worker will have it
            return None
        index, _ = self.todo.popleft()
        return Outcome(index, ended, reason)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self.connection.close()


def _ending(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"the process ended with exit code {code}"
    return f"the process was ended by {signal.Signals(-code).name}"
