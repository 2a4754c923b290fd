"""Real streams against their descriptions and against RTKLIB's decoding of the same bytes."""

from __future__ import annotations

import struct
import time
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from drivers.measurements import PositionFix, TimeReport, UtcStamp
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.raw.decoder import RawDecoder
from drivers.raw.driver import GnssDecoder
from drivers.raw.messages import Ephemeris, Klobuchar, RawEvent, RawGnssEpoch
from tests.drivers.raw.frames import differences
from tests.places import DATA

WALK = DATA / "walk_0827" / "gnss.ubx"
RTCM = DATA / "rtcm" / "ntrip_uscl00chl0.rtcm3"
MIXED = DATA / "nmea" / "ublox-zed-f9r.log"


def read(path: Path) -> bytes:
    if not path.is_file():
        pytest.skip(f"real recording {path.name} is absent: {path} (set FUSIOND_DATA)")
    return path.read_bytes()


def decode(path: Path, size: int = 1024, **options: Any) -> tuple[list[RawEvent], Counter[str]]:
    stream, decoder = read(path), RawDecoder("gnss", **options)
    found: list[RawEvent] = []
    for i in range(0, len(stream), size):
        found += decoder.feed(stream[i : i + size], i)
    return found + decoder.flush(), +decoder.counters


def ephemerides(events: list[RawEvent]) -> dict[str, Ephemeris]:
    """By satellite, but for those of B-CNAV, which BeiDou sends beside its D1."""
    return {
        e.satellite: e
        for e in events
        if isinstance(e, Ephemeris) and not e.message.startswith("bcnav")
    }


# --------------------------------------------------------------------------- the walk


def test_walk_is_complete_and_every_frame_accounted_for() -> None:
    """Counts of its description; what is left over is named."""
    events, counters = decode(WALK)
    epochs = [e for e in events if isinstance(e, RawGnssEpoch)]
    by_system = Counter(s.system for e in epochs for s in e.signals)
    assert by_system == {"C": 14_399, "G": 11_709, "E": 10_163}
    assert len(epochs) == 536
    assert (epochs[0].week, epochs[0].tow_s) == (2381, 408_639.748)
    assert isinstance(epochs[0].stamp, UtcStamp)
    # GGA of that epoch says 17:30:21.75 on 2025-08-28.
    assert epochs[0].stamp.utc_ns == pytest.approx(1_756_402_221_750_000_000, abs=5_000_000)
    assert {s.signal for e in epochs for s in e.signals if s.system == "C"} == {"6I", "1P", "5P"}
    assert counters == {
        "sentences": 2010,
        "ubx_frames": 536 + 536 + 2328,
        "ubx_not_used": 536,
        "rawx": 536,
        "epochs_raw": 536,
        "measured_C": 14_399,
        "measured_G": 11_709,
        "measured_E": 10_163,
        "half_cycle_open": 2395,
        "measured_sbas": 1579,
        "subframes_lnav": 80,
        "subframes_cnav": 148,
        "signal_delays": 44,
        "subframes_d1": 153,
        "subframes_bcnav1": 148,
        "subframes_bcnav2": 364,
        "subframes_inav": 393,
        "fnav_not_used": 98,
        "galileo_cnav_not_used": 634,
        "sbas_not_used": 307,
        "ephemeris_mixed": 3,
        "ephemerides": 53 + 134,
        "ionospheres": 2,  # of D1, and of B-CNAV
    }


def test_walk_satellites() -> None:
    found = ephemerides(decode(WALK)[0])
    beidou = {name for name in found if name[0] == "C"}
    assert beidou == {"C11", "C21", "C22", "C34", "C42", "C43", "C44", "C50"}
    assert {name for name in found if name[0] == "G"} == {"G10", "G23", "G27", "G32"}
    assert {name for name in found if not found[name].healthy} == {"C50", "E14"}
    assert {found[name].message for name in beidou} == {"d1"}
    for name, ephemeris in found.items():
        assert ephemeris.week == (1025 if name[0] == "C" else 2381)
        assert abs(ephemeris.toe_s - 408_700.0) <= 2 * 3600


