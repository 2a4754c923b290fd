"""Epochs of an NMEA receiver: grouping, fields, quality, velocity, sigma, heading, refusals."""

from __future__ import annotations

import math
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import (
    ArrivalStamp,
    Heading,
    Measurement,
    PositionFix,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding

EARLIEST = date(2025, 1, 1)
UTC_NS = int(datetime(2025, 6, 19, 2, 14, 29, tzinfo=UTC).timestamp()) * 1_000_000_000

# Golden sentences; the checksums were computed apart from this project's code.
GGA = "$GNGGA,021429.00,3958.12345,N,11619.54321,E,4,18,0.62,45.300,M,-9.100,M,1.0,0000*47"
GGA_SW = "$GPGGA,021429.00,3958.12345,S,11619.54321,W,1,08,1.10,45.3,M,,M,,*72"
GGA_NO_FIX = "$GAGGA,021429.00,,,,,0,00,99.99,,,,,,*7B"
RMC = "$GNRMC,021429.00,A,3958.12345,N,11619.54321,E,19.438,090.00,190625,,,R,V*2B"
RMC_V = "$GNRMC,021429.00,V,3958.12345,N,11619.54321,E,,,190625,,,N,V*2E"
VTG = "$GNVTG,090.00,T,,M,19.438,N,36.000,K,R*3B"
GNS = "$GNGNS,021429.00,3958.12345,N,11619.54321,E,RRNAN,18,0.62,45.300,-9.100,1.0,0000,V*53"
GSA = "$GNGSA,A,3,03,06,14,17,19,24,,,,,,,1.21,0.62,1.04,1*0A"
GSA_2D = "$GNGSA,A,2,03,06,14,,,,,,,,,,2.21,1.62,1.50,4*05"
GST = "$GNGST,021429.00,12,0.020,0.010,45,0.014,0.012,0.031*40"
GST_EMPTY = "$GBGST,021429.00,12,,,,,,*64"
ZDA = "$BDZDA,021429.00,19,06,2025,00,00*70"
ZDA_RDSS = "$BDZDA,3,000329.00,01,01,2006,-08,00,00,00,00,N*0F"
HDT = "$GNHDT,350.00,T*1D"
THS = "$GNTHS,010.50,A*1D"
THS_E = "$GNTHS,010.50,E*19"


def made(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def changed(sentence: str, old: str, new: str) -> str:
    """A golden sentence with one field changed, and its checksum mended."""
    assert old in sentence
    return made(sentence[1:-3].replace(old, new, 1))


def at(sentence: str, time: str) -> str:
    return changed(sentence, "021429.00", time)


def wire(*sentences: str) -> bytes:
    return "".join(sentence + "\r\n" for sentence in sentences).encode()


def decoder(**options: object) -> NmeaDecoder:
    return NmeaDecoder("gnss", NmeaDecoding.model_validate({"earliest_date": EARLIEST, **options}))


def decode(*sentences: str, **options: object) -> tuple[list[Measurement], NmeaDecoder]:
    one = decoder(**options)
    return one.feed(wire(*sentences), 7) + one.flush(), one


def fix_of(*sentences: str, **options: object) -> PositionFix:
    (fix,) = [m for m in decode(*sentences, **options)[0] if isinstance(m, PositionFix)]
    return fix


def fixes(found: list[Measurement]) -> list[PositionFix]:
    return [m for m in found if isinstance(m, PositionFix)]


# --------------------------------------------------------------------------- fields


def test_a_whole_epoch() -> None:
    found, one = decode(RMC, VTG, GGA, GSA, GST, ZDA)
    report, fix = found
    assert report == TimeReport("gnss", 7, UTC_NS, trusted=False)
    assert isinstance(fix, PositionFix)
    assert fix.stamp == UtcStamp(UTC_NS)
    assert math.degrees(fix.lat_rad) == pytest.approx(39 + 58.12345 / 60, abs=1e-9)
    assert math.degrees(fix.lon_rad) == pytest.approx(116 + 19.54321 / 60, abs=1e-9)
    assert fix.height_m == pytest.approx(45.3 - 9.1)
    assert (fix.quality, fix.satellites, fix.hdop, fix.vdop) == (4, 18, 0.62, 1.04)
    assert fix.sd_ned_m == (0.014, 0.012, 0.031)
    assert fix.v_ned_m_s is not None
    assert fix.v_ned_m_s == (
        pytest.approx(0.0, abs=1e-9),
        pytest.approx(19.438 * 1852 / 3600),
        None,
    )
    assert fix.sd_v_ned_m_s is None
    assert one.counters["fixes"] == one.counters["epochs"] == 1


def test_hemispheres_and_absent_separation() -> None:
    fix = fix_of(GGA_SW)
    assert math.degrees(fix.lat_rad) == pytest.approx(-(39 + 58.12345 / 60))
    assert math.degrees(fix.lon_rad) == pytest.approx(-(116 + 19.54321 / 60))
    assert fix.height_m is None  # sea level alone is no ellipsoidal height
    assert fix.stamp == TimeOfDayStamp(2 * 3600 + 14 * 60 + 29.0)
    assert (fix.v_ned_m_s, fix.sd_ned_m, fix.vdop) == (None, None, None)


@pytest.mark.parametrize("talker", ["GP", "GN", "BD", "GB", "GL", "GA", "GQ"])
def test_every_talker(talker: str) -> None:
    assert fix_of(changed(GGA, "GN", talker)).quality == 4


def test_talkers_of_other_devices_are_not_taken() -> None:
    found, one = decode(changed(GGA, "GN", "II"), changed(HDT, "GN", "HE"))
    assert not found
    assert one.counters["other_talker"] == 2


def test_gns_where_gga_is_not_sent() -> None:
    fix = fix_of(RMC, GNS)
    assert fix.quality == 1  # RRNAN: one system is autonomous
    assert fix.height_m == pytest.approx(36.2)
    assert (fix.satellites, fix.hdop) == (18, 0.62)


@pytest.mark.parametrize(
    ("modes", "quality"),
    [("A", 1), ("DDDN", 2), ("RRRR", 4), ("RF", 5), ("RFDA", 1), ("PR", 3), ("NNNR", 4)],
)
def test_worst_system_counts_in_gns(modes: str, quality: int) -> None:
    assert fix_of(changed(GNS, "RRNAN", modes)).quality == quality


def test_gga_settles_quality_beside_gns_in_either_order() -> None:
    assert fix_of(GGA, GNS).quality == 4
    assert fix_of(GNS, GGA).quality == 4


def test_velocity_from_vtg_where_rmc_is_not_sent() -> None:
    v = fix_of(GGA, VTG).v_ned_m_s
    assert v is not None
    assert v[1] == pytest.approx(19.438 * 1852 / 3600)
    v = fix_of(GGA, changed(VTG, "19.438", "")).v_ned_m_s
    assert v is not None
    assert v[1] == pytest.approx(10.0)  # km/h
    assert fix_of(GGA, changed(VTG, "K,R", "K,N")).v_ned_m_s is None


def test_velocity_needs_a_course_unless_at_rest() -> None:
    moving = changed(RMC, "19.438,090.00", "2.000,")
    resting = changed(RMC, "19.438,090.00", "0.013,")
    assert fix_of(GGA, moving).v_ned_m_s is None
    assert fix_of(GGA, resting).v_ned_m_s == (0.0, 0.0, None)
    v = fix_of(GGA, moving, VTG).v_ned_m_s
    assert v is not None
    assert v[1] == pytest.approx(2.0 * 1852 / 3600)


def test_two_dimensional_fix_has_no_height() -> None:
    found, one = decode(GGA, GSA_2D)
    assert fixes(found)[0].height_m is None
    assert one.counters["height_not_measured"] == 1


def test_sigma_without_numbers_is_none() -> None:
    assert fix_of(GGA, GST_EMPTY).sd_ned_m is None
    assert fix_of(GGA, changed(GST, "0.014", "0.000")).sd_ned_m is None


# --------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("sentences", "name"),
    [
        ([changed(GGA, "E,4", "E,6")], "dead_reckoning_refused"),
        ([GGA, changed(RMC, "R,V", "E,V")], "dead_reckoning_refused"),
        ([GGA, changed(VTG, "K,R", "K,E")], "dead_reckoning_refused"),
        ([changed(GNS, "RRNAN", "AENNN")], "dead_reckoning_refused"),
        ([changed(GGA, "E,4", "E,6"), RMC_V], "dead_reckoning_refused"),
        ([changed(GGA, "E,4", "E,0")], "no_fix"),
        ([changed(GGA, "E,4", "E,")], "no_fix"),
        ([GGA_NO_FIX], "no_fix"),
        ([GGA, RMC_V], "no_fix"),
        ([changed(GNS, "RRNAN", "NNNNN")], "no_fix"),
        ([changed(GGA, "E,4", "E,7")], "manual_refused"),
        ([changed(GGA, "E,4", "E,8")], "simulator_refused"),
        ([GGA, changed(RMC, "R,V", "S,V")], "simulator_refused"),
        ([changed(GGA, "E,4", "E,9")], "unknown_quality"),
        ([changed(GGA, "45.300", "1e300")], "height_implausible"),
        ([changed(GGA, "45.300", "-6371000")], "height_implausible"),
        ([changed(GGA, "-9.100", "100000")], "height_implausible"),
        ([GGA, changed(RMC, "19.438", "1e300")], "speed_implausible"),
        ([GGA, changed(RMC, "19.438", "2000.0")], "speed_implausible"),
        ([GGA, changed(VTG, "19.438", "1945.0")], "speed_implausible"),
        ([GGA, changed(GST, "0.014", "inf")], "sigma_too_large"),
        ([GGA, changed(GST, "0.031", "nan")], "sigma_too_large"),
        ([GGA, changed(GST, "0.012", "1e9")], "sigma_too_large"),
    ],
)
def test_epochs_refused_by_name(sentences: list[str], name: str) -> None:
    found, one = decode(*sentences)
    assert not fixes(found)
    assert one.counters[name] == 1
    assert one.refusal == name


@pytest.mark.parametrize("sigma", ["1e-9", "0.000", "0.0009"])
def test_a_sigma_that_nothing_reaches_is_left_out(sigma: str) -> None:
    found, one = decode(GGA, changed(GST, "0.012", sigma))
    (fix,) = fixes(found)
    assert fix.sd_ned_m is None
    assert one.counters["sigma_too_small"] == 1


def test_the_limits_of_what_is_plausible_pass() -> None:
    found, one = decode(
        changed(GGA, "45.300", "100009.1"),
        changed(RMC, "19.438", "1943.8"),
        changed(GST, "0.014,0.012,0.031", "0.001,100000,0.001"),
    )
    (fix,) = fixes(found)
    assert fix.height_m == pytest.approx(1e5)
    assert fix.sd_ned_m == (0.001, 1e5, 0.001)
    assert one.refusal == ""


def test_simulator_where_allowed() -> None:
    assert fix_of(changed(GGA, "E,4", "E,8"), allow_simulator=True).quality == 8
    assert fix_of(changed(GGA, "E,4", "E,7"), allow_simulator=True).quality == 7
    found, one = decode(changed(GGA, "E,4", "E,6"), allow_simulator=True)
    assert (fixes(found), one.counters["dead_reckoning_refused"]) == ([], 1)


@pytest.mark.parametrize(
    ("sentence", "old", "new"),
    [
        (GGA, "3958.12345", "3960.12345"),
        (GGA, "3958.12345", "9158.12345"),
        (GGA, "11619.54321", "18019.54321"),
        (GGA, "3958.12345", "-958.12345"),
        (GGA, ",N,", ",,"),
        (GGA, ",N,", ",X,"),
        (GGA, "0.62", "nan"),
        (GGA, "45.300", "inf"),
        (GGA, "E,4,18", "E,4,x"),
        (GGA, "021429.00", "241429.00"),
        (GGA, "021429.00", "021460.00"),
        (GGA, "021429.00", "2:14:29"),
        (RMC, "19.438", "-1.0"),
        (RMC, "090.00", "361.0"),
        (GST, "0.014", "-0.1"),
        (ZDA, ",06,", ",13,"),
        (HDT, "350.00", "400.0"),
    ],
)
def test_a_field_that_cannot_be_true_refuses_the_sentence_only(
    sentence: str, old: str, new: str
) -> None:
    found, one = decode(changed(sentence, old, new), GGA)
    assert one.counters["bad_field"] == 1
    assert len(fixes(found)) == 1


def test_cut_sentences_that_verify() -> None:
    for whole in (GGA, RMC, VTG, GNS, GSA, GST, ZDA, HDT, THS):
        fields = whole[1:-3].split(",")
        for length in range(1, len(fields)):
            decode(made(",".join(fields[:length])), GGA)


@given(
    st.sampled_from(["GGA", "RMC", "VTG", "GNS", "GSA", "GST", "ZDA", "HDT", "THS"]),
    st.lists(
        st.sampled_from(["", "021429.00", "9999999", "A", "nan", "-1", "3958.1", "N", "E", "6"])
        | st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=8),
        max_size=20,
    ),
)
@settings(max_examples=300, deadline=None)
def test_no_verified_sentence_raises(formatter: str, fields: list[str]) -> None:
    body = ",".join(["GN" + formatter, *fields]).replace("$", "").replace("*", "")
    for measurement in decode(made(body), GGA, RMC)[0]:
        if isinstance(measurement, PositionFix):
            assert math.isfinite(measurement.lat_rad)
            assert math.isfinite(measurement.lon_rad)


