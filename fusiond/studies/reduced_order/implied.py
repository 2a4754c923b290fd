r"""Noises that table 2 of paper 002 implies and does not print.

The flight's transitions and rows are the study's; only what is noise differs. Found by least
squares of the logarithms of the printed figures (Nelder and Mead); the accelerometer's bias, which
is printed, is held.

* 23 states: a gyro of 0.12 deg/sqrt(h) in place of 0.01, with 7 arc seconds of the radar's
  misalignment, makes the attitude 32, 36 and 39 arc seconds (printed: 33, 36, 33); no misalignment
  does (33 arc seconds: 17.7 level), for velocity shows tilt and bias together. Its velocities are
  those of ranges of 0.55 m and rates of 0.2 m/s: 0.023, 0.021, 0.0019 (0.023, 0.0163, 0.002).
* 17 states: the biases as noise of 3 m/s/sqrt(h), b^2 T with T of 2600 s, most of the flight
  (`fusiond.models.missing_states` derives 507 s there, and less with that gyro): the filter then
  forgets what the accelerometer knows of the tilt: 39 and 68 arc seconds (37, 66), 0.059 m/s east
  (0.061).

What no noise gives: an azimuth of 56 arc seconds where the 23 states have 33 (the same radar tells
it to both), and a vertical velocity of 0.008 m/s beside level ones of 0.04 to 0.06, of one noise of
three accelerometers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import SAR_MISALIGNMENT
from fusiond.models.model import Model
from fusiond.studies.covariance_analysis import System, analyse
from fusiond.studies.reduced_order import flight
from fusiond.studies.reduced_order.report import sigmas

Array = NDArray[np.float64]

ROOT_HOUR = 60.0
GYRO_DEG_SQRT_H, MISALIGNMENT_ARCSEC = 0.12, 7.0
RANGE_SD_M, RATE_SD_M_S = 0.55, 0.2
ACCELEROMETER_M_S_SQRT_H = 3.0
"""Of the filter with 17 states: what its biases are to it."""


def found(
    models: dict[str, Model], systems: dict[str, list[System]], kept: NDArray[np.int64]
) -> dict[str, Any]:
    """One sigma at the end of the flight with the implied noises, of 23 and of 17 states; `kept`
    (m,) as of `analyse`."""
    full, reduced = models["23"], models["17"]
    gyro = (math.radians(GYRO_DEG_SQRT_H) / ROOT_HOUR) ** 2
    of_biases = (ACCELEROMETER_M_S_SQRT_H / ROOT_HOUR) ** 2
    truth = list(_with(systems["23"], full, {"attitude": gyro}))
    filters = {
        "23": (full, truth, np.arange(full.size)),
        "17": (
            reduced,
            list(_with(systems["17"], reduced, {"attitude": gyro, "velocity": of_biases})),
            kept,
        ),
    }
    out: dict[str, Any] = {
        "gyro_noise_deg_sqrt_h": GYRO_DEG_SQRT_H,
        "sar_misalignment_sd_arcsec": MISALIGNMENT_ARCSEC,
        "range_sd_m": RANGE_SD_M,
        "rate_sd_m_s": RATE_SD_M_S,
        "accelerometer_noise_of_17_m_s_sqrt_h": ACCELEROMETER_M_S_SQRT_H,
        "models": {},
    }
    for name, (of, believed, slots) in filters.items():
        steps = zip(truth, believed, strict=True)
        *_, last = analyse(steps, slots, _initial(full), _initial(of), np.arange(9))
        out["models"][name] = sigmas(last.true)
    return out


def _initial(of: Model) -> Array:
    sd = flight.initial_sd(of)
    sd[of.slots_of(SAR_MISALIGNMENT)] = MISALIGNMENT_ARCSEC * flight.ARC_SECOND
    return np.asarray(np.diag(sd**2))


def _with(systems: list[System], of: Model, white: dict[str, float]) -> Iterator[System]:
    """The flight with densities (unit^2 / s) of some blocks and the implied ranges; a level flight,
    so that noise of body axes is that of north, east, down."""
    own = {block.name: block.white for block in of.blocks}
    more = np.zeros(of.size)
    for name, density in white.items():
        more[of.slots_of(name)] = density - own[name]
    for phi, q, h, r in systems:
        satellites = (len(r) - 2) // 2
        variance = np.repeat([RANGE_SD_M**2, RATE_SD_M_S**2], satellites)
        yield System(phi, q + np.diag(more), h, np.concatenate([variance, r[-2:]]))
