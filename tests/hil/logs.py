"""The logs of the daemon's drive through its faults: replayed where a replay is quickest.

A guest takes half a minute for what its host does in seconds, so it only hands them over; run by
hand, without a host that waits for them, the test replays them itself.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

HANDED_OVER = "FUSIOND_HIL_LOGS"
"""Environment: the folder that takes the logs."""
STEP_S = 3.0
"""By which the drive sets the system clock."""


def hand_over(folder: Path) -> None:
    """See to it that the logs are replayed."""
    to = os.environ.get(HANDED_OVER)
    if to is None:
        check(folder)
    else:
        shutil.copytree(folder, to)


def check(folder: Path) -> None:
    """What both runs of the daemon recorded, once more: the same bits at every tick."""
    # Not where the drive is only watched: navigation takes seconds to load there.
    from fusiond.recording.info import info  # noqa: PLC0415
    from fusiond.recording.reader import Log  # noqa: PLC0415
    from fusiond.replay.replay_output import ReplayOptions, replay  # noqa: PLC0415

    parts = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    assert len(parts) == 2, parts
    for path in parts:
        found = replay([path], ReplayOptions())
        assert found["identical"] is True, found["first_difference"]
        assert found["problems"] == found["driver_faults"] == []
        ticks, speed = found["compared"], found["times_real_time"]
        print(f"{ticks} ticks the same, from {found['started_from']}, {speed} times real time")
    first = info(Log(parts[:1]))
    assert first["sources"]["gnss"]["close"] >= 1
    assert first["sources"]["rdss"]["sent"] >= 1
    assert any(abs(step["step_s"] - STEP_S) < 0.1 for step in first["clock_steps"])
    print(f"overruns {first['overruns']}, {first['mb_per_hour']} MB an hour")
