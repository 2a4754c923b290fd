"""Attitude and bearings off a CAN bus: frames packed by hand, and the drivers on a shared bus."""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections import Counter

import can
import pytest

from drivers.base import PermanentDriverError
from drivers.can.attitude_bearing import (
    CanAttitudeDecoder,
    CanAttitudeDriver,
    CanAttitudeOptions,
    CanBearingDecoder,
    CanBearingDriver,
    CanBearingOptions,
)
from drivers.can.bus import CanFrame
from drivers.can.imu import CanImuDriver, CanImuOptions
from drivers.measurements import (
    ArrivalStamp,
    Attitude,
    Bearing,
    DeviceEvent,
    KernelStamp,
    Measurement,
)
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.can.star_tracker_radar import SIM_SAR, SIM_STAR
from tests.patience import until

SECOND = 1_000_000_000

DEG, ARCSEC = math.pi / 180.0, math.pi / 648e3
STEP = 0.00035 * DEG


def packed(*fields: tuple[int, int]) -> bytes:
    """Little-endian fields (value, bits) from bit 0 up, as Intel signals lie."""
    number = shift = 0
    for value, bits in fields:
        number |= (value & ((1 << bits) - 1)) << shift
        shift += bits
    return number.to_bytes((shift + 7) // 8, "little")


def star_frames(number: int, valid: int = 1) -> list[tuple[int, bytes]]:
    """Roll 1000 steps, pitch -2000, yaw -500000; sigma 200.0, 180.5 and 60 arcsec."""
    angles = packed((1000, 20), (-2000, 20), (-500_000, 20), (number % 16, 4))
    sigma = packed((2000, 16), (1805, 16), (600, 16), (number % 16, 4), (valid, 4))
    return [(273, angles), (274, sigma)]


def sar_frames(number: int, target: int = 4711, valid: int = 1) -> list[tuple[int, bytes]]:
    bearing = packed((250_000, 20), (-30_000, 20), (target, 16), (number % 16, 8))
    return [(281, bearing), (282, struct.pack("<HHB", 1000, 900, number % 16 | valid << 4))]


def fed(
    decoder: CanAttitudeDecoder | CanBearingDecoder, frames: list[tuple[int, bytes]], t_ns: int = 0
) -> list[Measurement]:
    fed = (decoder.feed(CanFrame(can_id, False, data, t_ns)) for can_id, data in frames)
    return [m for found in fed for m in found]


def test_an_attitude_out_of_two_frames() -> None:
    decoder = CanAttitudeDecoder("star_tracker", SIM_STAR)
    (m,) = fed(decoder, star_frames(3), 5)
    assert isinstance(m, Attitude)
    assert (m.source, m.t_seen_ns, m.stamp) == ("star_tracker", 5, ArrivalStamp(SIM_STAR.latency_s))
    assert m.rpy_rad == pytest.approx((1000 * STEP, -2000 * STEP, -500_000 * STEP))
    assert m.sd_rpy_rad == pytest.approx((200.0 * ARCSEC, 180.5 * ARCSEC, 60.0 * ARCSEC))
    assert fed(decoder, star_frames(4, valid=0)) == []
    # Of two samples that interleave, each frame goes to the other of its own counter.
    mixed = [star_frames(5)[0], star_frames(6)[1], star_frames(5)[1]]
    assert len(fed(decoder, mixed)) == 1
    assert decoder.counters["not_valid"] == 1


def test_a_bearing_names_its_target() -> None:
    decoder = CanBearingDecoder("sar", SIM_SAR)
    (m,) = fed(decoder, sar_frames(1))
    assert isinstance(m, Bearing)
    assert (m.target, m.point) == ("4711", None)
    assert m.azimuth_rad == pytest.approx(250_000 * STEP)
    assert m.elevation_rad == pytest.approx(-30_000 * STEP)
    assert m.sd_rad == pytest.approx((100.0 * ARCSEC, 90.0 * ARCSEC))
    assert fed(decoder, sar_frames(2, valid=0)) == []
    beyond = packed((520_000, 20), (0, 20), (1, 16), (3, 8))  # 182 deg, above the DBC's maximum
    assert fed(decoder, [(281, beyond), sar_frames(3)[1]]) == []
    assert decoder.counters == Counter(samples=2, not_valid=1, out_of_range=1)


def test_what_a_device_does_not_say() -> None:
    yaw_only = SIM_STAR.model_copy(
        update={"rpy": ("", "", "STAR_ATTITUDE.YAW"), "sd_rpy": ("",) * 3, "valid": None}
        | {"counter": "STAR_ATTITUDE.ATTITUDE_COUNTER"}
    )
    (m,) = fed(CanAttitudeDecoder("star_tracker", yaw_only), star_frames(0)[:1])
    assert isinstance(m, Attitude)
    assert m.rpy_rad[2] == pytest.approx(-500_000 * STEP)
    assert all(map(math.isnan, (*m.rpy_rad[:2], *m.sd_rpy_rad)))
    plain = SIM_SAR.model_copy(
        update={"sd_azimuth": None, "sd_elevation": None, "valid": None}
        | {"counter": "SAR_BEARING.BEARING_COUNTER"}
    )
    (b,) = fed(CanBearingDecoder("sar", plain), sar_frames(0)[:1])
    assert isinstance(b, Bearing)
    assert b.sd_rad is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"azimuth": "SAR_BEARING.AZIMUT"}, "azimuth: 'AZIMUT' is no signal of SAR_BEARING"),
        ({"azimuth": "SAR_BEARING.TARGET"}, "azimuth: the unit of TARGET is ''"),
        ({"target": "SAR_BEARING.AZIMUTH"}, "target: AZIMUTH must be an integer, one a step"),
        ({"sd_azimuth": None}, "sd_azimuth and sd_elevation: both or neither"),
    ],
)
def test_mappings_that_do_not_fit(change: dict[str, object], words: str) -> None:
    with pytest.raises(PermanentDriverError, match=words):
        CanBearingDecoder("sar", SIM_SAR.model_copy(update=change))


