r"""Whether a position goes with the motion: the trend of what is between the two.

A filter that comes out of an outage takes the first positions for what they are: it has nothing as
good to compare them with. A receiver that drifts from its first fix on takes the filter along, and
innovations do not show it. What shows it is the way that the filter has gone since, by velocities,
against the way of the fixes: with n fixes of sigma s over a time T, a drift d and a line through
what is between both ways,

    position, mean of the fixes      sigma s / sqrt(n)             off by d T / 2
    slope of the line                sigma sqrt(12) s / (T sqrt(n))
    position, where the line began   sigma 2 s / sqrt(n)           whatever d

A drift that has taken the filter away by k of its sigmas shows in the slope with k / sqrt(3): no
test is as quick as the error. So until it is known whether there is one, the position is not known
better than the line knows it. Fixes count with `UNPROVEN_SIGMAS` times their sigma, a mean of which
has the sigma of the line, and the slope is beyond chance (5.3 sigma, one in a million) before an
error that it causes is beyond 5 sigma: that is at a slope of 5.8.

A filter that knows its way less well forgets the first fixes and is taken along by more than T / 2,
and a slope beside such a way is told later; one that knew its place well is hardly taken along.
With the gain K of each fix it is off by d g,

    g <- g + K (t - g)

What is published is never surer than that the above holds still, which is what an estimate knows
that admits a drift; and it is open by what the slope has beyond what chance does once in twenty
(fusiond.integrity.hedge). For a sigma of the slope sigma_b and its estimate b

    max(P, (2^2 / 3) sigma_b^2 g^2) + max(0, b^2 - 3.84 sigma_b^2) g^2

The first is P of white errors and a way without any: sigma_b T / 2 = sqrt(3) s / sqrt(n). Where
fixes share an error that is a state P never falls below it, and it is the second alone: a slope
beyond chance is no such error's.

Errors that last make means and slopes less certain than white ones would: by the `colour` that the
series has shown before. The way has errors of its own: of velocities of sigma s_v, of which a slope
gets sqrt(1.2) s_v / sqrt(n).

Source: least squares; Brumback, Srinath, IEEE Trans. AC 32 (1987), 1133.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import State
from fusiond.aiding.offers import PositionOffer
from fusiond.integrity.means import LIKELY
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.error_model import DR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VE, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# A filter's velocity may be off for some seconds after an outage, until its sensor errors have
# settled: by 0.12 m/s for ten seconds and by 0.2 for five in drive_0708. So long its sigma is not
# below TREND_SD_M_S.
SETTLED_NS = 20_000_000_000
# The sigma of where a line begins, over that of the mean of its points.
UNPROVEN_SIGMAS = 2.0
# Of the slope of a random walk's line, over the walk's sigma by time.
WALKED = math.sqrt(1.2)
# A position comes back once its innovations are known not to run away by three times this (m/s):
# a drift of 0.2 m/s is what a filter with an honest velocity still tells from its own.
TREND_SD_M_S = 0.07
# One that was left out because it drifted, by a third and less: 0.1 m/s is what a receiver's honest
# velocity shows within twenty seconds, and five of this. Not so one that was seen to run away by
# five times the above, five sigma beyond half of that: a drift as slow is not what has to be over.
DRIFT_SD_M_S, SLOWEST_M_S = 0.02, 0.1
RUNS_M_S, RUNS_SIGMAS = 5.0 * TREND_SD_M_S, 5.0


class Offset(NamedTuple):
    """How far a filter is from a position that was measured, north and east (m), and one sigma of
    the measurement (m)."""

    north: float
    east: float
    sd: float


class Trend(NamedTuple):
    """Sums over innovations of a position (m) against time (s): does it still run away?"""

    n: int = 0
    t: float = 0.0
    tt: float = 0.0
    north: float = 0.0
    east: float = 0.0
    t_north: float = 0.0
    t_east: float = 0.0
    sd: float = 0.0

    def with_one(self, z: Offset, t_s: float) -> Trend:
        """With one innovation more."""
        return Trend(
            self.n + 1,
            self.t + t_s,
            self.tt + t_s * t_s,
            self.north + z.north,
            self.east + z.east,
            self.t_north + t_s * z.north,
            self.t_east + t_s * z.east,
            max(self.sd, z.sd),
        )

    @property
    def line(self) -> Offset:
        """How fast they run away, north and east (m/s), and one sigma of it (m/s); infinite where
        nothing is known."""
        spread = self.tt - self.t * self.t / self.n if self.n else 0.0
        if spread <= 0.0:
            return Offset(0.0, 0.0, math.inf)
        north = (self.t_north - self.t * self.north / self.n) / spread
        east = (self.t_east - self.t * self.east / self.n) / spread
        return Offset(north, east, self.sd / math.sqrt(spread))

    @property
    def slope(self) -> tuple[float, float]:
        """How fast they run away (m/s), and the sigma of one of its axes."""
        north, east, sd = self.line
        return math.hypot(north, east), sd

    def steady(self, least_sd: float = TREND_SD_M_S, slowest: float = math.inf) -> bool:
        """Whether the slope of a line through them is known to `least_sd` (m/s), and zero, and
        three sigma from one of `slowest` (m/s)."""
        slope, sd = self.slope
        return sd <= least_sd and slope <= 3.0 * least_sd and slope + 3.0 * sd < slowest

    @property
    def runs_away(self) -> bool:
        """Whether the slope is known to be that of no slow drift."""
        slope, sd = self.slope
        return slope > RUNS_M_S and slope > 0.5 * RUNS_M_S + RUNS_SIGMAS * sd


NO_TREND = Trend()


class Proof(NamedTuple):
    """What is seen of a position that came back: where the body's origin was at its first fix (rad,
    rad; ns), the way since then by the filter's velocity, north and east (m), that velocity (m/s)
    and instant (ns), the sigma (m/s) of a velocity as a mean of many shows it, the trend of what is
    between both ways, the series' `colour` (1), and by how much a drift of 1 m/s has taken away the
    filter, which `follows` it (s).
    """

    lat_rad: float
    lon_rad: float
    begin_ns: int
    t_ns: int
    velocity: tuple[float, float]
    colour: float
    sd_m_s: float = 0.0
    way: tuple[float, float] = (0.0, 0.0)
    trend: Trend = NO_TREND
    suspect: bool = False
    follows: float = 0.0

    @staticmethod
    def begun(offer: PositionOffer, nav: Array, colour: float, suspect: bool = False) -> Proof:
        """With the first fix; `nav` (10,) the filter's state. `suspect`: it was seen to run away
        before, so nothing but the whole proof will do."""
        lat, lon = float(nav[LAT]), float(nav[LON])
        z = apart(offer, lat, lon, nav)
        to_m = metres_a_radian(nav)
        place = lat - z.north / to_m[0], lon - z.east / to_m[1]
        v = float(nav[VN]), float(nav[VE])
        return Proof(*place, offer.t_ns, offer.t_ns, v, colour, suspect=suspect)

    def with_one(self, offer: PositionOffer, nav: Array, sd_m_s: float, gain: float) -> Proof:
        """With one fix more, of which the filter has taken `gain` of what was between them, and the
        sigma of the velocities that there are now."""
        v = float(nav[VN]), float(nav[VE])
        half_s = 0.5e-9 * (offer.t_ns - self.t_ns)
        north = self.way[0] + half_s * (v[0] + self.velocity[0])
        east = self.way[1] + half_s * (v[1] + self.velocity[1])
        moved = apart(offer, self.lat_rad, self.lon_rad, nav)
        z = Offset(moved.north + north, moved.east + east, moved.sd)
        t_s = (offer.t_ns - self.begin_ns) * 1e-9
        follows = self.follows + gain * (t_s - self.follows)
        trend, way = self.trend.with_one(z, t_s), (north, east)
        return self._replace(
            t_ns=offer.t_ns, velocity=v, sd_m_s=sd_m_s, way=way, trend=trend, follows=follows
        )

    @property
    def sigma(self) -> float:
        """Of one axis of the slope (m/s)."""
        walked = WALKED * self.sd_m_s / math.sqrt(max(self.trend.n, 1))
        return math.hypot(self.trend.slope[1] * self.colour, walked)

    def leaves_open(self, own: Sequence[float], *, white: bool = True) -> tuple[float, ...]:
        """What of a position, north and east (m^2), is open beside the variances that the filter
        has of its `own`, until it is known whether it drifts; `white`: its fixes share no error."""
        variance = self.sigma**2
        if not math.isfinite(variance):
            return 0.0, 0.0
        least = UNPROVEN_SIGMAS**2 / 3.0 * variance * self.follows**2 if white else 0.0
        open_by = (max(0.0, b * b - LIKELY * variance) * self.follows**2 for b in self.trend.line)
        return tuple(max(0.0, least - p) + more for p, more in zip(own, open_by, strict=False))

    @property
    def goes_along(self) -> bool:
        """Whether the slope is known well enough to say so, and zero as far as it is known."""
        return not self.suspect and self.trend.slope[1] <= TREND_SD_M_S and self._none

    @property
    def proven(self) -> bool:
        """Whether it would show if it drifted, and is three sigma from the slowest drift that
        shows."""
        slope, sd = self.trend.slope
        clear = slope + 3.0 * self.sigma < SLOWEST_M_S
        return sd * self.colour <= DRIFT_SD_M_S and self._none and clear

    @property
    def _none(self) -> bool:
        return self.trend.slope[0] <= 3.0 * max(self.sigma, DRIFT_SD_M_S)

    def drifts(self, chi_square: float) -> bool:
        """Whether the slope is beyond chance: `chi_square` of its two axes."""
        settled = self.t_ns - self.begin_ns >= SETTLED_NS
        sd = self.sigma if settled else math.hypot(self.sigma, TREND_SD_M_S)
        return self.trend.slope[0] ** 2 > chi_square * sd * sd


def metres_a_radian(nav: Array) -> tuple[float, float]:
    """Of latitude and of longitude, where the filter is."""
    lat, height = float(nav[LAT]), float(nav[HEIGHT])
    east = (transverse_radius(lat) + height) * math.cos(lat)
    return meridian_radius(lat) + height, east


def apart(offer: PositionOffer, lat: float, lon: float, nav: Array) -> Offset:
    """From the body's origin as measured to a place (rad, rad); `nav` (10,) turns the lever arm."""
    north, east = _apart(nav, lat - offer.lat_rad, lon - offer.lon_rad, *offer.lever)
    sd_n, sd_e, _ = offer.sd
    return Offset(north, east, max(sd_n, sd_e))


