"""Learned order of a receiver's sentences and pauses in an epoch.

Two epochs in a row of the same sentences in the same order are a *cycle*: from then on its last
sentence ends an epoch at once. A silence ends an epoch too, but where the receiver has gone on with
the same instant after such a silence: there it pauses, and what is to come is waited for.
"""

from __future__ import annotations

from collections.abc import Sequence

MOST_KEPT = 8
"""Cycles remembered as too short, and pauses; a receiver mixes at most a few output rates."""

Formatters = tuple[str, ...]


class Cycle:
    """Learned order of one receiver's epochs."""

    def __init__(self) -> None:
        self.last: Formatters = ()
        """The sentences of the epoch before."""
        self._whole: Formatters = ()
        self._too_short: set[Formatters] = set()
        self._pauses: set[Formatters] = set()

    def whole(self, so_far: Sequence[str]) -> bool:
        """True if an epoch of these sentences is complete."""
        return tuple(so_far) == self._whole

    def pauses(self, so_far: Sequence[str]) -> bool:
        """True if the receiver usually pauses here within an epoch."""
        return tuple(so_far) in self._pauses

    def ended(self, sentences: Sequence[str], *, learn: bool) -> None:
        """An epoch has ended. `learn`: something but what was learned has shown it."""
        cycle = tuple(sentences)
        if learn and cycle == self.last and cycle not in self._too_short:
            self._whole = cycle
        self.last = cycle

    def too_short(self) -> None:
        """More came of an epoch that was ended at once: what was learned is forgotten."""
        if self._whole and len(self._too_short) < MOST_KEPT:
            self._too_short.add(self._whole)
        self._whole = self.last = ()

    def paused(self) -> None:
        """More came of an epoch that a silence had ended."""
        if self.last and len(self._pauses) < MOST_KEPT:
            self._pauses.add(self.last)
        if self.last == self._whole:
            self._whole = ()
        self.last = ()
