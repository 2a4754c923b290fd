"""Targets of receivers' own solutions and of RINEX: one function a parser, as in `targets`.

A line of an input becomes one message with a good check where the choice says so, so that a fuzzer
reaches what stands behind it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from drivers.bestpos.decoder import BestposDecoder
from drivers.bestpos.framing import log_crc
from drivers.decoder_options import SolutionDecoding
from drivers.measurements import Heading, PositionFix
from drivers.plausible import HEIGHT_M, SIGMA_M, SPEED_M_S, within
from drivers.raw.messages import Ephemeris
from drivers.raw.rinex import ObservationReader, RinexError, version_and_type
from drivers.raw.rinex2_to_3 import as_version_3
from drivers.raw.rinex_nav import navigation
from drivers.sbf.decoder import SbfDecoder
from drivers.ubx.decoder import UbxDecoder
from tests.drivers.raw.frames import ubx as ubx_frame
from tests.drivers.sbf.blocks import block
from tests.fuzz.documents import input_of
from tests.fuzz.pieces import EARLIEST, whole_and_cut

DECODING = SolutionDecoding(earliest_date=EARLIEST, allow_simulator=True)


def _check(events: Sequence[object]) -> None:
    for event in events:
        if isinstance(event, PositionFix):
            assert abs(event.lat_rad) <= math.pi / 2
            assert abs(event.lon_rad) <= math.pi
            assert event.height_m is None or within(event.height_m, HEIGHT_M)
            assert all(within(sd, SIGMA_M) for sd in event.sd_ned_m or ())
            if event.v_ned_m_s is not None:
                assert all(x is None or math.isfinite(x) for x in event.v_ned_m_s)
                assert math.hypot(*event.v_ned_m_s[:2]) <= SPEED_M_S * (1.0 + 1e-12)
        elif isinstance(event, Heading):
            assert abs(event.yaw_rad) <= math.pi
            assert event.sd_rad is None or 0.0 < event.sd_rad < math.pi


def _solutions(kind: Any, mend: Callable[[bytes], bytes], data: bytes) -> None:
    """The same for any split, finite and plausible; nothing stays behind."""
    choice, stream = input_of(data)
    if choice & 8:
        stream = b"".join(mend(line) for line in stream.split(b"\n"))
    found = []
    for one, pieces in whole_and_cut(kind, choice, stream):
        decoder = one("fuzz", DECODING)
        events = [event for piece in pieces for event in decoder.feed(piece, 7)]
        found.append((events + decoder.flush(), decoder.counters))
        assert not decoder.epoch_open
    assert found[0] == found[1]
    _check(found[0][0])


def ubx(data: bytes) -> None:
    """UBX-NAV: a line is class, identifier and payload."""
    _solutions(UbxDecoder, lambda line: ubx_frame(line[:2], line[2:]) if line[2:] else line, data)


def _log(line: bytes) -> bytes:
    text = line.strip(b"#\r").partition(b"*")[0]
    return b"#%b*%08x\r\n" % (text, log_crc(text))


def bestpos(data: bytes) -> None:
    """Logs of the BESTPOS family: a line is one, without its CRC."""
    _solutions(BestposDecoder, _log, data)


def _block(line: bytes) -> bytes:
    number = int.from_bytes(line[:2], "little")
    return block(number & 0x1FFF, line[2:], number >> 13)


def sbf(data: bytes) -> None:
    """SBF: a line is number with revision, and body."""
    _solutions(SbfDecoder, _block, data)


def rinex(data: bytes) -> None:
    """A RINEX file is read, or RinexError says why not."""
    text = data.decode("latin-1")
    counters = Counter[str]()
    try:
        text = as_version_3(text)
        if version_and_type(text)[1] == "N":
            for record in navigation("fuzz", text, counters):
                if isinstance(record.message, Ephemeris):
                    assert 0.0 <= record.message.eccentricity < 1.0
                    assert math.isfinite(record.gps_s + record.message.clock_bias_s)
        else:
            for epoch in ObservationReader("fuzz", text, counters).epochs():
                assert 0.0 <= epoch.tow_s < 604_800.0
                for signal in epoch.signals:
                    assert math.isfinite(signal.pseudorange_m)
    except RinexError:
        pass
