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
from typing import NamedTuple, Self

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
    """Trace of the fix with the median number of modules, of `FIXES` fixes during a drive."""
    drive = Drive(1)
    drive.go_on(AT_S)
    ways = []
    for _ in range(FIXES):
        drive.to_next_fix()
        with Trace((OURS,)) as trace:
            drive.take_fix()
        ways.append(trace.way)
    return median(ways)


def median(ways: list[FixPath]) -> FixPath:
    """The way with the median number of modules, then of functions."""
    return sorted(ways, key=lambda way: (way.modules, way.functions))[len(ways) // 2]


class Trace:
    """Trace of the Python functions called inside `with`, of modules that begin with `ours`.

    Functions of `left_out`, by qualified name, and what they call are left out; so is what a
    dataclass writes for itself.
    """

    def __init__(self, ours: tuple[str, ...], left_out: frozenset[str] = frozenset()) -> None:
        self._ours, self._left_out = ours, left_out
        self._calls: Counter[tuple[str, str]] = Counter()
        self._named: dict[CodeType, tuple[str, str] | None] = {}
        self._outside: FrameType | None = None
        """Frame of a function of `left_out` that is running."""

    @property
    def way(self) -> FixPath:
        """The calls so far."""
        return FixPath(dict(self._calls))

    def __enter__(self) -> Self:
        self._before = sys.getprofile()
        sys.setprofile(self._event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(self._before)

    def _event(self, frame: FrameType, event: str, _: object) -> None:
        if self._outside is not None:
            if event == "return" and frame is self._outside:
                self._outside = None
        elif event == "call":
            code = frame.f_code
            if code.co_qualname in self._left_out:
                self._outside = frame
                return
            if code not in self._named:
                self._named[code] = self._name(frame)
            name = self._named[code]
            if name is not None:
                self._calls[name] += 1

    def _name(self, frame: FrameType) -> tuple[str, str] | None:
        module, code = str(frame.f_globals.get("__name__", "")), frame.f_code
        part = code.co_name.startswith("<") and code.co_name != "<lambda>"
        part |= code.co_qualname.startswith("__create_fn__")
        if not module.startswith(self._ours) or module.startswith(NOT_OURS) or part:
            return None
        return module, code.co_qualname
