r"""Car with unmeasured parameters, whose truth is drawn from the filter's own priors.

Every block of fusiond.models.vehicle_parameter_blocks has a true value of its own in each run:

    mounting m            the IMU's attitude is C_nv exp[m x], C_nv the car's
    axle_lever            the point that does not slide lies at l_0 + (l_x, 0, 0), IMU axes
    side_drift            0 = u_right - s + v: s and v are what the constraint is wrong by
    wheel_*               whole km/h of (1 + k) u(t - tau) + s_w + v, made with a share of a step
    gnss_time, _velocity  position and velocity of t + tau
    antenna_lever         the antenna sits at l_0 + dl, IMU axes
    barometer_*           the pressure, as fusiond.simulation.barometer has it

Sensors are those of `fusiond simulate`; measurements go through the daemon's own intake, so that
blocks, sigmas and measurements are those of the configuration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from drivers.measurements import Height, MonotonicStamp, PositionFix, WheelSpeed
from drivers.quantization import SHARED_SD, rounded_speed
from drivers.standard_atmosphere import pressure_height_m
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    AXLE_LEVER,
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    FIX_TIME,
    MOUNTING,
    SIDE_DRIFT,
    TIME_WALK_S_SQRT_S,
    VELOCITY_TIME,
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
)
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    quaternion_from_rpy,
    rotation_vector_to_quaternion,
    rpy_from_dcm,
)
from fusiond.navigator.intake import Intake
from fusiond.navigator.motion_constraints import GATE
from fusiond.simulation.barometer import Barometer, BarometerOptions
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Path, dcm_from_rpy
from fusiond.studies.navigation_error import metres_per_unit, true_nav

Array = NDArray[np.float64]
Measured = PositionFix | WheelSpeed | Height

RATE_HZ = 50.0
ORIGIN = (30.5 * DEG, 114.3 * DEG, 400.0)
"""Origin, at some height, so that a barometer's scale is observable."""
STEP_M_S = 1.0 / 3.6
FIX_SD_M, FIX_VELOCITY_SD_M_S = (0.02, 0.02, 0.04), (0.03, 0.03, 0.05)
"""A receiver with fixed ambiguities: what shows a lever arm of decimetres."""
STANDS_M_S = 0.5
"""Speed below which wheels give no pulses: they read 0, without noise."""
WHEEL_HZ, SLIP_HZ, AIR_HZ, AIR_SD_M = 2.0, 5.0, 1.0, 2.0
VEHICLE: dict[str, Any] = {
    # What a rest before the drive leaves of a `mems` unit's biases.
    "imu": {
        "sensor_class": "mems",
        "rate_hz": RATE_HZ,
        "gyro_bias_initial_deg_h": 36.0,
        "accel_bias_initial_mg": 5.0,
    },
    "aiding": {
        "gnss": {"lever_arm_m": [0.2, 0.1, -1.2], "lever_arm_sd_m": 0.3, "bias_sd_m": 0.0},
        "wheel": {},
        "barometer": {},
    },
    "constraints": {"non_holonomic": {"enabled": True, "lever_arm_m": [-1.0, 0.0, 0.5]}},
    "estimator": {"model": "ins21"},
}


def configuration(**imu: Any) -> Config:
    """Configuration of the car, with defaults where they exist."""
    return Config.model_validate(VEHICLE | {"imu": VEHICLE["imu"] | imu})


@immutable()
class SlippingConstraint(NonHolonomicConstraint):
    """The constraint on a vehicle that slides by `slip` (right, down; m/s), drift and noise."""

    slip: tuple[float, float] = (0.0, 0.0)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        found = NonHolonomicConstraint.innovation(self, state)
        if isinstance(found, NotApplicable):
            return found
        return found._replace(z=found.z + np.array(self.slip))

    def packed(self, model: Model) -> None:
        """Return no packed row, since the kernel ignores the slip."""
        return None


