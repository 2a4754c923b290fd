"""Progress of compiling kernels, once after an installation or an update.

with compiling():
    from fusiond.live.daemon import run_daemon
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

from fusiond.commands.shared import can_draw, freeze_imports
from fusiond.workers.forked import ForkedJobs

# A line of a log every so often, where a terminal's is written anew at each kernel.
LINE_EVERY_S = 5.0


@contextmanager
def compiling() -> Iterator[set[int]]:
    """Show progress while an import compiles kernels. The garbage collector then ignores all that
    was loaded.

    Where the widths of covariances are known (`kernel_widths`) and put into the set that it gives,
    kernels of no other are compiled."""
    from fusiond.navigation.compiled import gathered, needed  # noqa: PLC0415 - numba

    widths: set[int] = set()
    with gathered() as missing:
        yield widths
        freeze_imports()
    if missing:
        compile_aside(needed(missing, widths or None), Progress(sys.stderr))


def compile_aside(missing: Sequence[Callable[[], None]], progress: Progress) -> None:
    """Compile kernels in child processes and link them here. Kernels that cannot be stored on disk
    are compiled in this process."""
    from fusiond.navigation.compiled import (  # noqa: PLC0415 - numba
        kernels_can_be_kept,
        load_compiler,
    )

    total = len(missing)
    progress(0, total)
    if kernels_can_be_kept():
        with ForkedJobs(missing, load_compiler) as compiling:
            for done in compiling:
                progress(done, total)
        for load in missing:
            load()
        if compiling.done < total:
            progress(total, total)
        return
    for done, load in enumerate(missing):
        load()
        progress(done + 1, total)


class Progress:
    """Progress of the compilation: one line on a terminal, some lines in a pipe or journal, STATUS=
    for systemd."""

    def __init__(self, out: TextIO) -> None:
        from fusiond.live.service_manager import ServiceManager  # noqa: PLC0415

        self._out = out
        self._draws = can_draw(out)
        self._service = ServiceManager()
        self._started_s = time.monotonic()
        self._reported_s = -LINE_EVERY_S

    def __call__(self, done: int, total: int) -> None:
        if not done:
            self._started_s = time.monotonic()
        text = f"compiling {done}/{total} kernels, once"
        self._service.status(text)
        spent_s = time.monotonic() - self._started_s
        if done == total:
            self._say(f"compiled {total} kernels in {spent_s:.0f} s", ends=True)
        elif self._draws or spent_s - self._reported_s >= LINE_EVERY_S:
            self._reported_s = spent_s
            self._say(text, ends=False)

    def _say(self, text: str, ends: bool) -> None:
        if self._draws:
            # Back to the line's begin, and without the rest of what stood there (ECMA-48, EL).
            print(f"\r{text}\x1b[K", end="\n" if ends else "", file=self._out, flush=True)
        else:
            print(text, file=self._out, flush=True)