def settled(offer: PositionOffer, state: State) -> PositionOffer:
    """Without what the filter has found of its offset in time and of its lever arm: where a vehicle
    turns or brakes these move it by v tau and C dl, which is no drift. What the fixes share stays
    in: a drift goes into it. Of the lever arm's own motion, w x l tau, there is a centimetre."""
    at = state.model.indices
    time, rest = at[offer.time], at[offer.rest]
    lat, lon = _settled(state.nav, state.xi, time, rest, offer.lat_rad, offer.lon_rad)
    return offer._replace(lat_rad=lat, lon_rad=lon)


def residual(offer: PositionOffer, state: State) -> Offset:
    """From the body's origin, as the `settled` offer has it, to where the filter is, at once: asked
    of every fix."""
    at, place = state.model.indices, (offer.lat_rad, offer.lon_rad, *offer.lever)
    north, east = residual_of(state.nav, state.xi, at[offer.time], at[offer.rest], *place)
    sd_n, sd_e, _ = offer.sd
    return Offset(north, east, sd_n if sd_n > sd_e else sd_e)


def above(offer: PositionOffer, nav: Array) -> float:
    """How far (m) the body's origin as measured is above where the filter with the state `nav`
    (10,) is; 0 where no height was measured."""
    if offer.height_m is None:
        return 0.0
    c, (x, y, z) = dcm_elements(nav[Q0:]), offer.lever
    return float(offer.height_m + c[6] * x + c[7] * y + c[8] * z - nav[HEIGHT])


