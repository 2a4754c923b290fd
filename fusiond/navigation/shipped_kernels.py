"""Kernels that came with the package, for levels of processors."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite.binding import get_host_cpu_features

_host_features: Any = get_host_cpu_features  # llvmlite's functions have no types

# What an x86-64 processor of a level has (x86-64 psABI, 3.1.1), by LLVM's names; that of aarch64's
# base, Armv8.0-A, every one has. The first that is shipped and fits is taken.
LEVELS: dict[str, dict[str, tuple[str, ...]]] = {
    "x86_64": {
        "x86-64-v3": ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"),
        "x86-64-v2": ("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"),
    },
    "aarch64": {"generic": ()},
}


class Shipped(NamedTuple):
    """Kernels that came with the package, for processors of one level."""

    folder: Path
    level: str
    names: frozenset[str]


def shipped_in(folder: Path) -> Shipped | None:
    """Shipped kernels in a subfolder of `folder` for this processor; None without any.

    The folders are named after LLVM's names of processors; a kernel in them was compiled for that
    one with no feature besides (`tools.prebuilt`).
    """
    try:
        levels = set(os.listdir(folder))
    except OSError:
        return None
    has = {name for name, there in _host_features().items() if there}
    for level, needs in LEVELS.get(platform.machine(), {}).items():
        # Level 3 has what level 2 has.
        if level in levels and has.issuperset(needs):
            return Shipped(folder / level, level, frozenset(os.listdir(folder / level)))
    return None
