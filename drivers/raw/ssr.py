"""RTCM 3 state space representation: orbit, clock and code bias corrections by satellite.

    1057 to 1062 GPS, 1240 to 1245 Galileo, 1258 to 1263 BeiDou:
    orbit, clock, code bias, orbit and clock, accuracy (URA), high-rate clock

    header     number 12, epoch 20 (s of the week, the system's own), interval 4, more 1,
               [datum 1: messages with orbits], IOD SSR 4, provider 16, solution 4, satellites 6
    orbit      satellite 6, issue of the ephemeris (below), radial 22 in 0.1 mm, along, across 20
               in 0.4 mm, their rates 21 in 1 um/s, 19 in 4 um/s
    clock      satellite 6, C0 22 in 0.1 mm, C1 21 in 1 um/s, C2 27 in 20 nm/s^2
    bias       satellite 6, number 5, each: signal 5, bias 14 in cm
    accuracy   satellite 6, class 3 and value 3: 3^class (1 + value / 4) - 1 mm
    high rate  satellite 6, clock 22 in 0.1 mm

The issue is GPS's IODE (8), Galileo's IODnav (10), or BeiDou's (toe / 8 s) modulo 1024 (10) with 8
more bits, 24 more by an older draft: the message's length decides. A number with only its highest
bit set is unknown. The reference instant is half an interval after the epoch; with the shortest
interval, 1 s, it is the epoch.

Counters of unused contents: `ssr_not_known`, `ssr_implausible`, `ssr_unreadable`,
`ssr_glonass_not_used`, `ssr_not_used` (QZSS, SBAS, ionosphere, phase biases), `signal_unknown`.

Source: RTCM 10403.3, 3.5.12 and tables 3.5-42 to 3.5-48 (GPS); proposal
SSR_1_Gal_QZSS_SBAS_BDS_v08u (Galileo, BeiDou), as in pyrtcm.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

from drivers.plausible import within
from drivers.raw.bits import Bits
from drivers.raw.messages import Correction, CorrectionPart, System
from drivers.raw.weeks import BDT_BEHIND_GPS_S, WEEK_S, WeekReference

ORBIT, CLOCK, BIAS, COMBINED, ACCURACY, HIGH_RATE = range(6)
"""Kinds of messages, in the order of their numbers."""
FIRST_OF_SYSTEM: dict[int, System] = {1057: "G", 1240: "E", 1258: "C"}
GLONASS = range(1063, 1069)
OTHERS = (*range(1246, 1258), *range(1264, 1271))
MESSAGES = {
    first + kind: (system, kind) for first, system in FIRST_OF_SYSTEM.items() for kind in range(6)
}

INTERVALS_S = (1, 2, 5, 10, 15, 30, 60, 120, 240, 300, 600, 900, 1800, 3600, 7200, 10800)
"""Update intervals of DF391."""
_HEADER_BITS = 67
"""Bits of the header without the datum's."""
_ISSUE_BITS: dict[System, tuple[tuple[int, int], ...]] = {
    "G": ((8, 0),),
    "E": ((10, 0),),
    "C": ((10, 8), (10, 24)),
}
"""Bits of the issue, and behind it."""
_ORBIT = ((22, 1e-4), (20, 4e-4), (20, 4e-4), (21, 1e-6), (19, 4e-6), (19, 4e-6))
_CLOCK = ((22, 1e-4), (21, 1e-6), (27, 2e-8))
_HIGH_RATE = ((22, 1e-4),)
_BIAS = 14, 0.01
LARGEST_M, LARGEST_M_S = 100.0, 0.1
"""Largest plausible correction and its rate. Broadcast orbits and clocks are metres off, BeiDou's
geostationary ones tens of metres; a satellite a hundred off is faulty."""
ACCURACY_M = (0.0, 5.4665)
"""Accuracies of DF389: 0 is unknown, 63 worse than the second."""

SIGNALS: dict[System, tuple[str, ...]] = {
    "G": (
        *("1C", "1P", "1W", "1Y", "1M", "2C", "2D", "2S", "2L", "2X", "2P", "2W", "2Y", "2M"),
        *("5I", "5Q", "5X"),
    ),
    "E": (
        *("1A", "1B", "1C", "1X", "1Z", "5I", "5Q", "5X", "7I", "7Q", "7X", "8I", "8Q", "8X"),
        *("6A", "6B", "6C", "6X", "6Z"),
    ),
    "C": ("2I", "2Q", "2X", "6I", "6Q", "6X", "7I", "7Q", "7X"),
}
"""DF380, DF382, DF467."""


class _Head(NamedTuple):
    tow_s: float
    interval_s: float
    solution: tuple[int, int, int]
    satellites: int
    end: int


class _UnreadableError(Exception):
    """Error: a message is shorter than it states."""


_Found = list[tuple[int, CorrectionPart, int, tuple[float, ...], tuple[str, ...]]]
"""Number, part, issue, values and signals of satellites."""


