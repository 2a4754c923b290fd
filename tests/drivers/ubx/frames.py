"""UBX-NAV frames bit by bit, as the interface description lays them out."""

from __future__ import annotations

import struct
from datetime import UTC, datetime, timedelta
from typing import Any

from tests.drivers.raw.frames import ubx

START = datetime(2026, 12, 1, 2, 14, 29, tzinfo=UTC)
"""A Tuesday: 180,869 s after Sunday midnight, and 18 leap seconds."""


def utc_ns(second: float = 0.0) -> int:
    return int(START.timestamp()) * 1_000_000_000 + round(second * 1e9)


def itow(second: float = 0.0) -> int:
    """iTOW of a second after `START`."""
    sunday = datetime(2026, 11, 29, tzinfo=UTC)
    return round(((START - sunday).total_seconds() + 18 + second) * 1000)


def pvt(second: int = 0, **changed: Any) -> bytes:
    """NAV-PVT, 92 bytes: RTK fixed in Beijing unless told."""
    values: dict[str, Any] = {
        "nano": -127_759, "valid": 7, "fix": 3, "flags": 1 | 2 << 6, "satellites": 25,
        "lon": 1_163_257_202, "lat": 399_687_242, "height": 36_200, "sd_h": 14, "sd_v": 20,
        "v": (1_000, -2_000, 30), "sd_speed": 173, "flags3": 0, "day": None, "length": 92,
    }  # fmt: skip
    values |= changed
    when = START + timedelta(seconds=second)
    day = values["day"] or (when.year, when.month, when.day)
    payload = struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHH",
        values.get("itow", itow(second)), *day, when.hour, when.minute, when.second,
        values["valid"], 25, values["nano"], values["fix"], values["flags"], 0xE0,
        values["satellites"], values["lon"], values["lat"], values["height"], 45_300,
        values["sd_h"], values["sd_v"], *values["v"], 2_236, 0, values["sd_speed"], 0, 125,
        values["flags3"],
    )  # fmt: skip
    return ubx(b"\x01\x07", payload.ljust(values["length"], b"\x00"))


def nav(kind: int, layout: str, *values: Any) -> bytes:
    return ubx(bytes((1, kind)), struct.pack(f"<{layout}", *values))


def hpposllh(second: int = 0, *, flags: int = 0) -> bytes:
    """A tenth of a millimetre and 1e-9 degrees beside PVT."""
    return nav(
        0x14, "BxxBIiiiibbbbII", 0, flags, itow(second), 1_163_257_202, 399_687_242, 36_200,
        45_300, 12, -34, 5, -6, 141, 205,
    )  # fmt: skip


def dop(second: int = 0) -> bytes:
    return nav(0x04, "IHHHHHHH", itow(second), 141, 125, 65, 99, 77, 60, 48)


def cov(second: int = 0, *, valid: int = 1) -> bytes:
    position = (1e-4, 0.0, 0.0, 4e-4, 0.0, 9e-4)
    velocity = (1e-2, 0.0, 0.0, 4e-2, 0.0, 9e-2)
    return nav(0x36, "IBBB9x12f", itow(second), 0, valid, valid, *position, *velocity)


def timegps(second: int = 0, *, leap: int = 18, valid: int = 7) -> bytes:
    return nav(0x20, "IihbBI", itow(second), -127_759, 2447, leap, valid, 25)


def timeutc(second: int = 0, *, valid: int = 7) -> bytes:
    when = START + timedelta(seconds=second)
    day = (when.year, when.month, when.day, when.hour, when.minute, when.second)
    return nav(0x21, "IIiHBBBBBB", itow(second), 25, -127_759, *day, valid)


def posllh(second: int = 0) -> bytes:
    values = (1_163_257_202, 399_687_242, 36_200, 45_300, 1_414, 2_000)
    return nav(0x02, "IiiiiII", itow(second), *values)


def velned(second: int = 0) -> bytes:
    return nav(0x12, "IiiiIIiII", itow(second), 100, -200, 3, 224, 224, 0, 17, 0)


def status(second: int = 0, *, fix: int = 3, flags: int = 0xD) -> bytes:
    return nav(0x03, "IBBBBII", itow(second), fix, flags, 0, 0, 0, 0)


def sol(second: int = 0, *, flags: int = 0xD) -> bytes:
    """NAV-SOL of an antaris: Esbjerg, moving north."""
    place = (358_210_529, 53_258_973, 523_275_481)
    return nav(
        0x06, "IihBBiiiIiiiIHBBI", itow(second), -127_759, 2447, 3, flags, *place, 1_000,
        -82, -12, 57, 17, 125, 0, 9, 0,
    )  # fmt: skip


def posecef(second: int = 0) -> bytes:
    """Where `sol` is, and how `velecef` moves."""
    return nav(0x01, "IiiiI", itow(second), 358_210_529, 53_258_973, 523_275_481, 1_000)


def velecef(second: int = 0) -> bytes:
    return nav(0x11, "IiiiI", itow(second), -82, -12, 57, 17)


def end_of_epoch(second: int = 0) -> bytes:
    return nav(0x61, "I", itow(second))


def relposned(second: int = 0, *, flags: int = 0x1 | 0x4 | 2 << 3 | 0x20 | 0x100) -> bytes:
    """A metre of baseline at 123.45678 degrees, give or take 0.2."""
    baseline = (-55, 83, 0, 100, 12_345_678)
    accuracies = (30, 30, 50, 20, 20_000)
    return nav(
        0x3C, "BxHIiiiii4xbbbbIIIII4xI", 1, 0, itow(second), *baseline, 0, 0, 0, 0, *accuracies,
        flags,
    )  # fmt: skip
