"""What hostile bytes cost: `python -m tests.fuzz.hostile` tells each parser's time by length.

The slope is that of log time over log length, by least squares over 1, 2, 4 and 8 times a length: 1
is a parser whose work a byte does not grow, 2 one that goes through all that came for each byte.
The shortest length is beyond what a parser may hold back for a frame, so that a bound of its buffer
does not pass for a slope; times are the processor's, the least of some.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

from drivers.can.bus import CanFrame
from drivers.nmea.decoder import NmeaDecoder
from drivers.nmea.mixed_framing import StreamSplitter
from drivers.ntrip.protocol import HEADER_BYTES, CasterRefusedError, CasterReply
from drivers.raw.decoder import RawDecoder
from drivers.rdss import binary_4_0, text_2_1
from fusiond.navigator.state_file import MOST_BYTES, DamagedStateError, read_state
from fusiond.outputs.commands import MAX_PAYLOAD_BYTES, BadCommandError, parse
from tests.drivers.nmea.sentences import GSA, gga, wire
from tests.drivers.raw.frames import lnav_words, measurement, rawx, rtcm, sfrbx, ubx
from tests.fuzz.documents import INPUT_FILE, STATES, TABLES
from tests.fuzz.targets import DECODING, DEVICES, EARLIEST, Planned

TIMES = (1, 2, 4, 8)
STREAM = 16_384
"""Twice the longest frame that is waited for."""


class Hostile(NamedTuple):
    """`shortest`: bytes (CAN: of frames' data); `read(data)` takes that many times 1 to 8."""

    parser: str
    pattern: str
    unit: bytes
    shortest: int
    read: Callable[[bytes], object]

    def times_s(self, tries: int) -> list[float]:
        """By the lengths; the least processor time of `tries`."""
        return [min(self._once(n * self.shortest) for _ in range(tries)) for n in TIMES]

    def _once(self, length: int) -> float:
        data = (self.unit * (length // len(self.unit) + 1))[:length]
        began = time.process_time()
        self.read(data)
        return time.process_time() - began


def slope(times_s: list[float]) -> float:
    """Of log time over log length."""
    x = [math.log(n) for n in TIMES]
    y = [math.log(t) for t in times_s]
    x0, y0 = sum(x) / len(x), sum(y) / len(y)
    return sum((a - x0) * (b - y0) for a, b in zip(x, y, strict=True)) / sum(
        (a - x0) ** 2 for a in x
    )


# --------------------------------------------------------------------------- readers


def _pieces(data: bytes, size: int) -> Iterator[bytes]:
    return (data[at : at + size] for at in range(0, len(data), size))


def _splitter(size: int) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        splitter = StreamSplitter()
        for piece in _pieces(data, size):
            splitter.feed(piece)
        splitter.finish()

    return read


def _nmea(data: bytes) -> None:
    decoder = NmeaDecoder("hostile", DECODING)
    for piece in _pieces(data, 61):
        decoder.feed(piece, 7)
    decoder.flush()


def _raw(data: bytes) -> None:
    decoder = RawDecoder("hostile", earliest=EARLIEST)
    for piece in _pieces(data, 255):
        decoder.feed(piece, 7)
    decoder.flush()


def _rdss(family: type[binary_4_0.Decoder] | type[text_2_1.Decoder]) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        decoder = family()
        for piece in _pieces(data, 61):
            decoder.feed(piece)
        while decoder.awaited_bytes:
            decoder.expire()

    return read


def _can(device: int, step_ns: int) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        decoder = Planned("imu", DEVICES[device])
        ids = [plan.message.frame_id for plan in decoder.plans] + [0x7FF]
        t_ns = 1_000_000_000
        for number, piece in enumerate(_pieces(data, 8)):
            t_ns += step_ns
            decoder.feed(CanFrame(ids[number % len(ids)], False, piece, t_ns, t_ns))

    return read


def _ntrip(head: bytes, size: int) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        reply = CasterReply()
        with suppress(CasterRefusedError):
            for piece in (head, *_pieces(data, size)):
                reply.feed(piece)

    return read


def _command(name: str) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        # One takes tens of microseconds: less than a clock tells well.
        for _ in range(20):
            with suppress(BadCommandError):
                parse(name, data)

    return read


def _state(kind: int) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        INPUT_FILE.write_bytes(data)
        for _ in range(5):
            with suppress(DamagedStateError):
                read_state(INPUT_FILE, STATES[kind])

    return read


def _table(head: bytes, rows: Callable[[int], Iterator[bytes]]) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        INPUT_FILE.write_bytes(head + b"\n".join(rows(len(data) // 8)))
        TABLES[5](INPUT_FILE)

    return read


# --------------------------------------------------------------------------- patterns

_ANY = random.Random(1).randbytes(8 * STREAM)
_FALSE = {
    "UBX of 8192": b"\xb5\x62\x02\x15\x00\x20",
    "UBX of 32": b"\xb5\x62\x01\x07\x20\x00",
    "RTCM of 1023": b"\xd3\x03\xff\x46\x70",
    "RTCM of 19": b"\xd3\x00\x13\x3e\xd0",
    "UBX and RTCM": b"\xb5\x62\x02\x15\x00\x20\xd3\x03\xff\x46\x70",
    "0xD3": b"\xd3",
    "0xB5": b"\xb5",
    "dollars": b"$",
    "no checksum": b"$GPGGA,",
    "bad checksums": b"$GPGGA,1*00",
    "any bytes": _ANY,
}
_MSM = rtcm(bytes.fromhex("4670000000000000") + b"\xff" * 200)
_CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
_WHEEL = b"t_s,speed_m_s\n"

HOSTILE = [
    *(
        Hostile("splitter", f"{name}, whole", unit, STREAM, _splitter(1 << 20))
        for name, unit in _FALSE.items()
    ),
    *(
        Hostile("splitter", f"{name}, by 7", unit, STREAM, _splitter(7))
        for name, unit in _FALSE.items()
    ),
    *(
        Hostile("nmea", name, unit, STREAM, _nmea)
        for name, unit in {
            **_FALSE,
            "one epoch, repeated": gga(1),
            "GSA without end": wire(GSA),
        }.items()
    ),
    *(
        Hostile("raw", name, unit, STREAM, _raw)
        for name, unit in {
            **_FALSE,
            "RAWX": rawx(*[measurement()] * 60),
            "RAWX cut short": ubx(b"\x02\x15", b"\xff" * 40),
            "MSM of all cells": _MSM,
            "SFRBX of all satellites": b"".join(sfrbx(0, n, 0, lnav_words(n)) for n in range(256)),
        }.items()
    ),
    *(
        Hostile("rdss_binary", name, unit, STREAM, _rdss(binary_4_0.Decoder))
        for name, unit in {
            "dollars": b"$",
            "frames of 240": b"$TXXX\x00\xf0",
            "frames of 11": b"$ICJC\x00\x0c",
            "unknown of 240": b"$ABCD\x00\xf0",
            "any bytes": _ANY,
        }.items()
    ),
    *(
        Hostile("rdss_text", name, unit, STREAM, _rdss(text_2_1.Decoder))
        for name, unit in {
            "dollars": b"$",
            "heads": b"$BDTXR,",
            "heads in lines of 500": b"$BDTXR," * 71 + b"\r\n",
            "bad checksums": b"$BDTXR,1*00\r\n",
            "any bytes": _ANY,
        }.items()
    ),
    *(
        Hostile("can", f"{name}, {kind}", unit, STREAM, _can(device, step))
        for device, kind in enumerate(("Racelogic", "SBG"))
        for name, unit, step in (
            ("one frame again", b"\0\1\2\3\4\5\6\7", 0),
            ("any data", _ANY, 300_000),
            ("time backwards", _ANY, -5_000_000),
            ("pauses", _ANY, 1 << 40),
        )
    ),
    Hostile("ntrip", "head without end", b"x", HEADER_BYTES // 8, _ntrip(b"", 1 << 20)),
    Hostile("ntrip", "head by bytes", b"x", HEADER_BYTES // 8, _ntrip(b"ICY 200 OK", 64)),
    Hostile("ntrip", "chunks of a byte", b"1\r\nx\r\n", 4 * STREAM, _ntrip(_CHUNKED, 1 << 20)),
    Hostile("ntrip", "chunks of a byte, by 7", b"1\r\nx\r\n", STREAM, _ntrip(_CHUNKED, 7)),
    Hostile("ntrip", "a chunk that is huge", b"ffffffff\r\n", STREAM, _ntrip(_CHUNKED, 7)),
    *(
        Hostile("commands", name, unit, MAX_PAYLOAD_BYTES // 8, _command("set_position"))
        for name, unit in {
            "depth": b"[",
            "depth of objects": b'{"a":',
            "digits": b"9",
            "keys": b'{"id":"a"' + b"".join(b',"%d":0' % n for n in range(700)),
            "escapes": b'"\\u00e9',
            "any bytes": _ANY,
        }.items()
    ),
    *(
        Hostile("state", name, unit, MOST_BYTES // 8, _state(0))
        for name, unit in {
            "depth": b"[",
            "digits": b"9",
            "keys": b'{"utc_s":1' + b"".join(b',"%d":0' % n for n in range(12_000)),
            "escapes": b'"\\u00e9',
            "any bytes": _ANY,
        }.items()
    ),
    Hostile(
        "csv",
        "time backwards",
        b"x",
        4 * STREAM,
        _table(_WHEEL, lambda n: (b"%d,1" % (n - i) for i in range(n))),
    ),
    Hostile(
        "csv",
        "time to and fro",
        b"x",
        4 * STREAM,
        _table(_WHEEL, lambda n: (b"%d,1" % (i * 7919 % n) for i in range(n))),
    ),
    Hostile(
        "csv",
        "no numbers",
        b"x",
        4 * STREAM,
        _table(_WHEEL, lambda n: (b"%d,a" % i for i in range(n))),
    ),
    Hostile(
        "csv",
        "one long cell",
        b"x",
        4 * STREAM,
        _table(_WHEEL, lambda n: iter((b"1," + b"9" * 8 * n,))),
    ),
    Hostile(
        "csv",
        "one wide header",
        b"x",
        4 * STREAM,
        _table(b"", lambda n: iter((_WHEEL[:-1] + b"".join(b",%d" % i for i in range(n)), b"1,1"))),
    ),
]


def main() -> int:
    print(f"{'parser':<12}{'pattern':<34}{'bytes':>8}{'us a byte, 1, 2, 4, 8 times':>36}  slope")
    for each in HOSTILE:
        times = each.times_s(3)
        costs = "".join(
            f"{1e6 * t / (n * each.shortest):9.3f}" for t, n in zip(times, TIMES, strict=True)
        )
        print(f"{each.parser:<12}{each.pattern:<34}{each.shortest:>8}{costs}  {slope(times):5.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
