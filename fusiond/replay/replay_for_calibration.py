"""Replay of a recording with an observer, for `fusiond calibrate LOG.mcap`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fusiond.configuration.schema import Config
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.recording.reader import Log
from fusiond.replay.replay import Replay


def replay_for_calibration(
    recording: Log, config: Config, look: Callable[[Navigator], None]
) -> dict[str, Any]:
    """Run a replay and return the summary of its solution in the terms of `process`.

    The navigator starts without saved calibration, which this drive would count twice. `look`
    receives the navigator once a second. Raises `LogError`.
    """
    replay = Replay(recording, config, same=False, afresh=True)
    rows, why = 0, "the log has no tick of a daemon"
    second = Every(SECOND_NS)
    for tick in replay.ticks():
        assert replay.chain is not None
        replay.chain.navigator.keeps_solutions = True
        navigated = tick.solution.mode in (Mode.NAVIGATING, Mode.COASTING)
        rows, why = rows + navigated, tick.solution.reason
        if second.due(tick.solution.t_ns):
            look(replay.chain.navigator)
    if replay.chain is not None:
        look(replay.chain.navigator)
    return {
        "solution_rows": rows,
        "why": why,
        "driver_faults": replay.comparison.faults,
        "problems": recording.problems,
    }
