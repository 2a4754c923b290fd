"""Rate limit of the log: a few lines a minute for one cause, then their number.

A cause is the event's source and code, or the line of code that logs; the text may vary. Errors are
limited like other lines, since repeated tracebacks would fill a disk.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

MOST = 4
"""Most records of one cause in a window, besides one that reports the omission: ten in any minute,
across two windows."""
WINDOW_S = 60.0
CAUSES = 512
"""Remembered at once; those that have been silent longest are forgotten first."""


@dataclass(slots=True)
class _Cause:
    begin_s: float
    said: int = 0
    left_out: int = 0


class LogLimit(logging.Filter):
    """Rate limit of a log handler; `left_out` counts all omitted lines."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now
        self._causes: OrderedDict[tuple[str, str], _Cause] = OrderedDict()
        self.left_out = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """True if the record is to be written; the first one after omitted records states their
        number. Records below level `info` are never omitted."""
        if record.levelno < logging.INFO:
            return True
        now_s = self._now()
        cause = self._cause(record, now_s)
        if now_s - cause.begin_s >= WINDOW_S:
            if cause.left_out:
                record.msg = f"{record.getMessage()} ({cause.left_out} more like it were left out)"
                record.args = ()
            cause.begin_s, cause.said, cause.left_out = now_s, 0, 0
        cause.said += 1
        if cause.said <= MOST:
            return True
        if cause.said == MOST + 1:
            record.msg = f"{record.getMessage()} (more like it are left out for a minute)"
            record.args = ()
            record.exc_info = record.exc_text = None
            return True
        cause.left_out += 1
        self.left_out += 1
        return False

    def _cause(self, record: logging.LogRecord, now_s: float) -> _Cause:
        source = getattr(record, "fusiond_source", record.name)
        code = getattr(record, "fusiond_code", f"{record.pathname}:{record.lineno}")
        key = str(source), str(code)
        found = self._causes.get(key)
        if found is None:
            found = self._causes[key] = _Cause(now_s)
            if len(self._causes) > CAUSES:
                self._causes.popitem(last=False)
        self._causes.move_to_end(key)
        return found
