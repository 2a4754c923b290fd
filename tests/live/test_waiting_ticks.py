"""Ticks that leave their samples to the next one, beside ticks that all run the filter."""

from __future__ import annotations

from pathlib import Path

from fusiond.navigation.solution import Mode
from fusiond.recording.state_digest import state_digest
from tests.recording.driven import Drive

UNTIL_S = 15.0
"""The demo's car is aligned by its first motion, and has had some fixes since."""


class _Waiting(Drive):
    """Drive whose solutions nobody reads."""

    found: dict[int, bytes]
    waited: int

    def tick(self, t_ns: int) -> None:
        if self.chain.may_wait(t_ns):
            self.chain.wait()
            self.waited += 1
            return
        solution = self.chain.tick(t_ns)
        self.found[t_ns] = state_digest(self.chain.navigator, solution)


class _Ticking(_Waiting):
    """Drive of which each tick runs the filter."""

    def tick(self, t_ns: int) -> None:
        solution = self.chain.tick(t_ns)
        self.found[t_ns] = state_digest(self.chain.navigator, solution)


def test_samples_that_waited_for_a_tick_give_the_same_to_the_bit(tmp_path: Path) -> None:
    both = []
    for name, kind in (("waiting", _Waiting), ("ticking", _Ticking)):
        drive = kind(tmp_path / name, UNTIL_S)
        drive.found, drive.waited = {}, 0
        drive.run(UNTIL_S - 1.0)
        both.append(drive)
    waiting, ticking = both
    assert ticking.chain.solution is not None
    assert ticking.chain.solution.mode is Mode.NAVIGATING
    assert waiting.waited > 60
    assert len(waiting.found) + waiting.waited == len(ticking.found)
    assert waiting.found == {t_ns: ticking.found[t_ns] for t_ns in waiting.found}
