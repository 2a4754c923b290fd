"""Fields of NMEA sentences: quality, velocity, sigma, heading; what is refused, by name."""

from __future__ import annotations

import math

import pytest

from drivers.measurements import (
    ArrivalStamp,
    Heading,
    PositionFix,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.geoid import GEOID_SD_M
from tests.drivers.nmea.sentences import (
    GGA,
    GGA_NO_FIX,
    GGA_SW,
    GNS,
    GSA,
    GSA_2D,
    GST,
    GST_EMPTY,
    HDT,
    RMC,
    RMC_V,
    THS,
    THS_E,
    UTC_NS,
    VTG,
    ZDA,
    ZDA_RDSS,
    at,
    changed,
    decode,
    decoder,
    fix_of,
    fixes,
    made,
    wire,
)


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
    assert (fix.height_m, fix.geoid_sd_m) == (45.3, GEOID_SD_M)  # above the sea
    assert fix.stamp == TimeOfDayStamp(2 * 3600 + 14 * 60 + 29.0)
    assert (fix.v_ned_m_s, fix.sd_ned_m, fix.vdop) == (None, None, None)


@pytest.mark.parametrize(
    "talker", ["GP", "GN", "BD", "GB", "GL", "GA", "GI", "GQ", "QZ", "II", "IN"]
)
def test_every_talker(talker: str) -> None:
    assert fix_of(changed(GGA, "GN", talker)).quality == 4


def test_talkers_of_other_devices_are_not_taken() -> None:
    found, one = decode(changed(GGA, "GN", "LC"), changed(HDT, "GN", "HE"))
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


@pytest.mark.parametrize(
    ("said", "height_m"),
    [
        ([changed(GGA, ",18,", ",04,"), GSA_2D], None),
        ([changed(GGA, ",18,", ",,"), GSA_2D], None),
        ([GGA, changed(GSA_2D, "1.50", "99.99")], None),
        ([GGA, changed(GSA_2D, "1.50", "")], None),
        ([GGA, GSA_2D], 36.2),  # Quectel, Telit: 14 satellites and GSA says 2
        ([changed(GGA, ",18,", ",05,"), GSA_2D], 36.2),
        # Quectel EG25-G: GGA counts GPS alone, GNS and GSA all.
        ([changed(GGA, ",18,", ",04,"), changed(GNS, ",18,", ",08,"), GSA_2D], 36.2),
        ([changed(GGA, ",18,", ",03,"), GSA_2D, changed(GSA_2D, "1.50,4", "1.50,1")], 36.2),
        ([changed(GGA, ",18,", ",03,"), GSA_2D, changed(GSA_2D, "GN", "GP")], None),
        ([changed(GGA, ",18,", ",04,"), GSA_2D, GSA], 36.2),  # another system's says 3
        ([changed(GGA, ",18,", ",04,"), GSA], 36.2),
    ],
)
def test_two_dimensional_fix_has_no_height(said: list[str], height_m: float | None) -> None:
    found, one = decode(*said)
    (fix,) = fixes(found)
    assert fix.height_m == (None if height_m is None else pytest.approx(height_m))
    assert one.counters["height_not_measured"] == (height_m is None)
    assert fix.geoid_sd_m == 0.0


def test_a_two_dimensional_fix_above_the_sea_has_no_height_either() -> None:
    few = changed(changed(GGA, ",18,", ",03,"), "-9.100", "")
    assert fix_of(few, GSA_2D).height_m is None
    assert fix_of(few).height_m == 45.3


def test_a_separation_that_was_printed_once_is_remembered() -> None:
    """As far as the geoid is level: 1 m in 20 km; where the vehicle was shipped, not at all."""
    later = changed(changed(changed(GGA, "-9.100", ""), "021429", "021430"), "3958.", "4008.")
    elsewhere = changed(changed(changed(GGA, "-9.100", ""), "021429", "021431"), "N,116", "S,016")
    found = fixes(decode(GGA, later, elsewhere)[0])
    assert [f.height_m for f in found] == [pytest.approx(36.2), pytest.approx(36.2), 45.3]
    assert [f.geoid_sd_m for f in found] == [0.0, pytest.approx(0.93, abs=0.01), GEOID_SD_M]


@pytest.mark.parametrize(
    ("status", "mode", "quality", "refusal"),
    [
        ("A", "A", 1, ""),
        ("A", "", 1, ""),
        ("D", "R", 4, ""),  # Unicore UM960: the mode is R
        ("D", "", 2, ""),
        ("F", "", 5, ""),
        ("R", "", 4, ""),
        ("P", "", 3, ""),
        ("A", "N", None, "no_fix"),
        ("V", "A", None, "no_fix"),
        ("N", "", None, "no_fix"),
        ("", "", None, "no_fix"),
        ("E", "", None, "dead_reckoning_refused"),
        ("A", "E", None, "dead_reckoning_refused"),
        ("M", "", None, "manual_refused"),
        ("S", "", None, "simulator_refused"),
    ],
)
def test_rmc_alone(status: str, mode: str, quality: int | None, refusal: str) -> None:
    rmc = changed(changed(RMC, ",A,", f",{status},"), "R,V", f"{mode},V")
    epochs = [changed(rmc, "0214", f"02{minute}") for minute in range(14, 18)]
    found, one = decode(*epochs)
    assert [f.quality for f in fixes(found)] == ([] if quality is None else [quality] * 3)
    assert one.refusal == refusal
    for fix in fixes(found):
        assert math.degrees(fix.lat_rad) == pytest.approx(39 + 58.12345 / 60, abs=1e-9)
        assert math.degrees(fix.lon_rad) == pytest.approx(116 + 19.54321 / 60, abs=1e-9)
        assert (fix.height_m, fix.geoid_sd_m, fix.sd_ned_m, fix.hdop) == (None, 0.0, None, None)
        assert fix.v_ned_m_s == (
            pytest.approx(0.0, abs=1e-9),
            pytest.approx(19.438 * 1852 / 3600),
            None,
        )


def test_rmc_before_mode_and_status_of_the_standard() -> None:
    """NMEA 2.0 has neither mode nor what follows it."""
    old = made(RMC[1:-3].removesuffix(",,,R,V") + ",003.1,W")
    found, one = decode(*(changed(old, "0214", f"02{minute}") for minute in range(14, 17)))
    assert [f.quality for f in fixes(found)] == [1, 1]
    assert one.counters["rmc_alone"] == 2


GLL = made("GNGLL,3958.12345,N,11619.54321,E,021429.00,A,D")


@pytest.mark.parametrize(
    ("status", "mode", "quality", "refusal"),
    [
        ("A", "D", 2, ""),
        ("A", "R", 4, ""),
        ("A", "N", None, "no_fix"),
        ("A", "E", None, "dead_reckoning_refused"),
        ("A", "S", None, "simulator_refused"),
        ("V", "D", None, "no_fix"),
        ("V", "N", None, "no_fix"),
        ("", "", None, ""),
    ],
)
def test_gll_alone(status: str, mode: str, quality: int | None, refusal: str) -> None:
    """A plotter's output of old: GLL, VTG and HDT."""
    gll = changed(GLL, "A,D", f"{status},{mode}")
    epochs = [s for m in range(14, 18) for s in (changed(gll, "0214", f"02{m}"), VTG)]
    found, one = decode(ZDA, *epochs)
    assert [f.quality for f in fixes(found)] == ([] if quality is None else [quality] * 3)
    assert one.refusal == refusal
    for fix in fixes(found):
        assert math.degrees(fix.lat_rad) == pytest.approx(39 + 58.12345 / 60, abs=1e-9)
        assert math.degrees(fix.lon_rad) == pytest.approx(116 + 19.54321 / 60, abs=1e-9)
        assert (fix.height_m, fix.sd_ned_m, fix.hdop) == (None, None, None)
        assert fix.v_ned_m_s == (pytest.approx(0.0, abs=1e-9), pytest.approx(10.0, abs=1e-3), None)
        assert isinstance(fix.stamp, UtcStamp)


def test_gll_before_mode_of_the_standard() -> None:
    old = made("GPGLL,3958.123,N,11619.543,E,021429,A")
    found, one = decode(*(changed(old, "0214", f"02{minute}") for minute in range(14, 17)))
    assert [f.quality for f in fixes(found)] == [1, 1]
    assert one.counters["gll_alone"] == 2
    assert one.counters["gga_awaited"] == 1
    assert fixes(found)[0].rounding_sd_ned_m[0] == pytest.approx(1.852 / math.sqrt(12.0))


@pytest.mark.parametrize(
    "body", ["GPGLL,3958.12,N,11619.54,E", "GPGLL,3958.12,N,11619.54,E,021429.00,V,N"]
)
def test_gll_is_no_judge_of_gga(body: str) -> None:
    """One of before NMEA 2.0, without time and status, and one that says V beside a fix."""
    for said in ((made(body), GGA), (GGA, made(body))):
        assert fix_of(*said).quality == 4
        assert isinstance(fix_of(ZDA, *said).stamp, UtcStamp)


@pytest.mark.parametrize("fuller", [GGA, RMC, GNS])
def test_gll_holds_up_no_epoch_of_a_fuller_sentence(fuller: str) -> None:
    """A burst ends with GLL at u-blox: what GGA or RMC closes does not wait for it, but once."""
    one = decoder()
    for minute in range(14, 20):
        one.feed(wire(*(changed(s, "0214", f"02{minute}") for s in (fuller, GLL))), 0)
    assert one.counters["unused_sentence"] == 6
    assert one.counters["gll_alone"] == 0
    counts = one.counters["fixes"]
    one.feed(wire(changed(fuller, "0214", "0220")), 0)
    assert one.counters["fixes"] == counts + 1  # at once, with the learned last sentence


def test_a_gga_that_counts_no_satellites_beside_gns() -> None:
    """A timing receiver says 00 in GGA and 11 in GNS."""
    assert fix_of(GNS, changed(GGA, ",18,", ",00,")).satellites == 18
    assert fix_of(changed(GGA, ",18,", ",00,")).satellites == 0


def test_a_zda_ahead_of_rmc_holds_up_no_trust() -> None:
    """An AC12 sends ZDA two seconds ahead of the GGA and RMC before it: UTC is RMC's."""
    said = []
    for k in range(8):
        now, ahead = f"0214{10 + k}.00", f"0214{12 + k}.00"
        said.append([at(GGA, now), GSA, at(RMC, now), at(ZDA, ahead)])
    one = decoder()
    found = [m for k, epoch in enumerate(said) for m in one.feed(wire(*epoch), k * 1_000_000_000)]
    reports = [m for m in found + one.flush() if isinstance(m, TimeReport)]
    assert [m.trusted for m in reports] == [False, False, *[True] * 6]
    assert [m.utc_ns for m in reports] == [f.stamp.utc_ns for f in fixes(found)]  # type: ignore[union-attr]


def test_sentences_that_take_turns_are_a_fix_each() -> None:
    """RMC, GLL with VTG, RMC, GGA with ZDA, a second apart, as a plotter of 2006 sent them."""
    bare = made("INGLL,3958.1234,N,11619.5432,E,021429,A")
    turns = [[changed(RMC, "GN", "IN")], [bare, changed(VTG, "GN", "IN")]]
    turns += [[changed(RMC, "GN", "IN")], [changed(GGA_SW, "GP", "IN")]]
    said = [changed(s, "0214", f"02{14 + k}") if "0214" in s else s
            for k in range(16) for s in turns[k % 4]]  # fmt: skip
    found, one = decode(*said)
    assert len(fixes(found)) == 15
    assert [f.v_ned_m_s is not None for f in fixes(found)[:4]] == [True, True, False, True]
    assert one.counters["gll_alone"] == 4
    assert one.counters["rmc_alone"] == 7


def test_gll_of_another_time_or_place_is_refused() -> None:
    for bad in ("3960.1", "9158.1"):
        assert decode(changed(GLL, "3958.12345", bad))[1].counters["bad_field"] == 1
    assert decode(changed(GLL, "021429.00", "251429.00"))[1].counters["bad_field"] == 1
    assert decode(made("GNGLL"), made("GNGLL,,,,,,V,N"))[1].counters["fixes"] == 0


def test_integrated_instrumentation_says_so() -> None:
    found, one = decode(
        changed(GGA, "GN", "II"), changed(RMC, "GN", "II"), changed(HDT, "GN", "II")
    )
    (fix,) = fixes(found)
    assert fix.v_ned_m_s is not None
    assert [type(m).__name__ for m in found] == ["TimeReport", "PositionFix", "Heading"]
    assert one.counters["integrated"] == 1
    # Beside the receiver's own on one line: the same fix by another name.
    both = decode(GGA, RMC, changed(GGA, "GN", "II"), changed(RMC, "GN", "II"))[1]
    assert (both.counters["fixes"], both.counters["repeated_sentence"]) == (1, 2)


def test_a_lost_gga_is_not_replaced_by_rmc() -> None:
    epochs = [[changed(s, "0214", f"02{m}") for s in (GGA, RMC)] for m in range(14, 20)]
    del epochs[2][0]
    found, one = decode(*(sentence for epoch in epochs for sentence in epoch))
    assert [f.quality for f in fixes(found)] == [4] * 5
    assert one.counters["rmc_alone"] == 0


@pytest.mark.parametrize("status", ["D", "R", "F", "P"])
def test_rmc_status_that_tells_the_mode_leaves_velocity_and_time(status: str) -> None:
    report, fix = decode(GGA, changed(RMC, ",A,", f",{status},"))[0]
    assert isinstance(report, TimeReport)
    assert report.utc_ns == UTC_NS
    assert isinstance(fix, PositionFix)
    assert fix.v_ned_m_s is not None
    assert fix.stamp == UtcStamp(UTC_NS)
    assert fix.quality == 4


def test_a_status_that_is_none_makes_rmc_count_for_nothing() -> None:
    found, one = decode(GGA, changed(RMC, ",A,", ",Z,"))
    (fix,) = fixes(found)
    assert (fix.quality, fix.v_ned_m_s) == (4, None)
    assert one.counters["unknown_status"] == 1


def test_novatels_quality_of_a_fix_with_sbas() -> None:
    assert fix_of(changed(GGA, "E,4", "E,9")).quality == 2


def test_what_the_printed_digits_leave_out() -> None:
    fix = fix_of(changed(GGA, "3958.12345,N,11619.54321", "3958.12,N,11619.5"))
    step = 1852.0 / math.sqrt(12.0)
    cos = math.cos(fix.lat_rad)
    assert fix.rounding_sd_ned_m == pytest.approx(
        (step * 1e-2, step * 1e-1 * cos, 2.9e-4), abs=1e-5
    )


def test_sigma_without_numbers_is_none() -> None:
    assert fix_of(GGA, GST_EMPTY).sd_ned_m is None
    assert fix_of(GGA, changed(GST, "0.014", "0.000")).sd_ned_m is None


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
        ([changed(GGA, "E,4", "E,10")], "unknown_quality"),
        ([changed(GGA, "E,4", "E,3"), changed(RMC, ",A,", ",E,")], "dead_reckoning_refused"),
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


def test_rdss_text_on_the_same_port_is_left_alone() -> None:
    found, one = decode(GGA, ZDA_RDSS, made("BDFKI,DWA,N,Y,0,0058"), RMC)
    assert fixes(found)[0].stamp == UtcStamp(UTC_NS)
    assert one.counters["rdss_sentence"] == 2
    assert one.counters["implausible_date"] == 0


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
