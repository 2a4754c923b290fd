"""Resources of this process, and memory that it can release."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path

STATM, MAPS = Path("/proc/self/statm"), Path("/proc/self/maps")


class ProcessUsage:
    """CPU and memory of this process: `sample()` gives percent of one core since the last call
    and resident memory in MB (10^6 bytes), None where the kernel does not show it."""

    def __init__(self) -> None:
        self._page_bytes = os.sysconf("SC_PAGESIZE")
        self._wall_ns = time.monotonic_ns()
        self._cpu_ns = time.process_time_ns()

    def sample(self) -> tuple[float, float | None]:
        wall_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
        percent = 100.0 * (cpu_ns - self._cpu_ns) / max(1, wall_ns - self._wall_ns)
        self._wall_ns, self._cpu_ns = wall_ns, cpu_ns
        try:
            resident_pages = int(STATM.read_text(encoding="ascii").split()[1])
        except (OSError, ValueError, IndexError):  # no /proc, none that may be read, none like it
            return percent, None
        return percent, resident_pages * self._page_bytes / 1e6


_MADV_DONTNEED = 4


def release_compiler_pages() -> None:
    """Let go of LLVM's code, 50 MB resident once it has loaded the kernels and is called no more.

    madvise(2), MADV_DONTNEED: pages of an executable mapping are clean copies of the library's
    file; should LLVM run again, they are read again.
    """
    libc = ctypes.CDLL(None)
    try:
        lines = MAPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # the pages stay
        return
    mappings = [line.split(maxsplit=5) for line in lines]
    for fields in mappings:
        if fields[1] == "r-xp" and "libllvmlite" in fields[-1]:
            start, end = (int(address, 16) for address in fields[0].split("-"))
            libc.madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _MADV_DONTNEED)
