"""A wheel's speed that knows no direction, or was rounded: what a filter and a rest make of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.measurements import Heading, Height, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.body_velocity import SIGN_SIGMAS, WheelSpeedMeasurement
from fusiond.aiding.height import BarometerMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.aiding import BarometerAiding, HeightAiding, WheelAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.catalogue import make_model
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.navigator.intake import Intake
from tests import runs

SECOND = runs.SECOND
YAW_RAD = 0.7
SD_M_S = 0.2
KM_H = 1.0 / 3.6


def state(forward_m_s: float, sd_m_s: float | None) -> State:
    """Level, heading YAW_RAD; the sigma of the velocity, None where the state is no filter's."""
    model = make_model("ins15", imu_noise(Imu()))
    v = (forward_m_s * math.cos(YAW_RAD), forward_m_s * math.sin(YAW_RAD), 0.0)
    nav = runs.level_nav((0.0, 0.0, YAW_RAD), v)
    covariance = None
    if sd_m_s is not None:
        covariance = np.zeros((model.size, model.size))
        covariance[3:6, 3:6] = sd_m_s**2 * np.eye(3)
    return State(nav, np.zeros(model.size), np.zeros(STEP_SIZE), model, covariance)


def found(speed_m_s: float, at: State, signed: bool = False) -> float | str:
    """The innovation, or the name of why there is none."""
    measurement = WheelSpeedMeasurement("wheel", 0, 0.99, speed_m_s, 0.1, (0.0, 0.0, 0.0), signed)
    innovation = measurement.innovation(at)
    if isinstance(innovation, NotApplicable):
        return innovation.outcome
    assert isinstance(innovation, Innovation)
    return round(float(innovation.z[0]), 9)


def test_the_direction_is_the_filters_own_beyond_its_sigmas() -> None:
    assert found(5.0, state(5.5, SD_M_S)) == 0.5
    assert found(5.0, state(-5.5, SD_M_S)) == -0.5  # it reverses, and the wheel does not know
    assert found(5.0, state(-5.5, SD_M_S), signed=True) == -10.5
    edge = SIGN_SIGMAS * SD_M_S
    for sign in (1.0, -1.0):
        assert found(0.5, state(sign * 0.99 * edge, SD_M_S)) == "direction_unknown"
        assert found(0.5, state(sign * 1.01 * edge, SD_M_S)) == pytest.approx(
            sign * (1.01 * edge - 0.5)
        )
    assert found(0.0, state(0.1, SD_M_S), signed=True) == 0.1
    assert found(5.0, state(-4.0, None)) == 1.0  # a sigma point has the sign of its own velocity


def test_a_speed_that_reads_zero_long_is_no_rest_below_its_step() -> None:
    """Averaging takes noise away, not rounding: a car that creeps at 0.2 m/s reads 0 for ever."""
    rounded, fine = RestEvidence(), RestEvidence()
    sd = KM_H / math.sqrt(3.0)
    for k in range(40):
        reading = WheelSpeedMeasurement("wheel", k * SECOND // 4, 0.99, 0.0, sd, (0.0, 0.0, 0.0))
        fine.receive([reading])
        rounded.receive([replace(reading, rounding_sd_m_s=sd)])
    assert rounded.measured(0, 10 * SECOND) == (False, pytest.approx(sd), False)
    assert fine.measured(0, 10 * SECOND).sd == pytest.approx(sd / math.sqrt(40.0))
    # Two km/h contradict rest all the same, even one reading of them.
    moving = RestEvidence()
    moving.receive(
        [WheelSpeedMeasurement("wheel", 0, 0.99, 2.0 * KM_H, 0.1, (0.0,) * 3, False, 0.08)]
    )
    assert moving.measured(0, SECOND).contradicts


STAMP = MonotonicStamp(SECOND)
WHEEL = WheelSpeed("wheel", SECOND, STAMP, 10.0, 0.3, 0.4, signed=False)


def measurements(m: WheelSpeed | PositionFix | Heading | Height) -> list[AidingMeasurement]:
    result = Intake({}).measurements_of(m, SECOND, 0.0)
    assert not isinstance(result, str)
    return list(result)


def test_rounding_enters_the_noise_of_every_kind() -> None:
    (wheel,) = measurements(WHEEL)
    assert isinstance(wheel, WheelSpeedMeasurement)
    assert (wheel.sd_m_s, wheel.signed, wheel.rounding_sd_m_s) == (pytest.approx(0.5), False, 0.4)
    assert wheel.candidates()[0].drifts == (WheelAiding().drift_sd_m_s, WheelAiding().drift_s)
    fix = PositionFix("gnss", SECOND, STAMP, 0.9, 0.2, 50.0, sd_ned_m=(3.0, 3.0, 6.0))
    fix = replace(fix, v_ned_m_s=(5.0, 0.0, None), sd_v_ned_m_s=(0.3, 0.3, None))
    coarse = replace(fix, rounding_sd_ned_m=(4.0, 0.0, 8.0), rounding_sd_v_m_s=0.4)
    position, velocity = measurements(coarse)
    assert isinstance(position, PositionMeasurement)
    assert isinstance(velocity, VelocityMeasurement)
    assert position.sd == pytest.approx((5.0, 3.0, 10.0))
    assert velocity.sd == pytest.approx((0.5, 0.5))
    (heading,) = measurements(Heading("heading", SECOND, STAMP, 1.0, 0.03, 0.04))
    (height,) = measurements(Height("height", SECOND, STAMP, 100.0, 3.0, 4.0))
    assert getattr(heading, "sd_rad", None) == pytest.approx(0.05)
    assert getattr(height, "sd_m", None) == pytest.approx(5.0)


def test_a_barometer_is_refused_by_name_where_no_state_knows_the_weather() -> None:
    height = Height("baro", SECOND, STAMP, 100.0, 3.0, 4.0, barometric=True)
    assert Intake({}).measurements_of(height, SECOND, 0.0) == "weather_unknown"
    assert (
        Intake({"baro": HeightAiding()}).measurements_of(height, SECOND, 0.0) == "weather_unknown"
    )
    for name in ("baro", "barometer"):
        intake = Intake({name: BarometerAiding()})
        (measurement,) = intake.measurements_of(height, SECOND, 0.0)
        assert isinstance(measurement, BarometerMeasurement)
        assert measurement.sd_m == pytest.approx(5.0)
        assert not measurement.candidates()
        blocks = [block.name for block in intake.extra_blocks()]
        assert blocks == [measurement.offset, measurement.scale, measurement.airflow]
        assert measurement.offset == "barometer_offset" + ("_baro" if name == "baro" else "")
