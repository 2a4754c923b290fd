"""The recorder: what is kept, when, and what happens when the disk does not do its part."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.external_inputs import Inputs
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.recording import Recording
from fusiond.configuration.schema import ClockOptions, Config
from fusiond.outputs.messages.event import event_message
from fusiond.outputs.topics import EVENT
from fusiond.recording import log_writer
from fusiond.recording.info import info
from fusiond.recording.log_writer import logs_of
from fusiond.recording.mcap_writer import LogFile
from fusiond.recording.reader import Log
from fusiond.recording.recorder import Recorder, RecordingRefusedError
from fusiond.recording.records import Kind, tick_of
from tests.clock.host_time import MS, Host, S
from tests.patience import until


class Bench:
    """A recorder with one driver, in time of its own. Writing goes on in real time."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.folder = folder
        options = {"min_free_mb": 0.0, **options}
        config = Config(vehicle="test", recording=Recording(directory=folder, **options))
        self.host = Host()
        self.clock = Clock(ClockOptions(), self.host)
        self.events: list[tuple[str, str]] = []
        self.recorder = Recorder(config, self.clock, self.told)
        self.inputs = Inputs(self.host.monotonic_ns)
        self.inputs.on("read", lambda data, t_ns: self.clock.look())
        self.recorder.listen({"gnss": self.inputs})

    def told(self, code: str, text: str) -> None:
        self.events.append((code, text))
        self.event(code, "recording")

    def event(self, code: str, source: str = "navigator") -> None:
        self.recorder.publish(EVENT, event_message(None, source=source, code=code, text=code))

    def tick(self, count: int = 1, payload: bytes = b"$GNGGA") -> None:
        """Ticks of 10 ms, each after a read."""
        for _ in range(count):
            self.host.mono += 10 * MS
            self.inputs.take("read", payload)
            self.recorder.tick_begins(self.host.mono)
            self.recorder.tick_ended(self.host.mono, 0, 0, bytes(8))

    @property
    def files(self) -> list[Path]:
        return sorted(self.folder.glob("*.mcap"))

    def ticks(self) -> list[int]:
        """The instants of the recorded ticks."""
        return [r.t_ns for r in Log(self.files).records() if r.kind is Kind.TICK]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def bench(**options: Any) -> Bench:
        made.append(Bench(tmp_path / "logs", **options))
        return made[-1]

    yield bench
    for each in made:
        each.recorder.close()


