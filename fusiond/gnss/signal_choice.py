"""Cached choice of an epoch's signals, valid until signals or ephemerides change.

One signal of each satellite is used as range and carrier, a second one for its slant delay
(`fusiond.gnss.carrier_phase`). They are the pair, of all with known group delays, whose
ionosphere-free range has the smallest variance; without a pair the first available signal of
`PREFERRED` is used alone.

    variance = (gamma^2 (s^2 + s_a^2) + s^2 + s_b^2) / (gamma - 1)^2,   gamma = (f_a / f_b)^2

s is the sigma of a code, s_a and s_b are those of the group delays.

Refusals of satellites: `no_ephemeris`, `stale_ephemeris`, `unhealthy`, `no_group_delay` (for all
its signals, or all preferred ones), `no_correction` (in a system that uses a service's:
fusiond.gnss.corrections).
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.immutable import immutable
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    SYSTEMS,
    Ephemeris,
    RawGnssEpoch,
    RawSignal,
    SignalKey,
    System,
)
from fusiond.gnss import carrier_phase as ca
from fusiond.gnss import range_kernel as rk
from fusiond.gnss.bdgim import TERMS, bdgim_terms
from fusiond.gnss.corrections import CorrectedEphemeris
from fusiond.gnss.group_delay import GroupDelay
from fusiond.gnss.orbit import NOT_CORRECTED, Orbits
from fusiond.gnss.store import EphemerisStore

Array = npt.NDArray[np.float64]

PREFERRED: dict[System, tuple[str, ...]] = {
    "G": ("1C", "1W", "1P", "2W", "2L", "2S", "2X", "5Q", "5I", "5X"),
    "E": ("1C", "1B", "1X", "7Q", "7I", "7X", "5Q", "5I", "5X"),
    "C": ("2I", "2X", "6I", "6X", "1P", "1X", "1D", "5P", "5X", "5D", "7I", "7X"),
}
"""Signals that have a broadcast group delay, best known first."""

SIGNAL_IN_SPACE_M: dict[System, float] = {"G": 0.6, "E": 0.3, "C": 0.6}
"""Orbit and clock, global RMS: Montenbruck, Steigenberger, Hauschild, Advances in Space Research 61
(2018), 3020-3038: Galileo 0.2 m, GPS 0.6, BeiDou-2 1.0, all of 2017. Galileo's group delays are in
the 0.3 m. BeiDou-3, not whole then, has 0.5 m, mostly clocks: Initial assessment of BDS-3
preliminary system signal-in-space range error, GPS Solutions 24 (2020), doi
10.1007/s10291-019-0928-x."""
BEIDOU_2_IN_SPACE_M = 1.0
LAST_BEIDOU_2_PRN = 18
"""BDS-SIS-ICD-B1I-3.0 table 4-1: BeiDou-3 begins with 19 but for its GEO, from 59."""

GPS_IONO_HZ = CARRIER_HZ["G", "1"]
BEIDOU_IONO_HZ = CARRIER_HZ["C", "2"]
BAND_DELAY_M = 3.0
"""10 ns: what receivers delay one carrier more than another."""
LEAST_GAMMA = 1.3
"""Least (f_a / f_b)^2: closer carriers (B3I and B2a, 1.16; E1 and E6 have 1.52) amplify noise
tenfold, and receiver delays to metres."""


@immutable()
class RangeNoise:
    """Noise of ranges and rates: one sigma of each term.

    `multipath_m`: RTCA DO-229D J.2.4 has 0.13 + 0.53 exp(-E / 10 deg) m on an aircraft; a vehicle
    drives between walls. `thermal_m`: code tracking of a 1 Hz loop at 45 dB-Hz (Groves 9.3.3). With
    both and the receiver's own sigma the mean square residual of a walk with a hand-held antenna in
    the open is 0.19 of the expected one: conservative, because errors there last for minutes.
    `rate_m_s`: oscillator and moving antenna; the signal itself has 0.02 m/s at 45 dB-Hz.
    `ionosphere_share`: a Klobuchar model removes at least half (IS-GPS-200N 20.3.3.5.2.5); without
    a model 5 m at the zenith, as in middle latitudes on an afternoon with an active sun.
    """

    multipath_m: float = 0.5
    thermal_m: float = 0.3
    troposphere_m: float = 0.12
    ionosphere_share: float = 0.5
    ionosphere_unmodelled_m: float = 5.0
    ionosphere_local: float = 0.3
    rate_m_s: float = 0.05

    def array(self) -> Array:
        """Array for `range_kernel.range_rows`."""
        return np.array(
            (
                self.multipath_m,
                self.thermal_m,
                45.0,
                self.troposphere_m,
                self.ionosphere_share,
                self.ionosphere_unmodelled_m,
                self.ionosphere_local,
                self.rate_m_s,
            )
        )


@immutable()
class RangeOptions:
    """Masks and choices of ranges. `systems`: the systems to use."""

    systems: tuple[System, ...] = SYSTEMS
    elevation_mask_rad: float = np.radians(10.0)
    cno_mask_db_hz: float = 28.0
    preferred: dict[System, tuple[str, ...]] = field(default_factory=lambda: PREFERRED)
    noise: RangeNoise = RangeNoise()
    signal_in_space_m: dict[System, float] = field(default_factory=lambda: SIGNAL_IN_SPACE_M)


class SignalChoice(NamedTuple):
    """Cached choice of an epoch's signals, valid until signals or ephemerides change."""

    keys: tuple[SignalKey, ...]
    version: int
    gps_s: float
    followed: Array
    measured_at: npt.NDArray[np.int64]
    second_at: npt.NDArray[np.int64]
    """Second signals (n,) in the epoch, -1 without one."""
    satellites: tuple[str, ...]
    signals: tuple[str, ...]
    system: npt.NDArray[np.intp]
    clock: npt.NDArray[np.int64]
    orbits: Orbits
    fixed: Array
    ionosphere: Array
    refused: tuple[tuple[str, str], ...]