def test_rdss_text_on_the_same_port_is_left_alone() -> None:
    found, one = decode(GGA, ZDA_RDSS, made("BDFKI,DWA,N,Y,0,0058"), RMC)
    assert fixes(found)[0].stamp == UtcStamp(UTC_NS)
    assert one.counters["rdss_sentence"] == 2
    assert one.counters["implausible_date"] == 0


# --------------------------------------------------------------------------- heading


def test_heading_with_baseline_offset() -> None:
    headings = list(decode(GGA, RMC, HDT, heading_offset_deg=30.0)[0][1:])
    assert isinstance(headings[1], Heading)
    assert math.degrees(headings[1].yaw_rad) == pytest.approx(20.0)
    assert headings[1].stamp == UtcStamp(UTC_NS)
    (heading,) = [m for m in decode(GGA, THS)[0] if isinstance(m, Heading)]
    assert math.degrees(heading.yaw_rad) == pytest.approx(10.5)


def test_heading_that_is_not_a_measurement_is_refused() -> None:
    for sentences in ([GGA, THS_E], [changed(GGA, "E,4", "E,6"), HDT], [GGA_NO_FIX, HDT]):
        found, one = decode(*sentences)
        assert not [m for m in found if isinstance(m, Heading)]
        assert one.counters["heading_mode_refused"] == 1


