"""The daemon in a process of its own, killed while the vehicle drives."""

from __future__ import annotations

import math
from pathlib import Path

from tests.live.kill_nine import driving, killed

KILLS = 3


async def test_killed_while_driving_it_is_back_at_once_and_honest(tmp_path: Path) -> None:
    """At three random instants, for gaps of up to five seconds; `benchmarks/kill_nine.py` has more.

    On a computer that is so busy that the gap grows too long, the start is an ordinary one.
    """
    async with driving(tmp_path, 900.0, seed=3) as vehicle:
        restarts = [restart async for restart in killed(tmp_path, vehicle, KILLS, seed=4)]
    assert len(restarts) == KILLS
    for restart in restarts:
        assert restart.first_ratio < 3.0, restart
        if not math.isnan(restart.gap_s):
            # The first data are enough: within a few ticks, counted by the daemon's own clock.
            assert restart.solution_s < 1.0, restart
    log = (tmp_path / "killed.log").read_text()
    cold = sum(math.isnan(restart.gap_s) for restart in restarts)
    assert log.count("warm_state_refused") == cold
    assert "Traceback" not in log
