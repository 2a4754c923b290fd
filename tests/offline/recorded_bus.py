"""A bus with an inertial unit and a receiver that tells UTC, as messages and as text of a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import can
import numpy as np

from tests.drivers.can.css_module import GOOD, MODULE
from tests.places import REPOSITORY

CONFIG = REPOSITORY / "config" / "css_164.toml"
BEGIN_S = 1_760_000_000.0
RATE_HZ = 100
FIX = GOOD | {
    "gnss_time": {**GOOD["gnss_time"], "Epoch": 0.0},
    "gnss_speed": {"SpeedValid": 1, "Speed": 12.0, "SpeedAccuracy": 0.2},
}
NORTH_DEG_S = 12.0 * math.cos(math.radians(227.9)) / 111_350.0
EAST_DEG_S = 12.0 * math.sin(math.radians(227.9)) / 62_370.0
"""A degree north of 56 deg, and one east."""
IMU = {
    "ImuValid": 1,
    "AccelerationX": 9.75,
    **dict.fromkeys(("AccelerationY", "AccelerationZ"), 0.0),
    **dict.fromkeys(("AngularRateX", "AngularRateY", "AngularRateZ"), 0.0),
}


def bus(seconds: int, utc: bool = True) -> Iterator[can.Message]:
    """Samples at 100 Hz; each second a fix, 130 ms after its epoch and some jitter, of a vehicle
    that goes straight on at 12 m/s. Stamps are true UTC, from `BEGIN_S` on."""
    draw = np.random.default_rng(40)
    imu = MODULE.get_message_by_name("gnss_imu")
    for k in range(seconds * RATE_HZ):
        t_s = BEGIN_S + k / RATE_HZ
        data = imu.encode({**IMU, "AngularRateX": 0.25 * (k % 3)})
        yield can.Message(t_s, imu.frame_id, is_extended_id=False, data=data, channel=0)
        if k % RATE_HZ == 13:
            at_s = t_s + 0.004 * float(draw.random())
            for i, (name, values) in enumerate(FIX.items()):
                now = {"Epoch": BEGIN_S + k // RATE_HZ, "TimeConfirmed": utc}
                way = {
                    "Latitude": values.get("Latitude", 0.0) + NORTH_DEG_S * (k // RATE_HZ),
                    "Longitude": values.get("Longitude", 0.0) + EAST_DEG_S * (k // RATE_HZ),
                }
                changes = {"gnss_time": now, "gnss_pos": way}
                told = values | changes.get(name, {})
                message = MODULE.get_message_by_name(name)
                yield can.Message(
                    at_s + 1e-4 * i,
                    message.frame_id,
                    is_extended_id=False,
                    data=message.encode(told),
                    channel=0,
                )


def candump(
    messages: Iterator[can.Message], set_s: Callable[[float], float] = lambda t_s: 0.0
) -> list[str]:
    """Lines of `candump -L`, by a recorder whose clock is ahead by `set_s` of the time since the
    beginning."""
    return [
        f"({m.timestamp + set_s(m.timestamp - BEGIN_S):.6f}) can0 "
        f"{m.arbitration_id:03X}#{m.data.hex().upper()}"
        for m in messages
    ]