def test_heading_alone_has_only_its_arrival() -> None:
    found, one = decode(HDT, HDT, HDT)
    assert [m.stamp for m in found if isinstance(m, Heading)] == [ArrivalStamp()] * 3
    assert one.counters["untimed_epoch"] == 3


# --------------------------------------------------------------------------- grouping


def seconds(start: int, count: int, *cycle: str) -> list[list[str]]:
    """`count` epochs of a cycle of golden sentences, one second apart."""
    return [
        [at(s, f"0214{start + i:02d}.00") if "021429.00" in s else s for s in cycle]
        for i in range(count)
    ]


def test_epoch_closes_on_the_next_time() -> None:
    one = decoder()
    first, second = seconds(10, 2, GGA, RMC)
    assert not fixes(one.feed(wire(*first), 1))
    (fix,) = fixes(one.feed(wire(second[0]), 2))
    assert fix.t_seen_ns == 1  # what came later belongs to the next


def test_epoch_closes_on_silence() -> None:
    one = decoder()
    one.feed(wire(GGA), 1)
    assert one.epoch_open
    assert len(fixes(one.silence())) == 1
    assert not one.epoch_open
    assert one.silence() == []


def test_epoch_closes_on_the_configured_last_sentence() -> None:
    one = decoder(last_sentence="GST")
    for epoch in seconds(10, 3, GGA, RMC, GST):
        assert len(fixes(one.feed(wire(*epoch), 1))) == 1


