"""Raw messages of a GNSS receiver: observations, broadcast ephemerides, ionosphere models.

Angles are rad, times s, lengths m: the units of the orbit equations. The decoders resolve
semicircles, scale factors and week rollovers. Systems are the letters of RINEX: G GPS, E Galileo, C
BeiDou (others are counted and left out). Signals are RINEX 3 observation codes without their type:
"1C" GPS L1 C/A, "2I" BeiDou B1I, "6I" B3I, "1P" B1C pilot, "5P" B2a pilot.

A system's own time: GPS and Galileo weeks count from 1980-01-06 (Galileo's are given in GPS
weeks, 1024 more than its own count) and agree to nanoseconds; BeiDou's count from 2006-01-01 and
BDT = GPST - 14 s. `Ephemeris` keeps the system's own time, `RawGnssEpoch` is in GPS time.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from typing import Literal, overload

from drivers.immutable import immutable
from drivers.measurements import Stamp

System = Literal["G", "E", "C"]
SYSTEMS: tuple[System, ...] = ("G", "E", "C")

SPEED_OF_LIGHT_M_S = 299_792_458.0

CARRIER_HZ: dict[tuple[System, str], float] = {
    ("G", "1"): 1_575_420_000.0,
    ("G", "2"): 1_227_600_000.0,
    ("G", "5"): 1_176_450_000.0,
    ("E", "1"): 1_575_420_000.0,
    ("E", "5"): 1_176_450_000.0,
    ("E", "7"): 1_207_140_000.0,
    ("E", "8"): 1_191_795_000.0,
    ("E", "6"): 1_278_750_000.0,
    ("C", "2"): 1_561_098_000.0,
    ("C", "1"): 1_575_420_000.0,
    ("C", "5"): 1_176_450_000.0,
    ("C", "7"): 1_207_140_000.0,
    ("C", "8"): 1_191_795_000.0,
    ("C", "6"): 1_268_520_000.0,
}
"""Carrier by system and RINEX band (the first character of a signal): RINEX 3.05, table A23."""


@immutable()
class RawSignal:
    """Signal of one satellite. Range rate is positive while the distance grows.

    `sd_*` and `cno_db_hz` are the receiver's, None if it states none. A carrier with an unresolved
    half cycle is None. `lock_s` (s) is the least time of tracking by the receiver: infinite if it
    states none, or if its counter is full.
    """

    system: System
    prn: int
    signal: str
    pseudorange_m: float
    range_rate_m_s: float | None = None
    carrier_cycles: float | None = None
    cno_db_hz: float | None = None
    sd_pseudorange_m: float | None = None
    sd_range_rate_m_s: float | None = None
    lock_s: float = math.inf

    @property
    def satellite(self) -> str:
        """Name such as "C21"."""
        return f"{self.system}{self.prn:02d}"


SignalKey = tuple[System, int, str]
"""System, PRN and RINEX code of a signal."""
SIGNAL_VALUES = 7


class PackedSignals(Sequence[RawSignal]):
    """Signals of an epoch in one array; a `RawSignal` is made when it is asked for.

    `keys` (n,); `values` (n * 7): pseudorange (m), range rate (m/s), C/N0 (dB-Hz), their sigmas as
    the receiver states them (m, m/s), carrier (cycles), lock time (s), signal after signal; NaN is
    what the receiver does not say.
    """

    __slots__ = ("keys", "values")

    def __init__(self, keys: tuple[SignalKey, ...], values: array[float]) -> None:
        self.keys = keys
        self.values = values

    @classmethod
    def of(cls, signals: Sequence[RawSignal]) -> PackedSignals:
        """Pack single signals."""
        if isinstance(signals, PackedSignals):
            return signals
        values = array("d")
        for s in signals:
            said = (
                *(s.pseudorange_m, s.range_rate_m_s, s.cno_db_hz, s.sd_pseudorange_m),
                *(s.sd_range_rate_m_s, s.carrier_cycles, s.lock_s),
            )
            values.extend(math.nan if value is None else value for value in said)
        return cls(tuple((s.system, s.prn, s.signal) for s in signals), values)

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[RawSignal]:
        return map(self._signal, range(len(self.keys)))

    @overload
    def __getitem__(self, at: int) -> RawSignal: ...

    @overload
    def __getitem__(self, at: slice) -> tuple[RawSignal, ...]: ...

    def __getitem__(self, at: int | slice) -> RawSignal | tuple[RawSignal, ...]:
        found = range(len(self.keys))[at]
        return self._signal(found) if isinstance(found, int) else tuple(map(self._signal, found))

    def _signal(self, at: int) -> RawSignal:
        first = SIGNAL_VALUES * at
        pseudorange, *said, lock_s = self.values[first : first + SIGNAL_VALUES]
        rate, cno, sd, sd_rate, cycles = (None if math.isnan(v) else v for v in said)
        return RawSignal(*self.keys[at], pseudorange, rate, cycles, cno, sd, sd_rate, lock_s)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, PackedSignals):
            return self.keys == other.keys and self.values.tobytes() == other.values.tobytes()
        return tuple(self) == other

    def __hash__(self) -> int:
        return hash(self.keys)

    def __repr__(self) -> str:
        return repr(tuple(self))


@immutable()
class RawGnssEpoch:
    """Signals of one instant of the receiver's clock, which is GPS time `week`, `tow_s`.

    `stamp` is the same instant in UTC, if the receiver knows the leap seconds. `signals` become
    `PackedSignals`.
    """

    source: str
    t_seen_ns: int
    stamp: Stamp
    week: int
    tow_s: float
    signals: Sequence[RawSignal]
    clock_reset: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "signals", PackedSignals.of(self.signals))

    @property
    def packed(self) -> PackedSignals:
        """The signals in one array."""
        return PackedSignals.of(self.signals)


@immutable()
class Ephemeris:
    """Broadcast Keplerian ephemeris of one satellite (IS-GPS-200, BDS-SIS-ICD, Galileo OS SIS ICD).

    `week` with `toe_s` and `toc_s` in the system's own time. `group_delay_s`: GPS (TGD,),
    BeiDou (TGD1, TGD2) of D1 and D2, (T_GD B1C pilot, T_GD B2a pilot, ISC of the data component of
    B1C, or of B2a) of B-CNAV1, or B-CNAV2; Galileo (BGD E5a/E1, BGD E5b/E1). `message`: "lnav",
    "d1", "d2", "bcnav1", "bcnav2", "inav", "fnav". `healthy`: the satellite's own statement.
    `semi_major_rate` (m/s) and `mean_motion_rate` (rad/s^2) are B-CNAV's alone.
    """

    source: str
    t_seen_ns: int
    system: System
    prn: int
    message: str
    week: int
    toe_s: float
    toc_s: float
    sqrt_a: float
    eccentricity: float
    inclination: float
    ascending_node: float
    perigee: float
    mean_anomaly: float
    mean_motion_correction: float
    inclination_rate: float
    ascending_node_rate: float
    cuc: float
    cus: float
    crc: float
    crs: float
    cic: float
    cis: float
    clock_bias_s: float
    clock_drift: float
    clock_drift_rate: float
    group_delay_s: tuple[float, ...]
    issue: int
    accuracy_m: float | None
    healthy: bool
    semi_major_rate: float = 0.0
    mean_motion_rate: float = 0.0

    @property
    def satellite(self) -> str:
        """Name such as "C21"."""
        return f"{self.system}{self.prn:02d}"


@immutable()
class Klobuchar:
    """Ionosphere coefficients as broadcast: `alpha` s / semicircle^i, `beta` s / semicircle^i."""

    source: str
    t_seen_ns: int
    system: System
    alpha: tuple[float, float, float, float]
    beta: tuple[float, float, float, float]


@immutable()
class Bdgim:
    """Ionosphere of BeiDou-3 from B-CNAV: nine coefficients of spherical harmonics, in TECU (1e16
    electrons a square metre)."""

    source: str
    t_seen_ns: int
    alpha: tuple[float, float, float, float, float, float, float, float, float]


@immutable()
class SignalDelays:
    """Group delays of a GPS satellite from CNAV: T_GD (s) and, by signal, its inter-signal
    correction (s)."""

    source: str
    t_seen_ns: int
    system: System
    prn: int
    group_delay_s: float
    correction_s: tuple[tuple[str, float], ...]

    @property
    def satellite(self) -> str:
        """Name such as "G05"."""
        return f"{self.system}{self.prn:02d}"


CorrectionPart = Literal["orbit", "clock", "fast_clock", "bias", "accuracy"]


@immutable()
class Correction:
    """Correction of a satellite's ephemeris by a service (RTCM SSR).

    It is valid at GPS time `week`, `tow_s`, and updated every `interval_s`. Parts of one `solution`
    (provider, number, issue) belong together. `values`: of the orbit radial, along, across (m,
    broadcast minus true) and their rates (m/s); of the clock C0, C1, C2 (m, m/s, m/s^2, true minus
    broadcast), or what the fast one adds to C0; biases (m), added to the ranges of `signals`; the
    accuracy as one sigma of a range (m). `issue` is that of the ephemeris which an orbit part
    corrects: GPS's IODE, Galileo's IODnav, BeiDou's (toe / 8 s) modulo 1024; -1 for other parts.
    """

    source: str
    t_seen_ns: int
    system: System
    prn: int
    part: CorrectionPart
    week: int
    tow_s: float
    interval_s: float
    solution: tuple[int, int, int]
    issue: int
    values: tuple[float, ...]
    signals: tuple[str, ...] = ()

    @property
    def satellite(self) -> str:
        """Name such as "C21"."""
        return f"{self.system}{self.prn:02d}"


NavigationMessage = Ephemeris | Klobuchar | Bdgim | SignalDelays | Correction
"""Messages of orbits, clocks and the ionosphere: valid at no one instant."""
RawEvent = RawGnssEpoch | NavigationMessage
