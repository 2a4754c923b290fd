r"""Receivers that wheels deny: what of a disagreement is theirs, and not the motion's.

Of a velocity that parts from the filter the inertial unit or the receiver is wrong, and of two
receivers that part together as well (one antenna, one who spoofs them). A wheel's speed that agrees
with the filter is a third, of the length of the velocity alone. A heading that is wrong by an angle
a turns the velocity v, which is then off

    along the track v (1 - cos a)        across it v sin a        their ratio tan(a / 2)

so that what is off along the track by more than half of what it is across (a beyond 53 deg) is no
heading: the receiver is left out for itself, the motion is not doubted, and neither has it anybody
who speaks for its position. Once one position of a device so denied is found to drift, all are left
out: they are wrong together. Such a velocity comes back with the position, not before: where the
vehicle has turned a drift is across, and no wheel tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from fusiond.integrity.punctual import MOVING_M_S
from fusiond.integrity.series import DENIED, Series
from fusiond.integrity.support import SUPPORT_NS, Records

# tan(a / 2): see above.
MOST_TURN = 0.5


def denies(records: Records, record: Series, by: Sequence[float], v_n: float, v_e: float) -> bool:
    """Whether what a series is off `by` (m/s, north and east, of a velocity) from a filter that
    moves by `v_n` and `v_e` is its own; of a position, whether its device's velocity is denied."""
    if record.locates:
        return record.device in devices(records)
    if not record.moves or math.hypot(v_n, v_e) <= MOVING_M_S:
        return False
    along, across = by[0] * v_n + by[1] * v_e, by[1] * v_n - by[0] * v_e
    return abs(along) > MOST_TURN * abs(across) and rolling(records, record.heard_ns)


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
