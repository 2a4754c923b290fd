"""Frames of shipped IMUs, and a decoder that is fed with them without a bus."""

from __future__ import annotations

import struct

from drivers.can.bus import CanFrame
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import ImuSample

MS = 1_000_000
T0 = 50_000 * MS
EPOCH = 1_760_000_000_000 * MS
SBG = CanImuOptions(
    dbc="sbg_ellipse",
    gyro=("IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "-IMU_GYRO.GYRO_Z"),
    accel=("IMU_ACCEL.ACCEL_X", "-IMU_ACCEL.ACCEL_Y", "IMU_ACCEL.ACCEL_Z"),
    device_time="IMU_INFO.TIME_STAMP",
)
SBG_UNTIMED = SBG.model_copy(update={"device_time": ()})
MM7 = CanImuOptions(
    dbc="bosch_mm7_10",
    gyro=("-TX2.ROLL_RATE", "TX3.PITCH_RATE", "TX1.YAW_RATE"),
    accel=("TX2.AX", "TX1.AY", "TX3.AZ"),
    counter=("TX1.COUNTER", "TX2.COUNTER", "TX3.COUNTER"),
)
IMU04 = CanImuOptions(
    dbc="racelogic_imu04",
    gyro=("IMU_602.ROLL_RATE", "IMU_602.PITCH_RATE", "IMU_600.YAW_RATE"),
    accel=("IMU_600.ACCEL_X", "-IMU_601.ACCEL_Y", "IMU_603.ACCEL_Z"),
)
ACEINNA = CanImuOptions(
    dbc="aceinna_openimu300ri",
    gyro=("ARI.RATE_X", "ARI.RATE_Y", "ARI.RATE_Z"),
    accel=("ACCS.ACCEL_X", "ACCS.ACCEL_Y", "ACCS.ACCEL_Z"),
)


class Line:
    """Feeds a decoder with frames; frames of one sample lie 0.3 ms apart."""

    def __init__(self, options: CanImuOptions, kernel: bool = True) -> None:
        self.decoder = CanImuDecoder("imu", options)
        self.counters = self.decoder.counters
        self.samples: list[ImuSample] = []
        self.kernel = kernel
        self.offset_ns = EPOCH

    def frame(self, at_ns: int, can_id: int, data: bytes, extended: bool = False) -> None:
        stamp = at_ns + self.offset_ns if self.kernel else None
        for sample in self.decoder.feed(CanFrame(can_id, extended, data, at_ns, stamp)):
            assert isinstance(sample, ImuSample)
            self.samples.append(sample)

    def burst(self, at_ns: int, *frames: tuple[int, bytes]) -> None:
        for i, (can_id, data) in enumerate(frames):
            self.frame(at_ns + i * 300_000, can_id, data)


def sbg_time(us: int) -> tuple[int, bytes]:
    return 0x120, struct.pack("<IHh", us % 2**32, 0, 2500)


def sbg_accel(k: int) -> tuple[int, bytes]:
    return 0x121, struct.pack("<3h", k % 1000, 2, 981)


def sbg_gyro(k: int) -> tuple[int, bytes]:
    return 0x122, struct.pack("<3h", k % 1000, 20, 350)


def mm7(k: int, tx: int, value: int | None = None) -> tuple[int, bytes]:
    raw = 0x8000 + (k % 1000 if value is None else value)
    return 0x170 + 4 * tx, struct.pack("<HHHBB", raw, 0, raw, k % 16, 0)
