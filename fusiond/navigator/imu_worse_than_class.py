r"""Detection of an inertial unit that is worse than its configured class.

Rates of a body at rest are biases, or the body turns. A turn about the vertical may be that of a
deck or a table. A turn about a level axis at w turns gravity in the body; if the mean force stays
within d for t seconds, w is at most d / (g t). So the rates across the force are biases, k of them
of variance g s^2 + R. The prior: g = 1, the unit's class, except for one unit in `WRONG`; else a
larger g, uniform by octave.

Classes are ordered: a unit with gyro biases between those of two classes also has its other errors
between theirs, by logarithm.

On the move biases come from a fit (fusiond.navigator.alignment.motion_fit) with the class as a
prior: a worse class is accepted if its fit improves by more than its prior costs.

Source: Berger, Robust Bayesian analysis: sensitivity to the prior, J. Stat. Plan. Inference 25
(1990), 303 (a contaminated class of priors).
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Imu
from fusiond.configuration.sensor_class import CLASSES
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.models.blocks import ImuNoise

Array = NDArray[np.float64]

WRONG = 100.0
"""An engineer's: of a hundred vehicles one names another class than it has."""
WORSE: Final = 4.0 ** np.arange(0.25, 10.1, 0.25)
"""Grades beyond the class's: gyros of phones have 540 times the bias of tactical ones."""
AS_SAID = "bias_correlation_s"
"""Figure that all classes have alike."""


def worse_than_said(seen: Array, prior: float, noise: float) -> float:
    """E[g] from biases (k,), the data sheet's variance of them, and their measurement variance; 1
    if the unit is more likely of its class."""
    grades = np.concatenate(([1.0], WORSE))
    variance = grades * prior + noise
    log = -0.5 * (len(seen) * np.log(variance) + float(seen @ seen) / variance)
    weight = np.exp(log - log.max())
    weight[1:] /= WRONG * len(WORSE)
    if weight[0] >= weight[1:].sum():
        return 1.0
    return float(weight @ grades / weight.sum())


def widened(noise: ImuNoise, grade: float) -> ImuNoise:
    """Errors of a unit with that factor on the variance of its gyro biases."""
    if grade <= 1.0:
        return noise
    bias = math.sqrt(grade) * noise.rate_bias_initial
    classes = _ladder()
    biases = [math.log(each.rate_bias_initial) for each in classes]
    found = {}
    for name in (f.name for f in fields(noise) if f.name != AS_SAID):
        values = [math.log(getattr(each, name)) for each in classes]
        there = math.exp(float(np.interp(math.log(bias), biases, values)))
        found[name] = max(getattr(noise, name), there)
    return replace(noise, **{**found, "rate_bias_initial": bias})


def worse_classes(noise: ImuNoise) -> list[ImuNoise]:
    """Noise of each class with worse gyros, the best first."""
    bias = noise.rate_bias_initial
    return [
        widened(noise, (each.rate_bias_initial / bias) ** 2)
        for each in _ladder()
        if each.rate_bias_initial > bias
    ]


def evidence_against(noise: ImuNoise, worse: ImuNoise) -> float:
    """Decrease of chi-square that makes a worse unit likelier: its prior is one in `WRONG`, and its
    biases spread over a larger volume."""
    rate = math.log(worse.rate_bias_initial / noise.rate_bias_initial)
    force = math.log(worse.force_bias_initial / noise.force_bias_initial)
    return 2.0 * (math.log(WRONG) + 3.0 * rate + 3.0 * force)


def grades_of(noise: ImuNoise, sheet: ImuNoise, misalignment_rad: float) -> Array:
    """Grades (13,) of a unit with `noise` relative to its data `sheet`, whose axes are out of
    square by `misalignment_rad` (fusiond.navigator.imu_grade)."""
    pairs = (
        (noise.rate_bias_initial, sheet.rate_bias_initial),
        (noise.force_bias_initial, sheet.force_bias_initial),
        (noise.rate_scale, sheet.rate_scale),
        (noise.force_scale, sheet.force_scale),
    )
    biases = [math.log(each.rate_bias_initial) for each in _ladder()]
    axes = [DEG * values["misalignment_deg"] for values in CLASSES.values()]
    there = float(np.interp(math.log(noise.rate_bias_initial), biases, sorted(axes)))
    grade = 1.0 if misalignment_rad == 0.0 else max(1.0, (there / misalignment_rad) ** 2)
    return np.append(np.repeat([(one / other) ** 2 for one, other in pairs], 3), grade)


@lru_cache(maxsize=1)
def _ladder() -> list[ImuNoise]:
    """Classes, those with the best gyros first."""
    found = [imu_noise(Imu.model_validate({"sensor_class": name})) for name in CLASSES]
    return sorted(found, key=lambda each: each.rate_bias_initial)
