"""Learned order of a receiver's sentences and pauses in an epoch.

Two epochs in a row of the same sentences in the same order are a *cycle*: from then on its last
sentence ends an epoch at once. A receiver that mixes output rates, RMC at 50 Hz and GGA at 1 Hz,
has a cycle of its own at each phase of the second: there two seconds in a row show it.

A silence ends an epoch too, unless the receiver has continued with the same instant after a silence
at this place: then the silence is a pause inside the epoch, and its other sentences are awaited.
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
        """An epoch has ended. `learn`: something but what was learned has shown it."""
        cycle = tuple(sentences)
        if learn and cycle == self.last and cycle not in self._too_short:
            self._whole = cycle
        if phase is None:
            self._not_whole_here()  # what has no time may be of the epoch before
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
        """More came of an epoch that was ended at once: what was learned is forgotten."""
        if self._whole and len(self._too_short) < MOST_KEPT:
            self._too_short.add(self._whole)
        self._not_whole_here()
        self._whole = self.last = ()

    def _not_whole_here(self) -> None:
        """More came of the last epoch: at its phase these sentences are never a whole one again."""
        self._whole_at.discard((self._phase, self.last))
        self._too_short_at.add((self._phase, self.last))

    def paused(self) -> None:
        """More came of an epoch that a silence had ended."""
        if self.last and len(self._pauses) < MOST_KEPT:
            self._pauses.add(self.last)
        if self.last == self._whole:
            self._whole = ()
        self._not_whole_here()
        self.last = ()
