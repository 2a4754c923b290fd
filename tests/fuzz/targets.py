"""What is fuzzed: one function a parser, which raises where arbitrary bytes break a promise.

No exception escapes; every byte is accounted for; bytes in any split give the same; false headers
do not multiply the work. The first byte of an input chooses the split and whether checks are mended
first, so that a fuzzer reaches what stands behind them. What is no stream is in `documents`.
"""

from __future__ import annotations

import functools
import math
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from drivers.can.bus import CanFrame
from drivers.can.dbc import MessagePlan
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import DeviceStamp, Heading, ImuSample, Measurement, PositionFix
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.ntrip.protocol import CasterRefusedError, CasterReply
from drivers.plausible import HEIGHT_M, SIGMA_M, SPEED_M_S, within
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Correction, Ephemeris, RawGnssEpoch
from drivers.raw.rtcm import load_pyrtcm
from drivers.raw.ssr import LARGEST_M, MESSAGES
from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.framing import FrameDecoder, checksum
from drivers.rdss.messages import Message
from tests.drivers.raw.frames import beidou_words, inav_words, lnav_words, with_crc
from tests.fuzz.documents import commands, csv, hub, input_of, log, state
from tests.fuzz.mail import rdss_mail
from tests.fuzz.pieces import EARLIEST, UNTRACED, mended_lines, pieces_of, whole_and_cut
from tests.fuzz.recordings import can_log, dbc
from tests.fuzz.solutions import bestpos, rinex, sbf, ubx

__all__ = ["TARGETS", "UNTRACED"]

# --------------------------------------------------------------------------- NMEA, UBX, RTCM 3


def _split(
    kind: type[StreamSplitter], pieces: list[bytes]
) -> tuple[list[bytes], Counter[str], int]:
    splitter = kind()
    items = [item for piece in pieces for item in splitter.feed(piece)] + splitter.finish()
    assert splitter.waiting == 0
    return [item.raw for item in items], splitter.counters, splitter.summed


def _ends(data: bytes) -> int:
    return data.count(b"\r") + data.count(b"\n")


def splitter(data: bytes) -> None:
    """Sentences and frames out of a stream: the same for any split, every byte accounted for."""
    choice, stream = input_of(data)
    stream = mended_lines(stream) if choice & 8 else stream
    (items, counters, summed), cut = (
        _split(kind, pieces) for kind, pieces in whole_and_cut(StreamSplitter, choice, stream)
    )
    assert (items, counters) == cut[:2]
    used = b"".join(items)
    garbage = len(stream) - _ends(stream) - (len(used) - _ends(used))
    assert counters["garbage_bytes"] == garbage
    verified = ("sentences", "ubx_frames", "rtcm_frames")
    assert sum(counters[name] for name in verified) == len(items)
    assert summed <= 3 * len(stream)  # Fletcher's sums twice, the CRC once


DECODING = NmeaDecoding(earliest_date=EARLIEST, allow_simulator=True)


def nmea(data: bytes) -> None:
    """Measurements out of NMEA: the same for any split, finite and plausible."""
    choice, stream = input_of(data)
    stream = mended_lines(stream) if choice & 8 else stream
    found = []
    for kind, pieces in whole_and_cut(NmeaDecoder, choice, stream):
        decoder = kind("fuzz", DECODING)
        events = [event for piece in pieces for event in decoder.feed(piece, 7)]
        found.append((events + decoder.flush(), decoder.counters, decoder.cause))
        assert not decoder.epoch_open
        assert all(decoder.cautions.values())
    assert found[0] == found[1]
    _check_fixes(found[0][0])
    _check_fixes(_with_silences(pieces_of(choice, stream)))


def _with_silences(pieces: list[bytes]) -> list[Measurement]:
    """The same bytes off a line that pauses between the pieces, now shorter, now longer."""
    decoder, now_ns, events = NmeaDecoder("fuzz", DECODING), 0, []
    for number, piece in enumerate(pieces):
        events += decoder.feed(piece, now_ns)
        if number % 3:
            events += decoder.silence()
        now_ns += (number % 5) * 70_000_000
    return events + decoder.flush()


