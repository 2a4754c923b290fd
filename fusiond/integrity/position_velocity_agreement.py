r"""Agreement of an excluded device's positions with its velocities.

    |p_k - p_(k-1) - (v_k + v_(k-1)) h / 2| <= 4 s                                    north and east
    s^2 = 2 s_p^2 + s_v^2 h^2 / 2 + (v_k - v_(k-1))^2 h^2 / 12

The limit is four sigma for each fix. The last term is for the unknown way from one velocity to the
other: a change d at an instant u h of the interval makes the displacement v_(k-1) h + d (1 - u) h,
which is d h (1/2 - u) from the mean velocity's; of a u that is uniform in [0, 1] the variance is
d^2 h^2 / 12. A turn within the interval adds h^2 a_t / 12, centimetres at a fix a second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.navigation.earth import meridian_radius, transverse_radius

SIGMAS = 4.0
LONGEST_NS = 2_500_000_000
"""Longest interval of fixes: beyond it two velocities do not determine the displacement."""


class Agreement(NamedTuple):
    """Last position and velocity, and the start (ns) of their agreement."""

    position: PositionCandidate | None = None
    velocity: VelocityCandidate | None = None
    before: tuple[PositionCandidate, VelocityCandidate] | None = None
    since_ns: int = 0
    upto_ns: int = 0

    @property
    def lasted_ns(self) -> int:
        """Duration (ns) of the agreement."""
        return self.upto_ns - self.since_ns

    def with_measurement(self, measurement: AidingMeasurement) -> Agreement:
        """Agreement after one more position or velocity."""
        found = self
        for candidate in measurement.candidates():
            if isinstance(candidate, PositionCandidate):
                found = found._replace(position=candidate)
            elif isinstance(candidate, VelocityCandidate):
                found = found._replace(velocity=candidate)
        return found._with_pair()

    def _with_pair(self) -> Agreement:
        p, v = self.position, self.velocity
        if p is None or v is None or abs(p.t_ns - v.t_ns) > LONGEST_NS // 10:
            return self
        if self.before is not None and p.t_ns <= self.before[0].t_ns:
            return self
        fits = self.before is not None and _fits(*self.before, p, v)
        return self._replace(
            before=(p, v), since_ns=self.since_ns if fits else p.t_ns, upto_ns=p.t_ns
        )


def _fits(
    p0: PositionCandidate, v0: VelocityCandidate, p1: PositionCandidate, v1: VelocityCandidate
) -> bool:
    h = (p1.t_ns - p0.t_ns) * 1e-9
    if not 0.0 < h <= LONGEST_NS * 1e-9:
        return False
    lat = p0.lat_rad
    east = p1.lon_rad - p0.lon_rad
    east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
    way = (
        (p1.lat_rad - lat) * meridian_radius(lat),
        east * transverse_radius(lat) * math.cos(lat),
    )
    for axis in range(2):
        by_speed = 0.5 * h * (v0.v_ned[axis] + v1.v_ned[axis])
        variance = p0.sd[axis] ** 2 + p1.sd[axis] ** 2
        variance += (0.5 * h) ** 2 * (v0.sd[axis] ** 2 + v1.sd[axis] ** 2)
        variance += (v1.v_ned[axis] - v0.v_ned[axis]) ** 2 * h**2 / 12.0
        if abs(way[axis] - by_speed) > SIGMAS * math.sqrt(variance):
            return False
    return True
