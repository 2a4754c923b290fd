"""Whether what was refused had left the filter faster than an IMU's fault can explain.

With all series of position refused nobody can say who is wrong from innovations alone; how it began
can. An IMU's fault reaches the velocity before the position, and moves the position by no more than
that velocity and a bounded acceleration allow; a receiver's jump does not ask. So `lost` names a
cause: `source` where the position left its own velocity, or leaves the filter while the velocity
of the same device still agrees with it; `filter` where position and velocity went together.
"""

from __future__ import annotations

import math

from fusiond.integrity.series import Series
from fusiond.integrity.support import FORGET_NS

# Beyond what gravity on the wrong axis can do to a position in the time (m/s^2).
IMU_FAULT_M_S2 = 10.0
# Without a velocity of the same device, the velocity error that an unnoticed IMU fault may have
# brought before (m/s): ten times what an aided filter states, 0.1 to 1 m/s.
IMU_FAULT_M_S = 10.0
# A jump is beyond so many sigmas of its innovation, on top of the above.
JUMP_SIGMAS = 6.0


def jumps(record: Series, t_ns: int, nis: float, away: float, supported: bool) -> bool:
    """Whether a refused position or velocity, `away` (m or m/s) at that NIS, jumped; `supported`:
    a velocity of the same device agrees with the filter still."""
    if not math.isfinite(nis) or t_ns - record.fused_ns > FORGET_NS:
        return False
    apart_s = (t_ns - record.fused_ns) * 1e-9
    felt = IMU_FAULT_M_S2 * apart_s
    if record.locates:
        before = 0.0 if supported else IMU_FAULT_M_S
        felt = (before + 0.5 * felt) * apart_s
    return away > JUMP_SIGMAS * away / math.sqrt(nis) + felt
