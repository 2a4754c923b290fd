"""How long a piece of a guest's work takes, attack by attack:

    python benchmarks/attack_pieces.py [SECONDS]

The servers alone, in this process, with messages at 10 Hz; attacked as by `benchmarks/attack.py`. A
row has the processor time, ms, of the longest piece that was sent and heard, of the longest turn of
the door (`fusiond.outputs.client_sockets`) and of the longest look at who waits: what a tick may
have to wait for at most, on whatever computer this is, however much else runs on it. The garbage
collector is off, as it is in the daemon's ticks.
"""

from __future__ import annotations

import asyncio
import gc
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.attackers import ATTACKS, OVER_THE_BROKER, Ports
from fusiond.configuration.outputs import Foxglove, Gpsd, NmeaServed, Prometheus
from fusiond.outputs.base import Output, Surroundings
from fusiond.outputs.client_sockets import Guests
from fusiond.outputs.foxglove.server import FoxgloveServer
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.nmea import NmeaServer
from fusiond.outputs.prometheus import PrometheusEndpoint
from fusiond.outputs.topics import NAV, TOPICS
from tests.broker import free_port
from tests.outputs.messages_examples import EXAMPLES

PIECES = {"sent": "_send_one", "heard": "_receive_one", "turn": "_turn", "look": "_look"}
_OF_QUEUES = ("sent", "heard")


class Longest(defaultdict[str, int]):
    """How long each kind of work took at most, ns."""

    def __init__(self) -> None:
        super().__init__(int)

    def watch(self, worker: Any, titles: Iterable[str]) -> None:
        """Time the pieces of one who works."""
        for title in titles:
            setattr(worker, PIECES[title], self._timed(title, getattr(worker, PIECES[title])))

    def _timed(self, title: str, work: Callable[[], Any]) -> Callable[[], Any]:
        def timed() -> Any:
            begun_ns = time.thread_time_ns()
            done = work()
            took_ns = time.thread_time_ns() - begun_ns
            self[title] = max(self[title], took_ns)
            return done

        return timed


async def _feed(outputs: Sequence[Output]) -> None:
    """`nav` at 10 Hz, all else once a second."""
    number = 0
    while True:
        for topic in TOPICS:
            if topic.name in EXAMPLES and (topic is NAV or number % 10 == 0):
                for output in outputs:
                    output.publish(topic, EXAMPLES[topic.name])
        number += 1
        await asyncio.sleep(0.1)


async def main(seconds: str) -> None:
    guests, longest_ns = Guests(), Longest()
    longest_ns.watch(guests, PIECES.keys() - _OF_QUEUES)
    around = Surroundings("load", lambda code, text: None, guests=guests)
    ports = Ports(*(free_port() for _ in Ports._fields))
    outputs = (
        GpsdServer(Gpsd(port=ports.gpsd), around),
        NmeaServer(NmeaServed(port=ports.nmea), around),
        PrometheusEndpoint(Prometheus(port=ports.prometheus), around),
        FoxgloveServer(Foxglove(port=ports.foxglove), around),
    )
    for output in outputs:
        longest_ns.watch(output.server.queue, _OF_QUEUES)
    tasks = [asyncio.create_task(output.run()) for output in outputs]
    tasks.append(asyncio.create_task(_feed(outputs)))
    await asyncio.sleep(1.0)
    gc.collect()
    gc.freeze()
    gc.disable()
    print("".join(title.rjust(18 if title == "attack" else 8) for title in ("attack", *PIECES)))
    for name in (name for name in ATTACKS if name not in OVER_THE_BROKER):
        longest_ns.clear()
        attack = await asyncio.create_subprocess_exec(
            *(sys.executable, str(Path(__file__).with_name("attackers.py"))),
            *map(str, (name, seconds, *ports)),
            stdout=subprocess.DEVNULL,
        )
        await attack.wait()
        row = (f"{longest_ns[title] * 1e-6:.2f}".rjust(8) for title in PIECES)
        print(name.rjust(18) + "".join(row), flush=True)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "4"))
