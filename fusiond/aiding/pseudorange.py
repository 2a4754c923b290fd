r"""Ranges and range rates to satellites: raw GNSS, and the slant ranges of a double-star system.

With a = C l the lever arm and b = C (w x l) its velocity in NED axes, s and s' the satellite's
ECEF position and velocity, u the unit vector from the antenna to it, c_k and d the clock's offset
and drift as a range:

    rho^ = |s - p^ - a| + c_k^,     rate^ = u . (s' - v^ - b) + d^
    z_rho  = rho^ - rho   = -u . dr + (a x u) . phi - dc_k + v
    z_rate = rate^ - rate = -u . dv + (b x u + g x a) . phi + (C^T u x l) . e - dd
             + (g + turn) . dr + v
    g = -(I - u u^T)(s' - v - b) / |s - p - a|

An error that all ranges share for many minutes may be a state of the model (blocks of
`RANGE_BIAS`): a displacement t of the antenna for orbit errors, multipath and, downwards, the
residual ionosphere:

    rho^ = |s - p^ - a - K t^| + c_k^,    z_rho += u . K dt    (dt true minus estimated)

with K (3, 3), `shape`, by the sky's geometry (fusiond.gnss.range_error_displacement); if the sky
has changed, t is renewed in part (`renewal`).

Other errors that all ranges share are states of unit variance n (blocks of `RANGE_SHARED`: residual
ionosphere and troposphere, BeiDou-2's offset), with S the effect of one sigma of each on each
range:

    rho^ += S n^,    z_rho -= S dn;    without these blocks S S^T goes to the noise, by row

A carrier tracked since an anchor epoch replaces the Doppler: it measures the path since then
(fusiond.aiding.carrier_anchor), with states for a clone of the antenna's position at the anchor and
for the carriers' clock. At the anchor itself Dopplers are used.

`turn` is the turning of the NED axes with the position, which turns v + b. s and s' are those at
transmission, turned into the Earth's axes at reception: then the Earth's rotation needs no further
term in the rate either, for u . (w_ie x u) = 0. Satellite clock, group delay and atmosphere have
been subtracted. Neglected are the change of the flight time in the rate, under 3 mm/s, and the
Earth's own rate times the lever. dc_k and dd are true minus estimated, as all parameters.

A double-star system's two path lengths L1 = 2 rho_1, L2 = rho_1 + rho_2 (fusiond.aiding.
rdss_fix_covariance) are two ranges without a clock: rho_1 = L1 / 2 and rho_2 = L2 - L1 / 2 have
independent errors.

Source: Groves, 2nd ed., eq. 14.114 to 14.128 and 9.165.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.immutable import immutable
from fusiond.aiding.base import (
    AidingMeasurement,
    Innovation,
    NotApplicable,
    Renewal,
    State,
    Vector3,
    level_arm_m,
)
from fusiond.aiding.carrier_anchor import (
    AHEAD,
    BASIC,
    CARRIER,
    COLUMNS,
    RANGE,
    RANGE_VARIANCE,
    RATE,
    RATE_VARIANCE,
    SHARED,
    SLOTS,
    SPAN,
    VALUES,
    VX,
    X,
    anchored,
)
from fusiond.aiding.carrier_anchor_noise import ANCHORED, OF_ANCHOR, WALKED, leave
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.range_rows import SOUND, WRONG, by_clock, measured, range_rows
from fusiond.aiding.velocity import CORNER_RAD_S
from fusiond.models.blocks import CARRIER_ANCHOR, CARRIER_CLOCK, CLOCK_DRIFT, CLOCK_OFFSET

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

RANGE_BIAS = ("range_bias", "range_bias_down")
"""Blocks of the displacement: north and east, down."""
RANGE_SHARED = ("range_ionosphere", "range_troposphere", "range_beidou_2")
"""Blocks of one state each for model residuals shared by all ranges."""
_CLONED = (CARRIER_ANCHOR, CARRIER_CLOCK)
_BLOCKS = (
    *((CLOCK_OFFSET,), (CLOCK_DRIFT,), RANGE_BIAS, RANGE_SHARED),
    *((CARRIER_ANCHOR,), (CARRIER_CLOCK,)),
)
_NOTHING_KEPT, _ALL_KEPT = np.zeros((4, 4)), np.eye(4)
NO_CLOCK = -1
"""Index of a range without a receiver clock offset."""


def epoch_values(position: ArrayLike, velocity: ArrayLike, *rows: ArrayLike) -> Array:
    """Values (19, n) of an epoch of n satellites: positions, velocities (n, 3), and as `rows` (n,)
    ranges, rates, and their variances; no shared errors, no carriers. ValueError for other shapes.
    """
    parts = [np.asarray(part, float).T for part in (position, velocity, *rows)]
    if any(part.shape[-1:] != parts[-1].shape for part in parts):
        raise ValueError(f"shapes differ: {[part.T.shape for part in parts]}")
    basic = np.vstack(parts)
    values = np.vstack([basic, np.zeros((VALUES - BASIC, basic.shape[1]))])
    values[CARRIER] = np.nan
    return values


def nothing_left() -> Array:
    """(SLOTS, 9): no epoch before."""
    return np.zeros((SLOTS, COLUMNS))


@immutable(eq=False)
class PseudorangeMeasurement(AidingMeasurement):
    """Ranges and rates of one epoch to n satellites, corrected for all but geometry and clock.

    `values` (19, n) has as its rows `position` and `velocity` (three each, ECEF at transmission,
    turned to the axes at reception, m, m/s), `ranges` (m), `rates` (m/s; positive: going away) and
    their variances (m^2, (m/s)^2), the effect of one sigma of each of three shared errors (m), and
    of the carrier: seconds of tracking since the epoch before (0: none), its range up to a constant
    (m), its variance (m^2), its walk beside the models (m/sqrt(s)), the satellite's slot and its
    ephemeris' number; NaN is not measured. `before` and `left` (SLOTS, 9): output of the last epoch
    and of this one (fusiond.aiding.carrier_anchor). `clock` (n,): index of each range's state in
    the model's block `clock_offset`, or NO_CLOCK; a rate of a satellite with NO_CLOCK has no drift
    either. `lever` (m, body axes) of the antenna. `clock_reset`: the receiver has set its clock, of
    which `t_ns` is `ahead_s` (s; any constant in it says nothing). `shape` (3, 3): K; `kept`: R and
    cov(w) (3, 3) of the renewal of t since the epoch before, None without; `seen`, an empty list,
    receives z and u P u^T of the ranges before the update. Rows: the finite ranges in order, then
    the finite rates (`labels`).

    ValueError for shapes that do not fit, a value without a positive variance, or, with rates,
    satellites with and without a clock.
    """

    screened: ClassVar[bool] = True
    locates: ClassVar[bool] = True

    satellites: tuple[str, ...]
    values: Array
    clock: Indices
    lever: Vector3 = (0.0, 0.0, 0.0)
    clock_reset: bool = False
    ahead_s: float = 0.0
    before: Array = field(default_factory=nothing_left, repr=False)
    left: Array = field(default_factory=nothing_left, repr=False)
    shape: Array = field(default_factory=lambda: np.eye(3), repr=False)
    kept: tuple[Array, Array] | None = field(default=None, repr=False)
    seen: list[tuple[Array, Array]] | None = field(default=None, repr=False)
    _r: Array = field(init=False, repr=False)
    _ranges: int = field(init=False, repr=False)
    _clocks: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.satellites)
        if self.values.shape != (VALUES, n) or self.clock.shape != (n,):
            raise ValueError(f"shapes {self.values.shape} and {self.clock.shape} of {n} satellites")
        r = np.empty(2 * n)
        ranges, rates, clocks, wrong = measured(self.values, self.clock, r)
        if wrong != SOUND:
            raise ValueError(WRONG[wrong])
        object.__setattr__(self, "_r", r[: ranges + rates])
        object.__setattr__(self, "_ranges", ranges)
        object.__setattr__(self, "_clocks", clocks)

    @property
    def remembers(self) -> bool:
        return bool(self._anchored().any())

    def _anchored(self) -> NDArray[np.bool_]:
        """Carriers (n,) that have been followed since the anchor."""
        n = len(self.satellites)
        return np.fromiter((anchored(self.values, k, self.before) for k in range(n)), bool, n)

    @property
    def renewal(self) -> Renewal | None:
        return None if self.kept is None else Renewal(RANGE_BIAS, *self.kept)

    @property
    def position(self) -> Array:
        """(n, 3), m."""
        return self.values[X:VX].T

    @property
    def velocity(self) -> Array:
        """(n, 3), m/s."""
        return self.values[VX:RANGE].T

    @property
    def ranges(self) -> Array:
        """Ranges (n,), m."""
        return self.values[RANGE, :]

    @property
    def rates(self) -> Array:
        """(n,), m/s."""
        return self.values[RATE, :]

    @property
    def range_variance(self) -> Array:
        """(n,), m^2."""
        return self.values[RANGE_VARIANCE, :]

    @property
    def total_variance(self) -> Array:
        """Variances (n,) of ranges with shared errors, m^2."""
        found: Array = self.range_variance + (self.values[SHARED:SPAN] ** 2).sum(axis=0)
        return found

    @property
    def rate_variance(self) -> Array:
        """(n,), (m/s)^2."""
        return self.values[RATE_VARIANCE, :]

    @property
    def labels(self) -> list[tuple[str, str]]:
        """Satellite and `range`, `rate` or `carrier` of each row, in a filter with the clone."""
        spans, by_carrier = (self.values[SPAN] > 0.0).tolist(), self._anchored().tolist()
        found = [
            (name, "range")
            for name, value in zip(self.satellites, self.ranges.tolist(), strict=True)
            if math.isfinite(value)
        ]
        return found + [
            (name, "carrier" if carrier else "rate")
            for name, value, span, carrier in zip(
                self.satellites, self.rates.tolist(), spans, by_carrier, strict=True
            )
            if span or math.isfinite(value)
        ]

    def only(self, keep: Sequence[bool] | NDArray[np.bool_]) -> PseudorangeMeasurement:
        """The epoch with the satellites marked in `keep` (n,) alone."""
        mask = np.asarray(keep, dtype=bool)
        return PseudorangeMeasurement(
            self.source,
            self.t_ns,
            self.gate,
            tuple(s for s, k in zip(self.satellites, mask, strict=True) if k),
            self.values.compress(mask, axis=1),
            self.clock[mask],
            self.lever,
            self.clock_reset,
            self.ahead_s,
            self.before,
            self.left,
            self.shape,
            self.kept,
        )

    def without_attitude(self, way: HeadingHistory) -> PseudorangeMeasurement:
        """Copy with Doppler rates only, as without an attitude no position is cloned."""
        values, arm = self.values.copy(), level_arm_m(self.lever)
        values[RANGE_VARIANCE] += arm**2
        values[RATE_VARIANCE] += (CORNER_RAD_S * arm) ** 2
        values[SPAN], values[CARRIER] = 0.0, np.nan
        lever, nothing = (0.0, 0.0, self.lever[2]), nothing_left()
        return replace(self, values=values, lever=lever, before=nothing, left=nothing)

    def series(self, whitened: Sequence[float], codes: Sequence[int]) -> dict[str, Array]:
        """Innovations (2,) for each satellite system with a clock, by its letter: the sums of the
        whitened range and rate innovations over the root of their number.

        White innovations give N(0, 1) whatever the number of satellites, so that epochs of any sky
        form one series. A system without a range or without a rate in the epoch has none.
        """
        sums, first = np.empty((self._clocks, 2)), np.empty(self._clocks, dtype=np.int64)
        of_rows, y = np.frombuffer(bytearray(codes), np.uint8), np.frombuffer(array("d", whitened))
        found = by_clock(self.values, self.clock, of_rows, y, sums, first)
        firsts = first[:found].tolist()
        return {self.satellites[at][0]: sums[k] for k, at in enumerate(firsts)}

    def innovation(self, state: State) -> Innovation | NotApplicable:
        model = state.model
        if not self._r.size:
            return NotApplicable("no_satellites")
        clocks = self._clocks
        offsets, drifts, displacement, shared, anchor, carrier = model.slots_of_each(*_BLOCKS)
        if clocks > offsets.size or (clocks and not drifts.size):
            return NotApplicable("no_clock_state")
        rows = self._r.size
        z, r, h = np.empty(rows), np.empty(rows), np.zeros((rows, model.size))
        range_rows(
            state.nav,
            state.xi,
            state.step,
            model.column_of,
            model.active,
            self.values,
            self.clock,
            offsets,
            drifts,
            displacement,
            shared,
            anchor,
            carrier,
            self.shape,
            *self.lever,
            self._ranges,
            # A clock that was set says nothing of the time since the anchor.
            float(self.before[0, AHEAD]) if self.clock_reset else self.ahead_s,
            self.before,
            r,
            z,
            h,
        )
        if self.seen == [] and state.covariance is not None:
            sight = h[: self._ranges, 6:9]
            place = np.einsum("ij,jk,ik->i", sight, state.covariance[6:9, 6:9], sight)
            self.seen.append((z[: self._ranges].copy(), place))
        return Innovation(z, h, r)

    def leaves(self, state: State, codes: Sequence[int]) -> Renewal | None:
        slots = state.model.slots_of_all(_CLONED)
        if len(slots) != len(_NOTHING_KEPT):
            return None
        of_rows, anchor = np.frombuffer(bytearray(codes), np.uint8), state.xi[slots[:3]]
        epoch = np.array((self.t_ns * 1e-9, self.ahead_s, self.clock_reset, *self.lever), float)
        of_navigation, found = np.zeros((4, 9)), np.empty((5, 4))
        of = epoch, state.nav, anchor, self.before, self.left
        result = leave(self.values, of_rows, self._ranges, *of, of_navigation, found)
        noise, place = found[:4], found[4]
        if result == ANCHORED:
            return Renewal(_CLONED, _NOTHING_KEPT, noise, of_navigation, place)
        if result == WALKED:
            # Antenna of the place: its transpose takes an error in ECEF back to north, east, down.
            of_place, shared = np.zeros((9, 4)), np.zeros((4, 4))
            of_place[6:9, :3] = of_navigation[:3, 6:9].T
            shared[:3, :3] = (1.0 - OF_ANCHOR) * noise[:3, :3]
            noise *= OF_ANCHOR
            return Renewal(_CLONED, _ALL_KEPT, noise, with_navigation=(of_place, shared))
        return None