def test_walk_does_not_depend_on_how_the_bytes_come() -> None:
    def timeless(events: list[RawEvent]) -> list[str]:
        return [repr(e).replace(f"t_seen_ns={e.t_seen_ns}", "") for e in events]

    whole, counters = decode(WALK, size=1 << 24)
    for size in (97, 4096):
        pieces, again = decode(WALK, size=size)
        assert timeless(pieces) == timeless(whole)
        assert again == counters


def _blocks() -> dict[tuple[int, int, int], list[tuple[int, ...]]]:
    """Words by gnssId, svId and sigId, in the order of their coming, without our decoders."""
    found: dict[tuple[int, int, int], list[tuple[int, ...]]] = {}
    for item in StreamSplitter().feed(read(WALK)):
        if isinstance(item, Frame) and item.raw[2:4] == b"\x02\x13":
            gnss, prn, sig, _, count = item.raw[6:11]
            words = struct.unpack_from(f"<{count}I", item.raw, 14)
            found.setdefault((gnss, prn, sig), []).append(words)
    return found


def _array(rtklib: Any, value: int, length: int) -> Any:
    size = (length + 7) // 8
    array = getattr(rtklib, "Arr1Dunsigned char")(size + 64)
    for i in range(size + 64):
        array[i] = 0
    for i, byte in enumerate((value << 8 * size - length).to_bytes(size, "big")):
        array[i] = byte
    return array


def _join(blocks: list[tuple[int, int]]) -> tuple[int, int]:
    value = total = 0
    for block, length in blocks:
        value, total = value << length | block, total + length
    return value, total


def test_walk_beidou_d1_is_that_of_rtklib_field_by_field() -> None:
    rtklib = pytest.importorskip("pyrtklib")
    events, _ = decode(WALK)
    ours, ionosphere = ephemerides(events), [e for e in events if isinstance(e, Klobuchar)]
    compared = set()
    for (gnss, prn, sig), blocks in _blocks().items():
        if (gnss, sig) != (3, 4):
            continue
        frames: dict[int, dict[int, tuple[int, int]]] = {}
        for words in blocks:
            number = words[0] >> 12 & 7
            sow = (words[0] >> 4 & 0xFF) << 12 | words[1] >> 18
            value, _ = _join([(word, 30) for word in words])
            frames.setdefault(sow - 6 * (number - 1), {})[number] = (value << 4, 304)
        for parts in frames.values():
            if not {1, 2, 3} <= set(parts):
                continue
            eph, ion, utc = rtklib.eph_t(), rtklib.Arr1Ddouble(8), rtklib.Arr1Ddouble(8)
            buffer = _array(rtklib, *_join([parts[1], parts[2], parts[3]]))
            rtklib.decode_bds_d1(buffer, eph, ion, utc)
            mine = ours[f"C{prn:02d}"]
            assert differences(mine, eph) == {}
            assert (mine.week, mine.issue) == (eph.week, eph.iodc)
            assert mine.healthy == (eph.svh == 0)
            (model,) = ionosphere
            assert list(model.alpha + model.beta) == [ion[i] for i in range(8)]
            compared.add(prn)
    assert compared == {11, 21, 22, 34, 42, 43, 44, 50}


def test_walk_gps_lnav_is_that_of_rtklib_field_by_field() -> None:
    rtklib = pytest.importorskip("pyrtklib")
    ours, compared = ephemerides(decode(WALK)[0]), set()
    for (gnss, prn, sig), blocks in _blocks().items():
        if (gnss, sig) != (0, 0):
            continue
        parts = {}
        for words in blocks:
            data = [(word >> 6 & 0xFFFFFF, 24) for word in words]
            parts[data[1][0] >> 2 & 7] = _join(data)
        if not {1, 2, 3} <= set(parts):
            continue
        eph = rtklib.eph_t()
        buffer = _array(rtklib, *_join([parts[1], parts[2], parts[3], (0, 480)]))
        eight = rtklib.Arr1Ddouble(8), rtklib.Arr1Ddouble(8)
        rtklib.decode_frame(buffer, eph, rtklib.alm_t(), *eight)
        mine = ours[f"G{prn:02d}"]
        assert differences(mine, eph) == {}
        assert (mine.week, mine.issue) == (eph.week, eph.iode)
        assert mine.healthy == (eph.svh == 0)
        compared.add(prn)
    assert compared == {10, 23, 27, 32}


