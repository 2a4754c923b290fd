r"""RTCM 3 frames of a receiver's raw stream: MSM7 (1077 GPS, 1127 BeiDou), 1019 and 1042.

    D3 | 000000 length(10) | message | CRC-24Q over all before it

MSM7 splits each satellite's range, as time in ms, into a rough part of 2^-10 ms that its signals
share and fine parts: 2^-29 ms (pseudorange), 2^-31 ms (carrier, as a distance); range rate in m/s
plus 0.1 mm/s. Ranges and rates grow with the distance. The epoch of 1127 is BDT, 14 s behind 1077.
CRC-24Q: x^24 + x^23 + x^18 + x^17 + x^14 + x^11 + x^10 + x^7 + x^6 + x^5 + x^4 + x^3 + x + 1.

Source: RTCM 10403.3 sections 3.5.11 (1019, 1042), 3.5.16 (MSM, tables 3.5-74 to 3.5-99) and 4.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Ephemeris,
    RawGnssEpoch,
    RawSignal,
    System,
)
from fusiond.gnss.nominal_constellation import system_time
from fusiond.simulation.gnss.nav_fields import FIELDS, Bits, wire

PREAMBLE = 0xD3
MSM7: dict[System, int] = {"G": 1077, "C": 1127}
SIGNAL_ID: dict[tuple[System, str], int] = {
    ("G", "1C"): 2,
    ("C", "2I"): 2,
    ("C", "6I"): 8,
    ("C", "7I"): 14,
}
"""Place in the signal mask, from 1: tables 3.5-91 and 3.5-108."""
_MM = SPEED_OF_LIGHT_M_S * 1e-3
"""Metres of a millisecond."""
_MAX_CELLS = 64
_MAX_LOCK = 704


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        rest = byte << 16
        for _ in range(8):
            rest <<= 1
            if rest & 0x1000000:
                rest ^= 0x1864CFB
        table.append(rest)
    return tuple(table)


_CRC = _crc_table()


def crc24q(data: bytes) -> int:
    """Checksum CRC-24Q of a frame."""
    rest = 0
    for byte in data:
        rest = (rest << 8 & 0xFFFFFF) ^ _CRC[rest >> 16 ^ byte]
    return rest


def frame(message: Bits) -> bytes:
    """Encode one RTCM 3 frame."""
    payload = message.to_bytes()
    body = bytes((PREAMBLE,)) + len(payload).to_bytes(2, "big") + payload
    return body + crc24q(body).to_bytes(3, "big")


def ephemeris_frame(ephemeris: Ephemeris) -> bytes:
    """Message 1019 (GPS) or 1042 (BeiDou). Raises ValueError as `nav_fields.wire`."""
    w = wire(ephemeris)
    fields = FIELDS[w.system]

    def put(*names: str) -> None:
        bits.put_all((w.raw[name], fields[name].bits) for name in names)

    elements = ("crs", "mean_motion_correction", "mean_anomaly", "cuc", "eccentricity", "cus",
                "sqrt_a", "toe_s", "cic", "ascending_node", "cis", "inclination", "crc", "perigee",
                "ascending_node_rate")  # fmt: skip
    clock = ("toc_s", "clock_drift_rate", "clock_drift", "clock_bias_s")
    if w.system == "G":
        bits = Bits().put_all(((1019, 12), (w.prn, 6), (w.week % 1024, 10), (w.accuracy, 4)))
        bits.put(1, 2)
        put("inclination_rate")
        bits.put(w.issue, 8)
        put(*clock)
        bits.put(w.issue, 10)
        put(*elements)
        health = 0 if w.healthy else 63
        bits.put_all(((w.group_delay[0], 8), (health, 6), (0, 1), (0, 1)))
    else:
        bits = Bits().put_all(((1042, 12), (w.prn, 6), (w.week % 8192, 13), (w.accuracy, 4)))
        put("inclination_rate")
        bits.put(w.issue, 5)
        put(*clock)
        bits.put(w.issue, 5)
        put(*elements)
        bits.put_all((delay, 10) for delay in w.group_delay)
        bits.put(not w.healthy, 1)
    return frame(bits)


def msm7(epoch: RawGnssEpoch, locks_ms: Sequence[int], station: int = 0) -> bytes:
    """Frames of an epoch; `locks_ms` (n,): tracking time of each signal.

    A system without a signal sends none. Raises ValueError for more than 64 satellite and signal
    pairs of a system, KeyError for a signal without a place in the mask.
    """
    by_system: dict[System, list[tuple[RawSignal, int]]] = {}
    for signal, lock_ms in zip(epoch.signals, locks_ms, strict=True):
        by_system.setdefault(signal.system, []).append((signal, lock_ms))
    return b"".join(
        frame(_msm7(epoch, system, cells, station, k + 1 < len(by_system)))
        for k, (system, cells) in enumerate(by_system.items())
    )


def _msm7(
    epoch: RawGnssEpoch,
    system: System,
    cells: list[tuple[RawSignal, int]],
    station: int,
    more_follow: bool,
) -> Bits:
    def place(s: RawSignal) -> int:
        return SIGNAL_ID[system, s.signal]

    _, tow = system_time(system, epoch.week, epoch.tow_s)
    cells = sorted(cells, key=lambda cell: (cell[0].prn, place(cell[0])))
    prns = sorted({s.prn for s, _ in cells})
    places = sorted({place(s) for s, _ in cells})
    if len(prns) * len(places) > _MAX_CELLS:
        raise ValueError(f"{len(prns)} satellites and {len(places)} signals in one message")
    bits = Bits().put_all(((MSM7[system], 12), (station, 12), (round(tow * 1e3) % 604_800_000, 30)))
    bits.put_all(((more_follow, 1), (0, 3), (0, 7), (0, 2), (0, 2), (0, 1), (0, 3)))
    bits.put(sum(1 << (64 - prn) for prn in prns), 64)
    bits.put(sum(1 << (32 - p) for p in places), 32)
    present = {(s.prn, place(s)) for s, _ in cells}
    bits.put_all(((prn, p) in present, 1) for prn in prns for p in places)
    firsts = {prn: next(s for s, _ in cells if s.prn == prn) for prn in prns}
    rough = {prn: round(s.pseudorange_m / _MM * 1024.0) for prn, s in firsts.items()}
    rates = {
        prn: None if s.range_rate_m_s is None else round(s.range_rate_m_s)
        for prn, s in firsts.items()
    }
    bits.put_all((r >> 10, 8) for r in rough.values())
    bits.put_all((0, 4) for _ in prns)
    bits.put_all((r & 0x3FF, 10) for r in rough.values())
    bits.put_all((_signed(rate, 14), 14) for rate in rates.values())
    rest_ms = [s.pseudorange_m / _MM - rough[s.prn] / 1024.0 for s, _ in cells]
    bits.put_all((_signed(round(x * 2.0**29), 20), 20) for x in rest_ms)
    bits.put_all((_carrier(s, rough[s.prn]), 24) for s, _ in cells)
    bits.put_all((_lock(lock_ms), 10) for _, lock_ms in cells)
    bits.put_all((0, 1) for _ in cells)
    bits.put_all((round((s.cno_db_hz or 0.0) * 16.0), 10) for s, _ in cells)
    bits.put_all((_rate(s, rates[s.prn]), 15) for s, _ in cells)
    return bits


def _signed(value: int | None, bits: int) -> int:
    """Two's complement; the lowest number means "none" and replaces a value that does not fit."""
    limit = 1 << (bits - 1)
    if value is None or not -limit < value < limit:
        value = -limit
    return value & ((1 << bits) - 1)


def _carrier(s: RawSignal, rough: int) -> int:
    if s.carrier_cycles is None:
        return _signed(None, 24)
    ms = s.carrier_cycles / CARRIER_HZ[s.system, s.signal[0]] * 1e3
    return _signed(round((ms - rough / 1024.0) * 2.0**31), 24)


def _rate(s: RawSignal, rough_m_s: int | None) -> int:
    if s.range_rate_m_s is None or rough_m_s is None:
        return _signed(None, 15)
    return _signed(round((s.range_rate_m_s - rough_m_s) * 1e4), 15)


def _lock(lock_ms: int) -> int:
    """Lock indicator DF407: 2^n (i - 32 n) <= lock_ms, n such that i - 32 n is 32 to 63."""
    n = max(0, lock_ms.bit_length() - 6)
    return min(_MAX_LOCK, (lock_ms >> n) + 32 * n)