class _Served(NamedTuple):
    """Chosen signals of a satellite: for the range, and for the ionosphere; group (system,
    BeiDou-2, carrier); and the satellite's rows of the plan, without the group's."""

    at: int
    second: int | None
    ephemeris: Ephemeris
    group: tuple[System, bool, str]
    fixed: tuple[float, float, float, float]
    followed: tuple[float, float, float, float, float, float, float, float]
    corrected: tuple[float, ...]


class SignalChooser:
    """Factory of plans, by the ephemerides of a store."""

    def __init__(self, store: EphemerisStore, options: RangeOptions) -> None:
        self.store = store
        self.options = options

    def plan(self, epoch: RawGnssEpoch, now: float) -> SignalChoice:
        """Plan for an epoch at GPS time `now` (s)."""
        by_satellite: dict[tuple[System, int], dict[str, int]] = {}
        all_signals = tuple(epoch.signals)
        for k, s in enumerate(all_signals):
            if s.system in self.options.systems:
                by_satellite.setdefault((s.system, s.prn), {})[s.signal] = k
        chosen: list[_Served] = []
        refused: list[tuple[str, str]] = []
        corrected = self._corrected(epoch, by_satellite)
        for found in by_satellite.values():
            served = self._serve(epoch, all_signals, found, corrected)
            if isinstance(served, str):
                refused.append((all_signals[next(iter(found.values()))].satellite, served))
            else:
                chosen.append(served)
        signals = [all_signals[s.at] for s in chosen]
        seconds = [-1 if s.second is None else s.second for s in chosen]
        orbits = Orbits.of([s.ephemeris for s in chosen], [s.corrected for s in chosen])
        models = zlib.crc32(repr((self.store.ionosphere, self.store.bdgim)).encode())
        # What changes with orbit, clock or ionosphere, and so with a carrier's constant.
        issues = [zlib.crc32(row.tobytes(), models) for row in orbits.elements]
        return SignalChoice(
            epoch.packed.keys,
            self.store.version,
            now,
            np.array([s.followed for s in chosen], float).reshape(-1, ca.PLAN_COLUMNS),
            np.array([s.at for s in chosen], np.int64),
            np.array(seconds, np.int64),
            tuple(s.satellite for s in signals),
            tuple(s.signal for s in signals),
            np.array([SYSTEMS.index(s.system) for s in signals], np.intp),
            np.array([self.options.systems.index(s.system) for s in signals], np.int64),
            orbits,
            np.array(_fixed(chosen, issues), float).reshape(-1, rk.SIGNAL_COLUMNS),
            self._ionosphere(epoch),
            tuple(refused),
        )

    def _corrected(
        self, epoch: RawGnssEpoch, satellites: dict[tuple[System, int], dict[str, int]]
    ) -> dict[System, dict[int, CorrectedEphemeris]]:
        """Corrected satellites by system."""
        found: dict[System, dict[int, CorrectedEphemeris]] = {}
        if not self.store.corrections:
            return found
        for system in {system for system, _ in satellites}:
            numbers = [prn for s, prn in satellites if s == system]
            given = {
                prn: applied
                for prn in numbers
                if (applied := self.store.corrected(system, prn, epoch.week, epoch.tow_s))
            }
            if given and 2 * len(given) >= len(numbers):
                found[system] = given
        return found

    def _serve(
        self,
        epoch: RawGnssEpoch,
        signals: Sequence[RawSignal],
        found: dict[str, int],
        corrected: dict[System, dict[int, CorrectedEphemeris]],
    ) -> _Served | str:
        """Choose the signals of one satellite."""
        first = signals[next(iter(found.values()))]
        wanted = [found[name] for name in self.options.preferred[first.system] if name in found]
        outcome = "no_group_delay"
        candidates: list[tuple[int, Ephemeris, GroupDelay]] = []
        applied = None
        if first.system in corrected:
            applied = corrected[first.system].get(first.prn)
            wanted = [k for k in wanted if applied and signals[k].signal in applied.bias]
            if applied is None or not wanted:
                return "no_correction"
        for k in wanted or found.values():
            s = signals[k]
            if applied is not None:
                candidates.append((k, applied.ephemeris, _by_bias(applied, s.signal)))
                continue
            e = self.store.select(s.system, s.prn, epoch.week, epoch.tow_s, s.signal[0])
            if isinstance(e, str):
                outcome = e
            elif (delay := self.store.delay(e, s.signal)) is not None:
                candidates.append((k, e, delay))
        if not candidates:
            return outcome
        best: tuple[float, int, int, Ephemeris, GroupDelay, GroupDelay] | None = None
        for k, e, delay in candidates:
            for j in found.values():
                name = signals[j].signal
                other = self.store.delay(e, name)
                if applied is not None:
                    other = _by_bias(applied, name) if name in applied.bias else None
                if other is None:
                    continue
                gamma = _gamma(signals[k], signals[j])
                if gamma <= LEAST_GAMMA:
                    continue
                noise = ca.CODE_M**2
                a, b = noise + delay.sigma_m**2, noise + other.sigma_m**2
                variance = (gamma**2 * a + b) / (gamma - 1.0) ** 2
                if best is None or variance < best[0]:
                    best = variance, k, j, e, delay, other
        if best is None:
            k, e, delay = candidates[0]
            return self._served(signals, k, e, delay, None, None, applied)
        _, k, j, e, delay, other = best
        return self._served(signals, k, e, delay, j, other, applied)

    def _served(
        self,
        signals: Sequence[RawSignal],
        index: int,
        ephemeris: Ephemeris,
        delay: GroupDelay,
        second: int | None,
        other: GroupDelay | None,
        applied: CorrectedEphemeris | None,
    ) -> _Served:
        s = signals[index]
        model, scale = self._ionosphere_model(s)
        in_space = self.options.signal_in_space_m[s.system]
        beidou_2 = s.system == "C" and s.prn <= LAST_BEIDOU_2_PRN
        if beidou_2:
            in_space = max(in_space, BEIDOU_2_IN_SPACE_M)
        if applied is not None:
            in_space = applied.sigma_m
        variance = in_space**2 + delay.sigma_m**2
        delay_m = SPEED_OF_LIGHT_M_S * delay.delay_s
        slot = float(64 * SYSTEMS.index(s.system) + s.prn)
        length = SPEED_OF_LIGHT_M_S / CARRIER_HZ[s.system, s.signal[0]]
        first = float(_number(s.signal, ""))
        followed = (slot, length, 0.0, 0.0, 0.0, 0.0, 0.0, first)
        if second is not None and other is not None:
            b = signals[second]
            gamma = _gamma(s, b)
            followed = (
                slot,
                length,
                SPEED_OF_LIGHT_M_S / CARRIER_HZ[b.system, b.signal[0]],
                gamma,
                SPEED_OF_LIGHT_M_S * (other.delay_s - delay.delay_s),
                (delay.sigma_m**2 + other.sigma_m**2) / (gamma - 1.0) ** 2,
                float(_number(s.signal, b.signal)),
                first,
            )
        fixed = (delay_m, model, scale, variance)
        group = s.system, beidou_2, s.signal[0]
        columns = NOT_CORRECTED if applied is None else applied.columns
        return _Served(index, second, ephemeris, group, fixed, followed, columns)

    def _ionosphere_model(self, signal: RawSignal) -> tuple[float, float]:
        """Ionosphere model, with its scale to the signal's frequency: the system's own, else any
        received one. For BeiDou BDGIM is preferred, which covers the whole earth."""
        have = self.store.ionosphere
        carrier = CARRIER_HZ[signal.system, signal.signal[0]]
        if self.store.bdgim is not None and (signal.system == "C" or "G" not in have):
            return rk.BDGIM_MODEL, (GPS_IONO_HZ / carrier) ** 2
        if "C" in have and (signal.system == "C" or "G" not in have):
            return rk.BEIDOU_MODEL, (BEIDOU_IONO_HZ / carrier) ** 2
        if "G" in have:
            return rk.GPS_MODEL, (GPS_IONO_HZ / carrier) ** 2
        return rk.NO_MODEL, (GPS_IONO_HZ / carrier) ** 2

    def _ionosphere(self, epoch: RawGnssEpoch) -> Array:
        out = np.zeros((3, TERMS))
        if gps := self.store.ionosphere.get("G"):
            out[0, :8] = (*gps.alpha, *gps.beta)
        if beidou := self.store.ionosphere.get("C"):
            out[1, :8] = (*beidou.alpha, *beidou.beta)
        if self.store.bdgim is not None:
            out[2] = bdgim_terms(self.store.bdgim, epoch.week, epoch.tow_s)
        return out