@dataclass(frozen=True, slots=True)
class Car:
    """Run: IMU samples (n, 6), body axes; measurements in order; the true value of each block at
    the end; and the mounting as a matrix (3, 3), from the IMU's axes to the car's."""

    truth: Truth
    samples: Array
    measurements: list[AidingMeasurement]
    true: dict[str, Array]
    turn: Array

    def nav(self, t_s: float) -> Array:
        """True navigation state (10,) of the IMU."""
        nav: Array = true_nav(self.truth, np.array([t_s]))[0]
        c = dcm_from_quaternion(nav[6:]) @ self.turn
        nav[6:] = quaternion_from_rpy(*rpy_from_dcm(c))
        return nav


def draw_car(config: Config, path: Path, seconds: float, rng: np.random.Generator) -> Car:
    """Car on `path` (of its rear axle), drawn at random."""
    slip, wheel = config.constraints.non_holonomic, config.aiding["wheel"]
    mounting = rng.standard_normal(2) * (slip.mounting_sd_deg * DEG)
    turn = dcm_from_quaternion(np.array(rotation_vector_to_quaternion(0.0, *mounting)))
    axle_m = rng.standard_normal() * slip.lever_arm_sd_m
    axle = np.array(slip.lever_arm_m) + np.array([axle_m, 0.0, 0.0])
    x, y, z = (float(v) for v in -(turn @ axle))
    truth = Truth(replace(path, arm_m=(x, y, z)), ORIGIN, RATE_HZ, seconds)
    sensed = imu_output(config.imu, truth.gyro @ turn, truth.accel @ turn, rng)
    intake = Intake(config.aiding)
    true: dict[str, Array] = {MOUNTING: mounting, AXLE_LEVER: np.array([axle_m])}
    measured: list[Measured] = []
    measured += _fixes(config, truth, turn, true, rng)
    measured += _speeds(wheel, truth, true, rng)
    measured += _pressures(config.aiding["barometer"], truth, true, rng)
    measurements: list[AidingMeasurement] = []
    for m in measured:
        assert isinstance(m.stamp, MonotonicStamp)
        found = intake.measurements_of(m, m.stamp.t_ns, 0.0)
        assert not isinstance(found, str), found
        measurements += found
    measurements += _slips(config, truth, true, rng)
    measurements.sort(key=lambda each: each.t_ns)
    return Car(truth, np.hstack([sensed.gyro, sensed.accel]), measurements, true, turn)


def _walk(n: int, step_s: float, sd: float, walk: float, rng: np.random.Generator) -> Array:
    """Random walk (n,) from N(0, sd)."""
    return rng.standard_normal() * sd + np.cumsum(rng.standard_normal(n) * walk * math.sqrt(step_s))


def _at(name: str, t_s: float) -> tuple[str, int, MonotonicStamp]:
    t_ns = round(t_s * 1e9)
    return name, t_ns, MonotonicStamp(t_ns)


def _fixes(
    config: Config, truth: Truth, turn: Array, true: dict[str, Array], rng: np.random.Generator
) -> list[Measured]:
    o: Any = config.aiding["gnss"]
    t_s = np.arange(0.503, truth.duration_s - 0.5, 1.0)
    n = len(t_s)
    rest = rng.standard_normal(3) * o.lever_arm_sd_m
    delay, delay_v = (_walk(n, 1.0, o.time_offset_sd_s, TIME_WALK_S_SQRT_S, rng) for _ in range(2))
    true |= {ANTENNA_LEVER: rest, FIX_TIME: delay[-1:], VELOCITY_TIME: delay_v[-1:]}
    x, y, z = (float(v) for v in turn @ (np.array(o.lever_arm_m) + rest))
    place = truth.at(t_s + delay, (x, y, z))
    v = truth.at(t_s + delay_v, (x, y, z)).v_ned
    v = v + rng.standard_normal((n, 3)) * FIX_VELOCITY_SD_M_S
    found: list[Measured] = []
    noise = rng.standard_normal((n, 3)) * FIX_SD_M
    for k, t in enumerate(t_s.tolist()):
        p = place.position[k] + noise[k] / metres_per_unit(
            float(place.position[k, 0]), float(place.position[k, 2])
        )
        lat, lon, height = (float(value) for value in p)
        north, east, down = (float(value) for value in v[k])
        fix = PositionFix(
            *_at("gnss", t),
            lat,
            lon,
            height,
            quality=4,
            sd_ned_m=FIX_SD_M,
            v_ned_m_s=(north, east, down),
            sd_v_ned_m_s=FIX_VELOCITY_SD_M_S,
        )
        found.append(fix)
    return found


