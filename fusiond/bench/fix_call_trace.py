"""Trace of the functions and modules of an ordinary fix, from its arrival to the published sigma.

While the vehicle navigates, a fix with velocity arrives, the filter runs, and the solution is read.
The trace counts the Python functions that a person has to read to explain a published sigma,
without compiled kernels. Of five fixes the one with the median count is used, which excludes rare
work (a checkpoint, a verdict).
"""

from __future__ import annotations

import sys
from collections import Counter
from types import CodeType, FrameType
from typing import NamedTuple

from fusiond.bench.delayed_fix import AT_S, Drive

FIXES = 5
OURS, NOT_OURS = "fusiond.", ("fusiond.bench.", "fusiond.simulation.")
"""The receiver is simulated."""


class FixPath(NamedTuple):
    """Calls of each function, by module and qualified name."""

    calls: dict[tuple[str, str], int]

    @property
    def functions(self) -> int:
        """Number of different functions."""
        return len(self.calls)

    @property
    def modules(self) -> int:
        """Number of modules that contain these functions."""
        return len({module for module, _ in self.calls})


def ordinary_fix() -> FixPath:
    """Trace of the fix with the median number of functions, of `FIXES` fixes during a drive."""
    drive = Drive(1)
    drive.go_on(AT_S)
    found = [_way(drive) for _ in range(FIXES)]
    return sorted(found, key=lambda way: way.functions)[FIXES // 2]


def _way(drive: Drive) -> FixPath:
    calls: Counter[tuple[str, str]] = Counter()
    ours: dict[CodeType, tuple[str, str] | None] = {}

    def called(frame: FrameType, event: str, _: object) -> None:
        if event != "call":
            return
        code = frame.f_code
        if code not in ours:
            module = str(frame.f_globals.get("__name__", ""))
            part = code.co_name.startswith("<") and code.co_name != "<lambda>"
            ours[code] = None
            if module.startswith(OURS) and not module.startswith(NOT_OURS) and not part:
                ours[code] = module, code.co_qualname
        if (name := ours[code]) is not None:
            calls[name] += 1

    drive.to_next_fix()
    before = sys.getprofile()
    sys.setprofile(called)
    try:
        drive.take_fix()
    finally:
        sys.setprofile(before)
    return FixPath(dict(calls))
