"""Resources of this process, and release of unused memory."""

from __future__ import annotations

import ctypes
import fcntl
import gc
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

from fusiond.navigation.kernel_cache import release_bitcode

STATM, SMAPS = Path("/proc/self/statm"), Path("/proc/self/smaps")


class ProcessUsage:
    """CPU and memory of this process: `sample()` gives percent of one core since the last call and
    resident memory in MB (10^6 bytes), None if the kernel does not show it."""

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
        except (OSError, ValueError, IndexError):  # no /proc, no permission, or another format
            return percent, None
        return percent, resident_pages * self._page_bytes / 1e6


_MADV_DONTNEED = 4
_M_ARENA_MAX = -8


def share_one_heap() -> None:
    """Limit glibc to one heap for all threads (mallopt(3), M_ARENA_MAX); call it before any starts.
    Each further heap costs a megabyte or more, for a thread that writes ten times a second."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl lacks it
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


_MOST_DESCRIPTORS = 16_384
"""Largest size of the table: 128 kB of the kernel's memory."""


def widen_descriptor_table() -> None:
    """Enlarge the kernel's table of descriptors to its final size, before there are threads.

    The table grows at 64, 256, 512 and so on, and never shrinks. In a process with several threads
    each growth waits for all processors (Linux, fs/file.c, expand_fdtable: synchronize_rcu): 7 to
    20 ms on an idle computer, within the `accept` of the next client.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_DESCRIPTORS if soft == resource.RLIM_INFINITY else min(soft, _MOST_DESCRIPTORS)
    with open(os.devnull, "rb") as any_file:
        os.close(fcntl.fcntl(any_file.fileno(), fcntl.F_DUPFD_CLOEXEC, most - 1))


def release_start_memory() -> None:
    """Release memory that only the start needed: 45 MB of LLVM's pages, unused once the kernels are
    loaded; 13 MB of other libraries' pages; 7 MB of bitcode; objects in cycles; 1 MB of freed
    memory.

    madvise(2), MADV_DONTNEED: unmodified pages of a mapping are clean copies of the file and are
    read again when used. malloc_trim(3) is glibc's.
    """
    libc = ctypes.CDLL(None)
    for start, end in _clean_mappings():
        libc.madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _MADV_DONTNEED)
    release_bitcode()
    gc.collect()  # objects left by linking; those left by imports are frozen
    trim = getattr(libc, "malloc_trim", None)  # musl lacks it
    if trim is not None:
        trim(0)


def _clean_mappings() -> Iterator[tuple[int, int]]:
    """Address ranges of libraries' read-only mappings without a modified page.

    Pages in which the linker resolved addresses are modified: the file has no copy of them."""
    try:
        lines = SMAPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # without the list the pages stay in memory
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
