"""What the tests of the measurements share: a model, a state with rates and accelerations, two
measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, State
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rdss_position import BIAS_BLOCK, RdssPositionMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    FIX_TIME,
    SIDE_DRIFT,
    VELOCITY_TIME,
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
    antenna_lever_block,
    axle_lever_block,
    drift_block,
    fix_markov_block,
    mounting_block,
    time_offset_block,
    wheel_rounding_block,
    wheel_scale_block,
)
from fusiond.navigation.earth import gravity
from fusiond.navigation.rotation import dcm_from_quaternion, dcm_from_rpy
from fusiond.navigation.strapdown import STEP_SIZE

Array = NDArray[np.float64]

SOURCE = ("aid", 0, 0.99)
LEVER = (1.3, -0.4, -2.1)
FIX_BIAS = ("gnss_bias", "gnss_bias_down")
FIX_MARKOV = "gnss_wander"
RATE_SENSED = np.array([0.05, -0.03, 0.4])
VELOCITY = (12.0, -7.0, 0.8)
RPY = (0.08, -0.12, 2.3)


def measurement_model(name: str) -> Model:
    biases = (
        position_bias(BIAS_BLOCK, 30.0, 600.0),
        position_bias(FIX_BIAS[0], 1.5, 1800.0),
        position_bias(FIX_BIAS[1], 5.0, 1800.0, "d"),
        fix_markov_block(FIX_MARKOV, 30.0),
    )
    return make_model(name, imu_noise(Imu()), *biases)


VEHICLE = (
    mounting_block(0.1),
    axle_lever_block(1.0),
    drift_block(SIDE_DRIFT, 0.1, 5.0),
    drift_block(WHEEL_DRIFT, 0.1, 1.0),
    wheel_scale_block(WHEEL_SCALE, 0.02),
    time_offset_block(WHEEL_LATENCY, 0.2),
    time_offset_block(FIX_TIME, 0.1),
    time_offset_block(VELOCITY_TIME, 0.1),
    antenna_lever_block(ANTENNA_LEVER, 0.3),
    wheel_rounding_block(WHEEL_ROUNDING, 0.25),
)
# What the filter holds of them: mounting pitch and yaw, lever, two drifts, scale, latency, two
# offsets in time, lever of the antenna, rounding.
ESTIMATED = (-0.12, 0.09, 0.7, -0.2, 0.3, 0.013, 0.15, 0.12, -0.08, 0.2, -0.1, 0.05, 0.2)
ACCELERATION = (1.4, -0.8, 0.3)
KM_H = 1.0 / 3.6
AIR = (BAROMETER_OFFSET, BAROMETER_SCALE, BAROMETER_AIRFLOW)


def vehicle_model() -> Model:
    return make_model("ins15", imu_noise(Imu()), *VEHICLE)


def state_of(model: Model, nav: Array, xi: Array) -> State:
    """As the filter leaves it: `step` holds rate and force with the estimates taken out."""
    step = np.zeros(STEP_SIZE)
    for axis in range(3):
        bias = sum(xi[s] for s in model.parameters(9 + axis))
        scale = sum(xi[s] for s in model.parameters(15 + axis))
        step[3 + axis] = (RATE_SENSED[axis] - bias) / (1.0 + scale)
    step[9:18] = dcm_from_quaternion(nav[6:]).ravel()
    sensed = np.array(ACCELERATION) - [0.0, 0.0, gravity(float(nav[0]), float(nav[2]))]
    force = dcm_from_rpy(*RPY).T @ sensed
    for axis in range(3):
        force[axis] -= sum(xi[s] for s in model.parameters(12 + axis))
        force[axis] /= 1.0 + sum(xi[s] for s in model.parameters(18 + axis))
    step[18:21] = dcm_from_quaternion(nav[6:]) @ force
    step[21:24] = step[3:6]
    return State(nav, xi, step, model)


def innovation_of(measurement: Linearised, state: State) -> Innovation:
    found = measurement.innovation(state)
    assert isinstance(found, Innovation)
    return found


def position_measurement(nav: Array, height: bool = True) -> PositionMeasurement:
    lat, lon, up = (float(x) for x in nav[:3])
    sd = (1.0, 2.0, 3.0)
    return PositionMeasurement(
        *SOURCE, lat + 1e-6, lon - 2e-6, up + 3.0 if height else None, sd, LEVER
    )


def rdss_measurement(nav: Array, moved_s: float = 0.0) -> RdssPositionMeasurement:
    lat, lon = float(nav[0]) + 1e-6, float(nav[1]) - 2e-6
    return RdssPositionMeasurement(
        *SOURCE, lat, lon, (400.0, -150.0, 200.0), LEVER, moved_s=moved_s
    )
