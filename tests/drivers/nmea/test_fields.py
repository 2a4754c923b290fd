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
from drivers.nmea.judge import GEOID_SD_M
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
    changed,
    decode,
    fix_of,
    fixes,
    made,
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


@pytest.mark.parametrize("printed", ["0.0", "0", "0.000", "-0.0"])
def test_a_separation_of_zero_says_that_the_receiver_has_no_geoid(printed: str) -> None:
    """What it prints for an altitude above the sea as for one above the ellipsoid."""
    fix = fix_of(changed(GGA, "-9.100", printed))
    assert (fix.height_m, fix.geoid_sd_m) == (45.3, GEOID_SD_M)


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


def test_a_gga_that_counts_no_satellites_beside_gns() -> None:
    """A timing receiver says 00 in GGA and 11 in GNS."""
    assert fix_of(GNS, changed(GGA, ",18,", ",00,")).satellites == 18
    assert fix_of(changed(GGA, ",18,", ",00,")).satellites == 0


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
