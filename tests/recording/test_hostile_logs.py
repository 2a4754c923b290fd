"""Files that look like logs of ours: what they claim is not believed, and costs no memory."""

from __future__ import annotations

import importlib
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import zstandard

from fusiond.recording.channels import CHANNELS, INPUT
from fusiond.recording.info import info
from fusiond.recording.mcap_writer import FORMAT, About, LogFile
from fusiond.recording.reader import CHUNK_LIMIT, MOST_PROBLEMS, RATIO_FREE, Log, LogError
from fusiond.recording.records import NO_SOURCE, Kind, Record, pack

ABOUT = {
    **{"format": FORMAT, "run": "r", "part": "0", "vehicle": "truck", "epoch_ns": "5"},
    "sources": '["gnss"]',
}
MEGABYTE = 1 << 20


def log_with(path: Path, *chunks: bytes, **changed: str) -> Path:
    """A sound log of one event, then these records."""
    file = LogFile(path, About({**ABOUT, **changed}), 1)
    file.write(CHANNELS["/event"], 1, b'{"code": "sound"}')
    file.sync()
    file.abandon()
    with path.open("ab") as more:
        for chunk in chunks:
            more.write(chunk)
    return path


def chunk(said: int, data: bytes, kind: bytes = b"zstd", crc: int = 0) -> bytes:
    """MCAP's record of a chunk that says that it has `said` bytes."""
    head = struct.pack("<QQQII", 1, 1, said, crc, len(kind)) + kind
    body = head + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def zstd(data: bytes, *, sized: bool) -> bytes:
    return zstandard.ZstdCompressor(write_content_size=sized).compress(data)


def lz4(data: bytes) -> bytes:
    return bytes(importlib.import_module("lz4.frame").compress(data))


LITTLE = 1000


@cache
def huge() -> bytes:
    return bytes(400 * MEGABYTE)


