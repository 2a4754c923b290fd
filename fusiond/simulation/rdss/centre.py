"""What the RDSS centre makes of a request: the fix, its error and its delay, or nothing.

Source: delays and accuracy classes from the BeiDou RDSS literature (two geostationary hops up and
down, 20 m and 100 m classes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.rdss.messages import Family
from fusiond.simulation.imu_truth import Truth, metres_to_geodetic


@dataclass(frozen=True, slots=True)
class RdssOptions:
    """The terminal, its card and the errors of the centre's answers; one sigma, each axis."""

    family: Family = "4.0"
    user: int = 242286
    service_frequency_s: int = 10
    comm_level: int = 3
    """Of the card: how long a message may be; 0 allows none."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    precision_class_m: Literal[20, 100] = 20
    error_sd_m: float | None = None
    """Horizontal error; None: as large as the class."""
    error_correlation_s: float = 0.0
    """Correlation time of the error between fixes; 0: independent."""
    height_sd_m: float = 10.0
    """Error of the centre's terrain model, used when the request gives no height."""
    height_anomaly_m: float = -14.0
    response_s: float = 0.05
    """From the request's last byte to the burst: the instant the fix is for."""
    delay_s: tuple[float, float] = (0.6, 5.0)
    """Least and greatest time from the burst to the fix on the serial line."""
    mean_delay_s: float | None = 1.5
    """Mean of the delay, which is exponential above its least value; None: the delay is uniform."""
    reply_s: float = 0.05
    """From a command to its answer or feedback."""
    zone_h: int = 0
    """Zone of the time of day of fixes and of SJXX, 0 (UTC) or 8; BDZDA prints UTC (NMEA 0183)."""
    fraction_s: float = 0.01
    """Unit of the fraction byte of family 4.0: 0.01 or 0.1."""
    bds3_feedback: bool = False
    """BDFKI in the BDS-3 form (family 2.1)."""
    drop_probability: float = 0.0
    """A request left the antenna and nothing comes back."""
    refuse_probability: float = 0.0
    """A request is refused by chance: no beam at this moment or, as often, the service frequency
    is not reached because another host of the card has used it."""
    mute_probability: float = 0.0
    """A request or a message is swallowed by a terminal that is busy: no feedback, no burst."""
    convoy: bool = False
    """Another vehicle of a convoy reports its place, sends a text now and then and confirms those
    that ask for it (simulation.rdss.network)."""
    multi_value_probability: float = 0.0
    foreign_probability: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulatedFix:
    """A fix on its way: instants in s of the trajectory; position in degrees and metres."""

    t_s: float
    t_arrival_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    precision_class_m: Literal[20, 100]
    multi_value: bool


class RdssCentre:
    """The centre's side of a fix: the true position at the burst, its error, its delay."""

    def __init__(self, truth: Truth, options: RdssOptions, rng: np.random.Generator) -> None:
        self._truth = truth
        self._options = options
        self._rng = rng
        self._error = np.zeros(2)
        self._last_s = -math.inf

    def fix(self, burst_s: float, given_height_m: float | None) -> SimulatedFix:
        """The fix for a burst at `burst_s`."""
        o, rng = self._options, self._rng
        sd = float(o.precision_class_m) if o.error_sd_m is None else o.error_sd_m
        age = burst_s - self._last_s
        kept = math.exp(-age / o.error_correlation_s) if o.error_correlation_s > 0 else 0.0
        self._error = kept * self._error + (
            sd * math.sqrt(1.0 - kept * kept) * rng.standard_normal(2)
        )
        self._last_s = burst_s
        multi_value = bool(rng.random() < o.multi_value_probability)
        height_error = float(rng.standard_normal()) * o.height_sd_m
        least, greatest = o.delay_s
        if o.mean_delay_s is None:
            delay = float(rng.uniform(least, greatest))
        else:
            delay = least + float(rng.exponential(max(o.mean_delay_s - least, 0.0)))
        state = self._truth.at(np.array([burst_s]), o.lever_arm_m)
        north, east = (float(x) for x in self._error)
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
            height_m=height + height_error if given_height_m is None else given_height_m,
            precision_class_m=o.precision_class_m,
            multi_value=multi_value,
        )

    def dropped(self) -> bool:
        """Whether this request is lost on the way."""
        return bool(self._rng.random() < self._options.drop_probability)

    def mute(self) -> bool:
        """Whether the terminal says nothing to this one."""
        p = self._options.mute_probability
        return p > 0.0 and bool(self._rng.random() < p)

    def refused(self) -> Literal["no_beam", "other_host"] | None:
        """Whether and why this request is refused by chance."""
        p = self._options.refuse_probability
        if p == 0.0 or self._rng.random() >= p:
            return None
        return "no_beam" if self._rng.random() < 0.5 else "other_host"

    def other_burst_s(self, t_s: float) -> float:
        """When the other host's burst left: what is left to wait is whole seconds."""
        return t_s - float(self._rng.integers(0, self._options.service_frequency_s))

    def foreign(self) -> bool:
        """Whether somebody else's fix comes along with this one."""
        return bool(self._rng.random() < self._options.foreign_probability)
