"""Two simulated terminals on pseudo terminals, a network between them, and their daemons."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.rdss.messages import Family
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.rdss.centre import RdssOptions
from fusiond.simulation.rdss.short_messages import MessageNetwork
from fusiond.simulation.rdss.terminal import RdssTerminal
from fusiond.simulation.scenarios import SCENARIOS
from tests.broker import Listener

CARDS = {"ahead": 242286, "behind": 242407}
SERVICE_S = 1
CONFIG = """
vehicle = "{name}"
state_file = "{folder}/{name}.json"
[clock]
utc = "system"
[sources.rdss]
driver = "rdss"
port = "{folder}/{name}-rdss"
baud = 115200
family = "{family}"
message_expiry_s = {expiry_s}
[aiding.rdss]
[mqtt]
port = {port}
commands = ["send_message", "request_fix"]
"""


@dataclass
class Radio:
    """Both terminals on their lines, served by a task; instants are seconds since its start."""

    folder: Path
    family: Family
    loss_probability: float = 0.25
    refuse_probability: float = 0.1
    mute_probability: float = 0.05
    drop_probability: float = 0.0
    service_s: int = SERVICE_S
    delay_s: tuple[float, float] = (0.2, 1.0)
    mean_delay_s: float = 0.4
    levels: dict[str, int] = field(default_factory=dict)
    """Communication level of a card, where it is not the simulation's."""
    terminals: dict[str, RdssTerminal] = field(default_factory=dict)
    start_s: float = 0.0

    @property
    def now_s(self) -> float:
        """Instant of the terminals."""
        return time.monotonic() - self.start_s

    @asynccontextmanager
    async def on(self) -> AsyncIterator[MessageNetwork]:
        start_ns, self.start_s = time.time_ns(), time.monotonic()
        truth = SCENARIOS["static"].truth(30.0)
        rngs = np.random.default_rng(41).spawn(3)
        network = MessageNetwork(rngs[2], self.loss_probability, delay_s=(0.2, 0.8))
        lines = {}
        for (name, card), rng in zip(CARDS.items(), rngs[:2], strict=True):
            options = RdssOptions(
                family=self.family,
                user=card,
                service_frequency_s=self.service_s,
                delay_s=self.delay_s,
                mean_delay_s=self.mean_delay_s,
                drop_probability=self.drop_probability,
                refuse_probability=self.refuse_probability,
                mute_probability=self.mute_probability,
                comm_level=self.levels.get(name, 3),
            )
            self.terminals[name] = RdssTerminal(truth, options, rng, start_ns)
            network.join(self.terminals[name])
            lines[name] = PtyLine(self.folder / f"{name}-rdss")
            lines[name].plug()

        async def serve() -> None:
            while True:
                t_s = self.now_s
                for name, terminal in self.terminals.items():
                    if data := lines[name].read():
                        terminal.receive(data, t_s)
                    if data := terminal.read(t_s):
                        lines[name].write(data)
                await asyncio.sleep(0.01)

        task = asyncio.create_task(serve())
        try:
            yield network
        finally:
            task.cancel()
            for line in lines.values():
                line.unplug()


def said(listener: Listener, name: str, topic: str) -> list[dict[str, Any]]:
    return [json.loads(p) for p in listener.payloads(f"fusiond/{name}/{topic}")]


def config(folder: Path, name: str, family: Family, port: int, expiry_s: float = 60.0) -> Path:
    path = folder / f"{name}.toml"
    given = {"name": name, "family": family, "port": port, "expiry_s": expiry_s}
    path.write_text(CONFIG.format(folder=folder, **given))
    return path