def _check_fixes(events: Sequence[Measurement]) -> None:
    for event in events:
        if isinstance(event, PositionFix):
            assert math.isfinite(sum(event.rounding_sd_ned_m) + event.geoid_sd_m)
            assert abs(event.lat_rad) <= math.pi / 2
            assert abs(event.lon_rad) <= math.pi
            assert event.height_m is None or within(event.height_m, HEIGHT_M)
            assert all(within(sd, SIGMA_M) for sd in event.sd_ned_m or ())
            if event.v_ned_m_s is not None:
                assert math.hypot(*event.v_ned_m_s[:2]) <= SPEED_M_S * (1.0 + 1e-12)
        elif isinstance(event, Heading):
            assert abs(event.yaw_rad) <= math.pi


# --------------------------------------------------------------------------- raw observations


def _check_raw(events: Sequence[object]) -> None:
    for event in events:
        if isinstance(event, RawGnssEpoch):
            for signal in event.signals:
                rate = signal.range_rate_m_s
                assert math.isfinite(signal.pseudorange_m)
                assert rate is None or abs(rate) <= 1e4
        elif isinstance(event, Ephemeris):
            assert 0.0 <= event.eccentricity < 1.0
            assert math.isfinite(event.sqrt_a + event.mean_anomaly + event.clock_bias_s)


# Most frames of an input are those of the one before, and pyrtcm takes longer than all else.
_parse_rtcm = functools.lru_cache(4096)(load_pyrtcm())


def raw(data: bytes) -> None:
    """UBX and RTCM 3 payloads: the same for any split, finite and plausible."""
    choice, stream = input_of(data)
    stream = mended_lines(stream) if choice & 8 else stream
    found = []
    for kind, pieces in whole_and_cut(RawDecoder, choice, stream):
        decoder = kind("fuzz", earliest=EARLIEST)
        decoder._rtcm._parse = _parse_rtcm  # type: ignore[union-attr]
        decoder.note_utc(1_500_000_000_000_000_000)
        events = [event for piece in pieces for event in decoder.feed(piece, 7)]
        found.append((events + decoder.flush(), decoder.counters))
        assert not decoder.epoch_open
    assert found[0] == found[1]
    _check_raw(found[0][0])


_SSR = sorted(MESSAGES)


def ssr(data: bytes) -> None:
    """RTCM SSR: a line is the kind of a message and what stands behind its number; each message is
    used, or its reason counted."""
    decoder = RawDecoder("fuzz", earliest=EARLIEST)
    decoder.note_utc(1_500_000_000_000_000_000)
    for line in data.split(b"\n"):
        if len(line) < 2:
            continue
        number = _SSR[line[0] % len(_SSR)]
        body = (number << 4 | line[1] & 15).to_bytes(2, "big") + line[2:1023]
        frame = b"\xd3" + len(body).to_bytes(2, "big") + body
        before = decoder.counters.total()
        found = decoder.decode(Frame("rtcm", frame + b"\0\0\0"), 7)
        assert decoder.counters.total() > before
        for event in found:
            assert isinstance(event, Correction)
            assert 0.0 <= event.tow_s < 604_800.0 + event.interval_s
            assert all(abs(value) <= LARGEST_M for value in event.values)


_WORDS: tuple[tuple[int, int, int, Callable[[int], list[int]]], ...] = (
    (0, 0, 30, lnav_words),
    (3, 0, 28, beidou_words),
    (3, 1, 28, beidou_words),
    (2, 1, 16, inav_words),
)
"""gnssId, sigId, bytes of information, words with good parity."""


def _cnav(length: int, words: int) -> Callable[[int], list[int]]:
    return lambda information: with_crc(information & ((1 << length) - 1), length, words)