def test_last_sentence_is_learned_from_two_equal_cycles() -> None:
    one = decoder()
    closed_at_once = []
    for epoch in seconds(10, 6, RMC, VTG, GGA, GSA, GSA, GST):
        for sentence in epoch[:-1]:
            one.feed(wire(sentence), 1)
        closed_at_once.append(len(fixes(one.feed(wire(epoch[-1]), 2))))
    assert closed_at_once == [0, 0, 1, 1, 1, 1]
    assert one.counters["fixes"] == 6


def test_a_lost_sentence_only_delays_its_own_epoch() -> None:
    one = decoder()
    epochs = seconds(10, 8, RMC, GGA, GST)
    del epochs[4][2]
    found = [m for epoch in epochs for m in one.feed(wire(*epoch), 1)]
    assert [f.sd_ned_m is None for f in fixes(found)] == [i == 4 for i in range(8)]
    assert one.counters["late_sentence"] == 0


def test_slower_sentences_make_it_unlearn() -> None:
    """GGA at every epoch, RMC at every fourth: a cycle of GGA alone was too short to learn."""
    one = decoder()
    found = []
    for i, (gga, rmc) in enumerate(seconds(10, 24, GGA, RMC)):
        found += one.feed(wire(*([gga, rmc] if i % 4 == 3 else [gga])), 1)
    found += one.flush()
    assert len(fixes(found)) == 24
    assert one.counters["late_sentence"] == 1
    with_velocity = [i for i, f in enumerate(fixes(found)) if f.v_ned_m_s is not None]
    assert with_velocity == [7, 11, 15, 19, 23]


