"""What this process consumes, and what it need not hold."""

from __future__ import annotations

import ctypes
import os
import time


class ProcessUsage:
    """CPU and memory of this process: `sample()` gives percent of one core since the last call
    and resident memory in MB (10^6 bytes)."""

    def __init__(self) -> None:
        self._page_bytes = os.sysconf("SC_PAGESIZE")
        self._wall_ns = time.monotonic_ns()
        self._cpu_ns = time.process_time_ns()

    def sample(self) -> tuple[float, float]:
        wall_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
        percent = 100.0 * (cpu_ns - self._cpu_ns) / max(1, wall_ns - self._wall_ns)
        self._wall_ns, self._cpu_ns = wall_ns, cpu_ns
        with open("/proc/self/statm", encoding="ascii") as statm:
            resident_pages = int(statm.read().split()[1])
        return percent, resident_pages * self._page_bytes / 1e6


_MADV_DONTNEED = 4


def release_compiler_pages() -> None:
    """Let go of LLVM's code, 50 MB resident once it has loaded the kernels and is called no more.

    madvise(2), MADV_DONTNEED: pages of an executable mapping are clean copies of the library's
    file; should LLVM run again, they are read again.
    """
    libc = ctypes.CDLL(None)
    with open("/proc/self/maps", encoding="utf-8") as maps:
        mappings = [line.split(maxsplit=5) for line in maps]
    for fields in mappings:
        if fields[1] == "r-xp" and "libllvmlite" in fields[-1]:
            start, end = (int(address, 16) for address in fields[0].split("-"))
            libc.madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _MADV_DONTNEED)
