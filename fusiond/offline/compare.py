"""Comparison of a solution with a truth: errors, and errors relative to the stated sigma.

The solution is interpolated to the truth's epochs, linearly in position, velocity, sigma and in
unwrapped angles; never beyond its ends, never across a gap of more than `MAX_GAP_S`. Errors are
solution minus truth, position in metres north, east, down by the radii of curvature at the truth.

"Inside k sigma horizontally" is d^2 = (north / sd_n)^2 + (east / sd_e)^2 <= k^2, the error ellipse
whose axes lie north and east. For a two-dimensional Gaussian the share is the Rayleigh
distribution's 1 - exp(-k^2 / 2): 39.3 %, 86.5 %, 98.9 % for k = 1, 2, 3. The normalised estimation
error squared (NEES) is taken from the same diagonal, d^2 + (down / sd_d)^2, mean 3 when honest
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.2). A
truth's own error is not subtracted: an RTK track adds its centimetres to every figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fusiond.files.csv_tables import Flags, Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M

MAX_GAP_S = 1.0
_GAP_TOLERANCE_S = 1e-6
"""The resolution of the time column: rows 1 s apart are no gap."""

Report: TypeAlias = dict[str, float | int | None]


class NothingToCompareError(Exception):
    """Error: solution and truth have no common epoch; the text has the times of both."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Solution minus truth at n common epochs `t_s`, and the solution's sigma.

    Shapes are (n, 3): `position` (m) and `velocity` (m/s) north, east, down, `attitude` (rad) roll,
    pitch, yaw; `sd_*` likewise; NaN for missing values. `not_covered` counts epochs of the truth
    without a solution.
    """

    t_s: Floats
    position: Floats
    velocity: Floats
    attitude: Floats
    sd_position: Floats
    sd_velocity: Floats
    sd_attitude: Floats
    not_covered: int


def errors_of(solution: TrajectoryTable, truth: TrajectoryTable, after_s: float = 0.0) -> Errors:
    """Errors at the truth's epochs later than `after_s` after the solution's first.

    Raises `NothingToCompareError`.
    """
    usable = np.isfinite(solution.lat_rad) & np.isfinite(solution.lon_rad)
    start = float(solution.t_s[0]) + after_s if len(solution.t_s) else np.inf
    at = _Epochs(solution.t_s, usable, truth.t_s)
    chosen = at.bridged & (truth.t_s >= start)
    if not chosen.any():
        raise NothingToCompareError(
            f"no common epoch: solution with position {_span(solution.t_s[usable])}, "
            f"truth {_span(truth.t_s)}, compared from {start:.3f} s on"
        )

    lat, height = truth.lat_rad, truth.height_m
    w2 = 1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2
    transverse = SEMI_MAJOR_M / np.sqrt(w2)
    meridian = transverse * (1.0 - ECCENTRICITY_SQUARED) / w2
    position = np.stack(
        [
            (at.linear(solution.lat_rad) - lat) * (meridian + height),
            _wrapped(at.angle(solution.lon_rad) - truth.lon_rad)
            * (transverse + height)
            * np.cos(lat),
            height - at.linear(solution.height_m),
        ],
        axis=1,
    )
    attitude = np.stack(
        [_wrapped(at.angle(solution.rpy[:, k]) - truth.rpy[:, k]) for k in range(3)], axis=1
    )
    return Errors(
        t_s=truth.t_s[chosen],
        position=position[chosen],
        velocity=(at.columns(solution.v) - truth.v)[chosen],
        attitude=attitude[chosen],
        sd_position=at.columns(solution.sd_position)[chosen],
        sd_velocity=at.columns(solution.sd_v)[chosen],
        sd_attitude=at.columns(solution.sd_rpy)[chosen],
        not_covered=int((~at.bridged & (truth.t_s >= start)).sum()),
    )


def compare(solution: TrajectoryTable, truth: TrajectoryTable, after_s: float = 0.0) -> Report:
    """Error statistics, flat, units in the names; None if a file lacks the quantity.

    `after_s` omits that time after the solution's first epoch. `*_p95_*` is the 95th percentile of
    the absolute error. Raises `NothingToCompareError`.
    """
    return report_of(errors_of(solution, truth, after_s))


def report_of(errors: Errors) -> Report:
    """Statistics of errors, for `compare`."""
    position, velocity = errors.position, errors.velocity
    report: Report = {
        "epochs": len(errors.t_s),
        "epochs_not_covered": errors.not_covered,
        "t_first_s": float(errors.t_s[0]),
        "t_last_s": float(errors.t_s[-1]),
    }
    horizontal = np.hypot(position[:, 0], position[:, 1])
    report |= _statistics("horizontal", "m", horizontal)
    for name, error in zip(("north", "east", "down"), position.T, strict=True):
        report |= _statistics(name, "m", error, mean=True)
    report |= _statistics("v_horizontal", "m_s", np.hypot(velocity[:, 0], velocity[:, 1]))
    for name, error in zip(("v_n", "v_e", "v_d"), velocity.T, strict=True):
        report |= _statistics(name, "m_s", error)
    for name, error in zip(("roll", "pitch", "yaw"), np.degrees(errors.attitude).T, strict=True):
        report |= _statistics(name, "deg", error)
    return report | _consistency(position, errors.sd_position)


class _Epochs:
    """Interpolation of the solution's usable rows to the truth's epochs."""

    def __init__(self, t: Floats, usable: Flags, wanted: Floats) -> None:
        self._rows = np.flatnonzero(usable)
        self._t = t[self._rows]
        self._wanted = wanted
        self.bridged: Flags = np.zeros(len(wanted), dtype=np.bool_)
        if not len(self._t):
            return
        after = np.clip(np.searchsorted(self._t, wanted, side="left"), 0, len(self._t) - 1)
        exact = self._t[after] == wanted
        before = np.maximum(after - 1, 0)
        inside = (wanted > self._t[0]) & (wanted < self._t[-1])
        short = self._t[after] - self._t[before] <= MAX_GAP_S + _GAP_TOLERANCE_S
        self.bridged = exact | (inside & short)

    def linear(self, column: Floats) -> Floats:
        """Interpolate a column (n,) to the epochs; valid where `bridged`."""
        if not len(self._t):
            return np.full(len(self._wanted), np.nan)
        return np.interp(self._wanted, self._t, column[self._rows])

    def columns(self, table: Floats) -> Floats:
        """Interpolate columns (n, k) of a table, each as `linear`."""
        return np.stack([self.linear(column) for column in table.T], axis=1)

    def angle(self, column: Floats) -> Floats:
        """Interpolate a column of angles (rad) along the shorter arc between rows."""
        values = column[self._rows].copy()
        known = np.isfinite(values)
        values[known] = np.unwrap(values[known])
        if not len(self._t):
            return np.full(len(self._wanted), np.nan)
        return np.interp(self._wanted, self._t, values)


def _wrapped(angle: Floats) -> Floats:
    """Wrap angles to [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _span(t: Floats) -> str:
    return f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "none"


def _statistics(name: str, unit: str, error: Floats, mean: bool = False) -> Report:
    """Statistics of the known absolute errors: RMS, largest, 95th percentile."""
    known = error[np.isfinite(error)]
    size = np.abs(known)
    values: Report = {
        f"{name}_rms_{unit}": float(np.sqrt(np.mean(known**2))) if len(known) else None,
        f"{name}_max_{unit}": float(size.max()) if len(known) else None,
        f"{name}_p95_{unit}": float(np.percentile(size, 95.0)) if len(known) else None,
    }
    if mean:
        values[f"{name}_mean_{unit}"] = float(known.mean()) if len(known) else None
    return values


def _consistency(position: Floats, sigma: Floats) -> Report:
    """Shares inside 1, 2, 3 sigma beside a Gaussian's, and mean NEES (see the module)."""
    normalised = (position / sigma) ** 2
    horizontal = normalised[:, 0] + normalised[:, 1]
    horizontal = horizontal[np.isfinite(horizontal)]
    total = normalised.sum(axis=1)
    total = total[np.isfinite(total)]  # none if the height is held, not estimated
    report: Report = {}
    for k in (1, 2, 3):
        share = float(np.mean(horizontal <= k * k)) if len(horizontal) else None
        report[f"horizontal_inside_{k}_sigma"] = share
        report[f"expected_inside_{k}_sigma"] = float(1.0 - np.exp(-k * k / 2.0))
    report["horizontal_nees"] = float(horizontal.mean()) if len(horizontal) else None
    report["position_nees"] = float(total.mean()) if len(total) else None
    report["expected_horizontal_nees"] = 2.0
    report["expected_position_nees"] = 3.0
    return report
