"""Every splitter and framer of `drivers`: its work goes with the bytes, whatever these are.

Work is lines of `drivers` that Python runs, and the bytes that checks sum: the same on any host.
What runs inside one line is judged by processor time (tests/fuzz/hostile.py).
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import drivers
from drivers.bestpos.decoder import BestposDecoder
from drivers.bestpos.framing import LogSplitter
from drivers.nmea.compass import CompassDecoder, CompassDecoding
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.mixed_framing import NmeaSplitter, StreamSplitter
from drivers.ntrip import client
from drivers.ntrip.protocol import CasterRefusedError, CasterReply
from drivers.raw.decoder import RawDecoder
from drivers.raw.driver import GnssDecoder
from drivers.rdss import binary_4_0, text_2_1
from drivers.sbf.decoder import SbfDecoder
from drivers.sbf.framing import BlockSplitter
from drivers.ubx.decoder import UbxDecoder

Feed = Callable[[bytes], object]


def _stamped(decoder: Any) -> Feed:
    return lambda data: decoder.feed(data, 7)


def _reply() -> Feed:
    reply = CasterReply()
    reply.feed(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n")

    def feed(data: bytes) -> None:
        if reply.over is None:
            with suppress(CasterRefusedError):
                reply.feed(data)

    return feed


STREAMS: dict[type, Callable[[], Feed]] = {
    StreamSplitter: lambda: StreamSplitter().feed,
    NmeaSplitter: lambda: NmeaSplitter().feed,
    NmeaDecoder: lambda: _stamped(NmeaDecoder("a", NmeaDecoding())),
    CompassDecoder: lambda: _stamped(CompassDecoder("a", CompassDecoding(), Counter())),
    RawDecoder: lambda: _stamped(RawDecoder("a")),
    GnssDecoder: lambda: _stamped(GnssDecoder("a", NmeaDecoding())),
    binary_4_0.Decoder: lambda: binary_4_0.Decoder().feed,
    text_2_1.Decoder: lambda: text_2_1.Decoder().feed,
    client._Frames: lambda: client._Frames(Counter()).feed,
    CasterReply: _reply,
    LogSplitter: lambda: LogSplitter(Counter()).feed,
    BlockSplitter: lambda: BlockSplitter(Counter()).feed,
    BestposDecoder: lambda: _stamped(BestposDecoder("a")),
    SbfDecoder: lambda: _stamped(SbfDecoder("a")),
    UbxDecoder: lambda: _stamped(UbxDecoder("a")),
}
"""What is fed with bytes. What is fed with CAN frames gets eight bytes and has done with them."""

PER_BYTE, PER_PIECE = 40, 100
"""Lines; about twice what was found in streams of one unit, 20 a byte, 50 a piece."""
LENGTH = 12_288
"""Half as much again as the longest frame that is waited for."""

SYNC = st.sampled_from(
    (
        *(b"$", b"*", b"$GPGGA,", b"*00\r\n", b"$BDTXR,", b"$TXXX\x00\xf0", b"1\r\nx\r\n", b"\r\n"),
        *(b"\xd3", b"\xd3\x00", b"\xd3\x00\x13\x3e\xd0", b"\xd3\x03\xff\x46\x70"),
        *(b"\xb5", b"\xb5\x62", b"\xb5\x62\x02\x15\x00\x20", b"\xb5\x62\x01\x07\x20\x00"),
    )
)
UNITS = st.lists(SYNC | st.binary(min_size=1, max_size=3), min_size=1, max_size=4).map(b"".join)


def lines_of(feed: Feed, data: bytes, size: int) -> int:
    """Lines of `drivers` that run while `data` is fed in pieces."""
    lines = 0
    ours = drivers.__path__[0]

    def count(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal lines
        if event == "call" and not frame.f_code.co_filename.startswith(ours):
            return None
        lines += event == "line"
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        for at in range(0, len(data), size):
            feed(data[at : at + size])
    finally:
        sys.settrace(before)
    return lines


@pytest.mark.parametrize("kind", STREAMS, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
@given(unit=UNITS, size=st.sampled_from([1, 7, 255, 1024]))
@settings(max_examples=8, deadline=None)
def test_work_goes_with_bytes(kind: type, unit: bytes, size: int) -> None:
    data = (unit * (LENGTH // len(unit) + 1))[:LENGTH]
    pieces = -(-LENGTH // size)
    assert lines_of(STREAMS[kind](), data, size) <= PER_BYTE * LENGTH + PER_PIECE * pieces


@pytest.mark.parametrize("kind", STREAMS, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
@pytest.mark.parametrize("byte", [0xD3, 0xB5, 0x24, 0x00, 0xFF])
def test_one_byte_again_and_again(kind: type, byte: int) -> None:
    lines = lines_of(STREAMS[kind](), bytes((byte,)) * LENGTH, 1024)
    assert lines <= PER_BYTE * LENGTH


@given(unit=UNITS, size=st.sampled_from([1, 7, 1024]))
@settings(max_examples=20, deadline=None)
def test_checks_sum_no_byte_often(unit: bytes, size: int) -> None:
    splitter = StreamSplitter()
    data = (unit * (LENGTH // len(unit) + 1))[:LENGTH]
    for at in range(0, LENGTH, size):
        splitter.feed(data[at : at + size])
    assert splitter.summed <= 3 * LENGTH  # Fletcher's sums twice, the CRC once


def test_no_stream_is_left_out() -> None:
    found = set()
    for module in pkgutil.walk_packages(drivers.__path__, "drivers."):
        for _, one in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            feed = inspect.getattr_static(one, "feed", None)
            if not one.__module__.startswith("drivers") or feed is None:
                continue
            takes = list(inspect.signature(feed).parameters.values())[1]
            protocol = getattr(one, "_is_protocol", False) or inspect.isabstract(one)
            if str(takes.annotation) == "bytes" and not protocol:
                found.add(one)
    assert found == set(STREAMS)
