r"""Which series of measurements may be believed: fault detection with memory, exclusion, return.

A series is what one source says of one thing (`gnss`, `gnss_velocity`); a device may send several.
Its whitened innovations y (d,), S = L L^T, y = L^-1 nu, are N(0, I) while series and filter agree.
Three tests look at each, in order of validity:

Gate          y^T y against the chi-square of the aid's gate. `REFUSED_IN_A_ROW` failures in a row,
              and the series is excluded: single outliers are only left out.
Mean          m <- (1 - a) m + a y at two paces a. |m|^2 / (a / (2 - a) + c) is chi-square of d for
              innovations that share the part c of their variance, as the errors of a receiver
              without corrections do; beyond the quantile 1 - p the series has a bias that the gate
              cannot see: a ramp, a step inside the gate, a velocity of another instant. Of a series
              that is configured to share nothing c is 0 until it shows otherwise: sigma shrinks as
              if that were so, and what is as slow must be told as soon.
Repetition    what is the same to the bit while the filter moves, more often than by chance; a
              velocity as soon as the position of the same device is: a receiver that hangs.

A series that fails the mean test is measured against the rest: where another position, or the
velocity of the same device, is believed, the series is excluded; where nothing is left to compare
with, the filter's own motion and sensor errors are doubted, which widens P. So they are when the
aids that are fused correct its tilt more than its P allows (fusiond.integrity.tilt). Not so where
wheels say that it is the receiver (fusiond.integrity.denied).

An excluded series is looked at, not fused. It comes back when five innovations in a row over three
seconds have passed the gate, without a bias and, of a position, without running away: the
filter's own bound, grown as the IMU's errors let it, or another source then supports it. Patience
does not; what it may be off by still is open (fusiond.integrity.moved). The filter's error,
P / (P + R) of a position's variance, is the same in all of them, and c no less: a filter that has
gone astray by one of its sigmas could never be corrected else. After an outage of all positions the
first that comes back is taken at once, but counts less until it is seen to go with the motion
(fusiond.integrity.proof), and, where it lies behind the filter by more than is likely, is not
vouched for until a lateness would have shown (fusiond.integrity.returns); what is published is no
surer than that meanwhile (fusiond.integrity.punctual).

With all series of position refused, how it began tells who is wrong (fusiond.integrity.jumps).

Source: as of fusiond.integrity.means; Bar-Shalom, Li, Kirubarajan (2001), section 5.4; Brumback,
Srinath, IEEE Trans. AC 32 (1987), 1133.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, State
from fusiond.estimators.base import Estimator, Outcome, gate_threshold
from fusiond.estimators.update import Plain
from fusiond.integrity import ordinary, returns, support
from fusiond.integrity.action import MOTION, NONE, Action
from fusiond.integrity.denied import denies, position_away, rolling
from fusiond.integrity.hedge import differ
from fusiond.integrity.jumps import jumps
from fusiond.integrity.kept import Kept
from fusiond.integrity.moved import FINE_M, Parted, back
from fusiond.integrity.ordinary import Ordinary
from fusiond.integrity.proof import above, apart, filters_own, residual
from fusiond.integrity.punctual import MOVING_M_S
from fusiond.integrity.series import DENIED, DRIFTS, REPEATS, Said, Series, parts_by, said
from fusiond.integrity.support import FORGET_NS, Lost
from fusiond.integrity.tilt import Tilting, remember, too_far
from fusiond.models.model import Model
from fusiond.navigation.strapdown import LAT, LON, VE, VN

Array = NDArray[np.float64]

# Three failures of a gate of 0.9999 in a row are 1e-12 by chance; of one multipath burst in a
# street they are the rule.
REFUSED_IN_A_ROW = 3
# Probability of a false alarm of one mean test.
FALSE_ALARM = 1e-6
# A vehicle that does not face the way it is taken to, or slides: so long (ns) and so often in a row
# its constraint is refused. A corner taken too fast is over by then.
SLIDING_NS, SLIDING_COUNT = 1_000_000_000, 10
# So many doubts of the filter are remembered.
DOUBTS = 8


def _passed(aid: Aid, outcome: Outcome) -> bool:
    """Whether an innovation has passed its gate, fused or only looked at."""
    return outcome.nis <= gate_threshold(aid.gate, max(outcome.degrees, 1))


class Isolation(Kept):
    """Judges each aid once it has been looked at; a function of the aids in order alone."""

    def __init__(self, false_alarm: float = FALSE_ALARM) -> None:
        super().__init__()
        self.shown: tuple[float, ...] = ()
        """By how much (m, m/s) the series that was judged last was off, if it had a bias."""
        self._pass = 1.0 - false_alarm
        self._always: dict[tuple[object, ...], Ordinary | None] = {}
        self._model: Model | None = None
        """Of what is the same for aids that are not measured: of what model."""

    # ------------------------------------------------------------------ what others ask

    @property
    def excluded(self) -> dict[str, str]:
        """Series that are left out, and why."""
        return {name: r.excluded for name, r in self._records.items() if r.excluded}

    def unproven(self, series: str, t_ns: int) -> bool:
        """Whether a fine position is not yet seen to go with the motion since an outage."""
        record = self._records.get(series)
        if record is None or not 0.0 < record.sd_m <= FINE_M:
            return False
        return record.proof is not None or support.outage(self._records, record, t_ns)

    def coarseness(self, aid: Aid) -> float:
        """With how many times its stated sigma an aid counts, by how long its errors last; infinite
        where its series is not believed."""
        record = self._records.get(aid.source)
        if record is None:
            return 1.0
        if record.excluded:
            return math.inf
        asked = aid.moves or (aid.locates and record.alike)
        return support.coarseness(self._records, record, aid) if asked else 1.0

    def assumes(self, aid: Aid) -> bool:
        """Whether the aid counts as coarser than it says by what is assumed, or as it hangs: what
        its innovation says of the sigma that it states is then no one's."""
        return support.assumes(self._records, aid)

    def lost(self, t_ns: int) -> Lost | None:
        """Set while positions come and none is believed: since when, and who is to blame."""
        return support.lost(self._records, t_ns)

    def contested(self, t_ns: int) -> str | None:
        """Why nobody can tell whether filter or sources are right; None where that is known."""
        return support.contested(self._records, t_ns)

    def supported_by_another(self, device: str) -> bool:
        """Whether a position of another device has been fused since the start."""
        return support.from_another(self._records, device)

    def velocity_left_out(self, t_ns: int) -> bool:
        """Whether a velocity that comes is not believed."""
        return support.velocity_left_out(self._records, t_ns)

    def ordinary(self, aid: Aid, model: Model, tilts: bool) -> Ordinary | None:
        """What `take` wants of an aid for filters of a model; None where it is never ordinary."""
        if (always := aid.always) is None:
            return ordinary.made(aid, model, tilts, self._pass)
        if model is not self._model:
            self._model, self._always = model, {}
        if always not in self._always:
            self._always[always] = ordinary.made(aid, model, tilts, self._pass)
        return self._always[always]

    # ------------------------------------------------------------------ judgement

    def judge(
        self,
        aid: Aid,
        outcome: Outcome,
        nav: Array,
        covariance: Array | None = None,
        state: State | None = None,
        says: Said | None = None,
    ) -> Action:
        """Take in how an aid ended, fused, gated or only looked at; what the filter shall do.

        `nav` (10,): what it was compared with; P (n, n) and the whole `state`, where known; what it
        `says`, where that has been asked before.
        """
        t_ns = aid.t_ns
        record = self._records.get(aid.source)
        if record is None or aid.source in self._shared:
            record = self._own(aid, record)
        record.every_ns, record.heard_ns = t_ns - record.heard_ns, t_ns
        if record.every_ns > FORGET_NS:
            record.forget()
        says = says or said(aid.offers())
        offer, velocity, value = says
        offset, self.shown, repeats = None, (), False
        if offer is not None:
            if state is not None:
                offset = residual(offer, state)
            else:
                offset = apart(offer, float(nav[LAT]), float(nav[LON]), nav)
            record.sd_m, record.away_m = offset.sd, math.hypot(offset.north, offset.east)
            if outcome.name != "fused":
                record.above_m = above(offer, nav)
        elif record.moves:
            record.sd_m_s = 0.0 if velocity is None else max(velocity.sd[:2])
        v_n, v_e = nav.item(VN), nav.item(VE)
        if value is not None:
            moving = math.hypot(v_n, v_e) > MOVING_M_S
            repeats = record.repeats_itself(value, moving)
            repeats = repeats or (record.repeats > 0 and support.hangs(self._records, record))
        if record.excluded:
            self.hedge.drop(aid.source)
            own = 0.0 if offer is None or covariance is None else filters_own(offer, covariance)
            passed = _passed(aid, outcome) and not (repeats or position_away(self._records, record))
            record.look(t_ns, passed, outcome.whitened, offset, own, self._pass)
            if not record.excluded:
                self._followed(record, t_ns)
            if offset is not None and not record.excluded and covariance is not None:
                record.moved = back(record, t_ns, covariance)
            return NONE
        if repeats:
            record.exclude(t_ns, REPEATS, jumped=True)
            passed = _passed(aid, outcome)
            return self._doubted(Action.DOUBT_MEASURED if passed else NONE, t_ns)
        if outcome.name != "fused":
            if aid.constraint:
                self._slides(record, t_ns)
                return NONE
            if _passed(aid, outcome):
                return NONE
            by = (0.0, 0.0) if velocity is None else parts_by(velocity, v_n, v_e)
            away = record.away_m if aid.locates else math.hypot(*by)
            since_ns = t_ns - record.fused_ns
            if velocity is not None:
                record.parts(by, outcome.nis)
                if 0 < since_ns <= FORGET_NS:
                    self.hedge.refused(aid.source, by, since_ns * 1e-9)
            denied = denies(self._records, record, v_n, v_e)
            action = self._refuse(record, t_ns, outcome.nis, away, denied)
            if record.moves and action in MOTION:
                record.parted = Parted(record.refused_ns, *by)
            return self._doubted(action, t_ns)
        begun, comes, self._comes = self._begun, self._comes, returns.NOTHING
        runs = offer is not None and returns.prove(
            self._records, record, offer, nav, state, begun, comes, self._pass
        )
        record.fused_ns, record.refused, record.jumped = t_ns, 0, False
        if runs:
            record.exclude(t_ns, DRIFTS, jumped=True)
            return self._doubted(Action.DOUBT_MEASURED, t_ns)
        if record.no_slip and state is not None and aid.across_sd_m_s > 0.0:
            self.hedge.goes_across(aid, record, state)
        biased = record.means.tested(outcome.whitened, t_ns, self._pass)
        if velocity is not None:
            record.lately = record.lately.and_then(outcome.whitened, outcome.nis)
        return self._fused(aid, record, says, biased, nav, covariance, state)

    def _fused(
        self,
        aid: Aid,
        record: Series,
        says: Said,
        biased: bool,
        nav: Array,
        covariance: Array | None,
        state: State | None,
    ) -> Action:
        """Of an aid that was fused: what its series leaves open, whose means may be `biased`."""
        (offer, velocity, _), hedge, proof = says, self.hedge, record.proof
        if biased:
            self.shown = differ(record, offer or velocity, covariance)
            hedge.drop(aid.source)
            record.off = (self.shown[0], self.shown[1]) if self.shown[1:] else (0.0, 0.0)
            denied = denies(self._records, record, nav.item(VN), nav.item(VE))
            action = self._blame(record, aid, denied)
            if action in MOTION and self.shown:
                self._parts(record, aid.t_ns, self.shown)
            return self._doubted(action, aid.t_ns)
        told, white = False, proof is not None and aid.white
        if proof is not None and (white or aid.wanders):
            told = hedge.returns(aid.source, proof, covariance, white)
        if not told and (record.means.unlikely or (hedge.wider and hedge.holds(aid.source))):
            left = self._tilting.left(covariance)
            hedge.look(aid, record, offer or velocity, nav, covariance, left)
        if velocity is not None:
            hedge.lately(aid.source, record, velocity.sd, covariance)
        elif offer is not None and covariance is not None:
            hedge.stays(aid.source, record, offer.sd, covariance)
            if record.means.unlikely:
                self._goes_alone(record, aid.t_ns, offer, covariance)
        if offer is not None and aid.wanders:
            hedge.strays(aid.source, offer.wander, state)
        elif offer is not None:
            hedge.late(aid.source, record.punctual, covariance)
        if hedge.wider:
            hedge.answered(self._records, record, aid.t_ns)
        if record.moved is not None:
            record.moved = hedge.moved(aid.source, self._records, record, nav, covariance)
        return NONE

    def comes(self, aid: Aid, state: State, covariance: Array) -> None:
        """A position that is not yet seen to go with the motion is about to be fused into a filter
        with that state and P (n, n)."""
        self._comes = returns.coming(aid, state, covariance)

    def turns_at_rest(self, angle: float) -> None:
        """The gyros have felt a turn by so much (rad) of a vehicle that stands. One that does not
        slip cannot turn on the spot."""
        if any(record.no_slip for record in self._records.values()):
            self.hedge.turns_at_rest(angle)

    def unsettled(self, t_ns: int) -> float:
        """Of a doubt's variances, the share by which the sensors' errors may have changed anew
        since the position or velocity before the one that comes."""
        return support.unsettled(self._records, self._doubts, t_ns) if self._doubts else 0.0

    def correcting(self, nav: Array, covariance: Array) -> None:
        """A position or velocity is about to be fused into a filter with the state `nav` (10,) and
        P (n, n)."""
        remember(nav, covariance, self._tilting.before)

    def corrected(self, t_ns: int, nav: Array, covariance: Array, turned: float = 0.0) -> Action:
        """It was, and these are what came of it, P in axes that have `turned` (rad); what the
        filter shall do about the attitude, as fusiond.integrity.tilt has it."""
        tilting = self._tilting
        if not too_far(tilting.sums, t_ns, tilting.before, nav, covariance, turned):
            return NONE
        return self._tilted(t_ns)

    def _tilted(self, t_ns: int) -> Action:
        self._tilting = Tilting()
        if rolling(self._records, t_ns) and (wrong := self._denied_positions()):
            for one in wrong:
                one.exclude(t_ns, DRIFTS, jumped=True)
            return Action.DOUBT_MEASURED
        return self._doubted(Action.DOUBT_MOTION, t_ns)

    def take(
        self, aid: Aid, one: Ordinary, filter_: Plain, estimator: Estimator
    ) -> tuple[Outcome, int, Action] | None:
        """Fold an aid into an estimator, whose `filter_` that is, and take in how it ended, what
        `update` and all of the above do, if it is an ordinary one; else nothing has changed. With
        what that has shown (fusiond.integrity.ordinary)."""
        t_ns, record = aid.t_ns, self._records.get(aid.source)
        if record is None or not ordinary.may_be(one, t_ns, record):
            return None
        if one.tilts and self.unsettled(t_ns):
            return None
        if aid.source in self._shared:
            record = self._own(aid, record)
        taken = ordinary.take(one, t_ns, record, filter_, self._tilting)
        if taken is None:
            return None
        outcome, shown = taken
        self.shown, self._comes, action, hedge = (), returns.NOTHING, NONE, self.hedge
        if not (shown or hedge.wider):
            return outcome, shown, action
        state = estimator.state
        if record.no_slip and (shown & ordinary.ACROSS or hedge.wider):
            hedge.went_across(aid, record, state)
        if shown & ordinary.LEAVES_OPEN or hedge.wider:
            biased = shown & ordinary.BIAS > 0
            action = self._fused(aid, record, one.says, biased, state.nav, state.covariance, state)
        return outcome, shown, self._tilted(t_ns) if shown & ordinary.TILTED else action

    def _doubted(self, action: Action, t_ns: int) -> Action:
        if action in MOTION:
            self._doubts = (*self._doubts, t_ns)[-DOUBTS:]
        return action

    def _slides(self, record: Series, t_ns: int) -> None:
        """A constraint was refused."""
        record.refused += 1
        if record.refused == 1:
            record.refused_ns = t_ns
        lasts_ns = t_ns - record.refused_ns
        if record.no_slip and record.refused >= SLIDING_COUNT and lasts_ns >= SLIDING_NS:
            record.exclude(record.refused_ns, "disagrees", jumped=False)

    def _refuse(self, record: Series, t_ns: int, nis: float, away: float, denied: bool) -> Action:
        """A measurement was refused that is `away` (m or m/s) from the filter, or `denied`."""
        record.refused += 1
        if record.refused == 1:
            record.refused_ns = t_ns
            agrees = support.supported(self._records, record.device, t_ns)
            record.jumped = jumps(record, t_ns, nis, away, agrees)
        if record.refused < REFUSED_IN_A_ROW:
            return NONE
        reason = "jumped" if record.jumped else "disagrees"
        if denied:
            reason, record.jumped = DENIED if record.moves else reason, True
        record.exclude(record.refused_ns, reason, jumped=record.jumped)
        # A jump is the source's. Else the motion may be what is wrong, and positions shall decide.
        # What is neither position nor velocity (a heading, a height) has nobody to decide: a doubt
        # would open the filter until it passes, which is patience by another name.
        if record.jumped or not (record.locates or record.moves):
            return NONE
        return Action.DOUBT_MOTION

    def _blame(self, record: Series, aid: Aid, denied: bool) -> Action:
        """A bias inside the gate: the series', where something else supports the filter, or where
        it is `denied`."""
        record.means.restart()
        sd_m = 0.5 * record.away_m if aid.locates else FINE_M
        source = support.others(self._records, record, aid.t_ns, sd_m)
        if not source and aid.locates:
            source = support.vouched(self._records, record.device, aid.t_ns)
        if not (source or denied):
            return Action.DOUBT_FILTER
        its_own = record.locates or denied
        wrong = self._denied_positions() if record.locates and denied else []
        for one in (record, *wrong):
            one.exclude(aid.t_ns, DENIED if denied and one.moves else DRIFTS, jumped=its_own)
        return Action.DOUBT_MEASURED if its_own else Action.DOUBT_FILTER