def test_walk_galileo_inav_is_that_of_rtklib_field_by_field() -> None:
    rtklib = pytest.importorskip("pyrtklib")
    ours, compared = ephemerides(decode(WALK)[0]), set()
    for (gnss, prn, sig), blocks in _blocks().items():
        if (gnss, sig) != (2, 1):
            continue
        parts: dict[int, int] = {}
        for words in blocks:
            page, _ = _join([(word, 32) for word in words])
            data = (page >> 142 & ((1 << 112) - 1)) << 16 | page >> 110 & 0xFFFF
            parts[data >> 122] = data
        name = f"E{prn:02d}"
        if name not in ours or not set(range(1, 6)) <= set(parts):
            continue
        if len({parts[kind] >> 112 & 0x3FF for kind in (1, 2, 3, 4)}) > 1:
            continue
        parts[0], parts[6] = 2 << 120, 6 << 122
        eph = rtklib.eph_t()
        buffer = _array(rtklib, *_join([(parts[kind], 128) for kind in range(7)]))
        eight = rtklib.Arr1Ddouble(8), rtklib.Arr1Ddouble(8)
        rtklib.decode_gal_inav(buffer, eph, *eight)
        mine = ours[name]
        assert differences(mine, eph) == {}
        assert (mine.week, mine.issue) == (eph.week, eph.iode)
        assert mine.healthy == (eph.svh & 7 == 0)
        compared.add(name)
    assert compared == {"E07", "E08", "E13", "E14", "E26", "E29", "E33"}


def test_walk_observations_are_those_of_rtklib() -> None:
    """RTKLIB keeps three signals a satellite and no B3I: GPS L1 and Galileo E1 of one epoch."""
    rtklib = pytest.importorskip("pyrtklib")
    stream, raw = read(WALK), rtklib.raw_t()
    assert rtklib.init_raw(raw, rtklib.STRFMT_UBX)
    end = next(i for i, byte in enumerate(stream) if rtklib.input_ubx(raw, byte) == 1) + 1
    (ours,) = [e for e in RawDecoder("gnss").feed(stream[:end], 0) if isinstance(e, RawGnssEpoch)]
    mine = {(s.system, s.prn): s for s in ours.signals if s.signal == "1C"}
    compared = 0
    for i in range(raw.obs.n):
        observation = raw.obs.data[i]
        for system, base in (("G", rtklib.SYS_GPS), ("E", rtklib.SYS_GAL)):
            for prn in range(1, 37):
                if rtklib.satno(base, prn) == observation.sat and (system, prn) in mine:
                    signal = mine[system, prn]
                    assert signal.pseudorange_m == observation.P[0]
                    assert signal.cno_db_hz == pytest.approx(observation.SNR[0] * 1e-3, abs=0.3)
                    wavelength = 299_792_458.0 / 1_575.42e6
                    assert signal.range_rate_m_s == pytest.approx(-observation.D[0] * wavelength)
                    compared += 1
    assert compared == len(mine) > 8


def test_decoding_takes_less_than_a_tenth_of_a_core_at_10_hz() -> None:
    """About 68 measurements an epoch, with all its subframes and sentences."""
    stream, decoder = read(WALK), RawDecoder("gnss")
    before = time.process_time()
    for i in range(0, len(stream), 1024):
        decoder.feed(stream[i : i + 1024], 0)
    per_epoch_s = (time.process_time() - before) / decoder.counters["rawx"]
    assert per_epoch_s < 0.1 * 0.1


# --------------------------------------------------------------------------- mixed with NMEA


