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
`RANGE_BIAS`): a displacement t of the antenna that stands for orbit errors, multipath and,
downwards, the ionosphere that is left:

    rho^ = |s - p^ - a - k t^| + c_k^,    z_rho += k u . dt    (dt true minus estimated)

with k = sqrt(8 / n) of n satellites: errors of many average, t is that of eight.

Other errors that all ranges share are states of unit variance n (blocks of `RANGE_SHARED`: what the
models of ionosphere and troposphere leave, BeiDou-2's offset), with what one sigma of each adds to
each range, S:

    rho^ += S n^,    z_rho -= S dn;    without these blocks S S^T goes to the noise, by row

The carrier of a satellite, from epoch to epoch, gives its mean rate over the last dt, which takes
the Doppler's place. With q = s' - v~, v~ the antenna's mean velocity over dt, and its own clock m
(block `CARRIER_CLOCK`: phases walk by more than the drift's mean, the same for all satellites)

    rate^ = u . q - (dt / 2) (u . s'' + (|q|^2 - (u . q)^2) / rho) + d^ + m^,
    z = -u . dv + (y x u) . phi + (dt / 2) (C^T u) . f + .. - dd - dm + v
    v~ = v - w + (m - m') / dt + (a - a') / dt,     y = v~ - v + (0, 0, g dt / 2)

w is how much the IMU alone has changed the velocity since the start, m its integral, primes those
at the epoch before: so feedback in between, which moves v, leaves the difference alone. y is what
of v~ - v turns with the attitude, f the force error of the accelerometers, even over dt.

`turn` is the turning of the NED axes with the position, which turns v + b. s and s' are those at
transmission, turned into the Earth's axes at reception: then the Earth's rotation needs no further
term in the rate either, for u . (w_ie x u) = 0. All else (satellite clock, group delay, atmosphere)
has been taken off. Left out: the change of the flight time in the rate, under 3 mm/s, and the
Earth's own rate times the lever. dc_k and dd are true minus estimated, as all parameters.

A double-star system's two path lengths L1 = 2 rho_1, L2 = rho_1 + rho_2 (fusiond.aiding.
rdss_geometry) are two ranges without a clock: rho_1 = L1 / 2 and rho_2 = L2 - L1 / 2 have
independent errors.

Source: Groves, 2nd ed., eq. 14.114 to 14.128 and 9.165.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.immutable import immutable
from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.models.blocks import CLOCK_DRIFT, CLOCK_OFFSET
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M, gravity
from fusiond.navigation.error_model import CORE_SIZE, FORCE_ERROR, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    LON,
    Q0,
    STEP_CHANGED_N,
    STEP_MOVED_N,
    STEP_RATE_B,
    STEP_SECONDS,
    VN,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

RANGE_BIAS = ("range_bias", "range_bias_down")
"""Blocks of the displacement: north and east, down."""
RANGE_SHARED = ("range_ionosphere", "range_troposphere", "range_beidou_2")
"""Blocks, of one state each, of what the models leave in all ranges."""
CARRIER_CLOCK = "carrier_clock"
DISPLACED_BY = 8.0
"""Satellites, of which a displacement is as large as its block says."""
UNUSED_VARIANCE = 1e6
"""(m/s)^2, of a rate that only a carrier gives and nothing is known of the epoch before."""
SAME_SPAN_S = 1e-3
"""The IMU's time since the epoch before is that between the epochs, or it is of another start. A
microsecond's rounding is less, an IMU's sample more."""
_BLOCKS = ((CLOCK_OFFSET,), (CLOCK_DRIFT,), RANGE_BIAS, RANGE_SHARED, (CARRIER_CLOCK,))
NO_CLOCK = -1
"""In place of a clock offset: the range knows no receiver clock."""

# Rows of an epoch's values.
_BASIC, _VALUES = 10, 17
_X, _VX, _RANGE, _RATE, _RANGE_VARIANCE, _RATE_VARIANCE, _SHARED = 0, 3, 6, 7, 8, 9, 10
_SPAN, _CARRIER_RATE, _CARRIER_VARIANCE, _PULL = 13, 14, 15, 16
# What an epoch leaves to the next: seconds, changed velocity, its integral, the lever arm (NED).
_LEFT = 10


@compiled("void(b1[::1], f8[::1])", forceinline=True)
def _hold(active: NDArray[np.bool_], g: Array) -> None:
    """Nothing is told of navigation errors that are not estimated: zero in the row `g` (n,)."""
    for j in range(CORE_SIZE):
        if not active[j]:
            g[j] = 0.0


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], b1[::1], f8[:, ::1], i8[::1], i8[::1], i8[::1],"
    "i8[::1], i8[::1], i8[::1], f8, f8, f8, i8, f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1])"
)
def _rows(
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    active: NDArray[np.bool_],
    values: Array,
    clock: Indices,
    offsets: Indices,
    drifts: Indices,
    displacement: Indices,
    shared: Indices,
    carrier: Indices,
    l0: float,
    l1: float,
    l2: float,
    rate_row: int,
    before: Array,
    left: Array,
    r: Array,
    z: Array,
    h: Array,
) -> None:
    """Write z (m,), r (m,) and H (m, n), zero before: rows of the finite ranges, then of the rates,
    of which `rate_row` is the first.

    Slots of the clocks' offsets, of their drift, of the displacement, of other shared errors and of
    the carriers' clock; none where the model has no such state. `before` and `left` (10,): what the
    last epoch left and this one leaves; of 0 s where there is nothing.
    """
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = dcm_elements(nav[Q0:])
    a0 = c00 * l0 + c01 * l1 + c02 * l2
    a1 = c10 * l0 + c11 * l1 + c12 * l2
    a2 = c20 * l0 + c21 * l1 + c22 * l2
    w0, w1, w2 = step[STEP_RATE_B], step[STEP_RATE_B + 1], step[STEP_RATE_B + 2]
    t0, t1, t2 = w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0
    b0 = c00 * t0 + c01 * t1 + c02 * t2
    b1 = c10 * t0 + c11 * t1 + c12 * t2
    b2 = c20 * t0 + c21 * t1 + c22 * t2
    v0, v1, v2 = nav[VN] + b0, nav[VN + 1] + b1, nav[VN + 2] + b2
    left[0] = step[STEP_SECONDS]
    for j in range(3):
        left[1 + j], left[4 + j] = step[STEP_CHANGED_N + j], step[STEP_MOVED_N + j]
    left[7], left[8], left[9] = a0, a1, a2
    weight = gravity(nav[LAT], nav[HEIGHT])
    gone = left[0] - before[0] if before[0] > 0.0 else 0.0
    sl, cl = math.sin(nav[LAT]), math.cos(nav[LAT])
    so, co = math.sin(nav[LON]), math.cos(nav[LON])
    root = math.sqrt(1.0 - ECCENTRICITY_SQUARED * sl * sl)
    transverse, height = SEMI_MAJOR_M / root, nav[HEIGHT]
    radius_n = transverse + height
    radius_m = transverse * (1.0 - ECCENTRICITY_SQUARED) / (root * root) + height
    x, y = radius_n * cl * co, radius_n * cl * so
    zed = (transverse * (1.0 - ECCENTRICITY_SQUARED) + height) * sl

    begin = end = CORE_SIZE
    for slot in range(column_of.shape[0] - 1, CORE_SIZE - 1, -1):
        if 0 <= column_of[slot] - RATE_ERROR < 3:
            begin, end = slot, max(end, slot + 1)

    there = 0
    for i in range(clock.shape[0]):
        there += math.isfinite(values[_RANGE, i])
    several = math.sqrt(DISPLACED_BY / max(there, 1))

    range_row = 0
    for i in range(clock.shape[0]):
        # From the antenna to the satellite, north, east, down.
        e0, e1, e2 = values[_X, i] - x, values[_X + 1, i] - y, values[_X + 2, i] - zed
        m0 = -sl * co * e0 - sl * so * e1 + cl * e2 - a0
        m1 = -so * e0 + co * e1 - a1
        m2 = -cl * co * e0 - cl * so * e1 - sl * e2 - a2
        distance = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        u0, u1, u2 = m0 / distance, m1 / distance, m2 / distance
        if math.isfinite(values[_RANGE, i]):
            g = h[range_row]
            innovation = distance - values[_RANGE, i]
            g[0], g[1], g[2] = a1 * u2 - a2 * u1, a2 * u0 - a0 * u2, a0 * u1 - a1 * u0
            g[6], g[7], g[8] = -u0, -u1, -u2
            if clock[i] >= 0:
                slot = offsets[clock[i]]
                innovation += xi[slot]
                g[slot] = -1.0
            _hold(active, g)
            for axis in range(displacement.shape[0]):
                g[displacement[axis]] = -several * g[6 + axis]
                innovation -= g[displacement[axis]] * xi[displacement[axis]]
            r[range_row] = values[_RANGE_VARIANCE, i]
            for k in range(3):
                one = values[_SHARED + k, i]
                if shared.shape[0] == 3:
                    g[shared[k]] = -one
                    innovation += one * xi[shared[k]]
                else:
                    r[range_row] += one * one
            z[range_row] = innovation
            range_row += 1
        span = values[_SPAN, i]
        if math.isfinite(values[_RATE, i]) or span > 0.0:
            g = h[rate_row]
            e0, e1, e2 = values[_VX, i], values[_VX + 1, i], values[_VX + 2, i]
            q0 = -sl * co * e0 - sl * so * e1 + cl * e2 - v0
            q1 = -so * e0 + co * e1 - v1
            q2 = -cl * co * e0 - cl * so * e1 - sl * e2 - v2
            d0, d1, d2 = b0, b1, b2
            known = carrier.shape[0] == 1 and span > 0.0 and abs(gone - span) < SAME_SPAN_S
            if known:
                k0 = left[1] - (left[4] - before[4]) / span + b0 - (a0 - before[7]) / span
                k1 = left[2] - (left[5] - before[5]) / span + b1 - (a1 - before[8]) / span
                k2 = left[3] - (left[6] - before[6]) / span + b2 - (a2 - before[9]) / span
                q0, q1, q2 = q0 + k0, q1 + k1, q2 + k2
                # What turns with the attitude of v~: b in it, less what the force has changed.
                d0, d1, d2 = b0 - k0, b1 - k1, b2 - k2 + 0.5 * weight * span
            along = u0 * q0 + u1 * q1 + u2 * q2
            if known:
                bend = values[_PULL, i] + (q0 * q0 + q1 * q1 + q2 * q2 - along * along) / distance
                innovation = along - 0.5 * span * bend - values[_CARRIER_RATE, i]
                innovation += xi[carrier[0]]
                g[carrier[0]] = -1.0
                r[rate_row] = values[_CARRIER_VARIANCE, i]
            elif math.isfinite(values[_RATE, i]):
                innovation = along - values[_RATE, i]
                r[rate_row] = values[_RATE_VARIANCE, i]
            else:
                innovation = 0.0
                r[rate_row] = UNUSED_VARIANCE
            k0 = (along * u0 - q0) / distance
            k1 = (along * u1 - q1) / distance
            k2 = (along * u2 - q2) / distance
            g[0] = d1 * u2 - d2 * u1 + k1 * a2 - k2 * a1
            g[1] = d2 * u0 - d0 * u2 + k2 * a0 - k0 * a2
            g[2] = d0 * u1 - d1 * u0 + k0 * a1 - k1 * a0
            g[3], g[4], g[5] = -u0, -u1, -u2
            # The axes turn by [dr_e, -dr_n R_N / R_M, -dr_e tan(lat)] / R_N.
            p0, p1, p2 = v1 * u2 - v2 * u1, v2 * u0 - v0 * u2, v0 * u1 - v1 * u0
            g[6] = k0 + p1 / radius_m
            g[7] = k1 + (p2 * sl / cl - p0) / radius_n
            g[8] = k2
            # C^T u x l, by axis.
            n0 = c00 * u0 + c10 * u1 + c20 * u2
            n1 = c01 * u0 + c11 * u1 + c21 * u2
            n2 = c02 * u0 + c12 * u1 + c22 * u2
            for slot in range(begin, end):
                axis = column_of[slot] - RATE_ERROR
                if axis == 0:
                    g[slot] = n1 * l2 - n2 * l1
                elif axis == 1:
                    g[slot] = n2 * l0 - n0 * l2
                elif axis == 2:
                    g[slot] = n0 * l1 - n1 * l0
            if known:
                for slot in range(CORE_SIZE, column_of.shape[0]):
                    axis = column_of[slot] - FORCE_ERROR
                    if 0 <= axis < 3:
                        g[slot] = 0.5 * span * (n0 if axis == 0 else n1 if axis == 1 else n2)
            if clock[i] >= 0:
                innovation += xi[drifts[0]]
                g[drifts[0]] = -1.0
            _hold(active, g)
            z[rate_row] = innovation
            rate_row += 1


