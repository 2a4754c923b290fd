"""Wheel speeds by any DBC: frames packed by hand, and the driver on a real bus."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.base import PermanentDriverError
from drivers.can.wheel import CanWheelDecoder, CanWheelDriver, CanWheelOptions
from drivers.measurements import ArrivalStamp, WheelSpeed
from tests.drivers.can.served import SECOND, Served, fed, sent
from tests.patience import until

KM_H = 1.0 / 3.6
STEP = 0.01 * KM_H
NEAREST = 1.0 / math.sqrt(12.0)
# Wheels as many cars have them: 0.01 km/h a step from -67.67 km/h on, front and rear in a message;
# gear, steering wheel and the speed of the hubs in others.
DBC = """VERSION ""
NS_ :
BS_:
BU_: CAR HOST
BO_ 170 FRONT: 4 CAR
 SG_ FL : 7|16@0+ (0.01,-67.67) [0|250] "km/h" HOST
 SG_ FR : 23|16@0+ (0.01,-67.67) [0|250] "km/h" HOST
BO_ 171 REAR: 4 CAR
 SG_ RL : 7|16@0+ (0.01,-67.67) [0|250] "km/h" HOST
 SG_ RR : 23|16@0+ (0.01,-67.67) [0|250] "km/h" HOST
BO_ 172 GEAR: 2 CAR
 SG_ SELECTED : 0|4@1+ (1,0) [0|15] "" HOST
 SG_ SPEED_OK : 8|1@1+ (1,0) [0|1] "" HOST
BO_ 173 STEERING: 2 CAR
 SG_ ANGLE : 0|16@1- (0.1,0) [0|0] "deg" HOST
BO_ 174 HUBS: 8 CAR
 SG_ RPM_L : 0|16@1- (0.125,0) [0|0] "rpm" HOST
 SG_ RPM_R : 16|16@1- (0.125,0) [0|0] "rpm" HOST
 SG_ SIGMA : 32|8@1+ (0.01,0) [0|0] "m/s" HOST
 SG_ ODD : 40|8@1+ (1,0) [0|0] "furlong" HOST
