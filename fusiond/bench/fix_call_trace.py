"""Functions and modules that an ordinary fix passes, from its arrival to the published sigma.

A navigating vehicle has its IMU samples; a fix with velocity arrives, the filter runs, the solution
is read. To explain a published sigma, a person has to read the Python functions that are counted
here. Compiled kernels are not counted. The fix with the median count of five is taken: it has none
of the rare work (a checkpoint, a verdict).
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
    """Fix with the median number of functions, of `FIXES` fixes under way."""
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
