"""What a running solution is worth, and when it must be given up.

The filter says when its innovations do not fit (fusiond.integrity.isolation); here it is decided
what follows for the operator:

    doubted    the motion was in doubt lately: the sigma was widened, and is not yet proven
    unchecked  positions come and none is believed: the IMU alone carries the solution
    given up   the filter is wrong, or cannot be told from wrong any more: alignment begins anew

A filter that was given up and aligned anew is on trial for a while: its mode stays `invalid` until
it has gone on without a doubt.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.isolation import Isolation, Lost
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
# After a doubt the innovations of a few seconds bring the widened sigma down again.
DOUBTED_NS = 3_000_000_000
# More doubts than this within the time: what widens P does not cure the filter.
MOST_DOUBTS, DOUBTS_NS = 3, 20_000_000_000
# A start after a failure proves itself for so long before it is called navigation.
TRIAL_NS = 10_000_000_000


class Standing:
    """Follows one navigation from its start; `max_speed_m_s` of the vehicle."""

    def __init__(self, max_speed_m_s: float) -> None:
        self._max_speed = max_speed_m_s
        self._trial_end_ns = 0
        self._failed = False

    def started(self, t_ns: int) -> None:
        """A navigation has begun."""
        self._trial_end_ns = t_ns + TRIAL_NS if self._failed else t_ns
        self._failed = False

    def given_up(self) -> None:
        """It was wrong: the next one is on trial."""
        self._failed = True

    def failure(self, t_ns: int, isolation: Isolation, nav: Array) -> str | None:
        """Why navigation must begin anew; None while it need not.

        `nav` (10,) at `t_ns`, the filter's instant.
        """
        speed = math.hypot(nav[VN], nav[VE])
        if speed > self._max_speed:
            return f"{speed:.0f} m/s is faster than this vehicle can be"
        if isolation.doubts(t_ns, DOUBTS_NS) > MOST_DOUBTS:
            return "IMU and aids do not fit each other"
        lost = isolation.lost(t_ns)
        if lost is None:
            return None
        patience_ns = FILTER_WRONG_NS if lost.cause == "filter" else SOURCE_WRONG_NS
        waited_ns = t_ns - lost.since_ns
        if waited_ns <= patience_ns:
            return None
        return f"{_told(lost)} for {waited_ns * 1e-9:.0f} s"

    def unproven(self, t_ns: int) -> str | None:
        """Why a solution is not to be called valid yet: it is on trial."""
        if t_ns >= self._trial_end_ns:
            return None
        return f"on trial for {(self._trial_end_ns - t_ns) * 1e-9:.0f} s more after a failure"

    def shaken(self, t_ns: int, isolation: Isolation) -> str | None:
        """Why a solution is coasting though aids come; None where it is not."""
        lost = isolation.lost(t_ns)
        if lost is not None and t_ns - lost.since_ns > UNCHECKED_NS:
            return f"{_told(lost)}: nothing else can check it"
        if isolation.doubts(t_ns, DOUBTED_NS):
            return "IMU and aids did not fit: sigma widened"
        return None


def _told(lost: Lost) -> str:
    whose = "left the filter" if lost.cause == "source" else "and the filter disagree"
    return f"{lost.device} {whose} ({lost.reason})"