# What is wrong with the values of an epoch.
_SOUND, _VARIANCES, _CLOCKS = 0, 1, 2
_WRONG = {
    _VARIANCES: "variances must be positive and finite",
    _CLOCKS: "rates of satellites with and without a clock in one epoch",
}


@compiled("UniTuple(i8, 4)(f8[:, ::1], i8[::1], f8[::1])")
def _measured(values: Array, clock: Indices, r: Array) -> tuple[int, int, int, int]:
    """Write the variances of the finite ranges and then of the finite rates to r (2 n,); how many
    ranges and rates those are, how many clocks they have, and what is wrong with them."""
    n = clock.shape[0]
    row = finite = timed = clocks = 0
    wrong = _SOUND
    for i in range(n):
        clocks = max(clocks, clock[i] + 1)
        if math.isfinite(values[_RANGE, i]):
            r[row] = values[_RANGE_VARIANCE, i]
            row += 1
    finite = row
    for i in range(n):
        if math.isfinite(values[_RATE, i]) or values[_SPAN, i] > 0.0:
            r[row] = values[_RATE_VARIANCE, i]
            if values[_SPAN, i] > 0.0:
                r[row] = values[_CARRIER_VARIANCE, i]
            row += 1
            timed += clock[i] >= 0
    if 0 < timed < row - finite:
        wrong = _CLOCKS
    for a in range(row):
        if not 0.0 < r[a] < math.inf:
            wrong = _VARIANCES
    return finite, row - finite, clocks, wrong


