r"""The means of a series' whitened innovations, and what they have shown to be ordinary.

    m <- (1 - a) m + a y,   a bias if |m|^2 > chi2(d) s,   s -> the mean of |m|^2 / d

at two paces a, for innovations y (d,) that are N(0, I) while series and filter agree. The variance
s of a mean is a / (2 - a) for white ones; errors that last (orbits, slip of a tyre) add to it, so
it is learned from what the means show themselves, `LEARN_NS` after they have shown it: lately it
may be the beginning of a fault.

What the slow mean shows says by how much the series' sigma is too small for a filter that takes its
errors for white. Errors e of variance r whose correlation at a lag of k measurements is rho_k have

    var(sum of n) -> n r (1 + 2 sum rho_k) = n r c^2

with c^2 = (1 + rho) / (1 - rho) where they are of first order. White ones of variance c^2 r have
the same sums, which is what a filter that looks back further than they last makes of them.
s / (a / (2 - a)) of the slow mean is c^2 where they last for less than its 59 innovations, and 1
where they are white and the sigma honest. Once measurements count with c, s shows what is left of
it: c^2 s is averaged. Where r is little beside H P H^T that leaves c as it is.

A mean that is beyond what chance does once in twenty, and not yet what it does once in a million,
says that series and filter differ, and not which of them is wrong. What it has beyond chance is
the `excess`: a filter is not surer of what it says than that.

Source: Lowry, Woodall, Champ, Rigdon, A multivariate exponentially weighted moving average control
chart, Technometrics 34 (1992), eq. 2.2; Bar-Shalom, Li, Kirubarajan (2001), section 8.2 (errors
that are not white).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.base import THRESHOLDS
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import DR, DV, PHI

Array = NDArray[np.float64]

# Paces of the mean: some 11 and some 59 innovations deep, (2 - a) / a.
FAST, SLOW = 1.0 / 6.0, 1.0 / 30.0
FAST_COUNT = (2.0 - FAST) / FAST
# The variance of a mean at each pace, for white innovations of variance one; and what is assumed of
# a series before it has shown its own: successive innovations share a fifth of their variance.
WHITE_FAST, WHITE_SLOW = FAST / (2.0 - FAST), SLOW / (2.0 - SLOW)
ASSUMED = 0.2
# The variance that a series' means show by themselves is averaged over so many innovations: errors
# that last (orbits, slip of a tyre) are ordinary, and a fault is what stands out of them. What is
# assumed at first weighs as much as half the time that the slow mean looks back.
LEARN_COUNT, ASSUMED_COUNT = 300.0, 15.0
# Before a series has shown it: half of its variance lasts, for two seconds. A choice, for receivers
# say nothing of it: cars drawn with errors of that kind were looked at for it.
LASTING_SHARE, LASTS_S, LIKELY_COUNT = 0.5, 2.0, 8.0
# What is assumed says nothing of the sigma that was stated: a verdict on that waits until it is no
# more than this of the variance, a quarter of the interval of a hundred innovations of three.
ASSUMING = 0.05
# Nobody sends more often than 50 times a second.
LEAST_S = 0.02
# How long errors last is a receiver's nature, which does not change while it drives: it is averaged
# over forty minutes of 5 Hz. A fault of some seconds then excuses itself by a percent.
LASTING_COUNT = 12_000.0
# The slow mean looks back at 59 innovations, and squares of so few means scatter as much as they
# are large: as many innovations as make twenty new means are needed before half of what they show
# is believed. With an eighth of it, receivers whose errors are white hid a drift of 0.1 m/s and a
# mount that turns for some seconds more than they do.
DOUBTED_COUNT = 40.0 / SLOW
# What the means show lately may be the beginning of a fault: it counts once a period as long as it
# has gone by without one. A drift of 0.1 m/s is found within twice this; longer ones hide nothing.
LEARN_NS = 15_000_000_000
# Chi-square of one that chance exceeds once in twenty: what a mean has beyond it is not chance's.
LIKELY = 3.84
# A mean over fewer innovations than this is left to the gate.
FEWEST = 4

# Rows of the array that the kernels read; after `_HEAD` of them the d means of each pace. `_SHOWN`
# begins the sums of both means' squares, by degree of freedom and no less than of white ones, of
# the slow mean's as they are, and their number, since the instant `_SINCE` (ns, an integer),
# `_WAITING` the same of the period before. `_LEARNED` counts what the variances have been learned
# from; `_SLOWLY` is the slow mean's by that alone and in terms of the sigma that was stated,
# `_TOLD` what it counts, `_COARSE` the square of c with which the last measurement counted.
_SINCE, _COUNT, _SPREAD, _LEARNED, _SLOWLY, _TOLD, _COARSE = 0, 1, 2, 4, 5, 6, 7
_SHOWN, _WAITING, _HEAD = 8, 12, 16
_SUMS = _WAITING - _SHOWN
_LONG_AGO_NS = -(2**62)


@compiled("void(f8[::1])", forceinline=True)
def _begin(packed: Array) -> None:
    """One innovation more; the first begins the means."""
    if packed[_COUNT] == 0.0:
        packed[_HEAD:] = 0.0
    packed[_COUNT] += 1.0


@compiled("void(f8[::1], i8, i8, f8)", forceinline=True)
def _approach(packed: Array, d: int, i: int, y: float) -> None:
    """Take in component i of d."""
    fast, slow = packed[_HEAD + i], packed[_HEAD + d + i]
    packed[_HEAD + i] = fast + FAST * (y - fast)
    packed[_HEAD + d + i] = slow + SLOW * (y - slow)


@compiled("void(f8[::1], f8[::1])")
def _add(packed: Array, y: Array) -> None:
    """Take in an innovation (d,)."""
    _begin(packed)
    for i in range(y.shape[0]):
        _approach(packed, y.shape[0], i, y[i])


@compiled("void(f8[::1])")
def _believe(packed: Array) -> None:
    """No fault has followed what waits."""
    n = packed[_WAITING + 3]
    if n == 0.0:
        return
    packed[_TOLD] = min(packed[_TOLD] + n, LASTING_COUNT)
    alone = n / packed[_TOLD]
    packed[_SLOWLY] += alone * (packed[_WAITING + 2] / n - packed[_SLOWLY])
    share = min(1.0, n / min(ASSUMED_COUNT + packed[_LEARNED] + n, LEARN_COUNT))
    for k in range(2):
        packed[_SPREAD + k] += share * (packed[_WAITING + k] / n - packed[_SPREAD + k])
    packed[_LEARNED] = min(packed[_LEARNED] + n, LEARN_COUNT)


# What an innovation of fewer components has for the others.
_NO_MORE = (0.0, 0.0, 0.0)
# What a look at the means has shown.
_NOTHING, UNLIKELY, BIASED, _TOO_FEW = 0, 1, 2, 3


@compiled("i8(f8[::1], i8, f8, f8)")
def _look(packed: Array, t_ns: int, limit: float, own: float) -> int:
    """Whether a mean is beyond `limit`, the quantile of chi-square of d, where `own` of each
    innovation's variance is common to all, or one of its components unlikely; learn from it if it
    is not beyond, and nothing is common."""
    d = (packed.shape[0] - _HEAD) // 2
    fast = slow = most_fast = most_slow = 0.0
    for i in range(d):
        square = packed[_HEAD + i] * packed[_HEAD + i]
        fast += square
        most_fast = max(most_fast, square)
        square = packed[_HEAD + d + i] * packed[_HEAD + d + i]
        slow += square
        most_slow = max(most_slow, square)
    if fast > limit * (packed[_SPREAD] + own) or slow > limit * (packed[_SPREAD + 1] + own):
        for k in range(_SHOWN, _HEAD):
            packed[k] = 0.0
        packed[:1].view(np.int64)[0] = _LONG_AGO_NS
        return BIASED
    if own > 0.0:
        return _NOTHING
    unlikely = most_fast > LIKELY * packed[_SPREAD] or most_slow > LIKELY * packed[_SPREAD + 1]
    if t_ns - packed[:1].view(np.int64)[0] >= LEARN_NS:
        _believe(packed)
        for k in range(_SUMS):
            packed[_WAITING + k] = packed[_SHOWN + k]
            packed[_SHOWN + k] = 0.0
        packed[:1].view(np.int64)[0] = t_ns
    packed[_SHOWN] += max(fast / d, WHITE_FAST)
    packed[_SHOWN + 1] += max(slow / d, WHITE_SLOW)
    packed[_SHOWN + 2] += packed[_COARSE] * slow / d
    packed[_SHOWN + 3] += 1.0
    return UNLIKELY if unlikely else _NOTHING


@compiled("f8(f8[::1], f8[:, :], i8, f8, f8, f8)")
def _follows(packed: Array, p: Array, first: int, chance: float, sd_0: float, sd_1: float) -> float:
    """See `Means.follows`."""
    d, sd = (packed.shape[0] - _HEAD) // 2, (sd_0, sd_1)
    changes = 0.0
    for i in range(min(d, 2)):
        fast, slow = packed[_HEAD + i] ** 2, packed[_HEAD + d + i] ** 2
        fast = fast if fast > chance * packed[_SPREAD] else 0.0
        slow = slow if slow > chance * packed[_SPREAD + 1] else 0.0
        own, r = p[first + i, first + i], (math.sqrt(packed[_COARSE]) * sd[i]) ** 2
        changes += max(fast, slow) * (own + r) * (own / r) ** 2
    return changes


@compiled("void(f8, f8[:, :], i8, f8, f8[::1])")
def open_by(excess: float, p: Array, at: int, variance: float, out: Array) -> None:
    """Add to `out` (9,) what is left open of the state `at` by the `excess` of an innovation's
    variance (1), and by what P (n, n) has in common with it; measured with that `variance`."""
    own = p[at, at]
    if excess <= 0.0 or own <= 0.0:
        return
    share = excess * (own + variance) / (own * own)
    for j in range(3):
        with_position, with_velocity = p[DR + j, at], p[DV + j, at]
        out[j] += share * with_position * with_position
        out[3 + j] += share * with_velocity * with_velocity
    north, east, yaw = p[PHI, at], p[PHI + 1, at], p[PHI + 2, at]
    tilt = share * (north * north + east * east)  # of whichever axis roll and pitch are about
    out[6] += tilt
    out[7] += tilt
    out[8] += share * yaw * yaw


@compiled("void(f8[::1], f8[:, :], i8, f8, f8, f8, i8, f8[::1])")
def _open(
    packed: Array,
    p: Array,
    first: int,
    sd_0: float,
    sd_1: float,
    sd_2: float,
    axes: int,
    out: Array,
) -> None:
    """Add to `out` (9,) what the excess of each component leaves open."""
    d, sd = (packed.shape[0] - _HEAD) // 2, (sd_0, sd_1, sd_2)
    for i in range(min(d, axes)):
        fast, slow = packed[_HEAD + i], packed[_HEAD + d + i]
        excess = fast * fast - LIKELY * packed[_SPREAD]
        excess = max(excess, slow * slow - LIKELY * packed[_SPREAD + 1])
        open_by(excess, p, first + i, packed[_COARSE] * sd[i] * sd[i], out)


@compiled("i8(f8[::1], f8[::1], i8, f8)")
def _take(packed: Array, y: Array, t_ns: int, limit: float) -> int:
    """`_add`, and `_look` at what has come of it; `_TOO_FEW` while there is no mean."""
    _add(packed, y)
    return _look(packed, t_ns, limit, 0.0) if packed[_COUNT] >= FEWEST else _TOO_FEW


@compiled("i8(f8[::1], i8, f8, f8, f8, f8)")
def take_few(packed: Array, t_ns: int, limit: float, x: float, y: float, z: float) -> int:
    """`_take` of an innovation of up to three components: a third of the time of an array that is
    made for it."""
    d = (packed.shape[0] - _HEAD) // 2
    _begin(packed)
    _approach(packed, d, 0, x)
    if d > 1:
        _approach(packed, d, 1, y)
    if d > 2:
        _approach(packed, d, 2, z)
    return _look(packed, t_ns, limit, 0.0) if packed[_COUNT] >= FEWEST else _TOO_FEW


@compiled("Tuple((f8, b1))(f8[::1], f8)")
def lasting_of(packed: Array, every_s: float) -> tuple[float, bool]:
    """c of a receiver's velocity that comes next, `every_s` after the one before, and whether more
    of c^2 is assumed than `ASSUMING`. Of velocities that nothing is known of half of their variance
    is white.

    What the slow mean has shown beside white errors counts as far as it is taken for the series'
    nature: the part that chance explains is left out (James and Stein, 1961, positive part).
    """
    rho = math.exp(-max(every_s, LEAST_S) / LASTS_S)
    assumed = 1.0 + LASTING_SHARE * 2.0 * rho / (1.0 - rho)
    told = packed[_TOLD]
    beyond = packed[_SLOWLY] / WHITE_SLOW - 1.0
    new = (packed.shape[0] - _HEAD) // 2 * told * SLOW  # degrees of freedom of its squares
    shown = 1.0
    if new * beyond * beyond > 2.0:
        shown += (beyond - 2.0 / (new * beyond)) * told / (DOUBTED_COUNT + told)
    likely = LIKELY_COUNT / (LIKELY_COUNT + packed[_COUNT])
    beyond = likely * (assumed - shown)
    packed[_COARSE] = square = max(1.0, shown + beyond)
    return math.sqrt(square), beyond > ASSUMING * square


def _begun(assumed: float) -> Array:
    packed = np.zeros(_HEAD)
    packed[:1].view(np.int64)[0] = _LONG_AGO_NS
    packed[_SPREAD : _SPREAD + 2] = WHITE_FAST + assumed, WHITE_SLOW + assumed
    packed[_SLOWLY], packed[_COARSE] = WHITE_SLOW, 1.0
    return packed


class Means:
    """Of one series. A changed dimension d begins the means anew, not what they have shown."""

    __slots__ = ("_packed", "assuming", "unlikely")

    def __init__(self, packed: Array | None = None) -> None:
        self._packed = _begun(ASSUMED) if packed is None else packed
        self.assuming = False
        """Whether the measurement that `lasting` was last asked for counts with an assumption."""
        self.unlikely = False
        """Whether the last look that found no bias found a mean that chance hardly explains."""

    @staticmethod
    def begun(white: bool) -> Means:
        """Of a series that nothing is known of; `white`: its errors are said to share nothing."""
        return Means(_begun(0.0 if white else ASSUMED))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Means) and self._packed.tobytes() == other._packed.tobytes()

    __hash__ = None  # type: ignore[assignment]

    def copied(self) -> Means:
        """A copy for a checkpoint."""
        return Means(self._packed.copy())

    def restart(self) -> None:
        """The means begin anew."""
        self._packed[_COUNT] = 0.0

    def add(self, whitened: tuple[float, ...]) -> None:
        """Take in an innovation (d,), whitened."""
        _add(self._ready(len(whitened)), np.array(whitened))

    def tested(self, whitened: tuple[float, ...], t_ns: int, probability: float) -> bool:
        """`add` and `biased` in one, of a series that is believed; the quantile is that of the
        `probability`. Where nothing is `whitened` the means are as they were."""
        if not whitened:
            self.unlikely, d = False, self.degrees
            return d > 0 and self.biased(t_ns, THRESHOLDS[probability, d])
        degrees, packed = len(whitened), self._packed
        if packed.shape[0] != _HEAD + 2 * degrees:
            packed = self._ready(degrees)
        limit = THRESHOLDS[probability, degrees]
        if degrees <= 3:
            found = take_few(packed, t_ns, limit, *whitened, *_NO_MORE[degrees:])
        else:
            found = _take(packed, np.array(whitened), t_ns, limit)
        self.unlikely = found == UNLIKELY
        return found == BIASED

    def ready(self, degrees: int) -> Array | None:
        """What the kernels read; None where an innovation of that dimension begins the means."""
        packed = self._packed
        return packed if packed.shape[0] == _HEAD + 2 * degrees else None

    def _ready(self, degrees: int) -> Array:
        """What the kernels read, for an innovation of that dimension."""
        packed, width = self._packed, _HEAD + 2 * degrees
        if packed.shape[0] != width:
            packed = self._packed = np.concatenate((packed[:_HEAD], np.zeros(width - _HEAD)))
            packed[_COUNT] = 0.0
        return packed

    @property
    def degrees(self) -> int:
        """d; 0 while there are too few for a mean."""
        packed = self._packed
        return (packed.shape[0] - _HEAD) // 2 if packed[_COUNT] >= FEWEST else 0

    def biased(self, t_ns: int, limit: float, own: float = 0.0) -> bool:
        """Whether a mean of the innovations until `t_ns` is beyond chance: `limit` is the quantile
        of chi-square of `degrees`, `own` the part (1) of each innovation's variance that is the
        filter's and common to all. If not, what it shows of the series is learned from."""
        found = _look(self._packed, t_ns, limit, own)
        self.unlikely = found == UNLIKELY
        return found == BIASED

    def leaves_open(self, covariance: Array, first: int, sd: tuple[float, ...]) -> Array:
        """Variances (9,) of what is published, position, velocity (n, e, d) and attitude, that the
        excess of a mean leaves open (fusiond.integrity.hedge): of measurements with `sd` (d,) of
        the states from `first` on, of which a filter holds P (n, n)."""
        out, (sd_0, sd_1, sd_2) = np.zeros(9), (*sd, *_NO_MORE)[:3]
        _open(self._packed, covariance, first, sd_0, sd_1, sd_2, len(sd), out)
        return out

    def follows(self, covariance: Array, first: int, sd: tuple[float, ...], chance: float) -> float:
        """The square by which a filter that holds P (n, n) changes with each of these measurements,
        as the larger of each horizontal component's means has it that is beyond `chance`, a
        chi-square of one: sum (K m)^2 S of states from `first` on, measured with `sd`."""
        return _follows(self._packed, covariance, first, chance, *sd[:2])

    @property
    def excess(self) -> list[float]:
        """Of each component (d,), of an innovation's variance (1), what a mean has beyond what
        chance does once in twenty."""
        d = (self._packed.shape[0] - _HEAD) // 2
        squares = (self._packed[_HEAD:] ** 2).tolist()
        fast, slow = (LIKELY * self._packed[_SPREAD : _SPREAD + 2]).tolist()
        pairs = zip(squares[:d], squares[d:], strict=True)
        return [max(0.0, f - fast, s - slow) for f, s in pairs]

    def most(self) -> list[float]:
        """Each component (d,), of an innovation's sigma (1): of the mean where it is more."""
        d = (self._packed.shape[0] - _HEAD) // 2
        squares = (self._packed[_HEAD:] ** 2).tolist()
        return [math.sqrt(max(f, s)) for f, s in zip(squares[:d], squares[d:], strict=True)]

    @property
    def coarse(self) -> float:
        """The c that the last measurement counted with."""
        return math.sqrt(float(self._packed[_COARSE]))

    @property
    def colour(self) -> float:
        """By how much (1) the sigma of a mean over many errors is more than if they were white, as
        the series has shown."""
        return math.sqrt(max(1.0, float(self._packed[_SPREAD + 1]) / WHITE_SLOW))

    def lasting(self, every_s: float) -> float:
        """c: by how much (1, at least) a sigma is too small for errors that last, as the series has
        shown; the measurement that comes next counts with it. What is assumed of measurements
        `every_s` weighs as `LIKELY_COUNT` of them, and fades with each that is heard."""
        coarse, self.assuming = lasting_of(self._packed, every_s)
        return coarse
