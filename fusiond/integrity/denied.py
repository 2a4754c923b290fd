r"""Receivers that wheels deny: what of a disagreement is theirs, and not the motion's.

Of a velocity that parts from the filter the inertial unit or the receiver is wrong, and of two
receivers that part together as well (one antenna, one who spoofs them). A wheel's speed that agrees
with the filter is a third, of the length of the velocity alone. A heading that is wrong by an angle
a turns the velocity v, which is then off

    along the track v (1 - cos a)        across it v sin a        their ratio tan(a / 2)

so that what is off along the track by more than half of what it is across (a beyond 53 deg) is no
heading: the receiver is left out for itself, the motion is not doubted, and neither has it anybody
who speaks for its position. Receivers that part by the same, within their sigmas, are judged by
their mean, and what one is denied all are. Once one position of a device so denied is found to
drift, all are left out: they are wrong together. Such a velocity comes back with the position, not
before: where the vehicle has turned a drift is across, and no wheel tells.
"""

from __future__ import annotations

import math

from fusiond.integrity.punctual import MOVING_M_S
from fusiond.integrity.series import DENIED, Series
from fusiond.integrity.support import SUPPORT_NS, Records

# tan(a / 2): see above.
MOST_TURN = 0.5
# What two part by is the same within so many sigmas of both: chi-square of two, one in 3000.
SAME = 4.0


def denies(records: Records, record: Series, v_n: float, v_e: float) -> bool:
    """Whether what a velocity is `off` from a filter that moves by `v_n` and `v_e` (m/s) is its
    own; of a position, whether its device's velocity is denied."""
    if record.locates:
        return record.device in devices(records)
    if not record.moves or math.hypot(v_n, v_e) <= MOVING_M_S:
        return False
    if not rolling(records, record.heard_ns):
        return False
    others = [r for r in records.values() if r is not record and _same(r, record)]
    if any(r.excluded == DENIED for r in others):
        return True
    north, east = (sum(one) for one in zip(record.off, *(r.off for r in others), strict=True))
    own: bool = abs(north * v_n + east * v_e) > MOST_TURN * abs(east * v_n - north * v_e)
    return own


def _same(other: Series, record: Series) -> bool:
    """Whether another velocity is refused for the same offset."""
    if not (other.moves and (other.refused or other.excluded)):
        return False
    apart = math.dist(record.off, other.off)
    return apart <= SAME * math.hypot(record.sd_m_s, other.sd_m_s)


def rolling(records: Records, t_ns: int) -> bool:
    """Whether a speed that was measured otherwise than by a receiver, as by wheels, agrees with the
    filter still and has not been unusual."""
    return any(
        r.value is not None
        and not (r.locates or r.moves)
        and r.believed
        and not r.means.unlikely
        and t_ns - r.fused_ns <= SUPPORT_NS
        for r in records.values()
    )


def devices(records: Records) -> set[str]:
    """Those of which a velocity is left out for itself."""
    return {r.device for r in records.values() if r.excluded == DENIED}


def position_away(records: Records, record: Series) -> bool:
    """Whether a velocity that was denied would come back before the position of its device, which
    is left out as well and away."""
    return record.excluded == DENIED and any(
        r.locates and r.device == record.device and r.excluded and not r.passes
        for r in records.values()
    )
