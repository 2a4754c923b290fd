r"""Corrected pseudoranges and rates of an epoch with their variances.

    sigma^2(range) = (a m)^2 + b^2 10^((45 - C/N0) / 10) + s_rx^2 + s_sis^2 + s_d^2
                     + ionosphere left by carriers + (0.3 s_I)^2
    sigma^2(rate)  = (r m)^2 + s_rx^2
    common to all ranges: s_I n_1 + 0.12 m n_2 + s_2 n_3,   n ~ N(0, 1)

m = 1.001 / sqrt(0.002001 + sin^2 E) grows as 1 / sin E; a multipath at the zenith and b thermal
noise at 45 dB-Hz (m), s_rx what the receiver states, s_sis orbit and clock, s_d the group delay
left; r (m/s). If a receiver states none, C/N0 or s_rx is omitted.

s_I is the unknown part of the ionosphere: with one carrier half the modelled delay, or 5 m times m
without a model; with two the residual of `fusiond.gnss.range_kernel`. 0.12 m is the residual
troposphere, s_2 the receiver's delay of BeiDou-2 relative to BeiDou-3. These errors are not noise,
since a model is too strong or too weak for the whole sky and for hours. So each has its own column:
an unknown with unit variance (as in `fusiond.gnss.single_point`), or a state of a filter. 0.3 s_I
is the part that differs between satellites.

a and b are those of `RangeNoise` until satellites with two carriers have shown the receiver's own
(`fusiond.gnss.carrier_phase`).

Choice of a satellite's signals: `fusiond.gnss.signal_choice`.

Refusals of satellites, besides those of the plan: `weak_signal`, `low_elevation`, `multipath` (the
code has diverged from its carrier); of carriers, which then wait for a new anchor, `lock_lost`,
`cycle_slip`, and of all at once `clock_jump`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.raw.messages import SIGNAL_VALUES, RawGnssEpoch
from fusiond.gnss import carrier_phase as ca
from fusiond.gnss import range_kernel as rk
from fusiond.gnss.orbit import STATE_COLUMNS, WEEK_S
from fusiond.gnss.signal_choice import RangeNoise, RangeOptions, SignalChoice, SignalChooser
from fusiond.gnss.store import EphemerisStore

Array = npt.NDArray[np.float64]

__all__ = [
    "ChosenSignals",
    "RangeModel",
    "RangeNoise",
    "RangeOptions",
    "Rows",
    "TrackedSignals",
    "initial_carriers",
]

PLAN_HOLDS_S = 10.0
"""Time after which ephemerides are chosen again, and by which one may exceed its validity."""


class _Of:
    """Attribute that views values (n,) or (n, 3) of rows."""

    def __init__(self, which: int | slice) -> None:
        self._which = which

    def __get__(self, rows: Rows, _: type[Rows]) -> Array:
        found: Array = rows.values[self._which].T
        return found


@dataclass(slots=True, eq=False)
class Rows:
    """Usable data of an epoch, n rows; ECEF is the frame of the instant of reception.

    `pseudorange_m` and `rate_m_s` (n,) corrected, to range + clock offset of the receiver and its
    rate (NaN without a measured rate); `position` and `velocity` (n, 3) of the satellites;
    `line_of_sight` (n, 3) from receiver to satellite; `range_m` (n,) from the assumed receiver;
    `system` (n,) indices into `SYSTEMS`, `clock` (n,) into the systems in use; `measured_at` (n,)
    into the epoch's signals; `variance` and `rate_variance` (n,) of independent errors, `common`
    (n, 3) the effect of one sigma of each common error (ionosphere, troposphere, BeiDou-2),
    `total_variance` (n,) of both; `carrier_m` (n,) the carrier as a range plus a constant, NaN
    without one, tracked for `span_s` (n,); `troposphere_m` and `ionosphere_m` (n,) have been
    subtracted; `refused` pairs of satellite and reason. `lasting` (n,) m^2 the part of `variance`
    that lasts for many minutes. `values` (30, n) has all of these, as written by
    `range_kernel.range_rows`.
    """

    satellites: tuple[str, ...]
    signals: tuple[str, ...]
    system: npt.NDArray[np.intp]
    clock: npt.NDArray[np.int64]
    measured_at: npt.NDArray[np.intp]
    values: Array
    refused: tuple[tuple[str, str], ...]

    position = _Of(slice(rk.X, rk.X + 3))
    velocity = _Of(slice(rk.VX, rk.VX + 3))
    line_of_sight = _Of(slice(rk.LX, rk.LX + 3))
    pseudorange_m = _Of(rk.CORRECTED)
    rate_m_s = _Of(rk.CORRECTED_RATE)
    range_m = _Of(rk.RANGE)
    elevation_rad = _Of(rk.ELEVATION)
    variance = _Of(rk.VARIANCE)
    rate_variance = _Of(rk.RATE_VARIANCE)
    troposphere_m = _Of(rk.TROPOSPHERE)
    ionosphere_m = _Of(rk.IONOSPHERE)
    ionosphere_sigma_m = _Of(rk.COMMON)
    common = _Of(slice(rk.COMMON, rk.BEIDOU_2_SIGMA + 1))
    span_s = _Of(rk.CARRIER_SPAN)
    carrier_m = _Of(rk.CARRIER)
    total_variance = _Of(rk.TOTAL_VARIANCE)
    lasting = _Of(rk.LASTING)

    @property
    def azimuth_rad(self) -> Array:
        """Azimuth (n,) from north to east, 0 .. 2 pi."""
        found: Array = np.arctan2(self.values[rk.EAST], self.values[rk.NORTH]) % (2.0 * np.pi)
        return found

    def only(self, keep: npt.NDArray[np.bool_]) -> Rows:
        """Rows of the satellites marked in `keep` (n,)."""
        return Rows(
            tuple(compress(self.satellites, keep)),
            tuple(compress(self.signals, keep)),
            self.system[keep],
            self.clock[keep],
            self.measured_at[keep],
            self.values.compress(keep, axis=1),
            self.refused,
        )

    def without(self, satellites: Collection[str]) -> Rows:
        """Rows without the named satellites."""
        return self.only(np.array([s not in satellites for s in self.satellites], bool))


class ChosenSignals(NamedTuple):
    """Chosen signals of an epoch: (n, 7) as `measured`, and the `second` ones (n, 7), NaN if
    absent; `states` (n, 8) of the satellites as they sent the first."""

    plan: SignalChoice
    week: int
    tow_s: float
    measured: Array
    second: Array
    states: Array


class TrackedSignals(NamedTuple):
    """Chosen signals with the results of their carriers (n, 7).

    These parts do not depend on the receiver's position: the carriers' results by earlier epochs,
    the factors on the model's sigmas of codes, the carriers without a result, with the reason, and
    the codes (n,) that have diverged from their carriers (None: none)."""

    picked: ChosenSignals
    carriers: Array
    code_scale: float
    slips: tuple[tuple[str, str], ...]
    multipath: npt.NDArray[np.bool_] | None = None


def initial_carriers() -> Array:
    """State of the carriers before the first epoch."""
    return np.zeros((ca.SLOTS, ca.KEPT_COLUMNS))


class RangeModel:
    """Converter of epochs to rows, by the ephemerides of a store."""

    def __init__(self, store: EphemerisStore, options: RangeOptions | None = None) -> None:
        self.store = store
        self.options = options or RangeOptions()
        self._planner = SignalChooser(store, self.options)
        self._noise = self.options.noise.array()
        self._plan: SignalChoice | None = None
        self._kept = initial_carriers()

    def rows(self, epoch: RawGnssEpoch, receiver: Array) -> Rows:
        """Rows for a receiver at about (3,) ECEF m; an error of 100 m changes a correction by 1 cm.

        A receiver below the earth's surface is a first guess: then elevations are 90 deg and the
        atmosphere is neglected. Call it in the order of time.
        """
        return self.evaluate(self.followed(epoch), receiver)

    def followed(self, epoch: RawGnssEpoch) -> TrackedSignals:
        """Signals of an epoch, tracked from earlier ones."""
        return self.follow(self.pick(epoch), self._kept)

    def pick(self, epoch: RawGnssEpoch) -> ChosenSignals:
        """Choose the signals to use."""
        packed = epoch.packed
        now = epoch.week * WEEK_S + epoch.tow_s
        plan = self._plan
        if (
            plan is None
            or plan.version != self.store.version
            or abs(now - plan.gps_s) > PLAN_HOLDS_S
            or plan.keys != packed.keys
        ):
            self._plan = plan = self._planner.plan(epoch, now)
        n = len(plan.satellites)
        measured, second = np.empty((2, n, SIGNAL_VALUES))
        states = np.empty((n, STATE_COLUMNS))
        of = plan.measured_at, plan.second_at, plan.orbits.elements, float(epoch.week), epoch.tow_s
        rk.choose(np.frombuffer(packed.values), *of, measured, second, states)
        return ChosenSignals(plan, epoch.week, epoch.tow_s, measured, second, states)

    def follow(self, picked: ChosenSignals, kept: Array) -> TrackedSignals:
        """Update the state `kept` of earlier epochs by an epoch, in place."""
        plan = picked.plan
        carriers = np.empty((len(plan.satellites), ca.OUT_COLUMNS))
        refused = np.empty(len(plan.satellites), np.int64)
        now = picked.week * WEEK_S + picked.tow_s
        args = plan.followed, picked.measured, picked.second, now, carriers, refused
        found = ca.follow(kept, *args)
        scale = math.sqrt(ca.scale_squared(kept))
        slips: tuple[tuple[str, str], ...] = ()
        multipath = None
        if found & ca.SOME_REFUSED:
            slips = tuple(
                (plan.satellites[k], "lock_lost" if refused[k] == ca.LOCK_LOST else "cycle_slip")
                for k in np.flatnonzero((refused == ca.LOCK_LOST) | (refused == ca.CYCLE_SLIP))
            )
            multipath = refused == ca.MULTIPATH
        if found & ca.JUMPED:
            slips += (("", "clock_jump"),)
        return TrackedSignals(picked, carriers, scale, slips, multipath)

    def evaluate(self, followed: TrackedSignals, receiver: Array) -> Rows:
        """Rows of picked signals for a receiver at (3,) ECEF m."""
        picked, options = followed.picked, self.options
        plan = picked.plan
        out = np.empty((rk.ROW_COLUMNS, len(plan.satellites)))
        lost = rk.range_rows(
            picked.states,
            plan.fixed,
            picked.measured,
            followed.carriers,
            plan.ionosphere,
            float(picked.week),
            picked.tow_s,
            np.ascontiguousarray(receiver, float),
            self._noise,
            followed.code_scale,
            options.elevation_mask_rad,
            options.cno_mask_db_hz,
            out,
        )
        satellites, signals, refused = plan.satellites, plan.signals, plan.refused
        rows = Rows(satellites, signals, plan.system, plan.clock, plan.measured_at, out, refused)
        if not lost and followed.multipath is None:
            return rows
        weak = picked.measured[:, ca.CNO] < options.cno_mask_db_hz
        low = out[rk.ELEVATION] < options.elevation_mask_rad
        drop = weak | low
        if followed.multipath is not None:
            drop |= followed.multipath
        rows.refused += tuple(
            (
                satellites[k],
                "weak_signal" if weak[k] else "low_elevation" if low[k] else "multipath",
            )
            for k in np.flatnonzero(drop)
        )
        return rows.only(~drop)
