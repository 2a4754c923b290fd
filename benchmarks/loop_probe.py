"""`fusiond run` with a probe in its event loop, which says what the loop did where it was late:

    python benchmarks/loop_probe.py OUT.jsonl run CONFIG

A turn of the loop is a wait and the callbacks after it. A turn whose callbacks take longer than
`LONG_MS`, and a wait that lasts so much longer than was asked, is a line of JSON:

* `at_s` since the process began, `wall_ms`, and which of both it was (`what`);
* `cpu_ms` of the loop's thread; `queue_ms`, in which it could have run and no processor was free
  (proc(5), schedstat); the rest, `blocked_ms`, it waited: for a disk, a page or another thread;
* `others_cpu_ms` of the process's other threads, which may have held the interpreter;
* `steal_ms`: in the last second or two the host had taken processors from this computer so long
  (proc(5), stat);
* `major`, `minor` faults of pages and `voluntary`, `involuntary` switches of the loop's thread;
* `gc_ms` and `gc`, collections by generation; `imported` modules, by name; `linked` kernels;
* `callbacks`: the three longest, ms.

The last line, when the daemon ends, has the processor's time by callback (`cpu_s`). Of a core the
probe itself takes some 1 %.
"""

from __future__ import annotations

import asyncio
import atexit
import gc
import json
import os
import resource
import selectors
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

LONG_MS = 8.0
"""A tick of 10 ms that follows is late by that."""
_MS = 1e-6


class Ledger:
    """What the process has used so far."""

    NAMES = (
        *("wall_ms", "cpu_ms", "queue_ms", "process_ms", "major", "minor"),
        *("voluntary", "involuntary", "gc_ms"),
    )

    def __init__(self, thread: int) -> None:
        self._schedstat = os.open(f"/proc/self/task/{thread}/schedstat", os.O_RDONLY)
        self._stat = os.open("/proc/stat", os.O_RDONLY)
        self._tick_ms = 1000.0 / os.sysconf("SC_CLK_TCK")
        self.gc_ns = 0

    def read(self) -> tuple[float, ...]:
        """As `NAMES` has them."""
        used = resource.getrusage(resource.RUSAGE_THREAD)
        waited_ns = int(os.pread(self._schedstat, 96, 0).split()[1])
        return (
            time.perf_counter_ns() * _MS,
            time.thread_time_ns() * _MS,
            waited_ns * _MS,
            time.process_time_ns() * _MS,
            used.ru_majflt,
            used.ru_minflt,
            used.ru_nvcsw,
            used.ru_nivcsw,
            self.gc_ns * _MS,
        )

    def steal_ms(self) -> float:
        """Of all processors, since the computer's start."""
        return int(os.pread(self._stat, 256, 0).split(b"\n", 1)[0].split()[8]) * self._tick_ms


def difference(before: tuple[float, ...], after: tuple[float, ...]) -> dict[str, Any]:
    """Of two readings, rounded."""
    spent = zip(Ledger.NAMES, before, after, strict=True)
    found: dict[str, Any] = {name: round(b - a, 1) for name, a, b in spent}
    found["others_cpu_ms"] = round(found.pop("process_ms") - found["cpu_ms"], 1)
    blocked_ms = found["wall_ms"] - found["cpu_ms"] - found["queue_ms"]
    found["blocked_ms"] = round(max(0.0, blocked_ms), 1)
    return found