def _speeds(
    o: Any, truth: Truth, true: dict[str, Array], rng: np.random.Generator
) -> list[Measured]:
    """Speeds at the wheel's point, which is the IMU's: `[aiding.wheel] lever_arm_m` is zero."""
    t_s = np.arange(0.21, truth.duration_s - 0.5, 1.0 / WHEEL_HZ)
    n = len(t_s)
    scale, share = rng.standard_normal() * o.scale_sd, rng.standard_normal() * SHARED_SD
    delay = _walk(n, 1.0 / WHEEL_HZ, o.latency_sd_s, TIME_WALK_S_SQRT_S, rng)
    drift = gauss_markov(
        rng, (n, 1), step_s=1.0 / WHEEL_HZ, correlation_s=o.drift_s, sigma=o.drift_sd_m_s
    )[:, 0]
    true |= {
        WHEEL_SCALE: np.array([scale]),
        WHEEL_ROUNDING: np.array([share]),
        WHEEL_LATENCY: delay[-1:],
        WHEEL_DRIFT: drift[-1:],
    }
    states = truth.at(t_s - delay)
    forward = np.einsum("nij,ni->nj", dcm_from_rpy(states.rpy), states.v_ned)[:, 0]
    says = (1.0 + scale) * forward + drift + rng.standard_normal(n) * o.sd_m_s
    says = np.where(forward > STANDS_M_S, says, 0.0)
    # Nearest is a share of -1/4, downwards one of 1/4: the middle between takes a quarter off.
    steps = np.floor(np.maximum(says, 0.0) / STEP_M_S + (0.25 - share))
    found: list[Measured] = []
    for t, count in zip(t_s.tolist(), steps.tolist(), strict=True):
        r = rounded_speed(max(count, 0.0) * STEP_M_S, STEP_M_S, "unknown")
        found.append(
            WheelSpeed(
                *_at("wheel", t),
                r.mean_m_s,
                rounding_sd_m_s=r.sd_m_s,
                shared_step_m_s=r.shared_step_m_s,
            )
        )
    return found


def _pressures(
    o: Any, truth: Truth, true: dict[str, Array], rng: np.random.Generator
) -> list[Measured]:
    options = BarometerOptions(
        AIR_HZ, AIR_SD_M, o.weather_sd_m, o.weather_walk_m_sqrt_s, o.temperature_sd, o.airflow_sd
    )
    b = Barometer(truth, options, rng)
    true |= {
        BAROMETER_OFFSET: b.offset_m[-1:],
        BAROMETER_SCALE: np.array([b.scale]),
        BAROMETER_AIRFLOW: np.array([b.airflow]),
    }
    return [
        Height(*_at("barometer", t), pressure_height_m(p), AIR_SD_M, barometric=True)
        for t, p in zip(b.t_s.tolist(), b.pressure_pa.tolist(), strict=True)
    ]


def _slips(
    config: Config, truth: Truth, true: dict[str, Array], rng: np.random.Generator
) -> list[AidingMeasurement]:
    o = config.constraints.non_holonomic
    t_s = np.arange(0.1, truth.duration_s - 0.1, 1.0 / SLIP_HZ)
    n = len(t_s)
    drift = gauss_markov(
        rng, (n, 1), step_s=1.0 / SLIP_HZ, correlation_s=o.drift_s, sigma=o.drift_sd_m_s
    )
    true[SIDE_DRIFT] = drift[-1]
    noise = rng.standard_normal((n, 2)) * (o.sd_m_s, o.sd_down_m_s)
    noise[:, :1] += drift
    return [
        SlippingConstraint(
            "non_holonomic",
            round(t * 1e9),
            GATE,
            o.sd_m_s,
            o.sd_down_m_s,
            o.min_speed_m_s,
            o.lever_arm_m,
            slip=(float(right), float(down)),
        )
        for t, (right, down) in zip(t_s.tolist(), noise, strict=True)
    ]
