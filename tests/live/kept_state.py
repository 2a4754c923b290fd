"""A state on disk, and the keeper that writes it at rest."""

from __future__ import annotations

import asyncio
from pathlib import Path

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.state_keeper import (
    StateKeeper,
)
from fusiond.navigation.solution import Mode, Solution

S = 1_000_000_000
NAVIGATING = Solution(
    0,
    Mode.NAVIGATING,
    "aided by gnss",
    lat_rad=0.53,
    lon_rad=1.99,
    height_m=38.0,
    v_ned_m_s=(0.0, 0.0, 0.0),
    rpy_rad=(0.0, 0.0, 0.7),
    sd_ned_m=(3.0, 4.0, 2.0),
    sd_v_ned_m_s=(0.05, 0.05, 0.05),
    sd_rpy_rad=(0.001, 0.001, 0.05),
)


class Kept:
    """A keeper at the daemon's clock, and its file."""

    def __init__(self, path: Path) -> None:
        config = Config(state_file=path)
        self.path = path
        self.clock = Clock(config.clock)
        self.events: list[tuple[str, str]] = []
        self.keeper = StateKeeper(config, self.clock, lambda *event: self.events.append(event))
        self.t_ns = self.clock.now_ns()

    def at(self, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> Solution:
        return NAVIGATING._replace(t_ns=self.t_ns, mode=mode, v_ned_m_s=(speed_m_s, 0.0, 0.0))

    async def tick(self, after_s: float, speed_m_s: float, mode: Mode = Mode.NAVIGATING) -> None:
        """A tick some time later, and what it started in the background."""
        self.t_ns += round(after_s * S)
        self.keeper.keep(self.t_ns, self.at(speed_m_s, mode), confirmed=True)
        await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
