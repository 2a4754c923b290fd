r"""A bank of headings: filters that start with the heading in cells around the circle.

    p(x) = sum_i w_i N(x; x_i, P_i),   w_i <- w_i N(nu_i; 0, S_i) / sum

Each cell is a filter of the vehicle's own model (`InvariantFilter`), nearly Gaussian although the
heading alone is not; its weight w_i is its probability. Once the mixture has one narrow mode, the
start is its mean and covariance in the error xi common to all cells:

    m = sum w_i xi_i,   C = sum w_i (P_i + (xi_i - m)(xi_i - m)^T)

Source: Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE
TAC 17 (1972), eq. 14 to 20; Bar-Shalom, Li, Kirubarajan (2001), eq. 1.4.16-7 and -8 for the
moments. PX4's yaw estimator (EKFGSF_yaw) is such a bank of five filters on GNSS velocity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.estimators.invariant import InvariantFilter
from fusiond.navigation.error_model import DV, PHI
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.navigation.strapdown import Q0, VN

Array = NDArray[np.float64]

CELLS = 24
YAWS_RAD = tuple(2.0 * math.pi * k / CELLS for k in range(CELLS))
# One sigma of the heading in a cell: half the way to the next, so that their sum is flat to 2 %.
CELL_SD_RAD = 0.5 * 2.0 * math.pi / CELLS
# A cell that is as unlikely as this is given up.
UNLIKELY = 1e-5
# A source is heard twice a second at most: what it says oftener is alike, and costs every cell.
INTERVAL_NS = 500_000_000
# So many positions in a row that no cell can explain: what the bank began with was wrong.
MOST_REFUSED = 3


class Mixture(NamedTuple):
    """Mean state (10,), parameters (n,) and P (n, n) of all cells."""

    nav: Array
    xi: Array
    covariance: Array

    @property
    def sd_yaw(self) -> float:
        """One sigma of the heading (rad)."""
        return math.sqrt(float(self.covariance[PHI + 2, PHI + 2]))

    @property
    def sd_speed(self) -> float:
        """One sigma of the velocity along the forward axis (m/s)."""
        ahead = dcm_from_quaternion(self.nav[Q0:])[:, 0]
        return math.sqrt(float(ahead @ self.covariance[DV : DV + 3, DV : DV + 3] @ ahead))


@dataclass(slots=True)
class Cell:
    """Started filter and its probability."""

    filter: InvariantFilter
    weight: float


class HeadingBank:
    """Bank of filters with different headings, started at `t_ns` after `positions` fixes."""

    def __init__(
        self, cells: list[Cell], t_ns: int, positions: int, max_reverse_m_s: float
    ) -> None:
        self._cells, self.t_ns = cells, t_ns
        self.positions = positions
        """Fixes that some cell has taken."""
        self._max_reverse_m_s = max_reverse_m_s
        self._received_ns: dict[str, int] = {}
        self._refused = 0
        self.backwards = False
        """The likeliest cell drove backward, faster than the vehicle can."""
        self._prune()

    @property
    def lost(self) -> bool:
        """True if no filter explains the measurements."""
        return not self._cells or self._refused >= MOST_REFUSED

    @property
    def _best(self) -> Cell:
        return max(self._cells, key=lambda cell: cell.weight)

    def advance(
        self, imu: ImuBuffer, measurements: Sequence[AidingMeasurement], until_ns: int
    ) -> None:
        """Advance to `until_ns`, with `measurements` up to then in order of validity."""
        for measurement in measurements:
            if measurement.t_ns < self._received_ns.get(measurement.source, 0) + INTERVAL_NS:
                continue
            self._received_ns[measurement.source] = measurement.t_ns
            self._propagate(imu, measurement.t_ns)
            self._receive(measurement)
            if self.lost:
                return
        self._propagate(imu, until_ns)

    def mixture(self) -> Mixture:
        """Mean and covariance of all cells, about the likeliest."""
        best = self._best.filter
        back = best.of_vehicle(best.nav, best.xi, -1.0)
        turning = best.turning(best.nav, back @ best.covariance @ back.T)
        means, spread = [], np.zeros((best.model.size, best.model.size))
        for cell in self._cells:
            f = cell.filter
            divergence = best.between(f.nav, f.xi, turning)
            means.append(divergence)
            jacobian = best.jacobian(divergence, turning)
            own = np.linalg.solve(jacobian, f.of_vehicle(f.nav, f.xi, -1.0))
            spread += cell.weight * own @ f.covariance @ own.T
        weights = np.array([cell.weight for cell in self._cells])
        divergence = np.array(means)
        mean = weights @ divergence
        divergence -= mean
        spread += (divergence * weights[:, None]).T @ divergence
        nav, xi = best.without(best.nav, best.xi, mean, turning)
        t = best.of_vehicle(nav, xi) @ best.jacobian(mean, turning)
        covariance = t @ spread @ t.T
        return Mixture(nav, xi, 0.5 * (covariance + covariance.T))

    def _propagate(self, imu: ImuBuffer, t_ns: int) -> None:
        if t_ns <= self.t_ns:
            return
        for cell in self._cells:
            cell.filter.propagate(imu, t_ns)
        self.t_ns = t_ns

    def _receive(self, measurement: AidingMeasurement) -> None:
        outcomes = [
            cell.filter.update(measurement.at(cell.filter.nav)).name for cell in self._cells
        ]
        fused = "fused" in outcomes
        if measurement.locates:
            self.positions += fused
            self._refused = 0 if fused else self._refused + 1
        # Cells are compared by what all of them were measured with; what none takes is an outlier.
        if not fused or set(outcomes) - {"fused", "gated"}:
            return
        logs = np.array([cell.filter.log_likelihood for cell in self._cells])
        for cell, factor in zip(self._cells, np.exp(logs - logs.max()), strict=True):
            cell.weight *= float(factor)
        if measurement.locates:
            self._drop_backward()
        self._prune()

    def _drop_backward(self) -> None:
        """Drop filters that drive backward at an implausible speed."""
        for cell in self._cells:
            f = cell.filter
            ahead = dcm_from_quaternion(f.nav[Q0:])[:, 0]
            forward = float(ahead @ f.nav[VN : VN + 3])
            sd = math.sqrt(float(ahead @ f.covariance[DV : DV + 3, DV : DV + 3] @ ahead))
            if -forward - 3.0 * sd > self._max_reverse_m_s:
                self.backwards |= cell is self._best
                cell.weight = 0.0

    def _prune(self) -> None:
        total = sum(cell.weight for cell in self._cells)
        kept = [cell for cell in self._cells if cell.weight > UNLIKELY * total]
        total = sum(cell.weight for cell in kept)
        for cell in kept:
            cell.weight /= total
        self._cells = kept
