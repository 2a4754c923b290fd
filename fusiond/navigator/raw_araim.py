r"""Protection levels from raw epochs, each by advanced RAIM.

The position x_e of an epoch's ranges alone has levels PL_e that hold for any fault of one satellite
or constellation (fusiond.integrity.araim). With x_0 the published solution after the epoch

    |error of x_0|  <=  |x_0 - x_e| + |error of x_e|

so |x_0 - x_e| + PL_e bounds it, too, even if the filter has rejected some ranges or excluded the
receiver. With z the corrected ranges minus their prediction by the solution, S of the remaining
satellites, and t the model's displacement common to all ranges,

    x_0 - x_e = S z - t

Until the next epoch the level grows by K sigma_v dt of the filter's velocity, K the two-sided
quantile of the risk.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import NotApplicable, State
from fusiond.aiding.pseudorange import RANGE_BIAS, RANGE_SHARED
from fusiond.estimators.base import Estimator
from fusiond.gnss.ecef import ned_axes
from fusiond.integrity.araim import LPV_200, Epoch, Requirement, exclude
from fusiond.integrity.protection import INDEPENDENT_PER_HOUR
from fusiond.navigation.distributions import gaussian_quantile
from fusiond.navigation.strapdown import LAT, LON
from fusiond.navigator.raw_gnss import RawEpochMeasurement

Array = NDArray[np.float64]

SATELLITE_FAULT, CONSTELLATION_FAULT = 1e-5, 1e-4
"""Fault rates an hour: GPS SPS Performance Standard, 5th ed., 2020, section 3.5.1; Working Group C
ARAIM, Milestone 3 report, 2016."""
NOMINAL_BIAS_M = 0.75
"""Bias of a fault-free range (signal deformation, antenna): Blanch et al., IEEE Trans. AES 51
(2015), 713."""
UNMONITORED = LPV_200.unmonitored_risk / (LPV_200.vertical_risk + LPV_200.horizontal_risk)
"""Share of the risk for unmonitored faults, as in the reference."""
HOLDS_NS = 2_000_000_000
"""An epoch speaks for the solution for so long: of a receiver that sends each second one may be
lost."""


def requirement(risk: float, false_alarm: float) -> Requirement:
    """Requirement from risk and false alarms an hour: half of each vertical, half horizontal."""
    return Requirement(
        vertical_risk=0.5 * risk,
        horizontal_risk=0.5 * risk,
        vertical_false_alarm=0.5 * false_alarm,
        horizontal_false_alarm=0.5 * false_alarm,
        residual_false_alarm=false_alarm,
        unmonitored_risk=UNMONITORED * risk,
        effective_monitor_prior=LPV_200.effective_monitor_prior,
        samples=INDEPENDENT_PER_HOUR,
    )


class EpochLevel(NamedTuple):
    """Levels (m) of the solution at the epoch's instant, infinite without a bound, and the
    inconsistent satellites."""

    hpl_m: float
    vpl_m: float
    left_out: tuple[str, ...] = ()


NO_BOUND = EpochLevel(math.inf, math.inf)


@dataclass(slots=True)
class _Received:
    """An epoch at `t_ns`: its ranges z (n,) m less the solution's, the shared displacement t (3,) m
    north, east, down; its level once computed."""

    t_ns: int
    satellites: tuple[str, ...]
    epoch: Epoch
    z: Array
    shared: Array
    level: EpochLevel | None = None


class EpochProtection:
    """Protection levels from raw epochs, at a `risk` and a rate of `false_alarm`s, each an hour."""

    def __init__(self, risk: float, false_alarm: float) -> None:
        self._requirement = requirement(risk, false_alarm)
        self._risk = risk
        self._received: dict[str, _Received] = {}

    @cached_property
    def _quantile(self) -> float:
        """Quantile of the Gaussian law that one position exceeds with half the risk."""
        return -gaussian_quantile(0.5 * self._risk / INDEPENDENT_PER_HOUR)

    def clear(self) -> None:
        """Restart with the solution."""
        self._received.clear()

    def look(self, measurement: RawEpochMeasurement, state: State) -> None:
        """Compute the levels of an epoch from the filter's state at its instant."""
        self._received.pop(measurement.source, None)
        corrected = measurement.memory.corrected
        if corrected is None:
            return
        rows, ranges = corrected.rows, np.isfinite(corrected.measurement.ranges)
        innovation = corrected.measurement.innovation(state)
        if isinstance(innovation, NotApplicable):
            return
        n = int(ranges.sum())
        axes = ned_axes(float(state.nav[LAT]), float(state.nav[LON]))
        _, clocks = np.unique(corrected.measurement.clock[ranges], return_inverse=True)
        sigma = np.sqrt(corrected.measurement.total_variance[ranges])
        epoch = Epoch(
            rows.line_of_sight[ranges] @ axes,
            clocks.astype(np.int64),
            sigma,
            sigma,
            np.full(n, NOMINAL_BIAS_M),
            np.full(n, SATELLITE_FAULT),
            np.full(int(clocks.max(initial=-1)) + 1, CONSTELLATION_FAULT),
        )
        slots = [slot for block in RANGE_BIAS for slot in state.model.slots_of(block)]
        shared = corrected.measurement.shape @ state.xi[slots] if len(slots) == 3 else np.zeros(3)
        # Of an epoch alone nothing is known of what its ranges share.
        columns = state.model.slots_of_all(RANGE_SHARED)
        z = innovation.z[:n] + innovation.h[:n, columns] @ state.xi[columns]
        names = tuple(s for s, here in zip(rows.satellites, ranges, strict=True) if here)
        self._received[measurement.source] = _Received(measurement.t_ns, names, epoch, z, shared)

    def level(self, source: str, estimator: Estimator) -> EpochLevel:
        """Level of the estimator's present state, by the last epoch of a receiver."""
        received = self._received.get(source)
        if received is None or not 0 <= estimator.t_ns - received.t_ns <= HOLDS_NS:
            return NO_BOUND
        if received.level is None:
            received.level = self._level(received)
        north, east, down = estimator.sigmas()[3:6].tolist()
        grown = self._quantile * (estimator.t_ns - received.t_ns) * 1e-9
        found = received.level
        return found._replace(
            hpl_m=found.hpl_m + grown * math.hypot(north, east), vpl_m=found.vpl_m + grown * down
        )

    def _level(self, received: _Received) -> EpochLevel:
        found = exclude(received.epoch, self._requirement, received.z)
        if found is None:
            return NO_BOUND
        kept = ~found.out
        gain = found.protection.separation.gain[0]
        north, east, down = (gain @ received.z[kept] - received.shared).tolist()
        left_out = tuple(s for s, out in zip(received.satellites, found.out, strict=True) if out)
        return EpochLevel(
            found.protection.hpl_m + math.hypot(north, east),
            found.protection.vpl_m + abs(down),
            left_out,
        )
