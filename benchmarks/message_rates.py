"""Rates of fixes and messages together: two daemons, two simulated terminals, cards of each kind.

    python benchmarks/message_rates.py [--cards 1 10 60] [--minutes 10]

For each service frequency (s) a pair of daemons' processes on pseudo terminals, all pairs at once:
both cards always have texts and fixes to send, every other text asks for a receipt; a quarter of
the messages is lost, a tenth of the fixes, a tenth of the transmissions is refused by chance and a
twentieth swallowed; half-way one daemon is killed (SIGKILL) and started again. A line of JSON for
each pair: rates a minute of the daemon that is killed and of the other, what the terminals drew,
ends of the texts by name, and `lost_in_silence`: texts that were taken and have neither an end nor
a place among those that are kept on disk.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any

import aiomqtt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from drivers.rdss.messages import Family
from tests.broker import Broker, Listener, listening
from tests.hil.processes import DaemonProcess
from tests.live.radio import CARDS, Radio, config, said

FAMILY: Family = "4.0"
QUEUED = 2
"""Texts of each daemon that wait for a turn."""
OPEN = 30
"""Texts without an end, at most: two less than a daemon takes."""


class Book:
    """What was posted to a daemon and what it has said of each text since."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.posted: list[str] = []
        self.last: dict[str, dict[str, Any]] = {}
        self.taken: set[str] = set()
        self._read = 0

    def read(self, listener: Listener) -> None:
        """Take in what has come since the last call."""
        topics = f"fusiond/{self.name}/reply", f"fusiond/{self.name}/message"
        for message in listener.messages[self._read :]:
            topic = message.topic.value
            if topic not in topics:
                continue
            told = json.loads(bytes(message.payload))
            if topic == topics[0]:
                if told["ok"]:
                    self.taken.add(told["id"])
            elif told["kind"] == "text" and told["direction"] == "sent":
                self.last[told["id"]] = told
        self._read = len(listener.messages)

    @property
    def unended(self) -> set[str]:
        """Texts that have no end yet."""
        over = {number for number, of in self.last.items() if of["over"]}
        return set(self.posted) - over

    @property
    def waiting(self) -> int:
        """Texts that wait for a turn, or of which nothing is known yet."""
        return sum(self.last.get(n, {"state": "queued"})["state"] == "queued" for n in self.unended)

    async def post(self, client: aiomqtt.Client) -> None:
        """Post another text, every other with a receipt."""
        number = f"{self.name}-{len(self.posted)}"
        card = next(card for name, card in CARDS.items() if name != self.name)
        receipt = len(self.posted) % 2 == 0
        command = {"id": number, "card": card, "text": number, "receipt": receipt}
        self.posted.append(number)
        await client.publish(f"fusiond/{self.name}/cmd/send_message", json.dumps(command), qos=1)