# Made when a test asks: to compress it takes seconds, in every process that collects the tests.
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "says much": (lambda: chunk(len(huge()), zstd(huge(), sized=True)), "at most"),
    "says all that there is": (lambda: chunk((1 << 63) - 1, b""), "at most"),
    "says little": (
        lambda: chunk(LITTLE, zstd(huge(), sized=True)),
        "1001 bytes when decompressed",
    ),
    "says little, and its frame nothing": (
        lambda: chunk(LITTLE, zstd(huge(), sized=False)),
        "1001 bytes",
    ),
    "says little in lz4": (lambda: chunk(LITTLE, lz4(huge()), b"lz4"), "1001 bytes"),
    "has less than it says": (
        lambda: chunk(LITTLE, zstd(b"ab", sized=True)),
        "2 bytes when decompressed",
    ),
    "is long for what it is made of": (
        lambda: chunk(RATIO_FREE * 2, zstd(bytes(RATIO_FREE * 2), sized=True)),
        "at most",
    ),
    "is compressed by what we lack": (lambda: chunk(1, b"a", b"brotli"), "'brotli'"),
    "has another checksum": (lambda: chunk(2, b"ab", b"", crc=1), "checksum"),
    "is no frame of zstd": (lambda: chunk(2, b"ab"), "damaged chunk"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_chunk_that_is_none_is_left_out_and_costs_no_memory(case: str, tmp_path: Path) -> None:
    make, why = HOSTILE[case]
    sound = b"\x05" + struct.pack("<QHIQQ", 24, 1, 0, 9, 9) + b"{}"
    last = chunk(len(sound), sound, b"", zlib.crc32(sound))
    path = log_with(tmp_path / "a.mcap", make(), last)
    tracemalloc.start()
    try:
        log = Log([path])
        found = [message.data for message in log.messages()]
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found == [b'{"code": "sound"}', b"{}"]
    assert any("a damaged chunk is left out" in text and why in text for text in log.problems)
    assert most < 5 * MEGABYTE  # of 400; in lz4 the record itself has 1.6


def test_a_chunk_of_another_writer_is_read(tmp_path: Path) -> None:
    """Of 4 MiB, as the tool `mcap` makes them."""
    message = b"\x05" + struct.pack("<QHIQQ", 22 + 40, 1, 0, 9, 9)
    many = b"".join(message + (b"%d" % k).rjust(40) for k in range(4 * MEGABYTE // 71))
    assert len(many) < CHUNK_LIMIT
    zipped = zstd(many, sized=True)
    log = Log([log_with(tmp_path / "a.mcap", chunk(len(many), zipped, crc=zlib.crc32(many)))])
    assert sum(1 for _ in log.messages()) == 1 + 4 * MEGABYTE // 71
    assert not any("left out" in text for text in log.problems)


@pytest.mark.parametrize(
    "changed",
    [
        {"part": "x"},
        {"epoch_ns": ""},
        {"sources": "{"},
        {"sources": "[1]"},
        {"sources": "[" * 5000},
        {"sources": "5"},
    ],
)
def test_a_log_that_describes_itself_wrongly_is_refused(
    changed: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises(LogError, match="metadata 'fusiond' are damaged"):
        Log([log_with(tmp_path / "a.mcap", **changed)])


def test_deeply_nested_messages_are_refused(tmp_path: Path) -> None:
    deep = b"[" * 100_000
    message = b"\x05" + struct.pack("<QHIQQ", 22 + len(deep), 1, 0, 9, 9) + deep
    zipped = zstd(message, sized=True)
    log = Log([log_with(tmp_path / "a.mcap", chunk(len(message), zipped))])
    first, last = log.messages()
    assert first.json() == {"code": "sound"}
    with pytest.raises(ValueError, match="too deep"):
        last.json()
    with pytest.raises(json.JSONDecodeError):
        first._replace(data=b"{").json()


def input_log(path: Path, *records: bytes) -> Log:
    file = LogFile(path, About(ABOUT), 1)
    for sequence, record in enumerate(records, start=1):
        file.write(CHANNELS[INPUT], 1, record, sequence)
    file.finish()
    return Log([path])


SOUND = pack(Record(Kind.TICK, NO_SOURCE, 1, bytes(32)))
OTHERS = {
    "a source that the log has not": pack(Record(Kind.READ, 1, 2, b"a")),
    "a tick of a source": pack(Record(Kind.TICK, 0, 2, bytes(32))),
    "a read of nobody": pack(Record(Kind.READ, NO_SOURCE, 2, b"a")),
    "a tick that is short": pack(Record(Kind.TICK, NO_SOURCE, 2, b"a")),
    "a frame that is short": pack(Record(Kind.FRAME, 0, 2, b"a")),
    "a command that is a list": pack(Record(Kind.COMMAND, NO_SOURCE, 2, b"[1]")),
    "a command of depth": pack(Record(Kind.COMMAND, NO_SOURCE, 2, b"[" * 100_000)),
    "a start of no JSON": pack(Record(Kind.START, NO_SOURCE, 2, b"{")),
    "a reason in no alphabet": pack(Record(Kind.CLOSE, 0, 2, b"\xff")),
    "a time before 1970": pack(Record(Kind.OPEN, 0, -6, b"")),
    "a reading before 1970": pack(Record(Kind.OPEN, 0, 2, b"", [(0, -6, 0)])),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_record_that_nobody_writes_is_left_out_and_named(case: str, tmp_path: Path) -> None:
    log = input_log(tmp_path / "a.mcap", SOUND, OTHERS[case] + SOUND, SOUND)
    told = info(log)
    assert told["ticks"] == 3
    assert len(told["problems"]) == 1
    assert told["problems"][0].startswith("message 2 of input: ")


def test_times_beyond_four_digits_of_a_year_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = LogFile(path, About({**ABOUT, "epoch_ns": str(300_000_000_000 * 10**9)}), 1)
    file.write(CHANNELS[INPUT], 1, SOUND, 1)
    file.finish()
    told = info(Log([path]))
    assert told["ticks"] == 0
    assert len(told["problems"]) == 1


def test_a_length_inside_a_record_asks_for_no_memory(tmp_path: Path) -> None:
    """Of a chunk of 60 bytes that says that its data have 100 GB."""
    record = bytearray(chunk(2, b"ab", b""))
    record[9 + 32 : 9 + 40] = struct.pack("<Q", 100_000_000_000)
    log = Log([log_with(tmp_path / "a.mcap", bytes(record))])
    assert [message.topic for message in log.messages()] == ["/event"]
    assert any("cut off" in text for text in log.problems)


def test_at_most_a_hundred_problems_are_listed(tmp_path: Path) -> None:
    wrong = [pack(Record(Kind.READ, 1, 2, b"a")) for _ in range(500)]
    log = input_log(tmp_path / "a.mcap", *wrong)
    assert list(log.records()) == []
    assert len(log.problems) == MOST_PROBLEMS
