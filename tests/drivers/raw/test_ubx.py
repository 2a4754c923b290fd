"""RXM-RAWX in a mixed stream: units, refusals by name, and that no byte can harm."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import UtcStamp
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import PackedSignals, RawEvent, RawGnssEpoch, RawSignal
from tests.drivers.raw.frames import d1, inav, lnav, measurement, rawx, sfrbx, ubx

C = 299_792_458.0
GGA = b"$GNGGA,021429.00,3958.12345,N,11619.54321,E,4,18,0.62,45.300,M,-9.100,M,1.0,0000*47\r\n"

MEASURED = ("measured_G", "measured_E", "measured_C", "measured_sbas", "measured_qzss")
MEASURED += ("measured_glonass", "measured_navic", "measured_unknown_system")
REFUSED = ("signal_unknown", "prn_unknown", "pseudorange_invalid", "not_finite")
REFUSED += ("pseudorange_implausible", "rate_implausible", "signal_repeated")


def epoch(*measurements: tuple[Any, ...], **head: Any) -> tuple[RawGnssEpoch, Counter[str]]:
    decoder = RawDecoder("gnss")
    (found,) = decoder.feed(rawx(*measurements, **head), 7)
    assert isinstance(found, RawGnssEpoch)
    return found, decoder.counters


def test_units_of_one_measurement() -> None:
    one = measurement(
        range=2.4e7, carrier=1.25e8, doppler=-800.0, gnss=3, prn=21, sig=4, cno=44, sd_range=5
    )
    found, counters = epoch(one)
    (signal,) = found.signals
    assert signal == RawSignal(
        "C",
        21,
        "6I",
        2.4e7,
        pytest.approx(800.0 * C / 1_268_520_000.0),
        1.25e8,
        44.0,
        0.01 * 32,
        pytest.approx(0.002 * 64 * C / 1_268_520_000.0),
        1.0,
    )  # a negative Doppler: the distance grows
    assert found.signals[0].satellite == "C21"
    assert (found.source, found.t_seen_ns, found.week, found.tow_s) == ("gnss", 7, 2440, 345_600.25)
    assert not found.clock_reset
    assert counters["measured_C"] == counters["rawx"] == counters["ubx_frames"] == 1


@pytest.mark.parametrize(("ms", "lock_s"), [(0, 0.0), (250, 0.25), (64_500, math.inf)])
def test_how_long_a_carrier_has_been_followed(ms: int, lock_s: float) -> None:
    """The count ends at 64.5 s."""
    found, _ = epoch(measurement(lock=ms))
    assert found.signals[0].lock_s == lock_s


@pytest.mark.parametrize(
    ("track", "carrier", "opened"), [(7, 1.1e8, 0), (3, None, 1), (1, None, 0)]
)
def test_a_carrier_with_half_a_cycle_open_is_none(
    track: int, carrier: float | None, opened: int
) -> None:
    found, counters = epoch(measurement(track=track))
    assert found.signals[0].carrier_cycles == carrier
    assert counters["half_cycle_open"] == opened


def test_time_of_an_epoch() -> None:
    """GPS week 2440 begins on 2026-10-11; its day 4 less 18 leap seconds."""
    found, counters = epoch(measurement())
    assert found.stamp == UtcStamp(1_792_022_400_250_000_000 - 18_000_000_000)
    assert counters["leap_seconds_assumed"] == 0
    later, _ = epoch(measurement(), leap=19)
    assert isinstance(later.stamp, UtcStamp)
    assert later.stamp.utc_ns == found.stamp.utc_ns - 1_000_000_000
    unknown, counters = epoch(measurement(), leap=17, status=0)
    assert unknown.stamp == found.stamp  # 18 s until the receiver knows
    assert counters["leap_seconds_assumed"] == 1


def test_clock_reset_is_handed_over_and_counted() -> None:
    found, counters = epoch(measurement(), status=3)
    assert found.clock_reset
    assert counters["clock_reset"] == 1


@pytest.mark.parametrize(
    ("gnss", "sig", "signal", "mhz"),
    [
        (0, 0, "1C", 1575.42),
        (0, 3, "2L", 1227.6),
        (0, 7, "5Q", 1176.45),
        (2, 0, "1C", 1575.42),
        (2, 1, "1B", 1575.42),
        (2, 4, "5Q", 1176.45),
        (2, 6, "7Q", 1207.14),
        (2, 8, "6B", 1278.75),
        (3, 0, "2I", 1561.098),
        (3, 1, "2I", 1561.098),
        (3, 2, "7I", 1207.14),
        (3, 4, "6I", 1268.52),
        (3, 10, "6I", 1268.52),
        (3, 5, "1P", 1575.42),
        (3, 7, "5P", 1176.45),
    ],
)
def test_signals_and_their_carriers(gnss: int, sig: int, signal: str, mhz: float) -> None:
    found, _ = epoch(measurement(gnss=gnss, sig=sig, doppler=1000.0))
    (one,) = found.signals
    assert one.signal == signal
    assert one.range_rate_m_s == pytest.approx(-1e-3 * C / mhz, rel=1e-12)


@pytest.mark.parametrize("leap", [-100, 0, 9, 31, 127])
def test_leap_seconds_that_cannot_be_are_not_known(leap: int) -> None:
    decoder = RawDecoder("gnss")
    (found,) = decoder.feed(rawx(measurement(), leap=leap), 7)
    (usual,) = RawDecoder("gnss").feed(rawx(measurement()), 7)
    assert isinstance(found, RawGnssEpoch)
    assert isinstance(usual, RawGnssEpoch)
    assert found.stamp == usual.stamp
    assert decoder.leap_seconds is None
    assert decoder.counters["leap_seconds_implausible"] == 1


def test_an_epoch_after_2099_is_refused() -> None:
    decoder = RawDecoder("gnss")
    assert len(decoder.feed(rawx(measurement(), week=6260), 7)) == 1
    assert decoder.feed(rawx(measurement(), week=6261), 8) == []
    assert decoder.feed(rawx(measurement(), week=65_535), 9) == []
    assert decoder.counters["time_implausible"] == 2


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"track": 2}, "pseudorange_invalid"),
        ({"sig": 1}, "signal_unknown"),
        ({"prn": 33}, "prn_unknown"),
        ({"prn": 0}, "prn_unknown"),
        ({"range": math.nan}, "not_finite"),
        ({"doppler": math.inf}, "not_finite"),
        ({"carrier": math.nan}, "not_finite"),
        ({"range": 1e6}, "pseudorange_implausible"),
        ({"range": -2.2e7}, "pseudorange_implausible"),
        ({"range": 6e7}, "pseudorange_implausible"),
        ({"doppler": 3e38}, "rate_implausible"),
        ({"doppler": -53_000.0}, "rate_implausible"),
        ({"prn": 6}, "signal_repeated"),
        ({"gnss": 1, "prn": 131}, "measured_sbas"),
        ({"gnss": 5}, "measured_qzss"),
        ({"gnss": 6}, "measured_glonass"),
        ({"gnss": 7}, "measured_navic"),
        ({"gnss": 9}, "measured_unknown_system"),
    ],
)
def test_refused_by_name_and_the_good_one_stays(change: dict[str, Any], name: str) -> None:
    good = measurement(prn=6)
    found, counters = epoch(good, measurement(**change))
    assert [signal.prn for signal in found.signals] == [6]
    assert counters[name] == 1
    assert sum(counters[refused] for refused in REFUSED) == (name in REFUSED)


def test_what_the_receiver_does_not_say_is_none() -> None:
    found, _ = epoch(measurement(track=1, cno=0))
    assert found.signals[0].carrier_cycles is None
    assert found.signals[0].cno_db_hz is None


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        (ubx(b"\x02\x15", b"\x00" * 15), "rawx_unreadable"),
        (ubx(b"\x02\x15", rawx(measurement())[6:-2] + b"\x00"), "rawx_unreadable"),
        (ubx(b"\x02\x15", rawx(measurement())[6:-34]), "rawx_unreadable"),
        (rawx(measurement(), tow_s=math.nan), "rawx_unreadable"),
        (rawx(measurement(), tow_s=-1.0), "rawx_unreadable"),
        (rawx(measurement(), week=0), "time_unset"),
        (ubx(b"\x02\x13", b"\x00" * 7), "sfrbx_unreadable"),
        (ubx(b"\x02\x13", sfrbx(0, 1, 0, [0] * 10)[6:-6]), "sfrbx_unreadable"),
        (ubx(b"\x01\x07", b"\x00" * 92), "ubx_not_used"),
        (rawx(measurement())[:-1] + b"\x00", "ubx_damaged"),
        (rawx(measurement())[:-5], "frame_cut"),
    ],
)
def test_frames_refused_by_name(frame: bytes, name: str) -> None:
    decoder = RawDecoder("gnss")
    assert decoder.feed(frame, 0) + decoder.flush() == []
    assert decoder.counters[name] == 1


def test_half_a_frame_costs_itself_only() -> None:
    whole = rawx(measurement())
    for cut in range(1, len(whole)):
        decoder = RawDecoder("gnss")
        found = decoder.feed(whole[:cut] + whole + whole, 0) + decoder.flush()
        assert len(found) == 2
        assert decoder.counters["ubx_frames"] == 2


def test_an_epoch_without_satellites_is_an_epoch() -> None:
    found, _ = epoch()
    assert found.signals == ()


# --------------------------------------------------------------------------- any bytes

FRAMES = [
    rawx(measurement(), measurement(gnss=3, prn=30, sig=7, range=2.5e7)),
    rawx(measurement(range=math.nan), week=0),
    *(sfrbx(0, 7, 0, words) for words in lnav(1)),
    *(sfrbx(3, 21, 4, words) for words in d1(1)),
    *(sfrbx(2, 7, 1, words) for words in inav(1)),
    sfrbx(3, 21, 8, [1, 2, 3]),
    GGA,
    rawx(measurement())[:40],
    GGA[:20],
    b"\xb5\x62\x02\x15\xff\x1f",
    b"\xd3\x00\x13>\xd0",
]
STREAMS = st.lists(st.sampled_from(FRAMES) | st.binary(max_size=30), max_size=25).map(b"".join)


def run(*pieces: bytes) -> tuple[list[RawEvent], Counter[str]]:
    decoder = RawDecoder("gnss")
    found = [event for piece in pieces for event in decoder.feed(piece, 0)]
    return found + decoder.flush(), +decoder.counters


@given(STREAMS, st.lists(st.integers(0, 3000), max_size=8))
@settings(max_examples=150, deadline=None)
def test_any_split_gives_the_same(stream: bytes, cuts: list[int]) -> None:
    edges = [0, *sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    pieces = [stream[a:b] for a, b in itertools.pairwise(edges)]
    assert run(*pieces) == run(stream)


@given(STREAMS)
@settings(max_examples=30, deadline=None)
def test_byte_by_byte_gives_the_same(stream: bytes) -> None:
    assert run(*(stream[i : i + 1] for i in range(len(stream)))) == run(stream)


@given(st.integers(0, 255), st.integers(0, 255), st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_verified_frames_of_random_bytes_never_raise(cls: int, ident: int, payload: bytes) -> None:
    for class_id in (b"\x02\x15", b"\x02\x13", bytes([cls, ident])):
        _, counters = run(ubx(class_id, payload))
        assert counters["ubx_frames"] == 1


@given(st.integers(0, 9), st.integers(0, 255), st.integers(0, 12), st.data())
@settings(max_examples=300, deadline=None)
def test_subframes_of_random_words_never_raise(
    gnss: int, prn: int, sig: int, data: st.DataObject
) -> None:
    words = data.draw(st.lists(st.integers(0, 2**32 - 1), max_size=12))
    _, counters = run(sfrbx(gnss, prn, sig, words))
    other = {"ubx_frames": 1}
    assert len(counters - Counter(other)) == 1  # accounted for by exactly one name


@given(
    st.lists(
        st.builds(
            measurement,
            range=st.floats(1.9e7, 4.2e7) | st.floats(),
            doppler=st.floats(width=32),
            gnss=st.integers(0, 9),
            prn=st.integers(0, 255),
            sig=st.integers(0, 12),
            track=st.integers(0, 255),
        ),
        max_size=12,
    )
)
@settings(max_examples=200, deadline=None)
def test_every_measurement_is_accounted_for(measurements: list[tuple[Any, ...]]) -> None:
    found, counters = epoch(*measurements)
    assert sum(counters[name] for name in MEASURED) == len(measurements)
    wanted = sum(counters[name] for name in MEASURED[:3])
    assert len(found.signals) == wanted - sum(counters[name] for name in REFUSED)
    assert all(math.isfinite(s.pseudorange_m) for s in found.signals)


def test_packed_signals_are_the_single_ones() -> None:
    """What the receiver does not say stays unsaid; a repeated or refused signal takes no place."""
    single = (
        RawSignal("G", 5, "1C", 2.2e7, -3.5, 1.1e8, 44.0, 0.16, 0.02, 3.0),
        RawSignal("C", 21, "6I", 3.7e7),
        RawSignal("E", 36, "7Q", 2.5e7, cno_db_hz=31.0),
    )
    packed = PackedSignals.of(single)
    assert packed == single
    assert (packed[1], packed[-1], packed[:2]) == (single[1], single[2], single[:2])
    assert PackedSignals.of(packed) is packed
    assert packed != PackedSignals.of(single[:2])
    assert PackedSignals.of(()) == ()
    with pytest.raises(IndexError):
        packed[3]
    found, _ = epoch(measurement(prn=6, track=1, cno=0), measurement(prn=7), measurement(prn=6))
    again = PackedSignals.of(tuple(found.signals))
    assert again == found.packed
    assert [key[1] for key in again.keys] == [6, 7]
