"""Every measurement's Jacobian, numerically, for full, planar and scale-factor models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.attitude import AttitudeMeasurement, HeadingMeasurement
from fusiond.aiding.base import Linearised, NotApplicable
from fusiond.aiding.body_velocity import NonHolonomicConstraint, WheelSpeedMeasurement
from fusiond.aiding.compass import CompassMeasurement, deviation, disturbance
from fusiond.aiding.height import BarometerMeasurement, HeightMeasurement
from fusiond.aiding.standstill import ZeroAngularRateUpdate, ZeroVelocityUpdate
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    FIX_TIME,
    VELOCITY_TIME,
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
    barometer_airflow_block,
    barometer_offset_block,
    barometer_scale_block,
)
from tests import runs
from tests.aiding.measurement_bench import (
    AIR,
    ESTIMATED,
    FIX_BIAS,
    FIX_MARKOV,
    KM_H,
    LEVER,
    RPY,
    SOURCE,
    VELOCITY,
    Array,
    innovation_of,
    measurement_model,
    position_measurement,
    rdss_measurement,
    state_of,
    vehicle_model,
)

MODELS = ("ins15", "ins21", "planar15")


def _check_jacobian(
    make: Callable[[Array], Linearised],
    name: str,
    rpy: tuple[float, float, float] = RPY,
    tolerance: float = 1e-6,
    model: Model | None = None,
    estimated: tuple[float, ...] = (),
) -> None:
    """H against the change of z when the *computed* state is off by one state at a time.

    Parameters in error by +d are estimates short by d. `tolerance` covers the curvature over the
    step of the central difference and latitude's rounding.
    """
    model = model or measurement_model(name)
    v = (*VELOCITY[:2], 0.0) if model.hold_height else VELOCITY
    nav = runs.level_nav(rpy, v)
    xi = np.zeros(model.size)
    for axis in range(3):
        xi[model.parameters(9 + axis)[0]] = 1e-3 * (axis + 1)
    if estimated:
        xi[-len(estimated) :] = estimated
    measurement = make(nav)
    z, h, r = innovation_of(measurement, state_of(model, nav, xi))
    assert h.shape == (len(z), model.size)
    assert r.shape == z.shape
    assert (r > 0.0).all()
    for k in range(model.size):
        if not model.active[k]:
            assert (h[:, k] == 0.0).all()
            continue
        if model.column_of[k] in range(15, 18):
            continue  # see test_scale_factors_are_left_out_of_lever_arms
        size = 1.0 if 6 <= k < 9 else 1e-4
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(model.size)
            error[k] = sign * size
            off = runs.with_error(nav, error[:9])
            ends.append(
                innovation_of(
                    measurement, state_of(model, off, xi - np.r_[np.zeros(9), error[9:]])
                ).z
            )
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        assert numeric == pytest.approx(h[:, k], abs=tolerance), (k, numeric, h[:, k])


MEASUREMENTS: dict[str, Callable[[Array], Linearised]] = {
    "position": position_measurement,
    "horizontal position": lambda nav: position_measurement(nav, False),
    "position with a shared error": lambda nav: replace(position_measurement(nav), bias=FIX_BIAS),
    "horizontal, shared error": lambda nav: replace(
        position_measurement(nav, False), bias=FIX_BIAS
    ),
    "position with a part of it": lambda nav: replace(
        position_measurement(nav), bias=FIX_BIAS, bias_share=(0.3, 0.7, 0.2)
    ),
    "position that wanders": lambda nav: replace(
        position_measurement(nav), bias=FIX_BIAS, markov=FIX_MARKOV, markov_m=2.3
    ),
    "rdss": rdss_measurement,
    "rdss, moved by the delay": lambda nav: rdss_measurement(nav, 1.5),
    "velocity": lambda nav: VelocityMeasurement(*SOURCE, (12.3, -7.2, 0.7), (0.1, 0.1, 0.2), LEVER),
    "horizontal velocity": lambda nav: VelocityMeasurement(
        *SOURCE, (12.3, -7.2), (0.1, 0.1), LEVER
    ),
    "heading": lambda nav: HeadingMeasurement(*SOURCE, 2.25, 0.01),
    "non-holonomic": lambda nav: NonHolonomicConstraint(*SOURCE, 0.1, 0.2, 2.0, LEVER),
    "wheel speed": lambda nav: WheelSpeedMeasurement(*SOURCE, 14.0, 0.1, LEVER),
    "zero velocity": lambda nav: ZeroVelocityUpdate(*SOURCE, 0.05, runs.rest(100.0)),
    "zero rate": lambda nav: ZeroAngularRateUpdate(
        *SOURCE, (2e-3, 1e-3, 3e-3), 1e-3, runs.rest(100.0)
    ),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", sorted(MEASUREMENTS))
def test_jacobian(kind: str, model: str) -> None:
    # Position: a metre north turns east's scale by cos' / R.
    tolerance = {"zero rate": 1e-9}.get(kind, 2e-6)
    _check_jacobian(MEASUREMENTS[kind], model, tolerance=tolerance)


IN_TIME: dict[str, Callable[[Array], Linearised]] = {
    "no slip": MEASUREMENTS["non-holonomic"],
    "wheel": lambda nav: replace(
        WheelSpeedMeasurement(*SOURCE, 14.0, 0.1, LEVER),
        drift=WHEEL_DRIFT,
        scale=WHEEL_SCALE,
        latency=WHEEL_LATENCY,
        rounding=WHEEL_ROUNDING,
        shared_step_m_s=KM_H,
    ),
    "position": lambda nav: replace(position_measurement(nav), time=FIX_TIME, rest=ANTENNA_LEVER),
    "horizontal position": lambda nav: replace(position_measurement(nav, False), time=FIX_TIME),
    "velocity": lambda nav: replace(
        VelocityMeasurement(*SOURCE, (12.3, -7.2, 0.7), (0.1, 0.1, 0.2), LEVER),
        time=VELOCITY_TIME,
        rest=ANTENNA_LEVER,
    ),
}


@pytest.mark.parametrize("kind", sorted(IN_TIME))
def test_jacobian_of_what_an_owner_cannot_measure(kind: str) -> None:
    """With estimates of 5 to 7 deg, decimetres and tenths of seconds."""
    model = vehicle_model()
    # Third order of the mounting.
    _check_jacobian(IN_TIME[kind], "", tolerance=1e-3, model=model, estimated=ESTIMATED)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.5, 1.1, -3.0), (-2.0, -0.9, 1.0)])
def test_jacobian_at_steep_attitudes(rpy: tuple[float, float, float]) -> None:
    _check_jacobian(lambda nav: HeadingMeasurement(*SOURCE, rpy[2], 0.01), "ins15", rpy, 1e-5)
    _check_jacobian(lambda nav: AttitudeMeasurement(*SOURCE, rpy, (0.01, 0.02, 0.03)), "ins15", rpy)
    _check_jacobian(MEASUREMENTS["velocity"], "ins15", rpy, 2e-6)


def test_height_jacobian_and_planar() -> None:
    _check_jacobian(lambda nav: HeightMeasurement(*SOURCE, 41.0, 5.0), "ins15")
    model = measurement_model("planar15")
    state = state_of(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    assert HeightMeasurement(*SOURCE, 41.0, 5.0).innovation(state) == NotApplicable("height_held")
    assert BarometerMeasurement(*SOURCE, 41.0, 5.0, *AIR).innovation(state) == NotApplicable(
        "height_held"
    )


def test_barometer_jacobian_and_what_explains_it() -> None:
    blocks = (
        barometer_offset_block(AIR[0], 100.0, 0.15),
        barometer_scale_block(AIR[1], 0.04),
        barometer_airflow_block(AIR[2], 0.1),
    )
    model = make_model("ins15", imu_noise(Imu()), *blocks)
    measurement = BarometerMeasurement(*SOURCE, 120.0, 5.0, *AIR)
    _check_jacobian(lambda nav: measurement, "", model=model, estimated=(70.0, 0.05, 0.2))
    nav, xi = runs.level_nav(RPY, VELOCITY), np.zeros(model.size)
    xi[-3:] = 70.0, 0.05, 0.2
    lift_m = 0.2 * math.hypot(*VELOCITY[:2]) ** 2 / (2.0 * 9.80665)
    sensed = replace(measurement, height_m=1.05 * float(nav[2]) + 70.0 + lift_m)
    assert innovation_of(sensed, state_of(model, nav, xi)).z == pytest.approx([0.0], abs=1e-9)


def test_scale_factors_are_left_out_of_lever_arms() -> None:
    """What a scale factor does over a lever arm: 2000 ppm of 0.5 rad/s over 2 m is 2 mm/s."""
    model = measurement_model("ins21")
    nav = runs.level_nav(RPY, VELOCITY)
    measurement = MEASUREMENTS["velocity"](nav)
    xi = np.zeros(model.size)
    base = innovation_of(measurement, state_of(model, nav, xi)).z
    xi[model.parameters(17)] = 2e-3
    assert np.abs(innovation_of(measurement, state_of(model, nav, xi)).z - base).max() < 2e-3


def test_compass() -> None:
    """With a deviation that is known in part; what turns the compass turns the iron with it."""
    names = "deviation", "disturbance"
    blocks = deviation(names[0], 0.1), disturbance(names[1], 0.05, 20.0)
    _check_jacobian(
        lambda nav: CompassMeasurement(*SOURCE, 0.66, 0.01, *names, 0.1),
        "ins15",
        model=make_model("ins15", imu_noise(Imu()), *blocks),
        estimated=(0.05, -0.04, 0.03, 0.02),
    )
