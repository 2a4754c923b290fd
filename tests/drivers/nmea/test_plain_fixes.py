"""Fixes of RMC and GLL: alone, beside GGA, by whose status and mode."""

from __future__ import annotations

import math

import pytest

from drivers.measurements import (
    PositionFix,
    TimeReport,
    UtcStamp,
)
from tests.drivers.nmea.sentences import (
    GGA,
    GGA_SW,
    GNS,
    GSA,
    HDT,
    RMC,
    UTC_NS,
    VTG,
    ZDA,
    at,
    changed,
    decode,
    decoder,
    fix_of,
    fixes,
    made,
    wire,
)

GLL = made("GNGLL,3958.12345,N,11619.54321,E,021429.00,A,D")


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


@pytest.mark.parametrize("status", ["Z", "a"])
def test_a_status_that_is_none_makes_rmc_count_for_nothing(status: str) -> None:
    found, one = decode(GGA, changed(RMC, ",A,", f",{status},"))
    (fix,) = fixes(found)
    assert (fix.quality, fix.v_ned_m_s) == (4, None)
    assert one.counters["unknown_status"] == 1


@pytest.mark.parametrize(
    ("rmc", "quality", "refusal"),
    [(RMC, 4, ""), (changed(RMC, "R,V", ","), 1, ""), (changed(RMC, ",A,", ",V,"), None, "no_fix")],
)
def test_where_gga_leaves_its_quality_empty_rmc_says_it(
    rmc: str, quality: int | None, refusal: str
) -> None:
    """Jackson Labs' FireFly: with its altitude, which RMC has not."""
    found, one = decode(changed(GGA, "E,4", "E,"), rmc)
    got = fixes(found)
    assert [fix.quality for fix in got] == ([] if quality is None else [quality])
    assert all(fix.height_m == pytest.approx(36.2) for fix in got)
    assert one.refusal == refusal
    assert "rmc_alone" not in one.counters


@pytest.mark.parametrize(
    ("datum", "number"), [("W84", 1), ("P90", 1), ("", 1), ("W72", 0), ("999", 0), ("TOK", 0)]
)
def test_another_datum_is_refused(datum: str, number: int) -> None:
    dtm = made(f"GPDTM,{datum},,0.0,N,0.0,E,0.0,W84")
    found, one = decode(dtm, GGA, RMC)
    assert len(fixes(found)) == number
    assert one.refusal == ("" if number else "datum_refused")


def test_an_angle_that_is_none_is_no_missing_one() -> None:
    """Not "the receiver has no fix"."""
    _, one = decode(*[changed(GGA, "3958.12345", "3958;12345")] * 3)
    assert one.counters["bad_field"] == 3
    assert "cannot be true" in one.cause
