r"""UBX frames of a receiver's raw stream: RXM-RAWX and RXM-SFRBX.

    B5 62 | class | id | length u16 | payload | CK_A CK_B         Fletcher-8 over class to payload

RAWX: 16 bytes of header, 32 a signal; pseudorange m, carrier cycles, Doppler Hz (positive while the
distance shrinks), stated deviations as 0.01 * 2^n m, 0.004 n cycles, 0.002 * 2^n Hz.
SFRBX: one subframe, ten words of 32 bits as `nav_subframes` makes them.

Source: u-blox ZED-F9P interface description (HPG 1.32), 3.17.4 and 3.17.6.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from drivers.raw.messages import CARRIER_HZ, SPEED_OF_LIGHT_M_S, RawGnssEpoch, RawSignal, System
from fusiond.gnss.orbit import is_beidou_geo
from fusiond.simulation.gnss.nav_subframes import LEAP_SECONDS

RXM = 0x02
SFRBX, RAWX = 0x13, 0x15
GNSS_ID: dict[System, int] = {"G": 0, "E": 2, "C": 3}
# Of satellites with message D1, and of those with D2.
SIGNAL_ID: dict[tuple[System, str], tuple[int, int]] = {
    ("G", "1C"): (0, 0),
    ("E", "1C"): (0, 0),
    ("C", "2I"): (0, 1),
    ("C", "7I"): (2, 3),
    ("C", "6I"): (4, 10),
}
_MAX_LOCK_MS = 64_500
"""Limit of u-blox counters."""


def frame(message_class: int, message_id: int, payload: bytes) -> bytes:
    """Encode one UBX frame."""
    body = struct.pack("<BBH", message_class, message_id, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def signal_id(system: System, prn: int, signal: str) -> int:
    """UBX sigId. Raises KeyError for a signal that is not encoded here."""
    return SIGNAL_ID[system, signal][is_beidou_geo(system, prn)]


def sfrbx(system: System, prn: int, words: Sequence[int]) -> bytes:
    """RXM-SFRBX with a subframe received on GPS L1 C/A or BeiDou B1I."""
    broadcast_on = {"G": "1C", "C": "2I", "E": "1C"}[system]
    head = (
        GNSS_ID[system],
        prn,
        signal_id(system, prn, broadcast_on),
        0,
        len(words),
        prn % 32,
        2,
        0,
    )
    return frame(RXM, SFRBX, struct.pack(f"<8B{len(words)}I", *head, *words))


def rawx(epoch: RawGnssEpoch, locks_ms: Sequence[int]) -> bytes:
    """RXM-RAWX of an epoch; `locks_ms` (n,) since when each signal is tracked."""
    status = 0x01 | 0x02 * epoch.clock_reset
    count = len(epoch.signals)
    head = struct.pack("<dHbBBB2x", epoch.tow_s, epoch.week, LEAP_SECONDS, count, status, 1)
    return frame(RXM, RAWX, head + b"".join(map(_measurement, epoch.signals, locks_ms)))


def _measurement(s: RawSignal, lock_ms: int) -> bytes:
    hz = CARRIER_HZ[s.system, s.signal[0]]
    doppler = 0.0 if s.range_rate_m_s is None else -s.range_rate_m_s * hz / SPEED_OF_LIGHT_M_S
    carrier_ok = s.carrier_cycles is not None
    rate_sd = 1.0 if s.sd_range_rate_m_s is None else s.sd_range_rate_m_s
    return struct.pack(
        "<ddf4BH6B",
        s.pseudorange_m,
        s.carrier_cycles or 0.0,
        doppler,
        GNSS_ID[s.system],
        s.prn,
        signal_id(s.system, s.prn, s.signal),
        0,
        min(lock_ms, _MAX_LOCK_MS),
        round(s.cno_db_hz or 0.0),
        _power(s.sd_pseudorange_m, 0.01),
        1 if carrier_ok else 15,
        _power(rate_sd * hz / SPEED_OF_LIGHT_M_S, 0.002),
        0b111 if carrier_ok else 0b001,
        0,
    )


def _power(sd: float | None, unit: float) -> int:
    """Least n, 0 to 15, with unit * 2^n >= sd; 15 for an unstated sigma."""
    if sd is None:
        return 15
    return min(15, math.ceil(math.log2(sd / unit))) if sd > unit else 0