def test_slower_sentence_without_a_time_never_moves_to_the_next_epoch() -> None:
    one = decoder()
    found = []
    for i, (gga, vtg) in enumerate(seconds(10, 16, GGA, VTG)):
        found += one.feed(wire(*([gga, vtg] if i % 4 == 3 else [gga])), 1)
    found += one.flush()
    with_velocity = [i for i, f in enumerate(fixes(found)) if f.v_ned_m_s is not None]
    assert with_velocity == [7, 11, 15]
    assert one.counters["late_sentence"] == 1


def test_what_comes_after_the_configured_last_sentence_is_late() -> None:
    one = decoder(last_sentence="GGA")
    for epoch in seconds(10, 4, GGA, VTG):
        assert [f.v_ned_m_s for f in fixes(one.feed(wire(*epoch), 1))] == [None]
    assert one.counters["late_sentence"] == 4


def test_repeated_sentences_of_one_epoch() -> None:
    found, one = decode(GGA, changed(GGA, "GN", "GP"), RMC)
    assert len(fixes(found)) == 1
    assert one.counters["repeated_sentence"] == 1


def test_repeated_and_backward_epochs() -> None:
    one = decoder(last_sentence="RMC")
    for time in ("021430.00", "021430.00", "021429.00", "021431.00", "021430.50", "021432.00"):
        one.feed(wire(at(GGA, time), at(RMC, time)), 1)
    assert one.counters["fixes"] == 3
    assert one.counters["duplicate_epoch"] == 1
    assert one.counters["backward_epoch"] == 2


def test_a_receiver_that_sets_its_clock_back_is_followed() -> None:
    one = decoder(last_sentence="RMC")
    times = ["021450.00"] + [f"0214{s}.00" for s in range(32, 37)]
    found = [m for t in times for m in one.feed(wire(at(GGA, t), at(RMC, t)), 1)]
    assert len(fixes(found)) == 1 + 3
    assert one.counters["backward_epoch"] == 2
    assert one.counters["time_set_back"] == 1


def test_an_endless_epoch_is_bounded() -> None:
    one = decoder()
    one.feed(wire(GGA, *[GSA] * 1000), 1)
    assert one.counters["epochs"] >= 40


@given(st.integers(1, 60))
@settings(max_examples=20, deadline=None)
def test_any_chunks_give_the_same_measurements(size: int) -> None:
    stream = wire(*(s for epoch in seconds(10, 5, RMC, VTG, GGA, GSA, GST, ZDA) for s in epoch))
    one = decoder()
    found = [m for i in range(0, len(stream), size) for m in one.feed(stream[i : i + size], 1)]
    other = decoder()
    assert found + one.flush() == other.feed(stream, 1) + other.flush()
    assert one.counters == other.counters
