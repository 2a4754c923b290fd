"""Learned order of a receiver's sentences and pauses in an epoch.

Two consecutive epochs with the same sentences in the same order are a *cycle*; from then on its
last sentence ends an epoch at once. A receiver with several output rates, such as RMC at 50 Hz and
GGA at 1 Hz, has a cycle for each phase within the second, learned from two consecutive seconds.

A silence ends an epoch, too, unless the receiver has continued the same instant after a silence at
this place before: then it is a pause inside the epoch, whose other sentences follow.
"""

from __future__ import annotations

from collections.abc import Sequence

MOST_KEPT = 8
"""Cycles remembered as too short, and pauses; a receiver mixes at most a few output rates."""
MOST_PHASES = 128
"""Epochs in a second of the fastest receivers are 100; of one whose epochs drift through the second
it is forgotten what was learned of phases that do not come again."""

Formatters = tuple[str, ...]
Phase = int | None
"""Time of day of an epoch modulo a second, ns; None of one without a time."""


class SentenceOrder:
    """Learned order of one receiver's epochs."""

    def __init__(self) -> None:
        self.last: Formatters = ()
        """The sentences of the epoch before."""
        self._whole: Formatters = ()
        self._too_short: set[Formatters] = set()
        self._pauses: set[Formatters] = set()
        self._phase: Phase = None
        """Of the epoch before."""
        self._at_phase: dict[Phase, Formatters] = {}
        """Sentences of the last epoch at a phase."""
        self._whole_at: set[tuple[Phase, Formatters]] = set()
        self._too_short_at: set[tuple[Phase, Formatters]] = set()

    def whole(self, so_far: Sequence[str], phase: Phase) -> bool:
        """True if an epoch of these sentences is complete."""
        cycle = tuple(so_far)
        return cycle == self._whole or (phase, cycle) in self._whole_at

    def pauses(self, so_far: Sequence[str]) -> bool:
        """True if the receiver usually pauses here within an epoch."""
        return tuple(so_far) in self._pauses

    def ended(self, sentences: Sequence[str], phase: Phase, *, learn: bool) -> None:
        """Note the end of an epoch. `learn`: its end was not found by a learned cycle."""
        cycle = tuple(sentences)
        if learn and cycle == self.last and cycle not in self._too_short:
            self._whole = cycle
        if phase is None:
            self._not_whole_here()  # a sentence without time may belong to the epoch before
        else:
            self._learn_at(phase, cycle)
        self.last, self._phase = cycle, phase

    def _learn_at(self, phase: Phase, cycle: Formatters) -> None:
        if self._at_phase.get(phase) == cycle and (phase, cycle) not in self._too_short_at:
            self._whole_at.add((phase, cycle))
        if len(self._at_phase) >= MOST_PHASES and phase not in self._at_phase:
            self._at_phase.clear()
            self._whole_at.clear()
            self._too_short_at.clear()
        self._at_phase[phase] = cycle

    def too_short(self) -> None:
        """Forget the cycle that ended an epoch too early."""
        if self._whole and len(self._too_short) < MOST_KEPT:
            self._too_short.add(self._whole)
        self._not_whole_here()
        self._whole = self.last = ()

    def _not_whole_here(self) -> None:
        """Forbid these sentences as a cycle at the last epoch's phase: more of it followed."""
        self._whole_at.discard((self._phase, self.last))
        self._too_short_at.add((self._phase, self.last))

    def paused(self) -> None:
        """Note that an epoch continued after a silence."""
        if self.last and len(self._pauses) < MOST_KEPT:
            self._pauses.add(self.last)
        if self.last == self._whole:
            self._whole = ()
        self._not_whole_here()
        self.last = ()
