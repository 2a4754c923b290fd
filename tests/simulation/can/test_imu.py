"""Frames of a simulated IMU are read by the driver's decoder."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.can.bus import CanFrame
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import DeviceStamp, ImuSample
from fusiond.simulation.can.imu import SIM_IMU, CanImu

SBG = CanImuOptions(
    dbc="sbg_ellipse",
    gyro=("IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "IMU_GYRO.GYRO_Z"),
    accel=("IMU_ACCEL.ACCEL_X", "IMU_ACCEL.ACCEL_Y", "-IMU_ACCEL.ACCEL_Z"),
    device_time="IMU_INFO.TIME_STAMP",
)
XSENS = CanImuOptions(
    dbc="xsens_mti600",
    gyro=("RATE_OF_TURN.GYRO_X", "RATE_OF_TURN.GYRO_Y", "RATE_OF_TURN.GYRO_Z"),
    accel=("ACCELERATION.ACCEL_X", "ACCELERATION.ACCEL_Y", "ACCELERATION.ACCEL_Z"),
    device_time="SAMPLE_TIME.TIME",
)


@pytest.mark.parametrize(
    ("options", "gyro_step", "accel_step", "tick_ns"),
    [
        (SIM_IMU, 1e-5, 2e-4, 1000),
        (SBG, 1e-3, 1e-2, 1000),
        (XSENS, 2**-9, 2**-8, 100_000),
    ],
)
def test_samples_come_back_through_the_can_driver(
    options: CanImuOptions, gyro_step: float, accel_step: float, tick_ns: int
) -> None:
    rng = np.random.default_rng(3)
    gyro, accel = rng.normal(0.0, 0.3, (300, 3)), rng.normal(0.0, 5.0, (300, 3))
    encoder, decoder = CanImu(options), CanImuDecoder("imu", options)
    samples: list[ImuSample] = []
    for k in range(300):
        t_ns = 5_000_000 * k + 2**32 * 1000 - 500_000_000  # the device's time wraps on the way
        for sent in encoder.frames(k, t_ns, gyro[k].tolist(), accel[k].tolist()):
            data = bytes(sent.data)
            frame = CanFrame(sent.arbitration_id, sent.is_extended_id, data, t_ns, t_ns)
            for sample in decoder.feed(frame):
                assert isinstance(sample, ImuSample)
                samples.append(sample)
    assert decoder.counters["lost_samples"] == 0
    assert len(samples) >= 295  # pairing without a counter needs a few samples to begin
    first = 300 - len(samples)
    read = np.array([s.gyro_rad_s for s in samples])
    assert np.abs(read - gyro[first:]).max() <= 0.5001 * gyro_step
    read = np.array([s.accel_m_s2 for s in samples])
    assert np.abs(read - accel[first:]).max() <= 0.5001 * accel_step
    ticks = [s.stamp.ticks_ns for s in samples if isinstance(s.stamp, DeviceStamp)]
    assert len(ticks) == len(samples)
    assert np.abs(np.diff(ticks) - 5_000_000).max() <= tick_ns


def test_values_beyond_the_range_saturate() -> None:
    gyro_frame = CanImu().frames(17, 0, (100.0, -100.0, 0.0), (0.0, 0.0, 0.0))[1]
    raw = int.from_bytes(gyro_frame.data, "little")
    assert raw & 0xFFFFF == 0x7FFFF
    assert raw >> 20 & 0xFFFFF == 0x80000
    assert raw >> 60 == 1