async def exchange(folder: Path, card_s: int, minutes: float) -> dict[str, Any]:
    """Figures of a pair of daemons with cards of `card_s`."""
    radio = Radio(
        folder,
        FAMILY,
        loss_probability=0.25,
        refuse_probability=0.1,
        mute_probability=0.05,
        drop_probability=0.1,
        service_s=card_s,
        delay_s=(0.6, 5.0),
        mean_delay_s=1.5,
    )
    books = {name: Book(name) for name in CARDS}
    async with AsyncExitStack() as stack:
        broker = stack.enter_context(Broker(folder))
        network = await stack.enter_async_context(radio.on())
        listener, client = await stack.enter_async_context(listening(broker))
        daemons = {}
        for name in CARDS:
            path = config(folder, name, FAMILY, broker.port, expiry_s=3600.0)
            daemons[name] = await stack.enter_async_context(DaemonProcess(path))
            await daemons[name].start()
            await daemons[name].ready()
        for name in CARDS:
            await listener.until(partial(Listener.payloads, topic=f"fusiond/{name}/nav"))
        before = {name: _counts(radio, name) for name in CARDS}

        async def killed_and_started() -> float:
            """Seconds for which there was no daemon."""
            began_s = time.monotonic()
            os.kill(daemons["ahead"].pid, signal.SIGKILL)
            again = DaemonProcess(folder / "ahead.toml")
            daemons["ahead"] = await stack.enter_async_context(again)
            await again.start()
            await again.ready()
            return time.monotonic() - began_s

        start, restart = time.monotonic(), None
        while (passed_s := time.monotonic() - start) < 60.0 * minutes:
            for book in books.values():
                book.read(listener)
                if book.waiting < QUEUED and len(book.unended) < OPEN:
                    await book.post(client)
            if restart is None and passed_s > 30.0 * minutes:
                restart = asyncio.create_task(killed_and_started())
            await asyncio.sleep(0.1)
        after = {name: _counts(radio, name) for name in CARDS}
        down_s = await restart if restart is not None else 0.0
        await asyncio.sleep(1.0)
        for daemon in daemons.values():
            await daemon.terminate()
        for book in books.values():
            book.read(listener)
    return {
        "card_s": card_s,
        "minutes": round(minutes, 2),
        "down_s": round(down_s, 1),
        "allowed_per_min": round(60.0 / card_s, 2),
        **{
            f"{what}_per_min": [
                round((after[name][what] - before[name][what]) / minutes, 2) for name in CARDS
            ]
            for what in ("transmissions", "fixes", "messages")
        },
        "terminals": {name: after[name] - before[name] for name in CARDS},
        "least_spacing_s": round(
            min(b - a for t in radio.terminals.values() for a, b in itertools.pairwise(t.bursts_s)),
            2,
        ),
        **_ends(folder, books, listener),
        "network": dict(network.counters),
    }


def _counts(radio: Radio, name: str) -> Counter[str]:
    """Transmissions, answered fixes, and messages that left the antenna."""
    terminal = radio.terminals[name]
    bursts, fixes = len(terminal.bursts_s), terminal.counters["fixes"]
    asked = fixes + terminal.counters["dropped"]
    counts = Counter(transmissions=bursts, fixes=fixes, messages=bursts - asked)
    busy = {c: n for c, n in terminal.counters.items() if c.startswith(("refused", "muted"))}
    return counts + Counter(busy) + Counter(dropped=terminal.counters["dropped"])


def _ends(folder: Path, books: dict[str, Book], listener: Listener) -> dict[str, Any]:
    """Ends by name, and what contradicts them."""
    ends: Counter[str] = Counter()
    silent, false = [], []
    for name, book in books.items():
        other = next(n for n in CARDS if n != name)
        kept = (folder / f"{name}.messages.json").read_text()
        came = Counter(
            m["text"]
            for m in said(listener, other, "message")
            if m["direction"] == "received" and m["kind"] == "text" and not m["repeated"]
        )
        for number in book.posted:
            of = book.last.get(number)
            if of is not None and of["over"]:
                ends[of["state"]] += 1
                if of["state"] == "delivered" and came[number] != 1:
                    false.append(number)
            elif f'"{number}"' in kept:
                ends["kept"] += 1
            elif number in book.taken:
                silent.append(number)
            else:
                ends["not_taken"] += 1  # its command came while the daemon was down: no reply
    return {"ends": dict(ends), "lost_in_silence": silent, "delivered_falsely": false}


async def _all(folders: dict[int, Path], minutes: float) -> None:
    for found in asyncio.as_completed(
        [exchange(folders[card_s], card_s, minutes) for card_s in folders]
    ):
        print(json.dumps(await found), flush=True)


def main() -> None:
    """Run the exchange for each card."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cards", type=int, nargs="+", default=[1, 10, 60])
    parser.add_argument("--minutes", type=float, default=10.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fusiond-messages-") as folder:
        folders = {card_s: Path(folder) / f"card_{card_s}" for card_s in args.cards}
        for each in folders.values():
            each.mkdir()
        asyncio.run(_all(folders, args.minutes))


if __name__ == "__main__":
    main()
