"""Epochs of messages, and their ends: no I/O, no clock.

An epoch ends with a message of another instant, a repeated message, its last message, or silence.
The last message is learned from two equal cycles in a row.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

MAX_UNLEARNED = 8
"""Cycles remembered as too short; a receiver mixes at most a few output rates."""
MAX_CYCLE = 24
"""Most messages in an epoch; a receiver sends a dozen kinds."""

Name = int | str


class Cycle:
    """Names in the open epoch, and the pattern of earlier ones.

    Counts `late_message`: messages of an epoch that its supposedly last message had closed.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._key: Hashable = None
        self._names: list[Name] = []
        self._at_once = False
        self._last: tuple[Name, ...] = ()
        self._learned: tuple[Name, ...] = ()
        self._too_short: set[tuple[Name, ...]] = set()

    @property
    def open(self) -> bool:
        """True if an epoch is open."""
        return bool(self._names)

    def restarts(self, key: Hashable, name: Name) -> bool:
        """True if a message starts another epoch."""
        if not self._names:
            return False
        return key != self._key or name in self._names or len(self._names) >= MAX_CYCLE

    def delayed(self, key: Hashable, name: Name) -> bool:
        """True for a further message of the epoch just closed: the learned cycle was too short. A
        name that the epoch already has is a repetition instead."""
        if self._names or not self._at_once or key != self._key or name in self._last:
            return False
        self._counters["late_message"] += 1
        if self._learned and len(self._too_short) < MAX_UNLEARNED:
            self._too_short.add(self._learned)
        self._learned = self._last = ()
        return True

    def add(self, key: Hashable, name: Name) -> bool:
        """Add a message; true if it is the last one of its epoch."""
        self._key = key
        self._names.append(name)
        return tuple(self._names) == self._learned

    def close(self, *, learn: bool, at_once: bool) -> None:
        """Close the epoch; `at_once` if its last message closed it, so that no more is expected."""
        cycle = tuple(self._names)
        self._names.clear()
        if learn and cycle == self._last and cycle not in self._too_short:
            self._learned = cycle
        self._last, self._at_once = cycle, at_once
