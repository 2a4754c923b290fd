"""Common part of message decoders: collection of one satellite's subframes into an ephemeris.

The decoder of a message takes one verified block (a subframe, page or word) at a time and returns
what the block completes. It raises `RefusedError` with a name for a refused block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from drivers.raw.bits import Bits, KlobucharTable, Number
from drivers.raw.messages import Bdgim, Ephemeris, Klobuchar, NavigationMessage, System
from drivers.raw.weeks import HALF_WEEK_S

MAX_ECCENTRICITY = 0.5
"""Largest eccentricity in the 32 bits of IS-GPS-200 table 20-III (0.03); GPS and Galileo reserve
the rest, Galileo's E14 and E18 have 0.17."""
SQRT_A_M = (4000.0, 7000.0)
"""Orbit radius 16,000 to 49,000 km: MEO is above 25,500 km, GEO and IGSO at 42,164 km."""


class RefusedError(Exception):
    """Error: a block cannot be used; the text is the counter's name."""


@dataclass(frozen=True, slots=True)
class Subframe:
    """Contents of UBX-RXM-SFRBX: the words of one block of one signal of one satellite."""

    source: str
    t_seen_ns: int
    system: System
    prn: int
    signal_id: int
    words: tuple[int, ...]


@dataclass(slots=True)
class Parts:
    """Blocks by number with the same `key`; another key starts a new set."""

    key: Any = None
    found: dict[int, Any] = field(default_factory=dict)

    def add(self, key: Any, number: int, block: Any) -> bool:
        """Add a block; true if it discards earlier ones of another key."""
        mixed = bool(self.found) and key != self.key
        if mixed:
            self.found.clear()
        self.key = key
        self.found[number] = block
        return mixed

    def clear(self) -> None:
        self.found.clear()


Decoded = list[NavigationMessage]


def ephemeris(
    subframe: Subframe,
    message: str,
    numbers: dict[str, Any],
    *,
    sent: tuple[int, float],
    delays: tuple[Bits, tuple[Number, ...]],
    issue: int,
    accuracy_m: float | None,
    healthy: bool,
) -> Ephemeris:
    """Make the `Ephemeris` of `subframe`'s satellite. RefusedError for an impossible orbit.

    `sent`: week and time of week at which the message began; `delays`: the bits with the group
    delays, and their table.
    """
    week, tow_s = sent
    bits, table = delays
    found = Ephemeris(
        source=subframe.source,
        t_seen_ns=subframe.t_seen_ns,
        system=subframe.system,
        prn=subframe.prn,
        message=message,
        week=week_of_toe(week, tow_s, numbers["toe_s"]),
        group_delay_s=tuple(delay.read(bits) for delay in table),
        issue=issue,
        accuracy_m=accuracy_m,
        healthy=healthy,
        **numbers,
    )
    check_orbit(found)
    return found


def klobuchar(subframe: Subframe, bits: Bits, table: KlobucharTable) -> Klobuchar:
    """Make the ionosphere model of `bits` by `table` (drivers.raw.bits.klobuchar_table)."""
    (a0, a1, a2, a3), (b0, b1, b2, b3) = ([n.read(bits) for n in row] for row in table)
    return Klobuchar(
        subframe.source, subframe.t_seen_ns, subframe.system, (a0, a1, a2, a3), (b0, b1, b2, b3)
    )


def bdgim(subframe: Subframe, bits: Bits, table: tuple[Number, ...]) -> list[NavigationMessage]:
    """Make BeiDou-3's ionosphere model of `bits`; None if all are zero: the satellite sends
    none."""
    a1, a2, a3, a4, a5, a6, a7, a8, a9 = (n.read(bits) for n in table)
    alpha = (a1, a2, a3, a4, a5, a6, a7, a8, a9)
    return [Bdgim(subframe.source, subframe.t_seen_ns, alpha)] if any(alpha) else []


def check_orbit(found: Ephemeris) -> None:
    """RefusedError unless the orbit is one of a navigation satellite."""
    lowest, highest = SQRT_A_M
    if not (lowest <= found.sqrt_a <= highest and 0.0 <= found.eccentricity <= MAX_ECCENTRICITY):
        raise RefusedError("ephemeris_implausible")
    if not math.isfinite(found.mean_anomaly + found.clock_bias_s + found.toe_s):
        raise RefusedError("ephemeris_implausible")


def week_of_toe(week: int, tow_s: float, toe_s: float) -> int:
    """Week of `toe_s`, by `week` and `tow_s` of the transmission: toe is less than half a week
    away."""
    if toe_s - tow_s > HALF_WEEK_S:
        return week - 1
    if toe_s - tow_s < -HALF_WEEK_S:
        return week + 1
    return week


def ura_m(index: int) -> float | None:
    """Sigma of GPS (IS-GPS-200, 20.3.3.3.1.3) and BeiDou (BDS-SIS-ICD-B1I 5.2.4.5) by index:
    2^(1+N/2) m to N = 6, then 2^(N-2) m; None for 15, no prediction."""
    if index >= 15:
        return None
    return 2.0 ** (1.0 + index / 2.0) if index <= 6 else 2.0 ** (index - 2)


def sisa_m(index: int) -> float | None:
    """Sigma of Galileo by index (OS SIS ICD 5.1.12, table 90); None without a prediction."""
    for first, last, base_m, step_m in (
        (0, 49, 0.0, 0.01),
        (50, 74, 0.5, 0.02),
        (75, 99, 1.0, 0.04),
        (100, 125, 2.0, 0.16),
    ):
        if first <= index <= last:
            return base_m + (index - first) * step_m
    return None
