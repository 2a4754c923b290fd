r"""Barometer of a simulated vehicle: pressure of the standard atmosphere at the height

    H = (1 + k) h + b + c v^2 / (2 g) + n

with h the true height of the IMU, b the weather's offset (a random walk from N(0, weather_sd)), k
the relative lack of the air's temperature, c the missing share of the dynamic pressure, and white
noise n: the errors that `[aiding.barometer]` assumes (fusiond.aiding.height).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.standard_atmosphere import standard_pressure_pa
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.simulation.imu_truth import Truth

Array = NDArray[np.float64]

BAROMETER_COLUMNS = (("t_s", 6), ("t_arrival_s", 6), ("pressure_pa", 3), ("sd_m", 3))
"""Columns of barometer.csv and their decimals."""


@dataclass(frozen=True, slots=True)
class BarometerOptions:
    """One-sigma errors, named as in `fusiond.configuration.aiding.BarometerAiding`."""

    rate_hz: float = 2.0
    sd_m: float = 1.0
    weather_sd_m: float = 100.0
    weather_walk_m_sqrt_s: float = 0.15
    temperature_sd: float = 0.04
    airflow_sd: float = 0.1
    latency_s: float = 0.05


class Barometer:
    """Epochs over a whole trajectory, drawn at construction: `t_s`, `t_arrival_s`, `pressure_pa`
    (n,), and its errors: `offset_m` (n,), `scale`, `airflow`."""

    def __init__(self, truth: Truth, options: BarometerOptions, rng: np.random.Generator) -> None:
        o = self.options = options
        n = int(truth.duration_s * o.rate_hz + 1e-9)
        self.t_s = np.arange(1, n + 1) / o.rate_hz
        self.t_arrival_s = self.t_s + o.latency_s
        walk = rng.standard_normal(n) * (o.weather_walk_m_sqrt_s / math.sqrt(o.rate_hz))
        self.offset_m = rng.standard_normal() * o.weather_sd_m + np.cumsum(walk)
        self.scale = rng.standard_normal() * o.temperature_sd
        self.airflow = rng.standard_normal() * o.airflow_sd
        states = truth.at(self.t_s)
        head_m = np.square(states.v_ned[:, :2]).sum(axis=1) / (2.0 * STANDARD_GRAVITY_M_S2)
        self.height_m = (1.0 + self.scale) * states.position[:, 2] + self.offset_m
        self.height_m += self.airflow * head_m + rng.standard_normal(n) * o.sd_m
        self.pressure_pa = np.array([standard_pressure_pa(h) for h in self.height_m.tolist()])

    @property
    def rows(self) -> Array:
        """Rows of barometer.csv (n, 4)."""
        sd_m = np.full(len(self.t_s), self.options.sd_m)
        return np.column_stack((self.t_s, self.t_arrival_s, self.pressure_pa, sd_m))

    def values(self, k: int) -> list[float]:
        """Epoch `k` by the slots of `drivers.can.height.CanHeightDecoder`."""
        return [float(self.pressure_pa[k]), self.options.sd_m]


def barometer_stream(seed: int) -> np.random.Generator:
    """Random generator independent of the other devices' generators."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(102,)))