def test_everything_is_there_in_its_order(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.recorder.arm({"saved": None})
    bench.tick(3)
    bench.inputs.sent(b"$CCTXA")
    bench.host.system_error = S
    bench.tick()
    bench.recorder.close()
    records = list(Log(bench.files).records())
    kinds = [r.kind for r in records]
    four = [Kind.READ, Kind.TICK]
    assert kinds == [Kind.START, *four * 3, Kind.SENT, *four]
    assert [tick_of(r).inputs for r in records if r.kind is Kind.TICK] == [1, 2, 3, 4]
    ahead = [reading[2] for r in records for reading in r.readings if reading[0] == 0]
    assert ahead[-1] - ahead[0] == S  # the step, as it was read
    codes = [m.json()["code"] for m in Log(bench.files).messages("/event")]
    assert codes == ["recording_started"]


def test_recording_starts_and_stops_by_command(make: Callable[..., Bench]) -> None:
    bench = make(when="command")
    bench.recorder.arm({})
    bench.tick(2)
    with pytest.raises(RecordingRefusedError, match="nothing is being recorded"):
        bench.recorder.end("told")
    name = bench.recorder.begin()
    with pytest.raises(RecordingRefusedError, match=name):
        bench.recorder.begin()
    assert bench.recorder.recording.state == "recording"
    bench.tick(2)
    assert bench.recorder.end("told") == name
    assert bench.recorder.recording.state == "off"
    assert bench.inputs.on_input is None
    bench.tick(2)
    bench.recorder.close()
    assert len(bench.ticks()) == 2
    assert [code for code, _ in bench.events] == ["recording_started", "recording_stopped"]


def test_without_a_directory_nothing_can_be_recorded() -> None:
    recorder = Recorder(Config(), Clock(ClockOptions(), Host()), lambda code, text: None)
    recorder.arm({})
    with pytest.raises(RecordingRefusedError, match=r"recording\.directory is not configured"):
        recorder.begin()


def test_an_event_keeps_what_was_before_it(make: Callable[..., Bench]) -> None:
    bench = make(when="event", before_s=1.0, after_s=2.0, events=("diverged",))
    bench.recorder.arm({})
    bench.tick(500)
    assert bench.recorder.recording.state == "waiting"
    bench.event("mode_navigating")
    assert bench.recorder.recording.state == "waiting"
    at_ns = bench.host.mono
    bench.event("diverged")
    bench.tick(100)
    bench.event("diverged")  # again: the end moves on
    bench.tick(500)
    assert bench.recorder.recording.state == "waiting"
    bench.recorder.close()
    ticks = bench.ticks()
    assert at_ns - ticks[0] == pytest.approx(S, abs=30 * MS)
    assert ticks[-1] - at_ns == pytest.approx(3 * S, abs=30 * MS)
    assert [code for code, _ in bench.events] == ["recording_started", "recording_stopped"]


def test_a_recording_is_split_and_the_oldest_goes(make: Callable[..., Bench]) -> None:
    bench = make(split_mb=1.0, keep_mb=2.5)
    foreign = bench.folder / "test_by_hand.mcap"
    bench.folder.mkdir()
    foreign.write_bytes(bytes(3_000_000))
    bench.recorder.arm({})
    for _ in range(60):  # 6 MB that do not compress
        bench.tick(payload=os.urandom(100_000))
    bench.recorder.close()
    parts = sorted(logs_of(bench.folder, "test"))
    assert len(parts) >= 5
    assert all(path.stat().st_size < 1_300_000 for path in parts)
    for path in parts:  # each says all of itself
        about = Log([path]).about
        assert {"version", "host", "run", "part", "epoch_ns"} <= about.metadata.keys()
        assert "config.json" in about.attachments
    missing = f"{parts[2].name}: a part before it is missing"
    assert info(Log([parts[0], parts[2]]))["problems"][0] == missing
    second = make(keep_mb=2.5)
    second.recorder.arm({})
    second.recorder.close()
    assert foreign.exists()
    assert sum(p.stat().st_size for p in logs_of(bench.folder, "test")) < 2_500_000


# --------------------------------------------------------------------------- the disk


async def test_a_full_disk_ends_the_recording_not_the_daemon(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make()
    bench.recorder.arm({})
    bench.tick(10)
    sync = LogFile.sync
    synced = threading.Event()

    def once(self: LogFile) -> None:
        if synced.is_set():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(self)
        if len(bench.ticks()) >= 9:  # else it was of a chunk before the ten
            synced.set()

    monkeypatch.setattr(LogFile, "sync", once)
    await until(synced.is_set)

    def failed() -> bool:
        bench.tick()
        return bench.recorder.recording.state == "failed"

    await until(failed)
    code, text = bench.events[-1]
    assert (code, "No space left" in text) == ("recording_failed", True)
    bench.tick(10)
    assert len(bench.ticks()) >= 9  # what was synced can be read; the last tick was still open


@pytest.mark.parametrize("where", ["a file", "little room"])
async def test_where_nothing_can_be_written_it_says_why(
    make: Callable[..., Bench], where: str
) -> None:
    bench = make(min_free_mb=1e9 if where == "little room" else 0.0)
    if where == "a file":
        bench.folder.write_text("not a folder")
    bench.recorder.arm({})

    def failed() -> bool:
        bench.tick()
        return bench.recorder.recording.state == "failed"

    await until(failed)
    why = bench.events[-1][1]
    assert "File exists" in why if where == "a file" else "recording.min_free_mb" in why
    assert bench.inputs.on_input is None


async def test_a_recording_that_failed_takes_up_again_by_itself(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the disk takes nothing it is tried again and again, and nobody hears of that."""
    sync, broken, tried = LogFile.sync, threading.Event(), 0

    def perhaps(self: LogFile) -> None:
        nonlocal tried
        if broken.is_set():
            tried += 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        sync(self)

    monkeypatch.setattr(LogFile, "sync", perhaps)
    monkeypatch.setattr(log_writer, "WRITE_S", 0.01)
    bench = make()
    bench.recorder.arm({})
    bench.tick(10)
    broken.set()

    def ticked(done: Callable[[], bool]) -> Callable[[], bool]:
        def look() -> bool:
            bench.tick(20)
            return done()

        return look

    await until(ticked(lambda: tried >= 4))
    assert bench.recorder.recording.state == "failed"
    broken.clear()
    await until(ticked(lambda: bench.recorder.recording.state == "recording"))
    codes = [code for code, _ in bench.events]
    assert codes == ["recording_started", "recording_failed", "recording_started"]
    bench.tick(10)
    bench.recorder.close()
    again = Log([bench.files[-1]])
    assert sum(1 for r in again.records() if r.kind is Kind.TICK) >= 10
    assert again.problems == []


async def test_a_recording_that_failed_can_be_ended(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make(min_free_mb=1e9)
    bench.recorder.arm({})

    def failed() -> bool:
        bench.tick()
        return bench.recorder.recording.state == "failed"

    await until(failed)
    assert bench.recorder.end("an operator said so").startswith("nothing")
    bench.tick(2000)
    assert bench.recorder.recording.state == "off"


async def test_after_a_failure_it_waits_for_the_next_event(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    free_mb = 0.0
    monkeypatch.setattr(log_writer, "_free_mb", lambda folder: free_mb)
    bench = make(when="event", events=("diverged",), min_free_mb=1.0)
    bench.recorder.arm({})
    bench.event("diverged")

    def ticked(state: str) -> bool:
        bench.tick(20)
        return bench.recorder.recording.state == state

    await until(lambda: ticked("failed"))
    free_mb = 1e6
    await until(lambda: ticked("waiting"))
    bench.event("diverged")
    assert bench.recorder.recording.state == "recording"


async def test_a_slow_disk_costs_messages_and_no_tick(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk stands still until it is released: what the queue cannot hold is counted."""
    monkeypatch.setattr(log_writer, "QUEUE", 100)
    released = threading.Event()
    sync = LogFile.sync

    def slow(self: LogFile) -> None:
        released.wait()
        sync(self)

    monkeypatch.setattr(LogFile, "sync", slow)
    bench = make()
    bench.recorder.arm({})
    bench.tick(1000)
    assert bench.recorder.recording.dropped > 500
    released.set()

    def taken() -> bool:
        before = bench.recorder.recording.dropped
        bench.tick()
        return bench.recorder.recording.dropped == before

    await until(taken)
    bench.recorder.close()
    log = Log(bench.files)
    assert 50 < sum(1 for r in log.records() if r.kind is Kind.TICK) < 500
    assert any("messages of input are missing" in p for p in log.problems)
