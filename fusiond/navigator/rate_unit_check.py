r"""Check of the unit of rates: the path between fixes against the gyro's turns.

A vehicle that drives forward moves from fix to fix in a direction between its headings. For chord i
between two fixes that are far enough apart, G the gyro's heading since some instant, k = 1 for
rates in rad/s and pi / 180 for rates in deg/s,

    psi_i = theta + arg mean exp(j k G) - b t_i + q_i + e_i

theta is the heading at G = 0, unknown; b the bias of the rates, t_i the middle of the chord's time.
e_i is the effect of the fixes' errors: the lateral error of a fix over the chord's length, with the
opposite sign in the next chord. q_i is the effect of the unknown speed: the direction is anywhere
among the headings, whose range R_i makes an error of R_i / sqrt(12). All are normal, so that

    -2 ln L_k = min over theta of r^T C^-1 r + ln det C + ln (1^T C^-1 1)

is known for both units, with r the residual of psi without theta, and C the covariance of b t, q
and e. The bias of a gyro in deg/s is within its data sheet, s; read in rad/s it is 57 times larger.
A gyro in rad/s may also have a bias of that size, so the bias alone does not decide.

    2 ln (L_1 / L_57) > 2 ln 10^6

has a probability below one in a million for rates in deg/s: the expectation of L_1 / L_57 is one
under the rejected hypothesis (Markov's inequality; for all instants of the test, Ville's). The
accepted unit must also fit by its chi-square.

With fixes of 20 m every 11 s, on 150 drawn drives of 220 s with two noises each: a gyro in rad/s
with a bias of 0.6 or 2 deg/s was recognised on 294 and 292 of 300, half of them within 70 s of
driving off; one in deg/s on 290, after 103 s. The wrong unit was never accepted; its statistic
reached 13.3 of the required 27.6.

Fixes with lasting errors are closer to each other than assumed here, which is safe. A vehicle that
reverses fits neither unit; there is no decision until it has driven forward for the whole stored
path.

Source: Ville, Etude critique de la notion de collectif (1939); Groves, 2nd ed., section 5.1.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.navigation.chi_square import quantile
from fusiond.navigation.earth import meridian_radius, transverse_radius

Array = NDArray[np.float64]

# Radians that rates in rad/s, and in deg/s, have turned by for one that is read.
UNITS = (1.0, math.pi / 180.0)
PROOF = 2.0 * math.log(1e6)
# Probability with which what is believed fits.
FITS = 0.999
# A chord is so many sigmas of its ends' errors long: its direction is then known to 14 deg, of
# which the sine is wrong by 1 %.
LEAST_SIGMAS = 4.0
# So many chords are remembered, none longer than this (ns): the bias drifts.
MOST_CHORDS, LONGEST_NS = 12, 120_000_000_000
# The heading is kept so often (ns): a vehicle turns by 5 deg at most meanwhile.
KEPT_EVERY_NS = 200_000_000
# A pause of the samples that is longer (ns) ends a chord: nobody knows what was turned.
GAP_NS = 1_000_000_000
# A direction that is known worse (rad) says nothing of how often another has gone round.
DIRECTED_RAD = 0.25 * math.pi


class _Chord(NamedTuple):
    """Chord between fixes: middle (s), direction (rad), sigmas of the direction by either end
    (rad), contiguity with the chord before, and for each of `UNITS` the direction by the gyro and
    its sigma (rad)."""

    middle_s: float
    course: float
    ends: tuple[float, float]
    follows: bool
    turned: tuple[float, float]
    spread: tuple[float, float]


class WayTurns:
    """Comparison of the gyro's turns with those of the track; `bias_sd` (rad/s) is the data
    sheet's."""

    def __init__(self, bias_sd: float) -> None:
        self._bias_sd = bias_sd
        self._times: list[int] = []
        self._turned: list[float] = []
        self._latest_ns = 0
        self._total = 0.0
        self._waiting: deque[PositionCandidate] = deque(maxlen=MOST_CHORDS)
        self._last: PositionCandidate | None = None
        self._follows = False
        self._chords: deque[_Chord] = deque(maxlen=MOST_CHORDS)

    def samples(self, times: NDArray[np.int64], yaw_rates: Array) -> bool:
        """Add rates (m,) about the vertical, means until `times` (m,) ns; True if a chord has
        ended."""
        known = self._chords[-1] if self._chords else None
        instants = times.tolist()
        before_ns = self._latest_ns or instants[0]
        steps = [now - then for then, now in pairwise((before_ns, *instants))]
        if not 0 <= min(steps) <= max(steps) <= GAP_NS:
            self._break()
            steps = [0] * len(steps)
        begin, angle, turn = self._total, self._total, 0.0
        last_ns = self._times[-1] if self._times else -KEPT_EVERY_NS
        for t_ns, step, rate in zip(instants, steps, yaw_rates.tolist(), strict=True):
            turn += rate * step
            angle = begin + turn * 1e-9
            if t_ns - last_ns >= KEPT_EVERY_NS:
                self._times.append(t_ns)
                self._turned.append(angle)
                last_ns = t_ns
        self._latest_ns, self._total = instants[-1], angle
        while self._waiting and self._waiting[0].t_ns <= last_ns:
            self._reach(self._waiting.popleft())
        return bool(self._chords) and self._chords[-1] is not known

    def fix(self, position: PositionCandidate) -> None:
        """Add a fix in order of validity; one out of order is ignored."""
        newest = self._waiting[-1] if self._waiting else self._last
        if newest is None or position.t_ns > newest.t_ns:
            self._waiting.append(position)

    def log_odds(self) -> float:
        """Log odds 2 ln (L_1 / L_57) if the likelier unit fits; 0 if neither does."""
        if len(self._chords) < 3:
            return 0.0
        costs = [self._likelihood(unit) for unit in range(len(UNITS))]
        better = min(costs, key=lambda cost: cost[0])
        return costs[1][0] - costs[0][0] if better[1] else 0.0

    def restart(self) -> None:
        """Forget the path so far."""
        self._chords.clear()

    # ------------------------------------------------------------------ inside

    def _break(self) -> None:
        self._times, self._turned, self._last = [], [], None
        self._chords.clear()

    def _reach(self, position: PositionCandidate) -> None:
        """End a chord at a fix that the samples have reached, if it is far enough away."""
        last = self._last
        if last is None or position.t_ns - last.t_ns > LONGEST_NS or last.t_ns < self._times[0]:
            self._begin(position, follows=False)
            return
        lat, height = last.lat_rad, last.height_m or 0.0
        north = (position.lat_rad - lat) * (meridian_radius(lat) + height)
        east = math.remainder(position.lon_rad - last.lon_rad, 2.0 * math.pi)
        east *= (transverse_radius(lat) + height) * math.cos(lat)
        length = math.hypot(north, east)
        sds = max(last.sd[:2]), max(position.sd[:2])
        if not length >= LEAST_SIGMAS * math.hypot(*sds):
            return
        rows = slice(bisect_left(self._times, last.t_ns), bisect_left(self._times, position.t_ns))
        faced = np.array(self._turned[rows])
        if len(faced) < 2:
            return
        turned, spread = zip(*(_directions(k * faced) for k in UNITS), strict=True)
        middle_s = 0.5e-9 * (last.t_ns + position.t_ns)
        ends = sds[0] / length, sds[1] / length
        course = math.atan2(east, north)
        self._chords.append(_Chord(middle_s, course, ends, self._follows, turned, spread))
        self._begin(position, follows=True)

    def _begin(self, position: PositionCandidate, follows: bool) -> None:
        """Start the next chord here; drop the heading before it."""
        self._last, self._follows = position, follows
        old = max(0, bisect_left(self._times, position.t_ns) - 1)
        del self._times[:old], self._turned[:old]

    def _likelihood(self, unit: int) -> tuple[float, bool]:
        """Value -2 ln L of a unit, without common terms, and True if it fits."""
        chords, n = self._chords, len(self._chords)
        since_s = chords[0].middle_s
        t = np.array([chord.middle_s - since_s for chord in chords])
        c = np.diag([chord.spread[unit] ** 2 + sum(s * s for s in chord.ends) for chord in chords])
        for i in range(1, n):
            before, after = chords[i - 1], chords[i]
            if after.follows:
                along = math.cos(after.course - before.course)
                c[i, i - 1] = c[i - 1, i] = -before.ends[1] * after.ends[0] * along
        residuals = _unwound([x.course - x.turned[unit] for x in chords], np.sqrt(np.diag(c)))
        bias_sd = self._bias_sd / UNITS[1] * UNITS[unit]
        c += np.outer(t, t) * bias_sd**2
        inverse = np.linalg.inv(c)
        information = float(inverse.sum())
        mean = float((inverse @ residuals).sum()) / information
        off = residuals - mean
        cost = float(off @ inverse @ off)
        determinant = float(np.linalg.slogdet(c)[1]) + math.log(information)
        return cost + determinant, cost <= quantile(n - 1, 1.0 - FITS)


def _directions(faced: Array) -> tuple[float, float]:
    """Mean of directions (m,) and one sigma (rad) of any of them.

    The headings are in order of time and may exceed a full turn."""
    begin = float(faced[0])
    mean = complex(np.exp(1j * (faced - begin)).mean())
    spread = float(faced.max() - faced.min())
    if spread >= 2.0 * math.pi:
        return float(faced.mean()), 2.0 * math.pi / math.sqrt(12.0)
    # Of more than half a turn the mean of exp may have gone round.
    about = float(faced.mean()) - begin
    turn = about + math.remainder(math.atan2(mean.imag, mean.real) - about, 2.0 * math.pi)
    return begin + turn, spread / math.sqrt(12.0)


def _unwound(angles: Sequence[float], sds: Array) -> Array:
    """Unwrap angles (n,), each by the last well-known one."""
    found, reference = np.empty(len(angles)), 0.0
    for i, angle in enumerate(angles):
        found[i] = reference + math.remainder(angle - reference, 2.0 * math.pi)
        if i == 0 or sds[i] <= DIRECTED_RAD:
            reference = float(found[i])
    return found