"""


@pytest.fixture
def dbc(tmp_path: Path) -> str:
    path = tmp_path / "car.dbc"
    path.write_text(DBC)
    return str(path)


def decoder(dbc: str, **options: Any) -> CanWheelDecoder:
    return CanWheelDecoder("wheel", CanWheelOptions(dbc=dbc, **options))


def axle(can_id: int, left_km_h: float, right_km_h: float) -> tuple[int, bytes]:
    counts = (round((v + 67.67) * 100) for v in (left_km_h, right_km_h))
    return can_id, struct.pack(">HH", *counts)


def gear(selected: int, fine: int = 1) -> tuple[int, bytes]:
    return 172, bytes([selected, fine])


def steering(degrees: float) -> tuple[int, bytes]:
    return 173, struct.pack("<h", round(degrees * 10))


REAR = ("REAR.RL", "REAR.RR")
FRONT = ("FRONT.FL", "FRONT.FR")


def test_the_mean_of_an_axle(dbc: str) -> None:
    rear = decoder(dbc, wheels=REAR, latency_s=0.02)
    (m,) = fed(rear, [axle(171, 50.0, 50.5)], 7)
    assert isinstance(m, WheelSpeed)
    assert (m.source, m.t_seen_ns, m.stamp) == ("wheel", 7, ArrivalStamp(0.02))
    assert m.speed_m_s == pytest.approx(50.25 * KM_H)
    assert (m.sd_m_s, m.signed) == (None, False)
    assert m.rounding_sd_m_s == pytest.approx(STEP * NEAREST)


def test_zero_says_only_that_the_speed_is_below_a_step(dbc: str) -> None:
    (m,) = fed(decoder(dbc, wheels=REAR), [axle(171, 0.0, 0.0)])
    assert isinstance(m, WheelSpeed)
    assert (m.speed_m_s, m.signed) == (0.0, True)
    assert m.rounding_sd_m_s == pytest.approx(STEP / math.sqrt(3.0))


def test_the_direction_comes_of_its_own_message_and_holds_a_second(dbc: str) -> None:
    d = decoder(dbc, wheels=REAR, direction="GEAR.SELECTED", forward=(4,), backward=(2,))

    def signed(t_ns: int) -> tuple[float, bool]:
        (m,) = fed(d, [axle(171, 7.2, 7.2)], t_ns)
        assert isinstance(m, WheelSpeed)
        return round(m.speed_m_s, 9), m.signed

    assert signed(0) == (2.0, False)  # not heard of the gear yet
    fed(d, [gear(2)], SECOND)
    assert signed(SECOND) == (-2.0, True)
    assert signed(2 * SECOND) == (-2.0, True)
    assert signed(2 * SECOND + 1) == (2.0, False)  # too old
    fed(d, [gear(4)], 3 * SECOND)
    assert signed(3 * SECOND) == (2.0, True)
    fed(d, [gear(3)], 4 * SECOND)  # neutral
    assert signed(4 * SECOND) == (2.0, False)
    fed(d, [gear(4)], 5 * SECOND)
    d.reset()
    assert signed(5 * SECOND) == (2.0, False)


def test_steered_wheels_count_by_the_cosine_of_their_angle(dbc: str) -> None:
    options = {"steered": FRONT, "steering": "STEERING.ANGLE", "steering_ratio": 15.0}
    d = decoder(dbc, **options)
    assert fed(d, [axle(170, 36.0, 36.0)]) == []
    assert d.counters["no_steering"] == 1
    (m,) = fed(d, [steering(-450.0), axle(170, 36.0, 36.0)])
    assert isinstance(m, WheelSpeed)
    assert m.speed_m_s == pytest.approx(10.0 * math.cos(math.radians(30.0)))


def test_four_wheels_of_two_messages(dbc: str) -> None:
    d = decoder(dbc, wheels=REAR, steered=FRONT, steering="STEERING.ANGLE")
    fed(d, [steering(0.0)])
    found = []
    for k in range(20):
        t_ns = 20_000_000 * k
        found += fed(d, [axle(170, 36.0, 36.0)], t_ns)
        found += fed(d, [axle(171, 32.4, 32.4)], t_ns + 1_000_000)
    assert len(found) >= 14  # the first are needed to learn the interval
    assert {round(m.speed_m_s, 6) for m in found if isinstance(m, WheelSpeed)} == {9.5}


def test_hubs_count_turns_with_a_sign_and_state_a_sigma(dbc: str) -> None:
    d = decoder(
        dbc, wheels=("HUBS.RPM_L", "HUBS.RPM_R"), signed=True, radius_m=0.3, accuracy="HUBS.SIGMA"
    )
    data = struct.pack("<hhBB2x", -800, -800, 5, 0)
    (m,) = fed(d, [(174, data)])
    assert isinstance(m, WheelSpeed)
    assert m.speed_m_s == pytest.approx(-100.0 * 2.0 * math.pi / 60.0 * 0.3)
    assert (m.sd_m_s, m.signed) == (pytest.approx(0.05), True)


def test_a_flag_in_a_message_of_its_own_must_have_been_seen(dbc: str) -> None:
    d = decoder(dbc, wheels=REAR, valid="GEAR.SPEED_OK")
    assert fed(d, [axle(171, 5.0, 5.0)]) == []
    assert len(fed(d, [gear(0, fine=1), axle(171, 5.1, 5.1)])) == 1
    assert fed(d, [gear(0, fine=0), axle(171, 5.2, 5.2)]) == []
    assert d.counters["not_valid"] == 2


def test_what_a_wheel_cannot_say_is_refused(dbc: str) -> None:
    d = decoder(dbc, wheels=REAR)
    assert fed(d, [axle(171, -30.0, 10.0), axle(171, 300.0, 10.0), (171, b"\x00\x01")]) == []
    assert d.counters["out_of_range"] == 2
    assert d.counters["wrong_length"] == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "wheels and steered name 0 signals: one to four are needed"),
        ({"wheels": REAR * 3}, "name 6 signals"),
        ({"steered": FRONT}, "steered and steering: both or neither"),
        ({"wheels": REAR, "steering": "STEERING.ANGLE"}, "steered and steering: both or neither"),
        ({"wheels": REAR, "signed": True, "direction": "GEAR.SELECTED"}, "one of the two"),
        (
            {"wheels": REAR, "direction": "GEAR.SELECTED", "forward": (1, 2)},
            "forward and backward both list 2",
        ),
        ({"wheels": REAR, "timestamp": "device"}, "needs device_time"),
    ],
)
def test_options_that_do_not_go_together(dbc: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        CanWheelOptions(dbc=dbc, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"wheels": ("REAR.RX",)},
            "wheels: 'RX' is no signal of REAR of the DBC file; did you mean RR or RL",
        ),
        ({"wheels": ("HUBS.ODD",)}, "wheels: the unit of ODD is 'furlong'; known are m/s"),
        ({"wheels": ("HUBS.RPM_L",)}, "wheels: the unit of RPM_L is 'rpm'; known are m/s"),
        ({"wheels": ("REAR.RL",), "radius_m": 0.3}, "the unit of RL is 'km/h'; known are rad/s"),
        ({"wheels": REAR, "direction": "STEERING.ANGLE"}, "direction: ANGLE must be an integer"),
    ],
)
def test_mappings_that_do_not_fit(dbc: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(PermanentDriverError, match=words):
        decoder(dbc, **options)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    frames=st.lists(
        st.tuples(st.sampled_from((170, 171, 172, 173, 99)), st.binary(max_size=9)), max_size=40
    )
)
def test_garbage_never_raises_and_speeds_can_be_true(
    dbc: str, frames: list[tuple[int, bytes]]
) -> None:
    d = decoder(
        dbc,
        wheels=REAR,
        steered=FRONT,
        steering="STEERING.ANGLE",
        direction="GEAR.SELECTED",
        valid="GEAR.SPEED_OK",
    )
    for k, frame in enumerate(frames):
        for m in fed(d, [frame], 10_000_000 * k):
            assert isinstance(m, WheelSpeed)
            assert abs(m.speed_m_s) <= 250.1 * KM_H
            assert m.rounding_sd_m_s >= STEP * NEAREST * 0.999


async def test_on_a_bus_that_falls_silent_and_fails(dbc: str) -> None:
    options = {"dbc": dbc, "wheels": REAR, "direction": "GEAR.SELECTED", "forward": (4,)}
    wheel = Served(CanWheelDriver, "wheel", {**options, "timeout_s": 0.2})
    async with wheel.run() as bus:
        sent(bus, [gear(4), axle(171, 36.0, 36.0)])
        await until(lambda: len(wheel.measurements) == 1)
        (m,) = wheel.measurements
        assert isinstance(m, WheelSpeed)
        assert (m.speed_m_s, m.signed) == (pytest.approx(10.0), True)
        assert wheel.driver.status.state == "running"
        wheel.now_ns += SECOND
        await until(lambda: "0xAB REAR" in wheel.driver.status.detail)
        assert wheel.driver.status.state == "silent"
        bus.send(can.Message(arbitration_id=0x040, data=bytes(8), is_error_frame=True))
        await until(lambda: wheel.codes == ["bus_off"])
        assert wheel.driver.counters["error_bus_off"] == 1
