r"""Whether fixes come as late as they did: what the filter's own offsets in time say of themselves.

A filter that estimates an offset tau of a receiver follows one that has changed: slowly, for it is
taken for a constant, and with it goes the vehicle. An inertial unit whose biases are hardly known
contradicts neither; fixes and velocities go with each other and with the filter (a consumer unit,
0.8 s at 20 m/s: 16 m off at a stated 1.4 for minutes, no innovation unlikely). What has changed
shows in the estimates. Those of a constant are a martingale: from x_0, P_0 to x, P they move by an
amount of variance P_0 - P, with the random walk q T of clocks P_0 + q T - P. And by themselves the
measurements between the two would have it that the offset is by c another than it was,

    c = (x - x_0) P_0 / (P_0 - P),    var(c) = P_0^2 / (P_0 - P)

the difference of the two estimates that information adds up to x. Innovations that are a little
less white than they are taken for move x by many of so small sigmas, but then c is small. So an
offset has changed where both

    |x - x_0| > k sqrt(P_0 - P + FIRM_S^2)    and    |c| >= LATE_S

for a look at it in the last minute, the prior at the start among them, and none before P was opened
again by more than its walk (a doubt of the receiver does that): for k = 4 the mode says so
and the lateness is looked for (fusiond.navigator.alignment.lateness), for k = 4.9, a chance of one
in a million, the filter is given up.

A start after a failure was perhaps made of late fixes, and then nothing moves. The prior says
nothing of such a receiver. What is known of it without, tau_m = x / (1 - P / P_0) of variance s^2 =
P P_0 / (P_0 - P), excludes a lateness of `LATE_S` where -tau_m + 1.96 s < LATE_S; until then it is
not vouched for while the vehicle moves.

Source: martingale property of conditional means, Bar-Shalom, Li, Kirubarajan (2001), section 5.2;
sequential estimation and information, section 7.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.punctual import LATE_S, MOVING_M_S
from fusiond.integrity.returns import SURPRISE
from fusiond.integrity.series import NEVER_NS
from fusiond.models.model import Model
from fusiond.models.vehicle import FIX_TIME, VELOCITY_TIME
from fusiond.navigation.strapdown import VE, VN

Array = NDArray[np.float64]

# Chance exceeds them once in 16,000 and once in a million.
SUSPECT_SIGMAS, CHANGED_SIGMAS = 4.0, 4.9
# A sigma (s) of what moves an offset beside a clock's walk: receivers smooth by more or less as the
# vehicle moves. Two recorded cars, 50 minutes without a fault, reach 4.9 sigma without it and 3.6
# with it.
FIRM_S = 0.005
# A look each second, compared with those of the last minute: what is slower is a clock's walk.
LOOK_NS, COMPARED_NS = 1_000_000_000, 60_000_000_000
LOOKS = COMPARED_NS // LOOK_NS + 1
# A doubt adds the prior's variance to P, which had come below that; a fix that is taken back less.
OPENED = 1.5


class OffsetWatch:
    """Follows the offsets in time of a filter of `model`; `suspects` is why they are not believed,
    empty where they are, `changed` why the filter must be given up."""

    def __init__(self, model: Model) -> None:
        blocks = [b for b in model.blocks if b.name.startswith((FIX_TIME, VELOCITY_TIME))]
        self._slots = np.array([s for b in blocks for s in model.slots_of(b.name)], dtype=np.int64)
        self._names = [b.name for b in blocks]
        self._prior = np.array([b.initial**2 for b in blocks])
        self._walk = np.array([b.white for b in blocks])
        self.restart()

    def restart(self) -> None:
        """The filter that is looked at next is another, with the offsets as configured."""
        self._t_ns = np.full(LOOKS, NEVER_NS)
        self._x, self._p = np.zeros((2, LOOKS, len(self._slots)))
        self._row = 0
        self._unproven, self._looked_ns = False, NEVER_NS
        self.suspects = ""
        self.changed: str | None = None

    def look(
        self, t_ns: int, nav: Array, xi: Array, covariance: Array, failed: bool = False
    ) -> None:
        """The filter has come to `t_ns` with nav (10,), parameters (k,) and P (n, n); `failed`: one
        before it was given up."""
        if t_ns - self._looked_ns < LOOK_NS or not self._slots.size:
            return
        if self._looked_ns == NEVER_NS:
            self._keep(t_ns, np.zeros(len(self._slots)), self._prior)
            self._unproven = failed
        self._looked_ns = t_ns
        x, p = xi[self._slots], covariance[self._slots, self._slots]
        self._forget_opened(t_ns, p)
        self.suspects = self._compare(t_ns, x, p)
        self._keep(t_ns, x, p)
        self._unproven = self._unproven and not self._excluded(x, p)
        if self._unproven and not self.suspects and math.hypot(nav[VN], nav[VE]) > MOVING_M_S:
            self.suspects = "began anew after a failure, perhaps from fixes that are late"

    def _forget_opened(self, t_ns: int, p: Array) -> None:
        """The looks at an offset before a doubt of its receiver: it may have moved since."""
        row = (self._row - 1) % LOOKS
        walked = self._walk * (t_ns - self._t_ns[row]) * 1e-9
        self._p[:, p > (self._p[row] + walked) * OPENED] = 0.0

    def _keep(self, t_ns: int, x: Array, p: Array) -> None:
        row = self._row % LOOKS
        self._t_ns[row], self._x[row], self._p[row] = t_ns, x, p
        self._row += 1

    def _compare(self, t_ns: int, x: Array, p: Array) -> str:
        """Which offset has changed, in words; `changed` where that is no chance."""
        moved = x - self._x
        if np.abs(moved).max() <= SUSPECT_SIGMAS * FIRM_S:
            return ""  # whatever was learned
        since_ns = (t_ns - self._t_ns)[:, None]
        before = self._p + self._walk * since_ns * 1e-9
        learned = np.maximum(before - p, 1e-15)
        change = moved * before / learned
        sigmas = np.abs(moved) / np.sqrt(learned + FIRM_S**2)
        sigmas[(np.abs(change) < LATE_S) | (before <= p) | (since_ns > COMPARED_NS)] = 0.0
        row, k = np.unravel_index(int(np.argmax(sigmas)), sigmas.shape)
        most = float(sigmas[row, k])
        if most <= SUSPECT_SIGMAS:
            return ""
        by = f"{float(change[row, k]):+.1f} s, {most:.1f} sigma"
        text = f"{self._names[k]} moves as if by {by}: fixes have become late, or the IMU is wrong"
        if most > CHANGED_SIGMAS:
            self.changed = text
        return text

    def _excluded(self, x: Array, p: Array) -> bool:
        """Whether the offset that is known best, without its prior, is none of late fixes."""
        learned = np.maximum(self._prior - p, 1e-15)
        variance = p * self._prior / learned
        k = int(np.argmin(variance))
        late_s = -float(x[k] * self._prior[k] / learned[k])
        return late_s + SURPRISE * math.sqrt(float(variance[k])) < LATE_S
