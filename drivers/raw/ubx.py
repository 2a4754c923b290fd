"""Parser of UBX-RXM-RAWX and UBX-RXM-SFRBX, little endian, in verified frames.

    RAWX   rcvTow R8 s, week U2, leapS I1, numMeas U1, recStat X1, 3 bytes; then numMeas times
           prMes R8 m, cpMes R8 cycles, doMes R4 Hz, gnssId, svId, sigId, freqId U1, locktime U2 ms,
           cno U1 dB-Hz, prStdev, cpStdev, doStdev X1, trkStat X1, 1 byte
    SFRBX  gnssId, svId, sigId, freqId, numWords, chn, version U1, 1 byte; then numWords U4
    sigma  0.01 * 2^n m of the pseudorange, 0.002 * 2^n Hz of the Doppler (n: low four bits)
    rate   -doMes * c / f: a positive Doppler approaches

Source: u-blox F9 HPG interface description, UBX-RXM-RAWX and UBX-RXM-SFRBX.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections import Counter
from dataclasses import dataclass
from itertools import chain

from drivers.plausible import LEAP_SECONDS, within
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    PackedSignals,
    SignalKey,
    System,
)

RAWX = b"\x02\x15"
SFRBX = b"\x02\x13"

PSEUDORANGE_M = (1.5e7, 5.0e7)
"""Range of pseudoranges: a GPS satellite overhead is 20,200 km away, an IGSO one at the horizon
42,000 km; the rest is a margin for a receiver clock of 17 ms."""
MAX_RATE_M_S = 10_000.0
"""Largest range rate: a satellite moves at 3.9 km/s at most, a vehicle below 1 km/s, and a clock 10
ppm off adds 3."""
MAX_PRN: dict[System, int] = {"G": 32, "E": 36, "C": 63}
SYSTEM_BY_ID: dict[int, System] = {0: "G", 2: "E", 3: "C"}
OTHER_SYSTEMS = {1: "sbas", 5: "qzss", 6: "glonass", 7: "navic"}

SIGNALS: dict[tuple[int, int], str] = {
    (0, 0): "1C",
    (0, 3): "2L",
    (0, 4): "2S",
    (0, 6): "5I",
    (0, 7): "5Q",
    (2, 0): "1C",
    (2, 1): "1B",
    (2, 3): "5I",
    (2, 4): "5Q",
    (2, 5): "7I",
    (2, 6): "7Q",
    (2, 8): "6B",
    (2, 9): "6C",
    (3, 0): "2I",
    (3, 1): "2I",
    (3, 2): "7I",
    (3, 3): "7I",
    (3, 4): "6I",
    (3, 10): "6I",
    (3, 5): "1P",
    (3, 6): "1D",
    (3, 7): "5P",
    (3, 8): "5D",
}
"""RINEX signal by gnssId and sigId."""

_HEADER = struct.Struct("<dHbBB3x")
_MEASUREMENT = struct.Struct("<ddfBBBxHBBxBBx")
_LOCK_FULL_MS = 64_500
"""The count of locktime goes no further."""
_SUBFRAME = struct.Struct("<BBBxBxBx")

_LEAP_KNOWN, _CLOCK_RESET = 1, 2
_RANGE_VALID, _CARRIER_VALID, _HALF_KNOWN = 1, 2, 4

# By signal: system, RINEX code, and wavelength (m).
_BY_SIGNAL = {
    (gnss, sig): (
        SYSTEM_BY_ID[gnss],
        code,
        SPEED_OF_LIGHT_M_S / CARRIER_HZ[SYSTEM_BY_ID[gnss], code[0]],
    )
    for (gnss, sig), code in SIGNALS.items()
}


@dataclass(frozen=True, slots=True)
class Rawx:
    """Epoch as stated by the receiver. `leap_seconds` is None while unknown."""

    tow_s: float
    week: int
    leap_seconds: int | None
    clock_reset: bool
    signals: PackedSignals


@dataclass(frozen=True, slots=True)
class Sfrbx:
    gnss_id: int
    prn: int
    signal_id: int
    words: tuple[int, ...]


def parse_rawx(payload: bytes, counters: Counter[str]) -> Rawx | None:
    """Parse an epoch; None if the length is wrong or the time is no number.

    Every measurement is counted as `measured_G`, `measured_E`, `measured_C` or under another
    system's name, and a refused one of the three also as `signal_unknown`, `prn_unknown`,
    `pseudorange_invalid`, `not_finite`, `pseudorange_implausible`, `rate_implausible`,
    `signal_repeated`. A carrier with an unresolved half cycle is left out: `half_cycle_open`. An
    impossible leap second count is unknown: `leap_seconds_implausible`.
    """
    if len(payload) < _HEADER.size:
        return None
    tow_s, week, leap, count, status = _HEADER.unpack_from(payload)
    if len(payload) != _HEADER.size + count * _MEASUREMENT.size or not 0.0 <= tow_s < 604_801.0:
        return None
    signals: dict[SignalKey, tuple[float, ...]] = {}
    for measurement in _MEASUREMENT.iter_unpack(payload[_HEADER.size :]):
        refused = _measured(measurement, counters, signals)
        if refused:
            counters[refused] += 1
    known = bool(status & _LEAP_KNOWN)
    if known and not within(leap, LEAP_SECONDS):
        counters["leap_seconds_implausible"] += 1
        known = False
    return Rawx(
        tow_s,
        week,
        leap if known else None,
        bool(status & _CLOCK_RESET),
        PackedSignals(tuple(signals), array("d", chain.from_iterable(signals.values()))),
    )


def _measured(
    measurement: tuple[float, float, float, int, int, int, int, int, int, int, int],
    counters: Counter[str],
    signals: dict[SignalKey, tuple[float, ...]],
) -> str:
    """Add the values of one measurement to those of `signals`; why not, if it is refused."""
    pseudorange, carrier, doppler, gnss, prn, sig, lock_ms, cno, sd_range, sd_doppler, track = (
        measurement
    )
    system = SYSTEM_BY_ID.get(gnss)
    if system is None:
        return f"measured_{OTHER_SYSTEMS.get(gnss, 'unknown_system')}"
    counters[f"measured_{system}"] += 1
    known = _BY_SIGNAL.get((gnss, sig))
    if known is None:
        return "signal_unknown"
    if not 1 <= prn <= MAX_PRN[system]:
        return "prn_unknown"
    if not track & _RANGE_VALID:
        return "pseudorange_invalid"
    if not (math.isfinite(pseudorange) and math.isfinite(doppler) and math.isfinite(carrier)):
        return "not_finite"
    if not PSEUDORANGE_M[0] <= pseudorange <= PSEUDORANGE_M[1]:
        return "pseudorange_implausible"
    _, code, wavelength = known
    if abs(doppler * wavelength) > MAX_RATE_M_S:
        return "rate_implausible"
    followed = track & _CARRIER_VALID
    if followed and not track & _HALF_KNOWN:
        counters["half_cycle_open"] += 1
        followed = 0
    key = (system, prn, code)
    if key in signals:
        return "signal_repeated"
    signals[key] = (
        pseudorange,
        -doppler * wavelength,
        cno or math.nan,
        0.01 * (1 << (sd_range & 0xF)),
        0.002 * (1 << (sd_doppler & 0xF)) * wavelength,
        carrier if followed else math.nan,
        lock_ms * 1e-3 if lock_ms < _LOCK_FULL_MS else math.inf,
    )
    return ""


def parse_sfrbx(payload: bytes) -> Sfrbx | None:
    """Parse the words of a subframe; None if the length is wrong."""
    if len(payload) < _SUBFRAME.size:
        return None
    gnss, prn, sig, count, _version = _SUBFRAME.unpack_from(payload)
    if len(payload) != _SUBFRAME.size + 4 * count:
        return None
    return Sfrbx(gnss, prn, sig, struct.unpack_from(f"<{count}I", payload, _SUBFRAME.size))