@compiled("i8(f8[:, ::1], i8[::1], b1[::1], f8[::1], f8[:, ::1], i8[::1])")
def _by_clock(
    values: Array,
    clock: Indices,
    kept: NDArray[np.bool_],
    whitened: Array,
    sums: Array,
    first: Indices,
) -> int:
    """Write to `sums` (k, 2), for each clock that has both, the sum of what is `whitened` and
    `kept` (m,) of its ranges and that of its rates, each over the root of its number; to `first`
    (k,) the clocks' first satellites, by which they are ordered. How many clocks that are."""
    found = 0
    for i in range(clock.shape[0]):
        new = clock[i] >= 0
        for k in range(i):
            new &= clock[k] != clock[i]
        if not new:
            continue
        row, whole = 0, True
        for kind in range(2):
            total, count = 0.0, 0
            for k in range(clock.shape[0]):
                if math.isfinite(values[_RANGE + kind, k]) or (
                    kind == 1 and values[_SPAN, k] > 0.0
                ):
                    if kept[row] and clock[k] == clock[i]:
                        total += whitened[row]
                        count += 1
                    row += 1
            sums[found, kind] = total / math.sqrt(max(count, 1))
            whole &= count > 0
        first[found] = i
        found += whole
    return found


def epoch_values(position: ArrayLike, velocity: ArrayLike, *rows: ArrayLike) -> Array:
    """The values of an epoch of n satellites as the aid takes them (17, n): positions, velocities
    (n, 3), and as `rows` (n,) ranges, rates, and their variances; no shared errors, no carriers.
    ValueError for other shapes."""
    parts = [np.asarray(part, float).T for part in (position, velocity, *rows)]
    if any(part.shape[-1:] != parts[-1].shape for part in parts):
        raise ValueError(f"shapes differ: {[part.T.shape for part in parts]}")
    basic = np.vstack(parts)
    return np.vstack([basic, np.zeros((_VALUES - _BASIC, basic.shape[1]))])