_CNAV = (
    (3, 6, 72, _cnav(576, 19)),
    (3, 6, 30, _cnav(240, 9)),
    (3, 8, 33, _cnav(264, 9)),
    (3, 6, 9, _cnav(72, 3)),
)
"""The same of B-CNAV, whose words have one CRC."""


_SFRBX = b"\xb5\x62\x02\x13\0\0"


def words(data: bytes) -> None:
    """LNAV, D1, D2, I/NAV and B-CNAV words, with good parities or bits turned: each frame is in one
    counter, or used."""
    decoder = RawDecoder("fuzz", earliest=EARLIEST)
    while len(data) >= 2:
        prn, turned = 1 + (data[0] >> 2) % 37, data[1]
        gnss, sig, size, make = (_CNAV if turned & 0x80 else _WORDS)[data[0] & 3]
        information = int.from_bytes(data[2 : 2 + size].ljust(size, b"\0"), "big")
        data = data[2 + size :]
        if make is beidou_words:
            information &= (1 << 224) - 1
        try:
            made = make(information)
        except (IndexError, ValueError):
            continue
        if turned & 1:
            made[turned % len(made)] ^= 1 << (turned >> 3)
        if turned & 2 and turned & 4:
            made = made[: turned % len(made)]
        # The decoder is handed frames that somebody has verified, so that none is summed here.
        head = bytes((gnss, prn, sig, 0, len(made), 3, 2, 0))
        frame = Frame("ubx", _SFRBX + head + struct.pack(f"<{len(made)}I", *made) + b"\0\0")
        before = decoder.counters.total()
        events = decoder.decode(frame, 7)
        assert decoder.counters.total() == before + 1 + len(events)
        _check_raw(events)


# --------------------------------------------------------------------------- NTRIP


def _answer(pieces: list[bytes]) -> tuple[bytes, type[Exception] | None]:
    reply, found = CasterReply(), bytearray()
    try:
        for piece in pieces:
            found += reply.feed(piece)
    except CasterRefusedError:
        return bytes(found), CasterRefusedError
    return bytes(found), None if reply.over is None else type(reply.over)


def ntrip(data: bytes) -> None:
    """A caster's answer: the same corrections and the same end for any split."""
    choice, stream = input_of(data)
    whole = _answer([stream])
    assert whole == _answer(pieces_of(choice, stream))
    assert len(whole[0]) <= len(stream)


# --------------------------------------------------------------------------- RDSS


@functools.cache
def _watched(family: type[FrameDecoder]) -> Callable[[], Any]:
    """A decoder that keeps the frames it took, how often it looked at a head, what it read."""

    class Watched(family):  # type: ignore[misc, valid-type]
        def __init__(self) -> None:
            super().__init__()
            self.taken: list[bytes] = []
            self.heads = self.read = 0

        def _extent(self, buffer: bytearray, at: int) -> Any:
            self.heads += 1
            return super()._extent(buffer, at)

        def _read(self, whole: bytes) -> Message | None:
            self.read += len(whole)
            message = super()._read(whole)
            if message is not None:
                self.taken.append(whole)
            return message

    return Watched


def _rdss(family: type[FrameDecoder], between: bytes, stream: bytes, choice: int) -> None:
    found = []
    for kind, pieces in whole_and_cut(family, choice, stream):
        decoder = _watched(kind)()
        messages = [message for piece in pieces for message in decoder.feed(piece)]
        while decoder.awaited_bytes:
            messages += decoder.expire()
        taken = decoder.taken
        used = b"".join(taken)
        rest = len(stream) - len(used)
        spaces = sum(stream.count(byte) - used.count(byte) for byte in between)
        assert rest - spaces <= decoder.counters["garbage_bytes"] <= rest
        assert (
            len(messages) == len(taken) == decoder.counters["frames"] + decoder.counters["unknown"]
        )
        starts = stream.count(b"$")
        assert decoder.heads <= 2 * starts + len(pieces) + 1
        assert decoder.read <= 512 * starts
        found.append((messages, decoder.counters))
    assert found[0] == found[1]


