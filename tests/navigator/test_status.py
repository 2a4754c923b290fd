"""The reason of a mode: why it navigates, and why it does so again after coasting."""

from __future__ import annotations

from drivers.measurements import PositionFix
from fusiond.navigation.solution import Mode
from tests import runs
from tests.navigator.vehicle import START_NS, drive, started

WITHOUT_S = 20.0, 34.0
"""No fix in this part of the drive, which lasts for longer than `coast_after_s`."""


def test_the_fixes_that_end_a_coasting_are_the_reason_from_then_on() -> None:
    navigator, row = started()
    d, said = drive(), []
    waiting = [m for m in d.measurements if isinstance(m, PositionFix)]
    for first in range(row, len(d.times), 10):
        navigator.add_imu(d.times[first : first + 10], d.samples[first : first + 10])
        now = navigator.imu.latest_ns
        while waiting and waiting[0].t_seen_ns <= now:
            fix = waiting.pop(0)
            begin, end = (START_NS + round(s * runs.SECOND) for s in WITHOUT_S)
            if not begin < fix.t_seen_ns < end:
                navigator.add(fix, fix.t_seen_ns)
        navigator.advance()
        if (mode := navigator.mode(now)) not in said[-1:]:
            said.append(mode)
    modes = [mode for mode, _ in said]
    gone = next(k for k, (_, why) in enumerate(said) if why.startswith("No position fused"))
    assert said[gone - 1] == (Mode.NAVIGATING, "Heading from configured heading")
    assert set(modes[gone:-1]) == {Mode.COASTING}
    assert said[-1] == (Mode.NAVIGATING, "Position fixes of gnss are back")
