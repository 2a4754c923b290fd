"""What a running solution is worth, and when it must be given up.

The filter says when its innovations do not fit (fusiond.integrity.isolation); here it is decided
what follows for the operator:

    doubted    the motion was in doubt lately: the sigma was widened, and is not yet proven
    unchecked  positions come and none is believed: the IMU alone carries the solution
    turned     the gyros felt a turn of a vehicle that stood: they are wrong, or what it stands on
               has turned, and until it has moved nobody can tell
    contested  what was left out may be right: nobody can tell
    left       what the solution started from had left the one before it by a jump, and no other
               device has said since which of the two was right
    askew      the IMU does not sit on the vehicle as it was configured: whose attitude is it?
    given up   the filter is wrong, or cannot be told from wrong any more: alignment begins anew

A filter that was given up and aligned anew is on trial for a while: its mode stays `invalid` until
it has gone on without a doubt. What made it fail may be there still, and driving on at one speed
shows neither a wrong IMU nor stamps that are late: on a straight they are late by a way, in a
bend of rate w by a heading of w times as much. It coasts until its speed has changed, and until the
positions would have shown that they are late (fusiond.integrity.punctual): that the speed changes
evenly shows nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.base import Estimator
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.moved import Moved, left
from fusiond.integrity.series import NEVER_NS
from fusiond.integrity.support import Lost
from fusiond.models.vehicle import MOUNTING
from fusiond.navigation.strapdown import VE, VN

Array = NDArray[np.float64]

# An isolated refusal is ordinary; of a receiver that sends each second the third has come by then.
UNCHECKED_NS = 2_000_000_000
# Positions and velocities of a device that agree with each other and not with the filter for so
# long show that the filter is wrong: five of a receiver that sends each second.
FILTER_WRONG_NS = 5_000_000_000
# A source that jumped away is waited for while the IMU bounds the position: a minute is what a
# vehicle's MEMS unit keeps to within a hundred metres.
SOURCE_WRONG_NS = 60_000_000_000
# After a doubt the innovations of a few seconds bring the widened sigma down again, whether the IMU
# is sound or not; the next seconds tell.
DOUBTED_NS = 10_000_000_000
# Driving straight on proves little of an IMU or of a clock: after a second doubt it takes twice as
# long, and so on. Doubts this near to each other are one.
LONGEST_DOUBT_NS, ONE_DOUBT_NS = 320_000_000_000, 3_000_000_000
# More doubts than this within the time: what widens P does not cure the filter.
MOST_DOUBTS, DOUBTS_NS = 3, 20_000_000_000
# A start after a failure proves itself for so long before it is called navigation, and twice as
# long after each further one. What went well for ten times as long was none of a row.
TRIAL_NS, LONGEST_TRIAL_NS = 10_000_000_000, 320_000_000_000
LASTED = 10
# By so much (m/s) since the last doubt: at 1 m/s^2 stamps that are half a second late are off by
# ten sigma of a receiver's velocity meanwhile.
PROVING_M_S = 5.0
# A robot that never drives as fast stops and goes: by most of the speed that it had before the
# first failure, once that was more than a walk's.
MOST_OF_SPEED, SLOW_M_S = 0.8, 0.8
# A mounting found so many of its configured sigmas from what was configured is not the one that was
# configured: chance does that once in 16,000 vehicles.
ASKEW_SIGMAS = 4.0


class Standing:
    """Follows one navigation from its start; `max_speed_m_s` of the vehicle, and whether it is one
    that does not slide (`wheeled`) and so cannot turn on the spot."""

    def __init__(self, max_speed_m_s: float, wheeled: bool = False) -> None:
        self._max_speed, self._wheeled = max_speed_m_s, wheeled
        self._turned_ns, self._turned = NEVER_NS, False
        self._trial_ns = 0
        self._started_ns = 0
        self._since_ns = 0
        self._from = self._fastest = 0.0
        self._changed = 0.0
        self._left = ""
        self._gone: Moved | None = None
        self.moved: Moved | None = None
        """By what a source may be off still that had left the solution before the start, or was
        believed again in it."""
        self._shaken: tuple[int, str | None] | None = None

    def started(self, t_ns: int) -> None:
        """A navigation has begun."""
        self._started_ns, self._turned_ns, self._turned = t_ns, NEVER_NS, False
        self._shaken = None

    @property
    def failed(self) -> bool:
        """Whether a navigation was given up before this one."""
        return self._trial_ns > 0

    def turned(self, t_ns: int) -> None:
        """The gyros have felt a turn of a vehicle that stands."""
        if self._wheeled:
            self._turned_ns, self._turned = max(self._turned_ns, t_ns), True

    def given_up(self, t_ns: int) -> None:
        """It was wrong: the next one is on trial."""
        lasted = t_ns - self._started_ns > LASTED * max(self._trial_ns, TRIAL_NS)
        longer_ns = TRIAL_NS if lasted else max(TRIAL_NS, 2 * self._trial_ns)
        self._trial_ns = min(longer_ns, LONGEST_TRIAL_NS)

    def ended(self, isolation: Isolation) -> None:
        """A navigation is over, for whatever reason; the next one starts from the same sources."""
        gone, self._gone, still = self._gone, None, isolation.moved
        if gone is not None:
            still = gone.joined(still if still and still.device == gone.device else None)
        self.moved = still

    def failure(self, t_ns: int, isolation: Isolation, nav: Array) -> str | None:
        """Why navigation must begin anew; None while it need not. To be asked whenever the filter
        has run.

        `nav` (10,) at `t_ns`, the filter's instant.
        """
        self._shaken = self._gone = None
        v_n, v_e = nav[VN : VE + 1].tolist()
        speed, doubts = math.hypot(v_n, v_e), isolation.doubts
        self._watch(t_ns, isolation, speed)
        if speed > self._max_speed:
            return f"{speed:.0f} m/s is faster than this vehicle can be"
        if doubts and sum(t_ns - doubt_ns <= DOUBTS_NS for doubt_ns in doubts) > MOST_DOUBTS:
            return "IMU and aids do not fit each other"
        lost = isolation.lost(t_ns)
        # To begin anew from what is on its way back were to believe it before it has proven itself.
        if lost is None or lost.disputed or (lost.cause == "source" and lost.returning):
            return None
        patience_ns = FILTER_WRONG_NS if lost.cause == "filter" else SOURCE_WRONG_NS
        waited_ns = t_ns - lost.since_ns
        if waited_ns <= patience_ns:
            return None
        by_source = lost.cause == "source"
        self._left = lost.device if by_source else ""
        if by_source or lost.alone:
            self._gone = left(lost.device, t_ns, waited_ns, lost.away_m, lost.alone)
        return f"{_told(lost)} for {waited_ns * 1e-9:.0f} s"

    def _watch(self, t_ns: int, isolation: Isolation, speed: float) -> None:
        """How far the speed (m/s) has changed since the start or the last doubt, and since measured
        velocities go along: while one is left out nothing is proven."""
        since_ns = max(self._started_ns, self._turned_ns, *isolation.doubts)
        if since_ns != self._since_ns or isolation.velocity_left_out(t_ns):
            self._since_ns, self._from, self._changed = since_ns, speed, 0.0
        self._changed = max(self._changed, abs(speed - self._from))
        if not self._trial_ns:
            self._fastest = max(self._fastest, speed)
        if self._proven:  # a velocity that is left out an hour later says nothing of that turn
            self._turned = False

    @property
    def _proven(self) -> bool:
        """Whether the speed has changed by `PROVING_M_S`, or by most of what this vehicle does."""
        most = MOST_OF_SPEED * self._fastest
        return self._changed >= (min(most, PROVING_M_S) if most > SLOW_M_S else PROVING_M_S)

    def unproven(self, t_ns: int) -> str | None:
        """Why a solution is not to be called valid yet: it is on trial."""
        left_ns = self._started_ns + self._trial_ns - t_ns
        if left_ns <= 0:
            return None
        return f"on trial for {left_ns * 1e-9:.0f} s more after a failure"

    def doubtful(self, estimator: Estimator, isolation: Isolation) -> bool:
        """Whether it is not known that filter and aids fit each other."""
        unproven = self.unproven(estimator.t_ns) is not None
        return unproven or self.shaken(estimator, isolation) is not None

    def shaken(self, estimator: Estimator, isolation: Isolation) -> str | None:
        """Why a solution is coasting though aids come; None where it is not. Several ask it of one
        tick."""
        if self._shaken is None or self._shaken[0] != estimator.t_ns:
            self._shaken = estimator.t_ns, self._shakes(estimator, isolation)
        return self._shaken[1]

    def _shakes(self, estimator: Estimator, isolation: Isolation) -> str | None:
        t_ns = estimator.t_ns
        lost = isolation.lost(t_ns)
        if lost is not None and t_ns - lost.since_ns > UNCHECKED_NS:
            return f"{_told(lost)}: nothing else can check it"
        left_ns = _doubted_until(isolation.doubts) - t_ns
        if left_ns > 0:
            return f"IMU and aids did not fit: sigma widened, {left_ns * 1e-9:.0f} s to prove it"
        if self._trial_ns and not self._proven:
            return "after a failure, and no change of speed has proven it since"
        if self._left and isolation.supported_by_another(self._left):
            self._left = ""
        if self._left:
            return f"{self._left} left the solution of before the start: nothing else can check it"
        if self._turned:
            return "a turn was felt at rest: a gyro is wrong, or the ground has turned"
        return isolation.contested(t_ns) or _askew(estimator)


def _doubted_until(doubts: Sequence[int]) -> int:
    """Until when (ns) the motion is not yet proven."""
    patience_ns, before_ns = 0, NEVER_NS
    for doubt_ns in doubts:
        apart_ns = doubt_ns - before_ns
        if apart_ns > max(LASTED * patience_ns, ONE_DOUBT_NS):
            patience_ns = DOUBTED_NS
        elif apart_ns > ONE_DOUBT_NS:
            patience_ns = min(2 * patience_ns, LONGEST_DOUBT_NS)
        before_ns = doubt_ns
    return before_ns + patience_ns


def _askew(estimator: Estimator) -> str | None:
    """Attitude is that of the IMU's axes, and the vehicle's to within the mounting's sigma."""
    model = estimator.model
    for slot in model.slots_of(MOUNTING):
        angle = float(estimator.xi[slot])
        if abs(angle) > ASKEW_SIGMAS * float(model.initial[slot]):
            turned = f"{math.degrees(angle):+.0f} deg"
            return f"the IMU sits {turned} askew: [imu] mounting_deg is wrong, or it has turned"
    return None


def _told(lost: Lost) -> str:
    whose = "left the filter" if lost.cause == "source" else "and the filter disagree"
    return f"{lost.device} {whose} ({lost.reason})"
