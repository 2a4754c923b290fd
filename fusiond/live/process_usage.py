"""Resources of this process, and memory that it can release."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterator
from pathlib import Path

from fusiond.navigation.kernel_cache import release_bitcode

STATM, SMAPS = Path("/proc/self/statm"), Path("/proc/self/smaps")


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
_M_ARENA_MAX = -8


def share_one_heap() -> None:
    """Let all threads allocate from one heap, before there are any: each of glibc's own keeps a
    megabyte and more for a thread that writes ten times a second (mallopt(3), M_ARENA_MAX)."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


def release_start_memory() -> None:
    """Let go of what the start alone needed: pages of libraries, among them LLVM's, 45 MB, once it
    has loaded the kernels and is called no more, and 13 MB of the others; bitcode, 7 MB; objects in
    cycles; freed memory, 1 MB.

    madvise(2), MADV_DONTNEED: pages of a mapping that nobody wrote to are clean copies of the
    file, and those that are used are read again. malloc_trim(3) is glibc's.
    """
    libc = ctypes.CDLL(None)
    for start, end in _clean_mappings():
        libc.madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _MADV_DONTNEED)
    release_bitcode()
    gc.collect()  # what linking left: what was imported is frozen
    trim = getattr(libc, "malloc_trim", None)  # musl has none
    if trim is not None:
        trim(0)


def _clean_mappings() -> Iterator[tuple[int, int]]:
    """First and last address of read-only mappings of libraries without a written page.

    The linker writes to a page when it resolves addresses; the file has no copy of that."""
    try:
        lines = SMAPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # the pages stay
        return
    addresses: str | None = None
    for line in lines:
        fields = line.split(maxsplit=5)
        if not fields[0].endswith(":"):
            mine = len(fields) > 5 and ".so" in fields[5] and "w" not in fields[1]
            addresses = fields[0] if mine else None
        elif addresses is not None and line.startswith("Private_Dirty:") and fields[1] == "0":
            start, end = (int(address, 16) for address in addresses.split("-"))
            yield start, end