def test_walk_as_the_driver_sees_it() -> None:
    """Fixes of UBX-NAV-PVT, times as the NMEA decoder has them, epochs of the same instants."""
    stream, decoding = read(WALK), NmeaDecoding(earliest_date=date(2025, 1, 1))
    mixed, alone = GnssDecoder("gnss", decoding), NmeaDecoder("gnss", decoding)
    found, nmea = [], []
    for i in range(0, len(stream), 1024):
        found += mixed.feed(stream[i : i + 1024], i)
        nmea += alone.feed(stream[i : i + 1024], i)
    found += mixed.flush()
    nmea += alone.flush()
    assert [e for e in found if isinstance(e, TimeReport)] == [
        e for e in nmea if isinstance(e, TimeReport)
    ]
    fixes = [e for e in found if isinstance(e, PositionFix)]
    printed = [e for e in nmea if isinstance(e, PositionFix)]
    assert len(fixes) == len(printed) == 536
    assert mixed.counters["nmea_fix_superseded"] == 536
    for ours, theirs in zip(fixes, printed, strict=True):
        assert isinstance(ours.stamp, UtcStamp)
        assert isinstance(theirs.stamp, UtcStamp)
        assert abs(ours.stamp.utc_ns - theirs.stamp.utc_ns) <= 5_000_000
        assert ours.lat_rad == pytest.approx(theirs.lat_rad, abs=1e-9)
        assert ours.lon_rad == pytest.approx(theirs.lon_rad, abs=1e-9)
        assert ours.height_m == pytest.approx(theirs.height_m, abs=0.06)
        assert (ours.quality, ours.v_ned_m_s is None) == (theirs.quality, False)
    times = {round(e.stamp.utc_ns, -7) for e in fixes if isinstance(e.stamp, UtcStamp)}
    epochs = [e for e in found if isinstance(e, RawGnssEpoch)]
    assert len(epochs) == 536
    matched = sum(round(e.stamp.utc_ns, -7) in times for e in epochs)  # RAWX runs 2 ms early
    assert matched >= 530


def test_zed_f9r_log_is_accounted_for() -> None:
    """NMEA, UBX without observations, and MSM4 of a base station on one wire, at 1 Hz."""
    events, counters = decode(MIXED, earliest=date(2015, 1, 1))
    epochs = [e for e in events if isinstance(e, RawGnssEpoch)]
    assert len(epochs) == 21
    assert [e.tow_s for e in epochs] == [epochs[0].tow_s + i for i in range(21)]
    assert counters["ubx_frames"] == counters["ubx_not_used"] == 277
    named = ("msm", "week_unknown", "rtcm_ephemerides", "rtcm_not_used", "glonass_not_used")
    assert counters["rtcm_frames"] == 224 == sum(counters[name] for name in named)


def test_zed_f9r_log_dates_its_epochs_by_rmc() -> None:
    """The driver knows the date from NMEA: no epoch is lost until an ephemeris comes."""
    decoder = GnssDecoder("gnss", NmeaDecoding(earliest_date=date(2015, 1, 1)))
    found = decoder.feed(read(MIXED), 0) + decoder.flush()
    epochs = [e for e in found if isinstance(e, RawGnssEpoch)]
    fixes = [e for e in found if isinstance(e, PositionFix)]
    assert len(epochs) >= 21
    assert fixes
    first, last = fixes[0].stamp, fixes[-1].stamp
    assert isinstance(first, UtcStamp)
    assert isinstance(last, UtcStamp)
    for epoch in epochs:
        assert isinstance(epoch.stamp, UtcStamp)
        assert first.utc_ns <= epoch.stamp.utc_ns <= last.utc_ns


# --------------------------------------------------------------------------- RTCM 3


MSM7 = (1077, 1097, 1127)


def rtcm_events() -> tuple[list[RawEvent], Counter[str]]:
    return decode(RTCM, earliest=date(2024, 1, 1))


