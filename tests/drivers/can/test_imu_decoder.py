"""CAN frames to IMU samples without a bus: axes, units, filters, refusals, bad mappings."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import PermanentDriverError
from drivers.can.bus import CanFrame
from drivers.can.dbc import STANDARD_GRAVITY_M_S2, parameter_group
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import ArrivalStamp, DeviceStamp, ImuSample
from tests.drivers.can.imu_frames import (
    ACEINNA,
    IMU04,
    MM7,
    MS,
    SBG,
    SBG_UNTIMED,
    T0,
    Line,
    sbg_time,
)


def test_axes_signs_and_units() -> None:
    line = Line(SBG)
    line.burst(T0, sbg_time(7000), (0x121, bytes.fromhex("0C00DEFFD503")))
    line.frame(T0 + MS, 0x122, bytes.fromhex("0A00ECFF5E01"))
    (sample,) = line.samples
    assert sample.gyro_rad_s == pytest.approx((0.01, -0.02, -0.35))
    assert sample.accel_m_s2 == pytest.approx((0.12, 0.34, 9.81))
    assert sample.stamp == DeviceStamp("imu", 7_000_000)
    assert sample.t_seen_ns == T0 + MS
    bosch = Line(MM7)
    for frame in ("A08F0000577800 00", "A87D0000118300 00"):
        bosch.frame(T0, 0x174 if frame.startswith("A0") else 0x178, bytes.fromhex(frame))
    bosch.frame(T0, 0x17C, struct.pack("<HHHBB", 0x8000, 0, 0x8000, 0, 0))
    (sample,) = bosch.samples
    assert sample.gyro_rad_s == pytest.approx(
        (math.radians(3.0), 0.0, math.radians(20.0)), abs=1e-9
    )
    assert sample.accel_m_s2 == pytest.approx(
        (0.10003 * STANDARD_GRAVITY_M_S2, -0.24999 * STANDARD_GRAVITY_M_S2, 0.0), abs=3e-4
    )


def test_constant_axes_of_a_partial_imu() -> None:
    options = CanImuOptions(
        dbc="bosch_mm5_10",
        gyro=("TX2.ROLL_RATE", 0.0, "TX1.YAW_RATE"),
        accel=("TX2.AX", "TX1.AY", "-9.80665"),
        timestamp="arrival",
        latency_s=0.004,
    )
    line = Line(options)
    for k in range(20):
        raw = 0x8000 + k
        data = struct.pack("<HHHH", raw, 0, raw, 0)
        line.burst(T0 + k * 10 * MS, (0x174, data), (0x178, data))
    assert len(line.samples) >= 14
    assert line.samples[-1].gyro_rad_s[1] == 0.0
    assert line.samples[-1].accel_m_s2[2] == -9.80665
    assert line.samples[-1].stamp == ArrivalStamp(0.004)


def test_refusals_are_named() -> None:
    line = Line(IMU04)
    nan, inf = struct.pack(">2f", math.nan, 1.0), struct.pack(">2f", 1.0, math.inf)
    line.frame(T0, 0x600, nan)
    line.frame(T0, 0x600, inf)
    line.frame(T0, 0x600, struct.pack(">2f", 0.0, 3e38))
    line.frame(T0, 0x600, b"\x00" * 7)
    line.frame(T0, 0x7FF, b"\x00" * 8)
    line.frame(T0, 0x600, b"\x00" * 8, extended=True)
    assert line.counters["not_finite"] == 2
    assert line.counters["out_of_range"] == 1
    assert line.counters["wrong_length"] == 1
    assert line.counters["other_frames"] == 2
    line = Line(ACEINNA)
    not_available = struct.pack("<3H2x", 0xFFFF, 0x7D00, 0x7D00)
    line.frame(T0, 0x0CF02A80, not_available, extended=True)
    assert line.counters["out_of_range"] == 1


def test_j1939_matches_the_group_whatever_priority_and_one_source() -> None:
    ari, accs = bytes.fromhex("807D007C00870000"), bytes.fromhex("0C7DDE7CD5800000")
    for options, expected in (
        (ACEINNA, 0x42),
        (ACEINNA.model_copy(update={"source_address": 0x80}), 0x80),
    ):
        line = Line(options)
        for k in range(20):
            at_ns = T0 + 10 * MS * k
            for address in (0x42, 0x80):
                line.frame(
                    at_ns,
                    0x18F02A00 | address,
                    ari[:1] + bytes([125, address, 124]) + ari[4:],
                    True,
                )
                line.frame(at_ns + MS, 0x0CF02D00 | address, accs, True)
        assert len(line.samples) >= 14
        assert line.counters["other_source"] == 40
        rate_y = math.radians(((124 << 8 | expected) / 128.0) - 250.0)
        assert [s.gyro_rad_s[1] for s in line.samples] == pytest.approx(
            [rate_y] * len(line.samples)
        )
    assert parameter_group(0x18EA80FE) == 0xEA00


def test_filters_let_only_the_mapped_through() -> None:
    def passes(options: CanImuOptions, can_id: int, extended: bool) -> bool:
        return any(
            f["extended"] == extended and can_id & f["can_mask"] == f["can_id"] & f["can_mask"]
            for f in CanImuDecoder("imu", options).filters
        )

    assert passes(SBG, 0x120, False)
    assert not passes(SBG, 0x123, False)
    assert not passes(SBG, 0x120, True)
    assert passes(ACEINNA, 0x18F02A11, True)
    assert not passes(ACEINNA, 0x18F02911, True)
    addressed = ACEINNA.model_copy(update={"source_address": 0x80})
    assert passes(addressed, 0x18F02D80, True)
    assert not passes(addressed, 0x18F02D81, True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dbc": "no_such"}, ["no_such", "sbg_ellipse"]),
        ({"gyro": ("IMU_GYR.GYRO_X", "0", "0")}, ["IMU_GYR.GYRO_X", "IMU_GYRO.GYRO_X"]),
        ({"gyro": ("IMU_GYRO.GYROX", "0", "0")}, ["did you mean GYRO_X", "GYRO_Z"]),
        ({"accel": ("0", "0", "0")}, ["accel", "at least one"]),
        ({"accel": ("IMU_INFO.TEMPERATURE", "0", "0")}, ["degC", "m/s^2"]),
        ({"gyro_unit": "furlong"}, ["furlong", "rad/s"]),
        ({"device_time": "IMU_INFO.TEMPERATURE"}, ["unsigned"]),
        ({"device_time": "IMU_INFO.IMU_STATUS"}, ["device_time", "us"]),
    ],
)
def test_mistakes_in_the_mapping_are_explained(change: dict[str, object], words: list[str]) -> None:
    options = CanImuOptions.model_validate({**SBG.model_dump(), **change})
    with pytest.raises(PermanentDriverError) as mistake:
        CanImuDecoder("imu", options)
    for word in words:
        assert word in str(mistake.value)


def test_unit_override_and_foreign_spelling(tmp_path: Path) -> None:
    text = (
        'VERSION ""\nBU_: A\nBO_ 1 M: 4 A\n SG_ W : 0|16@1- (1,0) [0|0] "°/s" A\n'
        ' SG_ F : 16|16@1- (1,0) [0|0] "cm" A\n'
    )
    path = tmp_path / "own.dbc"
    path.write_text(text, encoding="utf-8")
    options = CanImuOptions(
        dbc=str(path), gyro=("M.W", 0.0, 0.0), accel=("M.F", 0.0, 0.0), accel_unit="mg"
    )
    line = Line(options)
    line.frame(T0, 1, struct.pack("<2h", 180, 1000))
    assert line.samples[0].gyro_rad_s[0] == pytest.approx(math.pi)
    assert line.samples[0].accel_m_s2[0] == pytest.approx(9.80665)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x120, 0x121, 0x122, 0x174, 0x178, 0x17C, 0x600, 0x601, 0x602, 0x603])
            | st.integers(0, 2**29 - 1),
            st.booleans(),
            st.binary(max_size=64),
            st.integers(-(2**62), 2**62),
            st.none() | st.integers(-(2**62), 2**62),
        ),
        max_size=60,
    )
)
def test_garbage_never_raises_and_samples_are_finite(
    frames: list[tuple[int, bool, bytes, int, int | None]],
) -> None:
    for options in (SBG, SBG_UNTIMED, MM7, IMU04, ACEINNA):
        decoder = CanImuDecoder("imu", options)
        for can_id, extended, data, t_seen_ns, realtime_ns in frames:
            frame = CanFrame(can_id, extended, data, t_seen_ns, realtime_ns)
            for sample in decoder.feed(frame):
                assert isinstance(sample, ImuSample)
                assert all(map(math.isfinite, sample.gyro_rad_s + sample.accel_m_s2))
