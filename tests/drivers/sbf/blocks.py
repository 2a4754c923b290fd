"""SBF blocks bit by bit, as the reference guide lays them out."""

from __future__ import annotations

import binascii
import math
import struct
from typing import Any

WEEK, TOW_MS = 2447, 180_887_000
"""2026-12-01 02:14:29 UTC, with 18 leap seconds."""
NO_NUMBER = -2e10


def block(number: int, body: bytes, revision: int = 0) -> bytes:
    body = body.ljust((len(body) + 3) // 4 * 4, b"\x00")
    covered = struct.pack("<HH", number | revision << 13, len(body) + 8) + body
    return b"$@" + struct.pack("<H", binascii.crc_hqx(covered, 0)) + covered


def at(second: float) -> tuple[int, int]:
    return TOW_MS + round(second * 1000), WEEK


def pvt(second: float = 0.0, **changed: Any) -> bytes:
    """PVTGeodetic of revision 2: RTK fixed in Beijing unless told."""
    values: dict[str, Any] = {
        "mode": 4, "error": 0, "lat": math.radians(39.9687242), "lon": math.radians(116.3257202),
        "height": 36.2, "v": (1.0, -2.0, -0.03), "datum": 0, "satellites": 31, "h_acc": 4,
        "v_acc": 5, "revision": 2, "when": at(second),
    }  # fmt: skip
    values |= changed
    body = struct.pack(
        "<IHBBdddfffffdfBBBBHHIBBHHHHB",
        *values["when"], values["mode"], values["error"], values["lat"], values["lon"],
        values["height"], -9.1, *values["v"], 296.565, 0.01, 0.001, 0, values["datum"],
        values["satellites"], 0, 123, 100, 0, 0, 1, 0, 250, values["h_acc"], values["v_acc"], 0,
    )  # fmt: skip
    return block(4007, body if values["revision"] == 2 else body[:68], values["revision"])


def covariance(number: int, second: float = 0.0, *, error: int = 0, scale: float = 1.0) -> bytes:
    """5906 of positions, 5908 of velocities: sigmas of 1, 2 and 3 cm times `scale`."""
    variances = (1e-4 * scale**2, 4e-4 * scale**2, 9e-4 * scale**2, 1.0, 0, 0, 0, 0, 0, 0)
    return block(number, struct.pack("<IHBB10f", *at(second), 4, error, *variances))


def dop(second: float = 0.0) -> bytes:
    body = struct.pack("<IHBBHHHHff", *at(second), 31, 0, 125, 65, 77, 99, 1.0, 2.0)
    return block(4001, body)


def receiver_time(second: float = 0.0, leap: int = 18) -> bytes:
    body = struct.pack("<IHbbbbbbbB", *at(second), 26, 12, 1, 2, 14, 29, leap, 7)
    return block(5914, body)


def end_of_pvt(second: float = 0.0) -> bytes:
    return block(5921, struct.pack("<IH", *at(second)))


def attitude(second: float = 0.0, *, mode: int = 2, error: int = 0, yaw: float = 123.5) -> bytes:
    body = struct.pack(
        "<IHBBHBB6f", *at(second), 20, error, mode, 0, 0, yaw, 1.0, NO_NUMBER, 0, 0, 0
    )
    return block(5938, body)


def attitude_covariance(second: float = 0.0, *, error: int = 0) -> bytes:
    """Heading to 0.2 degrees."""
    body = struct.pack("<IHBB6f", *at(second), 0, error, 0.04, 0.09, 0, 0, 0, 0)
    return block(5939, body)