def rdss_binary(data: bytes) -> None:
    """RDSS family 4.0: the same for any split, every byte accounted for."""
    choice, stream = input_of(data)
    if choice & 8 and len(stream) > 6 and stream[:1] == b"$":
        head = stream[:5] + (len(stream) + 1 & 0xFFFF).to_bytes(2, "big") + stream[7:]
        stream = head + bytes((checksum(head),))
    _rdss(binary_4_0.Decoder, b"", stream, choice)


def rdss_text(data: bytes) -> None:
    """RDSS family 2.1: the same for any split, every byte accounted for."""
    choice, stream = input_of(data)
    _rdss(text_2_1.Decoder, b"\r\n", mended_lines(stream) if choice & 8 else stream, choice)


# --------------------------------------------------------------------------- CAN

_SBG = CanImuOptions(
    dbc="sbg_ellipse",
    gyro=("IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "IMU_GYRO.GYRO_Z"),
    accel=("IMU_ACCEL.ACCEL_X", "IMU_ACCEL.ACCEL_Y", "IMU_ACCEL.ACCEL_Z"),
    device_time="IMU_INFO.TIME_STAMP",
)
_RACELOGIC = CanImuOptions(
    dbc="racelogic_imu04",
    gyro=("IMU_602.ROLL_RATE", "IMU_602.PITCH_RATE", "IMU_600.YAW_RATE"),
    accel=("IMU_600.ACCEL_X", "IMU_601.ACCEL_Y", "IMU_603.ACCEL_Z"),
)
DEVICES = (_RACELOGIC, _SBG)
# Reading a DBC and planning take a hundred times as long as the frames of one input, and a plan
# does not change.
_PLANS = [CanImuDecoder("imu", options)._plan() for options in DEVICES]
_REFUSED = ("other_frames", "wrong_length", "undecodable", "not_finite", "out_of_range")


class Planned(CanImuDecoder):
    def _plan(self) -> tuple[list[MessagePlan], list[float]]:
        return _PLANS[DEVICES.index(self._options)]


def can(data: bytes) -> None:
    """Frames of an IMU, ten bytes each: identifier, time and data; every frame accounted for."""
    choice, data = input_of(data)
    decoder = Planned("imu", DEVICES[choice & 1])
    ids = [plan.message.frame_id for plan in decoder.plans]
    t_ns, frames, samples = 1_000_000_000, 0, 0
    last: dict[str, int] = {}
    for at in range(0, len(data) - 1, 10):
        head, step = data[at], data[at + 1]
        t_ns += (0, 300_000, 5_000_000, 1 << 32)[step & 3] + step
        can_id = ids[head % len(ids)] if head < 240 else head
        frame = CanFrame(can_id, False, data[at + 2 : at + 10], t_ns, t_ns if choice & 2 else None)
        frames += 1
        for sample in decoder.feed(frame):
            assert isinstance(sample, ImuSample)
            samples += 1
            assert all(map(math.isfinite, sample.gyro_rad_s + sample.accel_m_s2))
            if isinstance(sample.stamp, DeviceStamp):
                assert sample.stamp.ticks_ns > last.get(sample.stamp.device, -1)
                last[sample.stamp.device] = sample.stamp.ticks_ns
    decoder.reset()
    counters, parts = decoder.counters, len(decoder.plans)
    accounted = sum(counters[name] for name in (*_REFUSED, "duplicates", "unpaired"))
    assert counters["samples"] == samples
    # A sample is made of one frame a message at least.
    whole = parts * (samples + counters["time_backward"])
    assert accounted + whole <= frames


_STREAMS = (splitter, nmea, raw, ssr, words, ubx, bestpos, sbf, rinex)
_MORE = (
    rdss_binary,
    rdss_text,
    rdss_mail,
    can,
    ntrip,
    commands,
    hub,
    log,
    state,
    csv,
    can_log,
    dbc,
)
TARGETS: dict[str, Callable[[bytes], None]] = {one.__name__: one for one in (*_STREAMS, *_MORE)}
