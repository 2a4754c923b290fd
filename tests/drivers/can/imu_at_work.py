"""Driver of an IMU on a real python-can bus, and frames of its samples."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator

import can

from drivers.can.imu import CanImuDriver, CanImuOptions
from drivers.measurements import DeviceEvent, ImuSample, Measurement
from tests.patience import until

SECOND = 1_000_000_000
SBG = {
    "dbc": "sbg_ellipse",
    "gyro": ("IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "IMU_GYRO.GYRO_Z"),
    "accel": ("IMU_ACCEL.ACCEL_X", "IMU_ACCEL.ACCEL_Y", "IMU_ACCEL.ACCEL_Z"),
    "device_time": "IMU_INFO.TIME_STAMP",
    "timeout_s": 0.2,
}


def sample_frames(k: int) -> list[can.Message]:
    parts = (
        (0x120, struct.pack("<IHh", 5000 * k, 0, 2500)),
        (0x121, struct.pack("<3h", k % 1000, 2, 981)),
        (0x122, struct.pack("<3h", k % 1000, 20, 350)),
    )
    return [can.Message(arbitration_id=i, data=d, is_extended_id=False) for i, d in parts]


class Running:
    """A driver at work, with what it emitted. Its clock stands still but for what a test adds."""

    def __init__(self, **options: object) -> None:
        self.now_ns = 7_000 * SECOND
        self.emitted: list[Measurement | DeviceEvent] = []
        self.driver = CanImuDriver(
            "imu",
            CanImuOptions.model_validate({**SBG, **options}),
            self.emitted.append,
            lambda: self.now_ns,
        )

    def follow_the_host(self) -> None:
        """Take the host's clock for the driver's."""
        self.driver._bus._now_ns = time.monotonic_ns

    @property
    def samples(self) -> list[ImuSample]:
        return [e for e in self.emitted if isinstance(e, ImuSample)]

    @property
    def codes(self) -> list[str]:
        return [e.code for e in self.emitted if isinstance(e, DeviceEvent)]

    @contextlib.asynccontextmanager
    async def run(self) -> AsyncIterator[Running]:
        task = asyncio.create_task(self.driver.run())
        try:
            await until(lambda: self.driver.status.state != "starting")
            yield self
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
