r"""Inertial unit that is worse than its class: what its sheet says is a prior, and may be wrong.

Rates of a body at rest are biases, or the body turns. Turns about the vertical a deck or a table
makes; one about a level axis at w turns gravity in the body, and where the mean force stays within
d of where it was for t seconds it is no faster than d / (g t). So the rates across the force are
biases, k of them of variance g s^2 + R: g = 1 where the unit is of its class, which it is but for
one in `WRONG`, else any that is larger, each octave as likely as the next.

Classes lie on a ladder: a unit whose gyros have biases between those of two has the other errors
between theirs too, by logarithm. What it is worse than its sheet says, it is in all of them.

On the move biases come out of a fit (fusiond.navigator.alignment.motion_fit), with those of its
class as a prior: there a worse class is taken where its fit is better by more than what makes it
likelier.

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
    """E[g] by rates (k,) that are biases, the sheet's variance of them, and that of what they are
    seen with; 1 where it is likelier than not that the unit is of its class."""
    grades = np.concatenate(([1.0], WORSE))
    variance = grades * prior + noise
    log = -0.5 * (len(seen) * np.log(variance) + float(seen @ seen) / variance)
    weight = np.exp(log - log.max())
    weight[1:] /= WRONG * len(WORSE)
    if weight[0] >= weight[1:].sum():
        return 1.0
    return float(weight @ grades / weight.sum())


def widened(noise: ImuNoise, grade: float) -> ImuNoise:
    """Errors of a unit whose gyros' biases have so many times the variance."""
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
    """Units as bad as each class whose gyros are worse, the best first."""
    bias = noise.rate_bias_initial
    return [
        widened(noise, (each.rate_bias_initial / bias) ** 2)
        for each in _ladder()
        if each.rate_bias_initial > bias
    ]


def evidence_against(noise: ImuNoise, worse: ImuNoise) -> float:
    """By how much lower (chi-square) a fit of biases must be with those of a worse unit for it to
    be likelier: one unit in `WRONG` is, and it spreads its biases over so much more."""
    rate = math.log(worse.rate_bias_initial / noise.rate_bias_initial)
    force = math.log(worse.force_bias_initial / noise.force_bias_initial)
    return 2.0 * (math.log(WRONG) + 3.0 * rate + 3.0 * force)


def grades_of(noise: ImuNoise, sheet: ImuNoise, misalignment_rad: float) -> Array:
    """Grades (13,) of a unit with that `noise` against what its `sheet` says, which has axes out of
    square by `misalignment_rad`: fusiond.navigator.unit_grade."""
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
    """Of the classes, the best gyros first."""
    found = [imu_noise(Imu.model_validate({"sensor_class": name})) for name in CLASSES]
    return sorted(found, key=lambda each: each.rate_bias_initial)
