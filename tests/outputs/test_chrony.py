"""Samples for chrony's SOCK: what they say, when, and that chronyd's absence harms nobody."""

from __future__ import annotations

import asyncio
import socket
import struct
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.measurements import TimeReport
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import ConfigError, load_config
from fusiond.configuration.outputs import Chrony
from fusiond.configuration.schema import ClockOptions
from fusiond.outputs.chrony import ChronySocket
from tests.clock.host_time import MS, Host, S
from tests.outputs.serving import Around
from tests.patience import until

LATENCY = 50 * MS
"""`serial_latency_s`, and the least lateness of the receiver below."""
AHEAD = 12 * MS
"""True UTC against the system clock."""


class Bench:
    """A clock with a receiver, and chronyd's end of the socket."""

    def __init__(self, folder: Path, utc: str = "gnss") -> None:
        self.host = Host(system_error=-AHEAD)
        self.clock = Clock(ClockOptions(utc=utc), self.host)
        self.around = Around(clock=self.clock)
        self.path = folder / "chrony.sock"
        self.output = ChronySocket(Chrony(socket=self.path), self.around.surroundings)
        self.chronyd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)

    def epochs(self, count: int, *, jump: int = 0, late: tuple[int, ...] = (0,)) -> None:
        """Epochs of a receiver at 5 Hz, whose UTC is wrong by `jump`, read `late` ns too late."""
        for k in range(count):
            self.host.mono += 200 * MS
            late_ns = LATENCY + late[k % len(late)]
            true_ns = self.host.mono + self.host.true_utc_at_zero
            report = TimeReport("gnss", self.host.mono, true_ns - late_ns + jump, True)
            self.clock.report(report)

    async def samples(self) -> list[tuple[float, float]]:
        """What has come since: instant of the system clock and offset, s."""
        await asyncio.sleep(0)
        found = []
        while True:
            try:
                data = self.chronyd.recv(100)
            except BlockingIOError:
                return found
            second, micro, offset, pulse, leap, pad, magic = struct.unpack("@lldiiii", data)
            assert (pulse, leap, pad, magic) == (0, 0, 0, 0x534F434B)
            found.append((second + micro * 1e-6, offset))


async def serving(bench: Bench) -> asyncio.Task[None]:
    bench.chronyd.bind(str(bench.path))
    task = asyncio.create_task(bench.output.run())
    await asyncio.sleep(0)
    return task


async def test_a_sample_a_second_is_the_least_late_report(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    task = await serving(bench)
    found = []
    for _ in range(8):  # a second each, taken before the next
        bench.epochs(5, late=(7 * MS, 3 * MS, 0, 9 * MS, 16 * MS))
        await asyncio.sleep(0)
        found += await bench.samples()
    task.cancel()
    assert len(found) == bench.output.counters["sent"] >= 5
    assert [offset for _, offset in found] == pytest.approx([AHEAD / S] * len(found), abs=1e-6)
    seconds = [at for at, _ in found]
    assert [b - a for a, b in pairwise(seconds)] == pytest.approx([1.0] * (len(found) - 1), abs=0.2)
    assert abs(seconds[-1] - bench.host.realtime_ns() / S) < 3.0
    assert bench.output.status.detail.endswith("UTC - system +0.0120 s")


async def test_nothing_before_utc_is_settled_nor_while_it_is_in_doubt(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    task = await serving(bench)
    bench.epochs(4)  # too few to know the least delay
    await asyncio.sleep(0)
    assert await bench.samples() == []
    bench.epochs(40)
    await asyncio.sleep(0)
    assert await bench.samples()
    bench.epochs(1, jump=3600 * S)
    sent = bench.output.counters["sent"]
    for _ in range(12):
        bench.epochs(5, jump=3600 * S)  # an hour: may be, but nobody else shall have it yet
        await asyncio.sleep(0)
    assert not bench.clock.sets_others
    assert bench.output.counters["sent"] <= sent + 1
    assert all(abs(offset) < 1.0 for _, offset in await bench.samples())
    task.cancel()


async def test_a_system_clock_that_is_slewed_shows_at_once(tmp_path: Path) -> None:
    """chrony has set the clock by 12 ms: the next samples say so, or it would do it again."""
    bench = Bench(tmp_path)
    task = await serving(bench)
    bench.epochs(40)
    await asyncio.sleep(0)
    await bench.samples()
    # A slew moves both of the host's clocks against true UTC.
    bench.host.mono += AHEAD
    bench.host.true_utc_at_zero -= AHEAD
    bench.host.system_error = 0
    bench.epochs(10)
    await asyncio.sleep(0)
    offsets = [offset for _, offset in await bench.samples()]
    assert offsets[-1] == pytest.approx(0.0, abs=2e-6)
    task.cancel()


async def test_chronyd_may_come_late_and_go(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    task = asyncio.create_task(bench.output.run())
    await asyncio.sleep(0)
    for _ in range(6):
        bench.epochs(5)
        await asyncio.sleep(0)
    await until(lambda: bench.output.status.state == "absent")
    bench.chronyd.bind(str(bench.path))
    bench.epochs(10)
    await until(lambda: bench.output.status.state == "running")
    assert [code for code, _ in bench.around.events] == ["chrony_absent"]
    assert bench.output.counters["failed"] >= 1
    assert await bench.samples()
    task.cancel()


def test_the_system_clock_is_not_set_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text('[clock]\nutc = "system"\n[outputs.chrony]\n')
    with pytest.raises(ConfigError, match="would set the system clock by itself"):
        load_config(path)