def filters_own(offer: PositionOffer, covariance: Array) -> float:
    """The part (1) of the variance of a position's innovation that is the filter's own error, in P
    (n, n): of the axis where it is most."""
    own: list[float] = covariance.diagonal()[DR : DR + 3].tolist()
    return max(p / (p + sd * sd) for p, sd in zip(own, offer.sd, strict=True))


@compiled("UniTuple(f8, 2)(f8[::1], f8, f8, f8, f8, f8)")
def _apart(
    nav: Array, north: float, east: float, x: float, y: float, z: float
) -> tuple[float, float]:
    """Latitude and longitude (rad) and a lever arm (m, body axes) in metres north and east, where
    the filter with the state `nav` (10,) is."""
    c = dcm_elements(nav[Q0:])
    lat, height = nav[LAT], nav[HEIGHT]
    east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
    to_east = (transverse_radius(lat) + height) * math.cos(lat)
    return (
        north * (meridian_radius(lat) + height) + c[0] * x + c[1] * y + c[2] * z,
        east * to_east + c[3] * x + c[4] * y + c[5] * z,
    )


@compiled("UniTuple(f8, 2)(f8[::1], f8[::1], i8[::1], i8[::1], f8, f8)")
def _settled(
    nav: Array, xi: Array, time: Indices, rest: Indices, lat: float, lon: float
) -> tuple[float, float]:
    """A place (rad, rad) without v tau and C dl, of which the slots `time` (0 or 1,) and `rest` (0
    or 3,) of xi (n,) are."""
    north, east = 0.0, 0.0
    if rest.size:
        north, east = _apart(nav, 0.0, 0.0, xi[rest[0]], xi[rest[1]], xi[rest[2]])
    for slot in time:
        north += nav[VN] * xi[slot]
        east += nav[VE] * xi[slot]
    to_east = (transverse_radius(nav[LAT]) + nav[HEIGHT]) * math.cos(nav[LAT])
    return lat - north / (meridian_radius(nav[LAT]) + nav[HEIGHT]), lon - east / to_east


@compiled("UniTuple(f8, 2)(f8[::1], f8[::1], i8[::1], i8[::1], f8, f8, f8, f8, f8)")
def residual_of(
    nav: Array,
    xi: Array,
    time: Indices,
    rest: Indices,
    lat: float,
    lon: float,
    x: float,
    y: float,
    z: float,
) -> tuple[float, float]:
    """`_apart` of the filter and the `_settled` place."""
    lat, lon = _settled(nav, xi, time, rest, lat, lon)
    return _apart(nav, nav[LAT] - lat, nav[LON] - lon, x, y, z)
