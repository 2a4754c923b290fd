r"""What a series and the filter differ by, before it can be told which of them is wrong.

A mean of innovations that is beyond what chance does once in a million is a bias, and its series is
left out. A drift has by then taken the filter away by more than it is sure of: no test is as quick
as the error (fusiond.integrity.proof). Before that the mean is beyond what chance does once in
twenty. Series and filter then differ by it, and either may be wrong, so that the filter is surer
than it can be unless what it publishes is open by as much: with m a mean of whitened innovations
and s the variance of such means (fusiond.integrity.means),

    sigma^2 + S max(0, m^2 - 3.84 s)                 S = P + R, of each axis

of what the series measures; and of all that P says goes with it, by the square of the regression on
it, P_ix / P_xx. P is not touched: the solution is the same, and as sure as before once
the mean is. One window in twenty of a sound series is a little wider.

P is that of sound sensors; of what an inertial unit that has changed does to an attitude it knows
nothing. Two equations do. A velocity that is corrected by K m sqrt(S) each interval T, and is off
by as much again, is accelerated by that over T, which gravity makes of a tilt:

    sigma_tilt^2 + (K / (g T))^2 S m^2        K = P / R, P after the update

A tilt is known better than some seconds of velocities tell it, so that this counts beyond what
chance does once in a thousand. The tilt is a sum of rates: it stays wrong when the mean passes
through zero on its way back, and beside a force that is wrong as long as the two look alike. An
update takes of an error what it takes of P, so that what was left open fades by (P+ / P-)^2. And a
vehicle that does not slip faces its velocity, which is measured: of what goes across at a speed v
a slip is one cause, a heading the other, for a mounting does not change,

    sigma_yaw^2 + S max(0, m^2 - 3.84 s) / v^2        S = R + v^2 P_yaw

What the last velocities leave open before any mean does has fusiond.integrity.lately, and what a
filter has followed that is shown no more.

A velocity that is refused, by chance one in ten thousand, is apart by u, and was not T before.
Either it is wrong, or the unit has felt an acceleration that was none: until the next has told
velocity, position and tilt are open by

    u^2        (u T / 2)^2        (u / (g T))^2

Where the filter has a state for a slip that lasts, the innovations say less of it than that state
does (fusiond.integrity.slip): what is beyond the slips that the vehicle has shown is open as well.

While such a vehicle stands it does not turn. What its gyros feel then, beyond their bias, is the
gyros' error or the ground's turn, and the heading is open by its sum until it has been driven along
for as long as the slow mean looks back.

What is published is the attitude of the axes that were configured, and the vehicle's as far as the
unit sits on it so. A mounting that is found off by more than chance has it in one vehicle of a
thousand is not the one that was configured: pitch and yaw are open by what it has beyond that,

    sigma^2 + max(0, m^2 - 10.83 sigma_m^2)          sigma_m as configured

and by all of it after a failure, which a unit that has turned may have been.

A position that is back after an outage may be late, and lie within the outage's sigma all the same:
until that would have shown position and velocity are no surer than a lateness leaves them
(fusiond.integrity.punctual), along the track and the acceleration. Fixes by code have errors that
last for seconds (`gnss_wander`): P is never below those.

Such a position has no means yet: it leaves open what its slope has beyond chance
(fusiond.integrity.proof), and where its errors are configured to be white is no surer than that
slope. Where fixes share one that is a state P never falls below it: as wide as the slope is known,
css_164's sigma would be 4 m, 90 s after each tunnel, of a receiver that states 1 to 2 m and is off
by less. What a source left open that has fallen silent stays, for silence answers nothing, until
another that measures the same, about as finely, has a mean of its own.

A filter that has a state b for an error that fixes share, of variance one (fusiond.aiding.wander),
takes a drift for it as long as it can, and for its own motion what is beyond. But whatever was
measured, the estimate of such a state has the variance 1 - P_bb, and one beyond what chance does
once in a thousand is of another error. Without its prior b would be estimated by b / (1 - P_bb),
and all that P says goes with it, P_ib / P_bb of the difference, is open by as much:

    sigma_i^2 + P_ib^2 max(0, b^2 - 10.83 (1 - P_bb)) / (1 - P_bb)^2

Once the series is left out, P is: by S m^2, which is what the filter and the series were apart for
as long as the mean looks back. The last innovation alone is mostly noise.

Source: Brenner, Integrated GPS/inertial fault detection availability, NAVIGATION 43 (1996), 111 (a
solution is off by no more than it is apart from one without the fault, and that one's error).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, State
from fusiond.aiding.offers import PositionOffer, VelocityOffer
from fusiond.integrity.lately import RARE, SELDOM, Shown, goes_on
from fusiond.integrity.means import SLOW
from fusiond.integrity.moved import FINE_M, LEAST, Moved
from fusiond.integrity.proof import Proof
from fusiond.integrity.punctual import MOVING_M_S, Punctual
from fusiond.integrity.series import Series
from fusiond.integrity.support import COARSER, FORGET_NS
from fusiond.models.vehicle import MOUNTING
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import DR, DV, PHI
from fusiond.navigation.strapdown import VE, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Said = PositionOffer | VelocityOffer | None

# What a turn at rest has left open fades by this with each innovation, as the slow mean's square;
# below a hundredth of P's variance, half a percent of sigma, it is nothing, and so is what is left
# open of a tilt, which is kept under its own name.
FADES, TILT = (1.0 - SLOW) ** 2, " tilt"
# What may be a lateness or a heading that has turned is kept under names of their own, too.
LATE, ACROSS, AT_REST = " late", " across", "turns at rest"
# So is what fixes share beyond chance, and what one that is believed again may be off by.
STRAYS, MOVED = " strays", " moved"
# And what the last velocities leave open, or a filter has followed.
LATELY = " lately"
# A mean of a position counts for that horizontally alone.
HORIZONTAL = np.array([1.0, 1.0, 0.0] * 2 + [1.0] * 3)

NOTHING: Mapping[str, Array] = {}


class Hedge:
    """By series, the variances (9,) that what is published is wider by: position, velocity (n, e,
    d), attitude. `wider` is replaced whenever it changes, never changed itself."""

    __slots__ = ("wider",)

    def __init__(self) -> None:
        self.wider = NOTHING

    def holds(self, source: str) -> bool:
        """Whether a series has left anything open."""
        return any(source + of in self.wider for of in ("", TILT, LATELY))

    def look(
        self,
        aid: Aid,
        record: Series,
        said: Said,
        nav: Array,
        covariance: Array | None,
        left: float,
    ) -> None:
        """A mean of a series that is fused is beyond what is likely, or was; the state `nav` (10,)
        and P (n, n) of the filter, and what the update has `left` of the tilt's (1). A coarse
        position cannot say that a fine one is wrong."""
        source, unlikely = aid.source, record.means.unlikely
        if covariance is None or record.sd_m > FINE_M:
            if not unlikely:
                self.drop(source)
            return
        if said is not None:
            first = DR if record.locates else DV
            wider = record.means.leaves_open(covariance, first, said.sd) if unlikely else None
            self._put(source, wider)
            if record.moves and not record.locates:
                self._put(source + TILT, self._tilts(source + TILT, record, said, covariance, left))
        elif aid.across_sd_m_s > 0.0:
            self._put(source, _turns(aid, record, nav, covariance) if unlikely else None)

    def lately(self, source: str, record: Series, sd: tuple[float, ...], p: Array | None) -> None:
        """A velocity with `sd` (d,) was fused, and `look` has seen its means; P (n, n) of the
        filter."""
        self._keeps(source, record, None if p is None else self._apart(source, record, sd, p))

    def stays(self, source: str, record: Series, sd: tuple[float, ...], p: Array) -> None:
        """A position with `sd` (d,) was fused, and `look` has seen its means; P (n, n) of the
        filter."""
        shown, wider = None, self.wider.get(source) if record.means.unlikely else None
        if wider is not None:
            rare = record.means.follows(p, DR, sd, RARE) > 0.0
            shown = Shown(wider * HORIZONTAL, mean=rare)
        self._keeps(source, record, shown)

    def _keeps(self, source: str, record: Series, shown: Shown | None) -> None:
        apart, t_ns = record.apart, record.heard_ns
        if shown is not None or apart is not None:
            record.apart = apart = goes_on(apart, t_ns, record.every_ns, shown)
        self._put(source + LATELY, None if apart is None else apart.leaves_open(t_ns))

    def _apart(self, source: str, record: Series, sd: tuple[float, ...], p: Array) -> Shown | None:
        lately, means = record.lately, record.means
        of_means = self.wider.get(source) if means.unlikely else None
        rare = of_means is not None and means.follows(p, DV, sd, RARE) > 0.0
        if not lately.seldom:
            return None if of_means is None else Shown(of_means, mean=rare)
        wider = lately.leaves_open(p, sd, means.coarse)
        wider = wider if of_means is None else np.maximum(wider, of_means)
        return Shown(wider, lately.last, rare)

    def _tilts(
        self,
        name: str,
        record: Series,
        said: PositionOffer | VelocityOffer,
        covariance: Array,
        left: float,
    ) -> Array | None:
        """What a velocity leaves open of roll and pitch; None where it is nothing."""
        before = self.wider.get(name)
        kept = 0.0 if before is None else left * left * float(before[6])
        told = record.means.unlikely and record.every_ns > 0
        now = _tilt(record, said, covariance) if told else 0.0
        tilt = max(kept, now)
        if tilt <= LEAST * min(covariance[PHI, PHI], covariance[PHI + 1, PHI + 1]):
            return None
        wider = np.zeros(9)
        wider[6:8] = tilt
        return wider

    def _put(self, name: str, wider: Array | None) -> None:
        if wider is not None:
            self.wider = {**self.wider, name: wider}
        elif name in self.wider:
            rest = {other: each for other, each in self.wider.items() if other != name}
            self.wider = rest or NOTHING

    def goes_across(self, aid: Aid, record: Series, state: State) -> None:
        """An aid that does not slip was fused; the `state` after it."""
        across, variance = aid.across(state), aid.across_sd_m_s**2
        record.slip = record.slip.with_one(aid.t_ns, across, state.speed, variance)
        self.went_across(aid, record, state)

    def went_across(self, aid: Aid, record: Series, state: State) -> None:
        """What the slip leaves open of one that was."""
        self._heading(aid.source + ACROSS, record.slip.opened)
        if AT_REST in self.wider:
            kept, p = FADES * float(self.wider[AT_REST][8]), state.covariance
            own = 0.0 if p is None else float(p[PHI + 2, PHI + 2])
            self._heading(AT_REST, kept if kept > LEAST * own else 0.0)

    def turns_at_rest(self, angle: float) -> None:
        """The gyros have felt a turn by so much (rad) of a vehicle that stands and cannot turn."""
        before = self.wider.get(AT_REST)
        angle += 0.0 if before is None else math.sqrt(before[8])
        self._heading(AT_REST, angle * angle)

    def _heading(self, name: str, variance: float) -> None:
        wider = None
        if variance > 0.0:
            wider = np.zeros(9)
            wider[8] = variance
        self._put(name, wider)

    def returns(self, source: str, proof: Proof, covariance: Array | None, white: bool) -> bool:
        """A position that is back, and whether it drifts, is not known yet; P (n, n) of the
        filter, `white` where its fixes share no error. Whether its means have nothing to add: they
        have where such an error keeps P, and the slope is not beyond chance."""
        if covariance is None:
            self.drop(source)
            return white
        owns: list[float] = covariance.diagonal()[DR : DR + 2].tolist()
        opened = proof.leaves_open(owns, white=white)
        if not any(opened):
            self.drop(source)
            return white
        wider = np.zeros(9)
        for axis, variance, own in zip((DR, DR + 1), opened, owns, strict=True):
            wider[:3] += variance * (covariance[DR : DR + 3, axis] / own) ** 2
            wider[3:6] += variance * (covariance[DV : DV + 3, axis] / own) ** 2
        self._put(source, wider)
        return True

    def late(self, source: str, punctual: Punctual | None, covariance: Array | None) -> None:
        """A position that is back, and whether it is on time has not shown yet; P (n, n) of the
        filter."""
        wider = None
        if punctual is not None and not punctual.started and covariance is not None:
            own = covariance.diagonal()
            known = np.concatenate((own[DR : DR + 3], own[DV : DV + 3]))
            opened = np.maximum(punctual.leaves_open - known, 0.0)
            wider = np.concatenate((opened, np.zeros(3))) if opened.any() else None
        if wider is not None or self.wider:
            self._put(source + LATE, wider)

    def strays(self, source: str, wander: str, state: State | None) -> None:
        """A position was fused whose error has the block `wander`; the `state` after it."""
        wider = None
        if state is not None and (p := state.covariance) is not None:
            slots = state.model.indices[wander]
            if any_beyond_prior(state.xi, p, slots):
                wider = _beyond_prior(state.xi, p, slots.tolist())
        if wider is not None or self.wider:
            self._put(source + STRAYS, wider)

    def refused(self, source: str, by: tuple[float, float], since_s: float) -> None:
        """A velocity was refused that is apart `by` (m/s) from the filter's, north and east, and
        was not `since_s` before."""
        north, east = by[0] ** 2, by[1] ** 2
        wider = np.zeros(9)
        wider[3:5] = north, east
        wider[:2] = wider[3:5] * (0.5 * since_s) ** 2
        wider[6:8] = (north + east) / (STANDARD_GRAVITY_M_S2 * since_s) ** 2
        self._put(source, wider)

    def moved(
        self,
        source: str,
        records: Mapping[str, Series],
        record: Series,
        nav: Array,
        covariance: Array | None,
    ) -> Moved | None:
        """A position was fused that may be off since it is believed again; the state `nav` (10,)
        and P (n, n) of the filter. What is left of that."""
        moved = record.moved
        if moved is None or moved.told(records.values()):
            wider = None
        else:
            speed = math.hypot(nav.item(VN), nav.item(VE))
            wider = moved.leaves_open(record.heard_ns, speed)
            own = 0.0 if covariance is None else LEAST * covariance.diagonal()[DR : DR + 3]
            wider = wider if np.any(wider[:3] > own) else None
        self._put(source + MOVED, wider)
        return None if wider is None else moved

    def answered(self, records: Mapping[str, Series], record: Series, t_ns: int) -> None:
        """A series is fused, and what others left open that are silent may be its to tell now."""
        if not record.means.degrees:
            return
        for name in self.wider:
            other = records.get(source := _series_of(name))
            if other is None or other is record or t_ns - other.heard_ns <= FORGET_NS:
                continue
            fine = 0.0 < record.sd_m <= max(FINE_M, COARSER * other.sd_m)
            if fine if other.locates else other.moves and record.moves:
                self.drop(source)
                self._put(source + MOVED, None)

    def sits(self, angles: Sequence[float], sd: float) -> None:
        """The mounting's pitch and yaw (rad) as found so far, beyond what was configured with one
        sigma `sd` (rad)."""
        pitch, yaw = (beyond_chance(angle, sd) for angle in angles)
        wider = None
        if pitch or yaw:
            wider = np.zeros(9)
            wider[7:] = pitch, yaw
        self._put(MOUNTING, wider)

    def drop(self, source: str) -> None:
        """Nothing of a series is beyond chance, or P holds it; what it may have moved by stays."""
        if self.wider:
            for name in (source, *(source + of for of in (TILT, LATE, ACROSS, STRAYS, LATELY))):
                self._put(name, None)


@cache
def _series_of(name: str) -> str:
    """Whose answer is awaited of what is kept under a name."""
    for what in (TILT, LATE, STRAYS, MOVED, LATELY):
        name = name.removesuffix(what)
    return name


@compiled("f8(f8, f8)")
def beyond_chance(angle: float, sd: float) -> float:
    """What the square of an angle has beyond what chance does with that sigma."""
    return max(0.0, angle * angle - SELDOM * sd * sd)


@compiled("b1(f8[::1], f8[:, :], i8[::1])")
def any_beyond_prior(xi: Array, covariance: Array, slots: Indices) -> bool:
    """Whether `_beyond_prior` has anything: asked of every fix."""
    for slot in slots:
        shown = 1.0 - covariance[slot, slot]
        if shown > 0.0 and xi[slot] * xi[slot] > SELDOM * shown:
            return True
    return False


def _beyond_prior(xi: Array, covariance: Array, slots: Sequence[int]) -> Array | None:
    """What estimates of variance one that are beyond chance leave open (9,); None where none is:
    the `slots` in xi (n,) and P (n, n)."""
    wider = None
    for slot in slots:
        shown = 1.0 - float(covariance[slot, slot])
        excess = float(xi[slot]) ** 2 - SELDOM * shown
        if shown <= 0.0 or excess <= 0.0:
            continue
        opened = excess * (covariance[:, slot] / shown) ** 2
        tilt = opened[PHI] + opened[PHI + 1]  # of whichever axis roll and pitch are about
        own = (*opened[DR : DR + 3], *opened[DV : DV + 3], tilt, tilt, opened[PHI + 2])
        wider = np.array(own) if wider is None else wider + own
    return wider


def _tilt(record: Series, said: PositionOffer | VelocityOffer, covariance: Array) -> float:
    """The square (rad^2) of the tilt that accelerates as a velocity has it."""
    changes = record.means.follows(covariance, DV, said.sd, SELDOM)
    return changes / (record.every_ns * 1e-9 * STANDARD_GRAVITY_M_S2) ** 2


def _turns(aid: Aid, record: Series, nav: Array, covariance: Array) -> Array:
    """What a velocity across leaves open of the heading (9,)."""
    wider, speed = np.zeros(9), max(math.hypot(nav[VN], nav[VE]), MOVING_M_S)
    yaw = float(covariance[PHI + 2, PHI + 2])
    wider[8] = record.means.excess[0] * ((aid.across_sd_m_s / speed) ** 2 + yaw)
    return wider


def differ(record: Series, said: Said, covariance: Array | None) -> tuple[float, ...]:
    """By how much (m or m/s) of each axis the means of a series are off; P (n, n) of the filter."""
    if said is None or covariance is None:
        return ()
    first, coarse = DR if record.locates else DV, record.means.coarse
    own: list[float] = covariance.diagonal()[first : first + 3].tolist()
    axes = zip(record.means.most(), own, said.sd, strict=False)
    return tuple(m * math.sqrt(p + (coarse * sd) ** 2) for m, p, sd in axes)