def test_an_attitude_needs_an_angle() -> None:
    none = SIM_STAR.model_copy(update={"rpy": ("", "", "")})
    with pytest.raises(PermanentDriverError, match="at least one angle"):
        CanAttitudeDecoder("star_tracker", none)


async def test_three_drivers_on_one_channel() -> None:
    """IMU, star tracker and radar share a bus; each takes its own frames and stamps."""
    channel = {"interface": "virtual", "channel": "t-shared"}
    emitted: list[Measurement | DeviceEvent] = []
    star_ns = SECOND  # clocks stand still: nobody falls silent because the host is busy
    imu = CanImuDriver(
        "imu", CanImuOptions(**{**SIM_IMU.model_dump(), **channel}), emitted.append, lambda: SECOND
    )
    star = CanAttitudeDriver(
        "star_tracker",
        CanAttitudeOptions(**{**SIM_STAR.model_dump(), **channel, "timeout_s": 0.3}),
        emitted.append,
        lambda: star_ns,
    )
    sar = CanBearingDriver(
        "sar",
        CanBearingOptions(**{**SIM_SAR.model_dump(), **channel}),
        emitted.append,
        lambda: SECOND,
    )
    drivers = (imu, star, sar)
    tasks = [asyncio.create_task(d.run()) for d in drivers]
    try:
        await until(lambda: all(d.status.state != "starting" for d in drivers))
        with can.Bus(interface="virtual", channel="t-shared", ignore_config=True) as bus:
            for k in range(8):
                for m in CanImu().frames(k, k * 10_000_000, (0.0,) * 3, (0.0, 0.0, -9.8)):
                    bus.send(m)
                for can_id, data in (*star_frames(k), *sar_frames(k)):
                    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            await until(lambda: len(emitted) == 24)
            assert [d.status.state for d in drivers] == ["running"] * 3
            star_ns += SECOND
            await until(lambda: star.status.state == "silent")
            await until(lambda: "0x111 STAR_ATTITUDE" in star.status.detail)
        assert [d.status.state for d in drivers] == ["running", "silent", "running"]
    finally:
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    kinds = Counter(type(m).__name__ for m in emitted)
    assert kinds == {"ImuSample": 8, "Attitude": 8, "Bearing": 8}
    stamps = [m.stamp for m in emitted if isinstance(m, Attitude)]
    assert all(isinstance(s, KernelStamp) for s in stamps)
