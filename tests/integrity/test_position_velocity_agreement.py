"""Whether a device that is out of service fits itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.integrity.position_velocity_agreement import Agreement
from tests import runs

SECOND = 1_000_000_000
LEVER = (0.0, 0.0, 0.0)
SD_M, SD_M_S = 1.0, 0.1


def after(
    count: int,
    period_s: float = 1.0,
    speed: tuple[float, float] = (3.0, -20.0),
    told: tuple[float, float] | None = None,
    jump_m: float = 0.0,
    lon_rad: float = 2.0,
    stops_s: float = math.inf,
) -> Agreement:
    """Of fixes of a vehicle of such a speed, which is `told` otherwise, jumps at the last and
    stops."""
    found, rng = Agreement(), np.random.default_rng(4)
    lat0 = 0.53
    to_m = runs.metres_per_unit(lat0, 0.0)
    for k in range(count):
        t_ns, t_s = round(k * period_s * SECOND), k * period_s
        at = np.array(speed) * min(t_s, stops_s) + SD_M * rng.standard_normal(2)
        at[0] += jump_m * (k == count - 1)
        north, east = at / to_m[:2]
        lon = (lon_rad + east + np.pi) % (2.0 * np.pi) - np.pi
        sd = (SD_M,) * 3
        v_n, v_e = np.array(told or speed) * (t_s < stops_s) + SD_M_S * rng.standard_normal(2)
        v = (float(v_n), float(v_e), 0.0)
        found = found.with_measurement(
            VelocityMeasurement("gnss_velocity", t_ns, 0.9999, v, (SD_M_S,) * 3, LEVER)
        ).with_measurement(
            PositionMeasurement(
                "gnss", t_ns, 0.9999, lat0 + float(north), float(lon), 0.0, sd, LEVER
            )
        )
    return found


@pytest.mark.parametrize("lon_rad", [2.0, np.pi])
def test_positions_fit_velocities_for_as_long_as_they_do(lon_rad: float) -> None:
    """Across 180 deg as anywhere."""
    assert after(40, lon_rad=lon_rad).lasted_ns == 39 * SECOND


def test_a_velocity_that_is_another_never_fits() -> None:
    assert after(40, told=(20.0, 3.0)).lasted_ns == 0


def test_a_jump_begins_anew() -> None:
    assert after(40, jump_m=10.0).lasted_ns == 0
    assert after(40, jump_m=1.0).lasted_ns == 39 * SECOND


@pytest.mark.parametrize("stops_s", [20.0, 20.02, 20.5, 20.98])
def test_a_velocity_that_steps_within_an_interval_goes_on(stops_s: float) -> None:
    """Half of 100 m/s and a second, to either side of the mean velocity's way."""
    assert after(40, speed=(100.0, 0.0), stops_s=stops_s).lasted_ns == 39 * SECOND


def test_a_jump_beside_a_step_of_velocity_begins_anew() -> None:
    """Of 4 sigma of the way, 4 x 20 / sqrt(12) m, and more."""
    assert after(40, speed=(20.0, 0.0), stops_s=39.0, jump_m=40.0).lasted_ns == 0


def test_fixes_far_apart_say_nothing() -> None:
    assert after(10, period_s=2.6).lasted_ns == 0
    assert after(10, period_s=2.4).lasted_ns == round(9 * 2.4 * SECOND)


def test_what_comes_twice_or_late_is_not_counted_again() -> None:
    once = after(10)
    assert once.position is not None
    same = PositionMeasurement(
        "gnss", once.position.t_ns, 0.9999, 0.53, 2.0, 0.0, (SD_M,) * 3, LEVER
    )
    assert once.with_measurement(same).lasted_ns == once.lasted_ns
