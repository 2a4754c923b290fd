"""Simulated runs for the tests of the numerics: a drive, its IMU with known errors, its filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.aiding.standstill import Rest
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.navigation.standstill import Window
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Leg, follow
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error

__all__ = [
    "ORIGIN",
    "SECOND",
    "TOWN",
    "Array",
    "ImuRun",
    "filled_buffer",
    "imu_run",
    "initial_sd",
    "level_nav",
    "make_estimator",
    "metres_per_unit",
    "nav_error",
    "random_attitude",
    "rest",
    "sample_times",
    "town_truth",
    "true_nav",
    "with_error",
]

Array = NDArray[np.float64]
ORIGIN = (math.radians(30.5), math.radians(114.3), 40.0)
SECOND = 1_000_000_000

TOWN = (
    Leg(8, speed_m_s=14.0),
    Leg(8, turn_deg=90.0),
    Leg(12, speed_m_s=18.0),
    Leg(6, turn_deg=-60.0),
    Leg(9, speed_m_s=6.0),
    Leg(14, turn_deg=200.0),
    Leg(8, speed_m_s=0.0),
    Leg(10),
)


def town_truth(seconds: float, rate_hz: float, climb_deg: float = 3.0) -> Truth:
    """Turns, stops and, unless `climb_deg` is 0, hills. Without them the height is constant."""
    legs: list[Leg] = []
    for k in range(1 + int(seconds // 75)):
        legs += TOWN[:2]
        legs += [Leg(6, climb_deg=climb_deg), Leg(8, climb_deg=-climb_deg), Leg(6, climb_deg=0.0)]
        legs += TOWN[2:] if k % 2 == 0 else TOWN[:1:-1]
    bank = -0.08 if climb_deg else 0.0
    return Truth(follow(legs, seconds, course_deg=40.0, bank_ratio=bank), ORIGIN, rate_hz, seconds)


def sample_times(truth: Truth, start_ns: int = 0) -> NDArray[np.int64]:
    """Stamps (n,) in ns of the truth's samples."""
    return start_ns + np.rint(truth.t_s[1:] * 1e9).astype(np.int64)


@dataclass(frozen=True)
class ImuRun:
    """One IMU on one trajectory: samples (n, 6), and its errors, biases (n, 6), scales (6,)."""

    samples: Array
    biases: Array
    _imu: Imu
    _seed: int

    @cached_property
    def scales(self) -> Array:
        """Told by the same seed with unit and with no motion."""
        zero, one = np.zeros((len(self.samples), 3)), np.ones((len(self.samples), 3))
        still, unit = (
            imu_output(self._imu, motion, motion, np.random.default_rng(self._seed))
            for motion in (zero, one)
        )
        return np.concatenate(
            [(unit.gyro - still.gyro)[0] - 1.0, (unit.accel - still.accel)[0] - 1.0]
        )


def imu_run(imu: Imu, truth: Truth, seed: int) -> ImuRun:
    """What that IMU says."""
    out = imu_output(imu, truth.gyro, truth.accel, np.random.default_rng(seed))
    biases = np.hstack([out.gyro_bias, out.accel_bias])
    return ImuRun(np.hstack([out.gyro, out.accel]), biases, imu, seed)


def filled_buffer(imu: Imu, times: NDArray[np.int64], samples: Array) -> ImuBuffer:
    """A buffer that holds all of the samples (body axes)."""
    seconds = float(times[-1] - times[0]) * 1e-9 + 10.0
    buffer = ImuBuffer(imu.rate_hz, seconds, np.eye(3), 0.0, imu.gap_s)
    assert buffer.append(times, samples) == len(times)
    return buffer


def make_estimator(name: str, imu: Imu) -> tuple[Model, KalmanEstimator]:
    """A shipped model and its filter for an IMU."""
    model = make_model(name, imu_noise(imu))
    return model, KalmanEstimator(model, imu.gap_s)


def initial_sd(model: Model, attitude: Array, velocity: float, position: float) -> Array:
    """One sigma (n,) at the start: as given for the navigation errors, else the model's."""
    sd = model.initial.copy()
    sd[0:3], sd[3:6], sd[6:9] = attitude, velocity, position
    sd[~model.active] = 0.0
    return sd


def random_attitude(rng: np.random.Generator) -> tuple[float, float, float]:
    """Roll, pitch, yaw anywhere short of the vertical."""
    roll, pitch, yaw = rng.uniform(-1.0, 1.0, 3) * [math.pi, 1.3, math.pi]
    return float(roll), float(pitch), float(yaw)


def level_nav(rpy: tuple[float, float, float], v: tuple[float, float, float]) -> Array:
    """A navigation state (10,) at ORIGIN."""
    return np.array([*ORIGIN, *v, *quaternion_from_rpy(*rpy)])


def rest(
    max_speed_m_s: float = 0.5,
    mean_rate: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rest_evidence: RestEvidence | None = None,
    end_s: float = 10.0,
    run: int = 1,
    scatter: Array | None = None,
) -> Rest:
    """The hypothesis of rest in a window of one second, with the default sigmas and no noise."""
    rate = np.array(mean_rate)
    force, scatters = np.array([0.0, 0.0, -9.8]), np.zeros(3) if scatter is None else scatter
    window = Window(round(end_s * 1e9), 100, rate, force, True, run, rate, scatters)
    sd_rate = math.radians(0.1)
    return Rest(window, rest_evidence or RestEvidence(), max_speed_m_s, 0.05, sd_rate, 0.0)
