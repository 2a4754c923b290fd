"""Faults put in on purpose: what comes of a measurement, and for how long."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from drivers.base import Emitted
from drivers.measurements import (
    ArrivalStamp,
    Attitude,
    DeviceEvent,
    Heading,
    Height,
    ImuSample,
    PositionFix,
    TimeReport,
    WheelSpeed,
)
from fusiond.live.injection import SECOND_NS, Injection
from fusiond.outputs.commands import BadCommandError, Inject, parse

T_NS = 100 * SECOND_NS
STAMP = ArrivalStamp()
FIX = PositionFix("gnss", T_NS, STAMP, 0.5, 2.0, 20.0, v_ned_m_s=(1.0, 2.0, 0.0))
IMU = ImuSample("imu", T_NS, STAMP, (0.1, 0.2, 0.3), (0.0, 0.0, -9.8))


class Bench:
    def __init__(self, source: str = "gnss", duration_s: float = 10.0, **fault: Any) -> None:
        self.told: list[tuple[str, str]] = []
        self.injection = Injection(lambda source, code, text: self.told.append((source, code)))
        command = Inject(id="1", source=source, duration_s=duration_s, **fault)
        self.injection.inject(command, T_NS)

    def after(self, item: Any, seconds: float = 0.0) -> list[Emitted]:
        """What is left of an item that comes so long after the start."""
        t_ns = T_NS + round(seconds * SECOND_NS)
        return list(self.injection.pass_on(replace(item, t_seen_ns=t_ns)))


def north_m(item: Any) -> float:
    return float((item.lat_rad - FIX.lat_rad) * 6.36e6)


def test_a_jump_moves_a_fix_where_it_is_told() -> None:
    (north,) = Bench(fault="jump", size=100.0).after(FIX)
    (east,) = Bench(fault="jump", size=100.0, direction_deg=90.0).after(FIX)
    assert isinstance(north, PositionFix)
    assert isinstance(east, PositionFix)
    assert north_m(north) == pytest.approx(100.0, rel=0.01)
    assert north.lon_rad == FIX.lon_rad
    assert (east.lon_rad - 2.0) * math.cos(0.5) * 6.38e6 == pytest.approx(100.0, rel=0.01)
    assert east.lat_rad == pytest.approx(FIX.lat_rad, abs=1e-12)
    assert north.v_ned_m_s == FIX.v_ned_m_s


def test_a_drift_grows_from_nothing() -> None:
    bench = Bench(fault="drift", size=2.0)
    errors = [north_m(bench.after(FIX, s)[0]) for s in (0.0, 1.0, 5.0)]
    assert errors == pytest.approx([0.0, 2.0, 10.0], rel=0.01)


def test_noise_has_its_sigma_and_is_the_same_again() -> None:
    def errors() -> list[float]:
        bench = Bench(fault="noise", size=5.0)
        return [north_m(bench.after(FIX, k * 0.01)[0]) for k in range(400)]

    first = errors()
    assert errors() == first
    rms = math.sqrt(sum(e * e for e in first) / len(first))
    assert rms == pytest.approx(5.0, rel=0.2)  # 5 sigma of a chi-square of 400


def test_dropped_and_delayed_sources_take_their_time_reports_along() -> None:
    report = TimeReport("gnss", T_NS, 5, True)
    bench = Bench(fault="drop")
    assert bench.after(FIX) == bench.after(report) == []
    other = replace(FIX, source="roof")
    assert bench.after(other) == [other]
    bench = Bench(fault="delay", size=1.5)
    assert bench.after(FIX) == bench.after(report, 0.1) == []
    assert list(bench.injection.tick(T_NS + SECOND_NS)) == []
    late_ns = T_NS + 2 * SECOND_NS
    assert list(bench.injection.tick(late_ns)) == [
        replace(FIX, t_seen_ns=late_ns),
        replace(report, t_seen_ns=late_ns),
    ]


def test_what_is_frozen_says_the_same_with_new_stamps() -> None:
    bench = Bench(fault="freeze")
    bench.after(FIX)
    moved = replace(FIX, lat_rad=0.6, height_m=50.0, v_ned_m_s=(9.0, 9.0, 9.0), satellites=4)
    (frozen,) = bench.after(moved, 3.0)
    assert frozen == replace(FIX, t_seen_ns=T_NS + 3 * SECOND_NS, satellites=4)


def test_of_an_imu_one_axis_is_falsified() -> None:
    (gyro,) = Bench("imu", fault="jump", size=10.0, axis="x").after(IMU)
    (accel,) = Bench("imu", fault="jump", size=-1.0, part="accel", axis="z").after(IMU)
    assert isinstance(gyro, ImuSample)
    assert isinstance(accel, ImuSample)
    assert gyro.gyro_rad_s == pytest.approx((0.1 + math.radians(10.0), 0.2, 0.3))
    assert gyro.accel_m_s2 == IMU.accel_m_s2
    assert accel.accel_m_s2 == pytest.approx((0.0, 0.0, -10.8))


@pytest.mark.parametrize(
    ("item", "field", "error"),
    [
        (Height("gnss", T_NS, STAMP, 5.0), "height_m", 2.0),
        (WheelSpeed("gnss", T_NS, STAMP, 5.0), "speed_m_s", 2.0),
        (Heading("gnss", T_NS, STAMP, 1.0), "yaw_rad", math.radians(2.0)),
    ],
)
def test_other_kinds_are_off_in_their_own_unit(item: Any, field: str, error: float) -> None:
    (off,) = Bench(fault="jump", size=2.0).after(item)
    assert getattr(off, field) - getattr(item, field) == pytest.approx(error)


def test_an_attitude_is_off_in_heading() -> None:
    attitude = Attitude("gnss", T_NS, STAMP, (0.1, 0.2, 0.3), (0.01, 0.01, 0.01))
    (off,) = Bench(fault="jump", size=2.0).after(attitude)
    assert isinstance(off, Attitude)
    assert off.rpy_rad == pytest.approx((0.1, 0.2, 0.3 + math.radians(2.0)))


def test_it_ends_by_itself_and_says_so() -> None:
    bench = Bench(fault="delay", size=2.0, duration_s=1.0)
    assert bench.injection.active == ("gnss: delay 2 for 1 s",)
    bench.after(FIX, 0.9)
    assert list(bench.injection.tick(T_NS + SECOND_NS)) == []
    assert bench.told == [("gnss", "injected"), ("gnss", "injection_ended")]
    assert bench.injection.active == ()
    assert len(bench.after(FIX, 1.1)) == 1  # what comes now comes at once
    assert len(list(bench.injection.tick(T_NS + 3 * SECOND_NS))) == 1  # and what was held, late
    assert not bench.injection.faults


def test_events_of_a_source_are_never_held_back() -> None:
    event = DeviceEvent("gnss", T_NS, "device_absent", "unplugged")
    assert Bench(fault="drop").after(event) == [event]


@pytest.mark.parametrize("payload", [b'{"fault": "jump"}', b'{"fault": "delay", "size": -1.0}'])
def test_a_fault_without_a_size_that_makes_sense_is_refused(payload: bytes) -> None:
    head = b'{"id": "1", "source": "gnss", "duration_s": 1.0, '
    with pytest.raises(BadCommandError, match="size"):
        parse("inject", head + payload[1:])
