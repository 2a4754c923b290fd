"""A receiver on CAN by any DBC: frames of a recorded module, of a made-up one, and on a bus."""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.base import PermanentDriverError
from drivers.can.gnss import CanGnssDecoder, CanGnssDriver, CanGnssOptions
from drivers.measurements import (
    ArrivalStamp,
    Heading,
    Measurement,
    PositionFix,
    TimeReport,
    UtcStamp,
)
from fusiond.configuration.load import load_config
from tests.drivers.can.css_module import EPOCH_S, GOOD, MODULE
from tests.drivers.can.served import SECOND, Served, fed, sent
from tests.patience import until
from tests.places import REPOSITORY

DEG = math.pi / 180.0
NEAREST = 1.0 / math.sqrt(12.0)
SHIPPED = load_config(REPOSITORY / "config" / "css_164.toml").sources["gnss"].options


def module(**changes: Any) -> CanGnssDecoder:
    return CanGnssDecoder("gnss", CanGnssOptions.model_validate({**SHIPPED, **changes}))


def burst(**changes: float) -> list[tuple[int, bytes]]:
    """An epoch of the module, with signals changed."""
    frames = []
    for name, signals in GOOD.items():
        message = MODULE.get_message_by_name(name)
        values = {s: changes.get(s, v) for s, v in signals.items()}
        frames.append((message.frame_id, message.encode(values)))
    return frames


def settled(d: CanGnssDecoder) -> None:
    """Let it learn the interval of its messages."""
    for k in range(6):
        fed(d, burst(Satellites=k), k * SECOND)
    d.counters.clear()


def epoch(d: CanGnssDecoder, k: int = 0, **changes: float) -> list[Measurement]:
    return fed(d, burst(**changes), (10 + k) * SECOND)


def the_fix(found: list[Measurement]) -> PositionFix:
    (fix,) = [m for m in found if isinstance(m, PositionFix)]
    return fix


# The frames of the recording css_164 at t_s = 1060.38.
RECORDED = [
    (1, "6B"),
    (2, "03 70 02 0B 0A 0B"),
    (3, "CF 38 72 11 7A 5F 56 06"),
    (4, "4F DF 11 00"),
    (5, "11 0E 19 C1 E1 38 47 04"),
    (7, "A9 B2 00 1A 00"),
]


def test_frames_off_the_wire_by_the_shipped_names() -> None:
    """Each of the module's messages, byte by byte, against an independent reading of its bits."""

    def bits(data: bytes, start: int, length: int) -> int:
        return int.from_bytes(data, "little") >> start & (1 << length) - 1

    wire = {can_id: bytes.fromhex(text) for can_id, text in RECORDED}
    d = module(position_valid=(), height_valid=(), velocity_valid=())
    settled(d)
    found = fed(d, wire.items(), 10 * SECOND)
    fix = the_fix(found)
    assert fix.lat_rad == pytest.approx((bits(wire[3], 1, 28) * 1e-6 - 90.0) * DEG)
    assert fix.lon_rad == pytest.approx((bits(wire[3], 29, 29) * 1e-6 - 180.0) * DEG)
    assert fix.height_m == pytest.approx(bits(wire[4], 1, 18) * 0.1 - 6000.0)
    assert fix.satellites == bits(wire[1], 3, 5)
    assert fix.v_ned_m_s is not None
    assert math.hypot(*fix.v_ned_m_s[:2]) == pytest.approx(bits(wire[7], 1, 20) * 1e-3)
    (report,) = [m for m in found if isinstance(m, TimeReport)]
    utc_s = bits(wire[2], 8, 40) * 1e-3 + 1_577_840_400
    assert report.utc_ns == pytest.approx(utc_s * 1e9, abs=1e3)