def nothing_left() -> Array:
    """(10,): no epoch before."""
    return np.zeros(_LEFT)


@immutable(eq=False)
class PseudorangeAid(Aid):
    """Ranges and rates of one epoch to n satellites, all else than geometry and clock taken off.

    `values` (17, n) has as its rows `position` and `velocity` (three each, ECEF at transmission,
    turned to the axes at reception, m, m/s), `ranges` (m), `rates` (m/s; positive: going away) and
    their variances (m^2, (m/s)^2), what one sigma of each of three shared errors adds (m), and of
    the carrier: seconds since the epoch before (0: none), mean rate, its variance, and the
    satellite's acceleration away (m/s^2); NaN is not measured. `before` and `left` (10,) are what
    the last epoch left and this one leaves, whatever has evaluated them last. `clock` (n,): which of the states of the
    model's block `clock_offset` each range has, or NO_CLOCK; a rate of a satellite with NO_CLOCK
    has no drift either. `lever` (m, body axes) of the antenna. `clock_reset`: the receiver has set
    its clock.
    Rows: the finite ranges in order, then the finite rates (`labels`).

    ValueError for shapes that do not fit, a variance that is not positive where there is a value,
    or a satellite with a clock beside one without where rates are given.
    """

    screened: ClassVar[bool] = True
    locates: ClassVar[bool] = True

    satellites: tuple[str, ...]
    values: Array
    clock: Indices
    lever: Vector3 = (0.0, 0.0, 0.0)
    clock_reset: bool = False
    before: Array = field(default_factory=nothing_left, repr=False)
    left: Array = field(default_factory=nothing_left, repr=False)
    _r: Array = field(init=False, repr=False)
    _ranges: int = field(init=False, repr=False)
    _clocks: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.satellites)
        if self.values.shape != (_VALUES, n) or self.clock.shape != (n,):
            raise ValueError(f"shapes {self.values.shape} and {self.clock.shape} of {n} satellites")
        r = np.empty(2 * n)
        ranges, rates, clocks, wrong = _measured(self.values, self.clock, r)
        if wrong != _SOUND:
            raise ValueError(_WRONG[wrong])
        object.__setattr__(self, "_r", r[: ranges + rates])
        object.__setattr__(self, "_ranges", ranges)
        object.__setattr__(self, "_clocks", clocks)

    @property
    def position(self) -> Array:
        """(n, 3), m."""
        return self.values[_X:_VX].T

    @property
    def velocity(self) -> Array:
        """(n, 3), m/s."""
        return self.values[_VX:_RANGE].T

    @property
    def ranges(self) -> Array:
        """(n,), m."""
        return self.values[_RANGE, :]

    @property
    def rates(self) -> Array:
        """(n,), m/s."""
        return self.values[_RATE, :]

    @property
    def range_variance(self) -> Array:
        """(n,), m^2."""
        return self.values[_RANGE_VARIANCE, :]

    @property
    def total_variance(self) -> Array:
        """(n,), m^2: of ranges with what they share."""
        found: Array = self.range_variance + (self.values[_SHARED:_SPAN] ** 2).sum(axis=0)
        return found

    @property
    def rate_variance(self) -> Array:
        """(n,), (m/s)^2."""
        return self.values[_RATE_VARIANCE, :]

    @property
    def labels(self) -> list[tuple[str, str]]:
        """Satellite and `range`, `rate` or `carrier` of each row."""
        spans = (self.values[_SPAN] > 0.0).tolist()
        found = [
            (name, "range")
            for name, value in zip(self.satellites, self.ranges.tolist(), strict=True)
            if math.isfinite(value)
        ]
        return found + [
            (name, "carrier" if span else "rate")
            for name, value, span in zip(self.satellites, self.rates.tolist(), spans, strict=True)
            if span or math.isfinite(value)
        ]

    def only(self, keep: Sequence[bool] | NDArray[np.bool_]) -> PseudorangeAid:
        """The epoch with the satellites marked in `keep` (n,) alone."""
        mask = np.asarray(keep, dtype=bool)
        return PseudorangeAid(
            self.source,
            self.t_ns,
            self.gate,
            tuple(s for s, k in zip(self.satellites, mask, strict=True) if k),
            self.values.compress(mask, axis=1),
            self.clock[mask],
            self.lever,
            self.clock_reset,
            self.before,
            self.left,
        )

    def series(self, whitened: Sequence[float], kept: NDArray[np.bool_]) -> dict[str, Array]:
        """A row (2,) for each satellite system of ranges with a clock, by its letter: the sums of
        the whitened innovations of its ranges and of its rates over the root of their number.

        White innovations give N(0, 1) whatever the number of satellites, so that epochs of any sky
        form one series. A system without a range or without a rate in the epoch has none.
        """
        sums, first = np.empty((self._clocks, 2)), np.empty(self._clocks, dtype=np.int64)
        y = np.fromiter(whitened, float, len(whitened))
        found = _by_clock(self.values, self.clock, kept, y, sums, first)
        firsts = first[:found].tolist()
        return {self.satellites[at][0]: sums[k] for k, at in enumerate(firsts)}

    def innovation(self, state: State) -> Innovation | NotApplicable:
        model = state.model
        if not self._r.size:
            return NotApplicable("no_satellites")
        clocks = self._clocks
        offsets, drifts, displacement, shared, carrier = model.slots_of_each(*_BLOCKS)
        if clocks > offsets.size or (clocks and not drifts.size):
            return NotApplicable("no_clock_state")
        rows = self._r.size
        z, r, h = np.empty(rows), np.empty(rows), np.zeros((rows, model.size))
        _rows(
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
            carrier,
            *self.lever,
            self._ranges,
            self.before,
            self.left,
            r,
            z,
            h,
        )
        return Innovation(z, h, r)
