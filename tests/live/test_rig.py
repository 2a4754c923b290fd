"""The rig of the faults on wires: what it does to bytes and samples is what it says."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusiond.studies.faults.error_sigma_score import Course, Sample
from tests.live.rig import AlteredImu, Wire
from tests.live.wire_faults import ALL, FAULTS
from tests.live.wire_runs import Run, judged
from tests.patience import until


@pytest.fixture
def line(tmp_path: Path) -> Iterator[tuple[Wire, int]]:
    """A wire and the descriptor of who reads it."""
    wire = Wire(tmp_path / "gnss")
    wire.plug()
    reader = os.open(wire.link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(reader)
    yield wire, reader
    os.close(reader)
    wire.unplug()


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 4096)
    except BlockingIOError:
        return b""


async def test_bytes_that_are_late_keep_their_order_and_come_in_one_burst_at_the_end(
    line: tuple[Wire, int],
) -> None:
    wire, reader = line
    heard = bytearray()

    def has(text: bytes) -> bool:
        heard.extend(_read(reader))
        return bytes(heard) == text

    assert wire.write(b"one ")
    await until(lambda: has(b"one "))
    wire.late_s = 0.2
    wire.write(b"two ")
    assert not has(b"one two ")
    await until(lambda: has(b"one two "))
    wire.late_s = 3600.0
    wire.write(b"three ")
    wire.write(b"four ")
    assert has(b"one two ")
    wire.late_s = 0.0
    wire.write(b"five")
    await until(lambda: has(b"one two three four five"))


async def test_bytes_are_altered_on_their_way(line: tuple[Wire, int]) -> None:
    wire, reader = line
    wire.alter = lambda data: data[:2]
    wire.write(b"half")
    wire.alter = lambda data: b""
    assert wire.write(b"nothing")
    heard = bytearray()
    await until(lambda: heard.extend(_read(reader)) or bytes(heard) == b"ha")


def test_samples_are_altered_and_lost() -> None:
    imu = AlteredImu()
    good = imu.frames(1, 10_000_000, [0.0] * 3, [0.0] * 3)
    imu.time = lambda t_ns: t_ns + 700_000_000
    ahead = imu.frames(1, 10_000_000, [0.0] * 3, [0.0] * 3)
    assert [f.data for f in ahead] != [f.data for f in good]
    imu.number = lambda n: None
    assert imu.frames(1, 10_000_000, [0.0] * 3, [0.0] * 3) == []


def test_a_start_that_comes_a_little_later_is_no_news_and_a_mode_that_is_never_usual_is() -> None:
    def course(*modes: str) -> Course:
        return Course([Sample(float(k), mode) for k, mode in enumerate(modes)], [])

    usual = course(*["aligning"] * 5, *["coasting"] * 10)
    later = course(*["aligning"] * 7, *["coasting"] * 8)
    assert judged(Run("nothing", "aligning", later, 2.0, 4.0), usual)["noticed_s"] is None
    lost = course(*["aligning"] * 5, *["coasting"] * 5, "invalid", *["coasting"] * 4)
    assert judged(Run("nothing", "aligning", lost, 2.0, 4.0), usual)["noticed_s"] == 8.0


def test_every_fault_has_phases_that_exist() -> None:
    for name, fault in FAULTS.items():
        assert fault.phases, name
        assert set(fault.phases) <= set(ALL), name
        assert not fault.first_byte or fault.phases == ("aligning",), name
