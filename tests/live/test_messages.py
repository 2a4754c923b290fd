"""Two daemons' processes, two simulated terminals, one lossy network: every message has its end.

The cards are of 1 s, busy now and then (no feedback, or a refusal); a quarter of the messages is
lost, as receipts are; one daemon is killed with messages under way, and comes back.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest

from drivers.rdss.messages import Family
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.rdss.centre import RdssOptions
from fusiond.simulation.rdss.network import MessageNetwork
from fusiond.simulation.rdss.terminal import RdssTerminal
from fusiond.simulation.scenarios import SCENARIOS
from tests.broker import Broker, Listener, listening
from tests.hil.processes import DaemonProcess

CARDS = {"ahead": 242286, "behind": 242407}
SERVICE_S = 1
EACH = 6
ENDS_WITHIN_S = 150.0
"""Expiry of a message, and a card's turns for what waits behind it; on a computer with others."""
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
message_expiry_s = 60.0
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
    terminals: dict[str, RdssTerminal] = field(default_factory=dict)

    @asynccontextmanager
    async def on(self) -> AsyncIterator[MessageNetwork]:
        start_ns, start_s = time.time_ns(), time.monotonic()
        truth = SCENARIOS["static"].truth(30.0)
        rngs = np.random.default_rng(41).spawn(3)
        network = MessageNetwork(rngs[2], loss_probability=0.25, delay_s=(0.2, 0.8))
        lines = {}
        for (name, card), rng in zip(CARDS.items(), rngs[:2], strict=True):
            options = RdssOptions(
                family=self.family,
                user=card,
                service_frequency_s=SERVICE_S,
                delay_s=(0.2, 1.0),
                mean_delay_s=0.4,
                refuse_probability=0.1,
                mute_probability=0.05,
            )
            self.terminals[name] = RdssTerminal(truth, options, rng, start_ns)
            network.join(self.terminals[name])
            lines[name] = PtyLine(self.folder / f"{name}-rdss")
            lines[name].plug()

        async def serve() -> None:
            while True:
                t_s = time.monotonic() - start_s
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


def config(folder: Path, name: str, family: Family, port: int) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(CONFIG.format(name=name, folder=folder, family=family, port=port))
    return path


def ended(listener: Listener, name: str) -> dict[str, str]:
    """The end of each of a daemon's own texts, by its id."""
    own = [m for m in said(listener, name, "message") if m["kind"] == "text" and m["id"]]
    return {m["id"]: m["state"] for m in own if m["over"]}


async def send(client: aiomqtt.Client, name: str, text: str, receipt: bool) -> None:
    other = next(card for n, card in CARDS.items() if n != name)
    command = {"id": text, "card": other, "text": text, "receipt": receipt}
    await client.publish(f"fusiond/{name}/cmd/send_message", json.dumps(command), qos=1)


@pytest.mark.parametrize("family", ["4.0", "2.1"])
async def test_every_message_ends_by_name_through_loss_busy_cards_and_a_kill(
    tmp_path: Path, family: Family
) -> None:
    radio = Radio(tmp_path, family)
    with Broker(tmp_path) as broker:
        async with (
            radio.on() as network,
            listening(broker) as (listener, client),
            DaemonProcess(config(tmp_path, "behind", family, broker.port)) as behind,
        ):
            ahead = DaemonProcess(config(tmp_path, "ahead", family, broker.port))
            await behind.start()
            await behind.ready()
            async with ahead:
                await ahead.start()
                await ahead.ready()
                for n in range(EACH):
                    await send(client, "ahead", f"order {n}", receipt=True)
                    await send(client, "behind", f"answer {n}", receipt=n > 0)

                def answered(li: Listener) -> bool:
                    replies = said(li, "ahead", "reply") + said(li, "behind", "reply")
                    return len(replies) == 2 * EACH

                await listener.until(answered)
                await listener.until(lambda li: len(ended(li, "ahead")) >= 2, ENDS_WITHIN_S)
                os.kill(ahead.pid, signal.SIGKILL)
            before = len(said(listener, "ahead", "message"))
            bursts_before = len(radio.terminals["ahead"].bursts_s)
            async with DaemonProcess(tmp_path / "ahead.toml") as again:
                await again.start()
                await again.ready()

                def all_ended(li: Listener) -> bool:
                    return len(ended(li, "ahead")) == len(ended(li, "behind")) == EACH

                with contextlib.suppress(TimeoutError):
                    await listener.until(all_ended, ENDS_WITHIN_S)
                ends = {name: ended(listener, name) for name in CARDS}
                assert all_ended(listener), ends

    print({name: Counter(of.values()) for name, of in ends.items()}, network.counters)
    for name, terminal in radio.terminals.items():
        print(name, len(terminal.bursts_s), "bursts,", dict(terminal.counters))
    replies = said(listener, "ahead", "reply") + said(listener, "behind", "reply")
    assert all(reply["ok"] for reply in replies)
    for name, other in (("ahead", "behind"), ("behind", "ahead")):
        texts = Counter(
            m["text"]
            for m in said(listener, other, "message")
            if m["direction"] == "received" and m["kind"] == "text" and not m["repeated"]
        )
        for text, state in ends[name].items():
            assert state in ("sent", "delivered", "unconfirmed", "expired"), (text, state)
            if state == "delivered":
                assert texts[text] == 1, (text, texts)
    # What is drawn is asked of both together: a few draws may all fall one way.
    delivered = sum(state == "delivered" for of in ends.values() for state in of.values())
    assert delivered >= 2, "lost messages and lost receipts go again"
    kept = [m for m in said(listener, "ahead", "message")[before:] if "restart" in m["why"]]
    assert kept, "what waited when it was killed goes on"
    assert network.counters["lost"] > 0
    for terminal in radio.terminals.values():
        apart = [b - a for a, b in itertools.pairwise(terminal.bursts_s)]
        assert min(apart) >= SERVICE_S
        assert terminal.counters["fixes"] > 5, "fixes go on beside messages"
        assert terminal.counters["TextRequest"] >= EACH
    busy = ("muted", "refused_not_locked", "refused_not_sent", "refused_frequency")
    drawn = [terminal.counters[name] for terminal in radio.terminals.values() for name in busy]
    assert sum(drawn) > 0
    # The spacing does not outlive a process: one attempt at the most is too early for that.
    assert radio.terminals["behind"].counters["too_early"] <= 2
    assert radio.terminals["ahead"].counters["too_early"] <= 3
    assert len(radio.terminals["ahead"].bursts_s) > bursts_before