class SsrDecoder:
    """Decoder of messages into corrections."""

    def __init__(self, source: str, weeks: WeekReference, counters: Counter[str]) -> None:
        self._source = source
        self._weeks = weeks
        self._counters = counters

    def decode(self, number: int, bits: Bits, t_seen_ns: int) -> list[Correction]:
        """Decode a message by its `number`, one of `MESSAGES`, `GLONASS` or `OTHERS`."""
        if number not in MESSAGES:
            name = "ssr_glonass_not_used" if number in GLONASS else "ssr_not_used"
            self._counters[name] += 1
            return []
        system, kind = MESSAGES[number]
        try:
            head = self._head(system, kind, bits)
            week = self._weeks.week_of_tow(head.tow_s)
            if week is None:
                self._counters["week_unknown"] += 1
                return []
            found = self._satellites(system, kind, bits, head)
        except (_UnreadableError, IndexError):
            self._counters["ssr_unreadable"] += 1
            return []
        self._counters["rtcm_ssr"] += 1
        tow_s = head.tow_s
        if head.interval_s > INTERVALS_S[0]:
            tow_s += 0.5 * head.interval_s
        return [
            Correction(
                self._source,
                t_seen_ns,
                system,
                prn,
                part,
                week,
                tow_s,
                head.interval_s,
                head.solution,
                issue,
                values,
                signals,
            )
            for prn, part, issue, values, signals in found
        ]

    def _head(self, system: System, kind: int, bits: Bits) -> _Head:
        end = _HEADER_BITS + (kind in (ORBIT, COMBINED))
        if bits.length < end:
            raise _UnreadableError
        tow_s = bits.unsigned(12, 20)
        if tow_s >= WEEK_S:
            raise _UnreadableError
        if system == "C":
            tow_s = (tow_s + BDT_BEHIND_GPS_S) % WEEK_S
        at = end - 30
        solution = bits.unsigned(at + 4, 16), bits.unsigned(at + 20, 4), bits.unsigned(at, 4)
        interval_s = float(INTERVALS_S[bits.unsigned(32, 4)])
        return _Head(float(tow_s), interval_s, solution, bits.unsigned(at + 24, 6), end)

    def _satellites(self, system: System, kind: int, bits: Bits, head: _Head) -> _Found:
        found: _Found = []
        at, behind = head.end, 0
        issue_bits = 0
        if kind in (ORBIT, COMBINED):
            issue_bits, behind = _layout(system, kind, bits, head)
        for _ in range(head.satellites):
            if at + 6 > bits.length:
                raise _UnreadableError
            prn, at, issue = bits.unsigned(at, 6), at + 6, -1
            if kind in (ORBIT, COMBINED):
                issue, at = bits.unsigned(at, issue_bits), at + issue_bits + behind
                at = self._numbers(bits, at, _ORBIT, (prn, "orbit", issue), found)
            if kind in (CLOCK, COMBINED):
                at = self._numbers(bits, at, _CLOCK, (prn, "clock", -1), found)
            if kind == HIGH_RATE:
                at = self._numbers(bits, at, _HIGH_RATE, (prn, "fast_clock", -1), found)
            if kind == ACCURACY:
                if at + 6 > bits.length:
                    raise _UnreadableError
                sd_m = accuracy_m(bits.unsigned(at, 6))
                at += 6
                if sd_m is not None:
                    found.append((prn, "accuracy", -1, (sd_m,), ()))
            if kind == BIAS:
                at = self._biases(system, prn, bits, at, found)
        return found

    def _numbers(
        self,
        bits: Bits,
        at: int,
        fields: tuple[tuple[int, float], ...],
        of: tuple[int, CorrectionPart, int],
        found: _Found,
    ) -> int:
        """Add the plausible numbers of a satellite; return the position of the next one."""
        values, known = [], True
        for length, scale in fields:
            if at + length > bits.length:
                raise _UnreadableError
            n = bits.signed(at, length)
            known &= n != -(1 << (length - 1))
            values.append(n * scale)
            at += length
        half = 3 if len(values) == len(_ORBIT) else 1
        if not known:
            self._counters["ssr_not_known"] += 1
        elif not (
            all(within(v, (-LARGEST_M, LARGEST_M)) for v in values[:half])
            and all(within(v, (-LARGEST_M_S, LARGEST_M_S)) for v in values[half:])
        ):
            self._counters["ssr_implausible"] += 1
        else:
            found.append((*of, tuple(values), ()))
        return at

    def _biases(
        self,
        system: System,
        prn: int,
        bits: Bits,
        at: int,
        found: _Found,
    ) -> int:
        if at + 5 > bits.length:
            raise _UnreadableError
        count, at = bits.unsigned(at, 5), at + 5
        length, scale = _BIAS
        names, values = [], []
        for _ in range(count):
            if at + 5 + length > bits.length:
                raise _UnreadableError
            k, n = bits.unsigned(at, 5), bits.signed(at + 5, length)
            at += 5 + length
            if k >= len(SIGNALS[system]):
                self._counters["signal_unknown"] += 1
            elif n == -(1 << (length - 1)):
                self._counters["ssr_not_known"] += 1
            else:
                names.append(SIGNALS[system][k])
                values.append(n * scale)
        if names:
            found.append((prn, "bias", -1, tuple(values), tuple(names)))
        return at


def _layout(system: System, kind: int, bits: Bits, head: _Head) -> tuple[int, int]:
    """Lengths of the issue and of the bits behind it, by the message's length."""
    rest = sum(length for length, _ in _ORBIT) + 6
    if kind == COMBINED:
        rest += sum(length for length, _ in _CLOCK)
    for issue, behind in _ISSUE_BITS[system]:
        needed = head.end + head.satellites * (rest + issue + behind)
        if -(-needed // 8) == bits.length // 8:
            return issue, behind
    raise _UnreadableError


def accuracy_m(index: int) -> float | None:
    """One sigma by DF389; None if unknown."""
    if not 0 < index < 63:
        return None if index == 0 else ACCURACY_M[1]
    return (math.pow(3.0, index >> 3) * (1.0 + 0.25 * (index & 7)) - 1.0) * 1e-3
