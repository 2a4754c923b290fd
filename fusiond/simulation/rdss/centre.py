r"""Simulated RDSS centre: fix, error and delay of each reply, or no reply.

The error is that of eq. 4 of paper 000 at the place (`fusiond.aiding.rdss_fix_covariance`): slant
ranges that are too long by d rho and a height that is too great by dH give

    [dN, dE]^T = G d rho + g dH + f

so that north and east are correlated. dH is the error of the height that the fix states (of the
height in the request, if given). f is the rest of the error up to the accuracy class, which is a
lower bound. Where the geometry gives no fix, the error is that of the class.

Source: delays and accuracy classes from the BeiDou RDSS literature (two geostationary hops up and
down, 20 m and 100 m classes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.rdss.messages import Family
from fusiond.aiding.base import NotApplicable
from fusiond.aiding.rdss_fix_covariance import LONGITUDES_DEG, RdssGeometry, with_floor
from fusiond.simulation.imu_truth import Truth, metres_to_geodetic

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RdssOptions:
    """Terminal, card and errors of the centre's replies; one sigma on each axis."""

    family: Family = "4.0"
    user: int = 242286
    service_frequency_s: int = 10
    comm_level: int = 3
    """Communication level of the card, which limits a message's length; 0 allows none."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    precision_class_m: Literal[20, 100] = 20
    error_sd_m: float | None = None
    """Horizontal error (m), equal and independent north and east; None: by eq. 4."""
    satellites_deg: tuple[float, float] = LONGITUDES_DEG
    """Longitudes of the two geostationary satellites, east positive."""
    range_sd_m: float = 15.3
    """One sigma of a slant range after differential correction: the paper's 8 and 13 m together."""
    error_correlation_s: float = 0.0
    """Correlation time of the error between fixes; 0: independent."""
    height_sd_m: float = 10.0
    """Error of the centre's terrain model, used when the request gives no height."""
    height_anomaly_m: float = -14.0
    response_s: float = 0.05
    """Time from the request's last byte to the burst, the instant of the fix."""
    delay_s: tuple[float, float] = (0.6, 5.0)
    """Least and greatest time from the burst to the fix on the serial line."""
    mean_delay_s: float | None = 1.5
    """Mean of the delay, which is exponential above its least value; None: the delay is uniform."""
    reply_s: float = 0.05
    """Time from a command to its reply or feedback."""
    zone_h: int = 0
    """Time zone of the time of day of fixes and of SJXX, 0 (UTC) or 8; BDZDA prints UTC (NMEA
    0183)."""
    fraction_s: float = 0.01
    """Unit of the fraction byte of family 4.0: 0.01 or 0.1."""
    bds3_feedback: bool = False
    """BDFKI in the BDS-3 form (family 2.1)."""
    drop_probability: float = 0.0
    """Probability that a request leaves the antenna without a reply."""
    refuse_probability: float = 0.0
    """A request is refused by chance: no beam at this moment or, as often, the service frequency
    is not reached because another host of the card has used it."""
    mute_probability: float = 0.0
    """Probability that a busy terminal swallows a request or message: no feedback, no burst."""
    convoy: bool = False
    """True for a convoy: another vehicle reports its place, sends texts and confirms those that ask
    for it (simulation.rdss.network)."""
    multi_value_probability: float = 0.0
    foreign_probability: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulatedFix:
    """Fix under way: instants in s of the trajectory; position in degrees and metres."""

    t_s: float
    t_arrival_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    precision_class_m: Literal[20, 100]
    multi_value: bool


class RdssCentre:
    """Centre that draws a fix: true position at the burst, error, delay."""

    def __init__(self, truth: Truth, options: RdssOptions, rng: np.random.Generator) -> None:
        self._truth = truth
        self._options = options
        self._rng = rng
        self._unit = np.zeros(2)
        self._last_s = -math.inf

    def fix(self, burst_s: float, given_height_m: float | None) -> SimulatedFix:
        """Fix for a burst at `burst_s`."""
        o, rng = self._options, self._rng
        age = burst_s - self._last_s
        kept = math.exp(-age / o.error_correlation_s) if o.error_correlation_s > 0 else 0.0
        self._unit = kept * self._unit + math.sqrt(1.0 - kept * kept) * rng.standard_normal(2)
        self._last_s = burst_s
        multi_value = bool(rng.random() < o.multi_value_probability)
        height_error = float(rng.standard_normal()) * o.height_sd_m
        least, greatest = o.delay_s
        if o.mean_delay_s is None:
            delay = float(rng.uniform(least, greatest))
        else:
            delay = least + float(rng.exponential(max(o.mean_delay_s - least, 0.0)))
        state = self._truth.at(np.array([burst_s]), o.lever_arm_m)
        if given_height_m is not None:
            height_error = given_height_m - float(state.position[0, 2])
        north, east = (float(x) for x in self._horizontal(state.position[0], height_error))
        if multi_value:  # the other of the two solutions: far off, as an ambiguous fix may be
            north -= 3000.0
        offset = metres_to_geodetic(
            state.position[:, 0], state.position[:, 2], np.array([[north, east, 0.0]])
        )
        lat, lon, height = (float(x) for x in (state.position + offset)[0])
        return SimulatedFix(
            t_s=burst_s,
            t_arrival_s=burst_s + min(delay, greatest),
            lat_deg=math.degrees(lat),
            lon_deg=math.degrees(lon),
            height_m=height + height_error,
            precision_class_m=o.precision_class_m,
            multi_value=multi_value,
        )

    def _horizontal(self, place: Array, height_error_m: float) -> Array:
        """Error (2,) north and east at a geodetic position (3,), from the fix's height error."""
        o = self._options
        if o.error_sd_m is not None:
            return o.error_sd_m * self._unit
        lat, lon, height = (float(x) for x in place)
        geometry = RdssGeometry(o.satellites_deg)
        found = geometry.covariance(lat, lon, height, o.range_sd_m, o.height_sd_m)
        by = geometry.sensitivity(lat, lon, height)
        if isinstance(found, NotApplicable) or isinstance(by, NotApplicable):
            return o.precision_class_m * self._unit
        beside_height = with_floor(found.total, o.precision_class_m) - found.height
        return np.linalg.cholesky(beside_height) @ self._unit + by.height * height_error_m

    def dropped(self) -> bool:
        """True if this request is lost."""
        return bool(self._rng.random() < self._options.drop_probability)

    def mute(self) -> bool:
        """True if the terminal ignores this request."""
        p = self._options.mute_probability
        return p > 0.0 and bool(self._rng.random() < p)

    def refused(self) -> Literal["no_beam", "other_host"] | None:
        """Reason why this request is refused by chance; falsy for none."""
        p = self._options.refuse_probability
        if p == 0.0 or self._rng.random() >= p:
            return None
        return "no_beam" if self._rng.random() < 0.5 else "other_host"

    def other_burst_s(self, t_s: float) -> float:
        """Instant of the other host's burst; the remaining wait is in whole seconds."""
        return t_s - float(self._rng.integers(0, self._options.service_frequency_s))

    def foreign(self) -> bool:
        """True if another card's fix arrives with this one."""
        return bool(self._rng.random() < self._options.foreign_probability)