class Probe:
    """In the loop of this thread, from its first turn on."""

    def __init__(self, out: Path) -> None:
        self._out = out.open("a", buffering=1)
        self._thread = threading.get_ident()
        self._ledger = Ledger(threading.get_native_id())
        self._before = self._ledger.read()
        self._begun_ms = self._before[0]
        self._steal = (self._begun_ms, self._ledger.steal_ms())
        self._longest: list[tuple[float, str]] = []
        self._collected: Counter[int] = Counter()
        self._collecting_ns = 0
        self._modules = set(sys.modules)
        self._linked = 0
        self._cpu_ns: Counter[str] = Counter()
        self._calls: Counter[str] = Counter()

    def install(self) -> None:
        """Into asyncio, whose handles and waits it times; no part of fusiond knows of it."""
        run, select = asyncio.events.Handle._run, selectors.EpollSelector.select
        mine = threading.get_ident

        def timed_run(handle: asyncio.Handle) -> None:
            if mine() != self._thread:
                run(handle)
                return
            name = _name_of(handle)
            start_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
            run(handle)
            self._cpu_ns[name] += time.thread_time_ns() - cpu_ns
            self._calls[name] += 1
            self._longest.append(((time.perf_counter_ns() - start_ns) * _MS, name))

        def timed_select(selector: selectors.EpollSelector, timeout: float | None = None) -> Any:
            if mine() != self._thread:
                return select(selector, timeout)
            begun = self._ledger.read()
            self._tell("callbacks", self._before, begun, LONG_MS)
            events = select(selector, timeout)
            self._before = self._ledger.read()
            if not events and timeout is not None:
                self._tell("wait", begun, self._before, 1000.0 * timeout + LONG_MS)
            self._longest.clear()
            return events

        setattr(asyncio.events.Handle, "_run", timed_run)  # noqa: B010
        setattr(selectors.EpollSelector, "select", timed_select)  # noqa: B010
        gc.callbacks.append(self._on_collection)
        atexit.register(self._end)

    def _on_collection(self, phase: str, about: dict[str, int]) -> None:
        if phase == "start":
            self._collecting_ns = time.perf_counter_ns()
            return
        self._ledger.gc_ns += time.perf_counter_ns() - self._collecting_ns
        self._collected[about["generation"]] += 1

    def _tell(
        self, what: str, before: tuple[float, ...], after: tuple[float, ...], limit_ms: float
    ) -> None:
        if after[0] - self._steal[0] > 1000.0 or after[0] - before[0] > limit_ms:
            steal, self._steal = self._steal, (after[0], self._ledger.steal_ms())
        if after[0] - before[0] > limit_ms:
            modules, linked = set(sys.modules), _kernels_linked()
            longest = sorted(self._longest, reverse=True)[:3]
            self._say(
                {
                    "at_s": round((after[0] - self._begun_ms) * 1e-3, 2),
                    "what": what,
                    **difference(before, after),
                    "steal_ms": self._steal[1] - steal[1],
                    "gc": dict(self._collected),
                    "imported": sorted(modules - self._modules),
                    "linked": linked - self._linked,
                    "callbacks": [(name, round(ms, 1)) for ms, name in longest],
                }
            )
            self._modules, self._linked = modules, linked
        self._collected.clear()

    def _say(self, line: dict[str, Any]) -> None:
        self._out.write(json.dumps(line) + "\n")

    def _end(self) -> None:
        most = self._cpu_ns.most_common(25)
        cpu_s = {name: [round(ns * 1e-9, 3), self._calls[name]] for name, ns in most}
        self._say({"what": "ended", "cpu_s": cpu_s, "process_s": round(time.process_time(), 2)})


def _name_of(handle: asyncio.Handle) -> str:
    """A task's name, or the function's."""
    call: Callable[..., Any] = handle._callback  # type: ignore[attr-defined]
    owner = getattr(call, "__self__", None)
    if isinstance(owner, asyncio.Task):
        return str(owner.get_name())
    call = getattr(call, "func", call)
    return str(getattr(call, "__qualname__", call))


def _kernels_linked() -> int:
    """How many kernels wait no longer for their first call."""
    compiled = sys.modules.get("fusiond.navigation.compiled")
    return 0 if compiled is None else -len(vars(compiled)["waiting"])


def main() -> None:
    out = Path(sys.argv[1])
    Probe(out).install()
    from fusiond.live.__main__ import main as daemon  # noqa: PLC0415 - timed too

    daemon(Path(sys.argv[3]))


if __name__ == "__main__":
    main()