def test_an_epoch_of_several_messages() -> None:
    d = module()
    settled(d)
    report, fix = epoch(d)
    assert report == TimeReport("gnss", 10 * SECOND, round(EPOCH_S * 1e9), True)
    assert isinstance(fix, PositionFix)
    assert (fix.source, fix.stamp) == ("gnss", UtcStamp(round(EPOCH_S * 1e9)))
    assert (fix.lat_rad, fix.lon_rad) == pytest.approx((56.030215 * DEG, 10.061796 * DEG))
    assert fix.height_m == pytest.approx(127.9)
    assert (fix.quality, fix.satellites, fix.sd_ned_m) == (1, 13, (3.0, 3.0, 6.0))
    north, east = (22.868 * f(227.9 * DEG) for f in (math.cos, math.sin))
    assert fix.v_ned_m_s == (pytest.approx(north), pytest.approx(east), None)
    assert fix.sd_v_ned_m_s == (pytest.approx(0.208), pytest.approx(0.208), None)
    step_m = 1e-6 * DEG * 6_378_137.0
    assert fix.rounding_sd_ned_m == pytest.approx(
        (step_m * NEAREST, step_m * NEAREST * math.cos(56.030215 * DEG), 0.1 * NEAREST)
    )
    assert fix.rounding_sd_v_m_s == pytest.approx(22.868 * 0.1 * DEG * NEAREST)
    assert d.counters == Counter(samples=1)


def test_what_is_not_valid_is_left_out() -> None:
    d = module()
    settled(d)
    assert the_fix(epoch(d, 0, AltitudeValid=0, Altitude=-5400.0)).height_m is None
    assert the_fix(epoch(d, 1, SpeedValid=0)).v_ned_m_s is None
    assert the_fix(epoch(d, 2, AttitudeValid=0)).v_ned_m_s is None
    (report,) = epoch(d, 3, PositionValid=0)
    assert isinstance(report, TimeReport)
    assert d.counters["not_valid"] == 1
    for k, flag in enumerate(("TimeValid", "TimeConfirmed"), start=4):
        report, fix = epoch(d, k, **{flag: 0})
        assert isinstance(report, TimeReport)
        assert not report.trusted
        assert isinstance(fix, PositionFix)
        assert fix.stamp == ArrivalStamp(0.0)


def test_the_time_of_the_bus_where_the_configuration_says_so() -> None:
    d = module(timestamp="arrival", latency_s=0.1)
    settled(d)
    assert the_fix(epoch(d)).stamp == ArrivalStamp(0.1)


def test_a_message_that_is_missing_costs_its_epoch_alone() -> None:
    d = module()
    settled(d)
    assert fed(d, burst()[:4], 10 * SECOND) == []
    assert the_fix(epoch(d, 1)).satellites == 13
    assert d.counters["unpaired"] == 3  # the satellites' message is held, not paired


def test_the_course_has_a_sigma_of_its_own() -> None:
    d = module(course_accuracy="gnss_attitude.HeadingAccuracy")
    settled(d)
    fix = the_fix(epoch(d, HeadingAccuracy=6.0, Heading=90.0))
    assert fix.sd_v_ned_m_s == (
        pytest.approx(22.868 * 6.0 * DEG),
        pytest.approx(0.208),
        None,
    )


def test_kinds_of_fix_and_those_that_are_none() -> None:
    d = module(quality="gnss_status.FixType", qualities={2: 1, 3: 4})
    settled(d)
    assert the_fix(epoch(d, 0, FixType=3)).quality == 4
    assert the_fix(epoch(d, 1, FixType=2)).quality == 1
    assert not [m for m in epoch(d, 2, FixType=1) if isinstance(m, PositionFix)]
    assert d.counters["no_fix"] == 1