def _by_bias(applied: CorrectedEphemeris, signal: str) -> GroupDelay:
    """Group delay equivalent to a bias, which is added to the range."""
    return GroupDelay(-applied.bias[signal] / SPEED_OF_LIGHT_M_S)


def _fixed(chosen: Sequence[_Served], issues: Sequence[int]) -> list[tuple[float, ...]]:
    """Rows of the plan with the numbers of their groups. If satellites with two carriers determine
    the clock, it includes the receiver's delay between the carriers; a satellite with a single
    other carrier does not share that delay."""
    numbers: dict[tuple[System, bool, str], int] = {}
    paired: dict[tuple[System, bool], set[str]] = {}
    for s in chosen:
        numbers.setdefault(s.group, len(numbers))
        if s.second is not None:
            paired.setdefault(s.group[:2], set()).add(s.group[2])
    rows: list[tuple[float, ...]] = []
    for s, issue in zip(chosen, issues, strict=True):
        delay, model, scale, variance = s.fixed
        settled = paired.get(s.group[:2])
        if settled and s.group[2] not in settled:
            variance += BAND_DELAY_M**2
        own = numbers[s.group], s.group[1], s.followed[ca.SLOT], issue
        rows.append((delay, model, scale, variance, *own))
    return rows


def _gamma(a: RawSignal, b: RawSignal) -> float:
    """(f_a / f_b)^2."""
    hertz = (CARRIER_HZ[s.system, s.signal[0]] for s in (a, b))
    return float(next(hertz) / next(hertz)) ** 2


def _number(a: str, b: str) -> int:
    """Number, above 0, of a pair of signals."""
    return int.from_bytes((a + b).encode("ascii"))