def test_rtcm_ephemerides_are_those_of_rtklib_field_by_field() -> None:
    rtklib = pytest.importorskip("pyrtklib")
    ours = ephemerides(rtcm_events()[0])
    stream, rtcm = read(RTCM), rtklib.rtcm_t()
    assert rtklib.init_rtcm(rtcm)
    rtcm.time = rtklib.gpst2time(2305, 318_940.0)
    for byte in stream:
        rtklib.input_rtcm3(rtcm, byte)
    bases = {"G02": rtklib.SYS_GPS, "C12": rtklib.SYS_CMP, "E03": rtklib.SYS_GAL}
    bases["E05"] = rtklib.SYS_GAL
    assert set(ours) == set(bases)
    for name, base in bases.items():
        second = rtklib.MAXSAT if ours[name].message == "fnav" else 0  # kept behind I/NAV
        eph = rtcm.nav.eph[rtklib.satno(base, int(name[1:])) - 1 + second]
        assert differences(ours[name], eph) == {}
        assert ours[name].healthy
        assert ours[name].week == (949 if name[0] == "C" else 2305)
    assert {e.message for e in ours.values()} == {"lnav", "d1", "fnav", "inav"}


def test_rtcm_epoch_of_beidou_is_gps_time() -> None:
    """1127 says 318931.000 s of BDT, 1077 and 1097 318945.000 s of GPS time: one instant."""
    events, counters = rtcm_events()
    (epoch,) = [e for e in events if isinstance(e, RawGnssEpoch)]
    assert (epoch.week, epoch.tow_s) == (2305, 318_945.0)
    assert Counter(s.system for s in epoch.signals) == {"G": 42, "E": 35, "C": 23}
    assert counters["msm"] == 6  # 1076 and then 1077, and so on: MSM7 takes the place of MSM6
    assert counters["signal_superseded"] == 100
    assert counters["signal_repeated"] == 0
    assert counters["rtcm_system_parameters"] == 1  # 1013 says 18
    assert counters["leap_seconds_assumed"] == 0


def test_rtcm_observations_are_those_of_rtklib() -> None:
    rtklib = pytest.importorskip("pyrtklib")
    (epoch,) = [e for e in rtcm_events()[0] if isinstance(e, RawGnssEpoch)]
    mine = {(s.system, s.prn, s.signal): s for s in epoch.signals}
    rtcm = rtklib.rtcm_t()
    assert rtklib.init_rtcm(rtcm)
    rtcm.time = rtklib.gpst2time(2305, 318_940.0)
    for frame in StreamSplitter().feed(read(RTCM)):
        if isinstance(frame, Frame) and int.from_bytes(frame.raw[3:5], "big") >> 4 in MSM7:
            for byte in frame.raw:
                rtklib.input_rtcm3(rtcm, byte)
    bases = {"G": rtklib.SYS_GPS, "E": rtklib.SYS_GAL, "C": rtklib.SYS_CMP}
    firsts = {"G": "1C", "E": "1C", "C": "2I"}
    compared: Counter[str] = Counter()
    for i in range(rtcm.obs.n):
        observation = rtcm.obs.data[i]
        for (system, prn, signal), one in mine.items():
            if signal == firsts[system] and rtklib.satno(bases[system], prn) == observation.sat:
                assert one.pseudorange_m == pytest.approx(observation.P[0], abs=1e-3)
                assert one.carrier_cycles == pytest.approx(observation.L[0], abs=1e-3)
                compared[system] += 1
    assert compared == {"G": 10, "E": 7, "C": 11}


def test_rtcm_without_any_date_is_refused_by_name() -> None:
    """Observations alone do not say their week."""
    stream = read(RTCM)
    decoder = RawDecoder("gnss")
    frames = [f for f in StreamSplitter().feed(stream) if isinstance(f, Frame)]
    msm = [f for f in frames if int.from_bytes(f.raw[3:5], "big") >> 4 == 1127]
    assert [event for f in msm for event in decoder.decode(f, 0)] + decoder.flush() == []
    assert decoder.counters["week_unknown"] == 1
    decoder.note_utc(1_710_347_000_000_000_000)  # 2024-03-13
    found = [event for f in msm for event in decoder.decode(f, 0)] + decoder.flush()
    assert [e.week for e in found if isinstance(e, RawGnssEpoch)] == [2305]