DBC = """VERSION ""
NS_ :
BS_:
BU_: BOX HOST
BO_ 2566844416 PLACE: 8 BOX
 SG_ LAT : 0|32@1- (1E-007,0) [0|0] "deg" HOST
 SG_ LON : 32|32@1- (1E-007,0) [0|0] "deg" HOST
BO_ 2566844417 MOTION: 8 BOX
 SG_ VN : 0|16@1- (0.01,0) [0|0] "m/s" HOST
 SG_ VE : 16|16@1- (0.01,0) [0|0] "m/s" HOST
 SG_ VD : 32|16@1- (0.01,0) [0|0] "m/s" HOST
 SG_ SD_V : 48|8@1+ (0.01,0) [0|0] "m/s" HOST
BO_ 2566844418 ANTENNAS: 8 BOX
 SG_ YAW : 0|16@1- (0.01,0) [0|0] "deg" HOST
 SG_ SD_YAW : 16|8@1+ (0.1,0) [0|0] "deg" HOST
 SG_ YAW_OK : 24|1@1+ (1,0) [0|1] "" HOST
 SG_ HEIGHT : 32|32@1- (1,0) [0|0] "ft" HOST
BO_ 2566844419 CLOCK: 8 BOX
 SG_ YEAR : 0|8@1+ (1,0) [0|0] "year" HOST
 SG_ MONTH : 8|8@1+ (1,0) [0|0] "" HOST
 SG_ DAY : 16|8@1+ (1,0) [0|0] "d" HOST
 SG_ HOUR : 24|8@1+ (1,0) [0|0] "h" HOST
 SG_ MINUTE : 32|8@1+ (1,0) [0|0] "min" HOST
 SG_ SECOND : 40|16@1+ (0.01,0) [0|0] "s" HOST
"""
BOX = {
    "lat": "PLACE.LAT",
    "lon": "PLACE.LON",
    "velocity": ("MOTION.VN", "MOTION.VE", "MOTION.VD"),
    "speed_accuracy": "MOTION.SD_V",
    "heading": "ANTENNAS.YAW",
    "heading_accuracy": "ANTENNAS.SD_YAW",
    "heading_valid": "ANTENNAS.YAW_OK",
    "height": "ANTENNAS.HEIGHT",
    "geoid_m": 40.0,
    "utc": tuple(f"CLOCK.{p}" for p in ("YEAR", "MONTH", "DAY", "HOUR", "MINUTE", "SECOND")),
}


@pytest.fixture
def dbc(tmp_path: Path) -> str:
    path = tmp_path / "box.dbc"
    path.write_text(DBC)
    return str(path)


def box_frames(k: int, yaw_ok: int = 1, month: int = 8) -> list[tuple[int, bytes]]:
    return [
        (0x18FEF100 + 0x100, b""),  # somebody else's
        (0x18FF0000 + 0xE100, b""),
        (2566844416 & 0x1FFFFFFF, struct.pack("<ii", 301234567 + k, -1143000000)),
        (2566844417 & 0x1FFFFFFF, struct.pack("<hhhBx", 1000, -500, 25, 4)),
        (2566844418 & 0x1FFFFFFF, struct.pack("<hBBi", -4500, 5, yaw_ok, 100)),
        (2566844419 & 0x1FFFFFFF, struct.pack("<5BHx", 26, month, 31, 23, 59, 6050)),
    ]


def test_velocity_heading_and_a_calendar_by_29_bit_identifiers(dbc: str) -> None:
    d = CanGnssDecoder("box", CanGnssOptions.model_validate({"dbc": dbc, **BOX}))
    for k in range(8):
        found = fed(d, box_frames(k), k * SECOND // 10, extended=True)
    report, fix, heading = found
    assert isinstance(report, TimeReport)
    # 2026-08-31 23:59:60.5 is the next day's first half second.
    assert report.utc_ns == 1_788_220_800_500_000_000
    assert isinstance(fix, PositionFix)
    assert fix.v_ned_m_s == pytest.approx((10.0, -5.0, 0.25))
    assert fix.sd_v_ned_m_s == pytest.approx((0.04, 0.04, 0.04))
    assert fix.rounding_sd_v_m_s == pytest.approx(0.01 * NEAREST)
    assert fix.height_m == pytest.approx(100 * 0.3048 + 40.0)
    assert (fix.sd_ned_m, fix.stamp) == (None, UtcStamp(report.utc_ns))
    assert isinstance(heading, Heading)
    assert heading.yaw_rad == pytest.approx(315.0 * DEG)
    assert heading.sd_rad == pytest.approx(0.5 * DEG)
    assert heading.rounding_sd_rad == pytest.approx(0.01 * DEG * NEAREST)
    found = fed(d, box_frames(20, yaw_ok=0, month=13), 2 * SECOND, extended=True)
    assert [type(m) for m in found] == [PositionFix]
    assert d.counters["bad_date"] == 1
    assert replace(the_fix(found), lat_rad=0.0).stamp == ArrivalStamp(0.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"course": None}, "speed and course: both or neither"),
        ({"velocity": ("a", "b", "c")}, "velocity, or speed and course: not both"),
        ({"speed": None, "course": None, "velocity": ("a", "", "c")}, "north and east must be"),
        ({"quality": "gnss_status.FixType"}, "quality and qualities: both or neither"),
        ({"height": None}, "height_valid: what it belongs to is not mapped"),
        ({"utc": None}, "utc_valid: what it belongs to is not mapped"),
        ({"heading_accuracy": "gnss_attitude.HeadingAccuracy"}, "heading_accuracy: what it"),
        ({"lattitude": "gnss_pos.Latitude"}, "Extra inputs are not permitted"),
    ],
)
def test_options_that_do_not_go_together(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        CanGnssOptions.model_validate({**SHIPPED, **change})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"lat": "gnss_pos.Lat"},
            "lat: 'Lat' is no signal of gnss_pos of the DBC file; did you mean Latitude",
        ),
        ({"lat": "gnss_speed.Speed"}, "lat: the unit of Speed is 'm/s'"),
        ({"height": "gnss_pos.Latitude"}, "height: the unit of Latitude is 'deg'"),
        ({"satellites": "gnss_speed.Speed"}, "satellites: Speed must be an integer"),
        ({"position_valid": "gnss_pos.Valid"}, "position_valid: 'Valid' is no signal"),
        ({"dbc": "css_canmod"}, "dbc: there is no file 'css_canmod'"),
    ],
)
def test_mappings_that_do_not_fit(change: dict[str, Any], words: str) -> None:
    with pytest.raises(PermanentDriverError, match=words):
        module(**change)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    frames=st.lists(
        st.tuples(st.sampled_from((1, 2, 3, 4, 5, 7, 8)), st.binary(max_size=9)), max_size=40
    )
)
def test_garbage_never_raises_and_fixes_are_finite(frames: list[tuple[int, bytes]]) -> None:
    d = module()
    settled(d)
    for k, frame in enumerate(frames):
        for m in fed(d, [frame], 10 * SECOND + k * 1_000_000):
            if isinstance(m, PositionFix):
                assert abs(m.lat_rad) <= 0.5001 * math.pi
                assert abs(m.lon_rad) <= 1.0001 * math.pi
                assert all(map(math.isfinite, m.sd_ned_m or ()))


async def test_on_a_bus_that_goes_silent() -> None:
    names = ("dbc", "lat", "lon", "position_valid", "horizontal_accuracy")
    alone = {k: SHIPPED[k] for k in names}  # of one message: a busy host pairs nothing wrongly
    gnss = Served(CanGnssDriver, "gnss", {**alone, "timeout_s": 0.3})
    async with gnss.run() as bus:
        sent(bus, burst())
        await until(lambda: len(gnss.measurements) == 1)
        (fix,) = gnss.measurements
        assert isinstance(fix, PositionFix)
        assert fix.sd_ned_m == (3.0, 3.0, 6.0)
        assert gnss.driver.counters["other_frames"] == 5
        gnss.now_ns += SECOND
        await until(lambda: "0x3 gnss_pos" in gnss.driver.status.detail)
