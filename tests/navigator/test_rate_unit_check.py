"""The unit of the rates, told by positions alone: an RDSS terminal's, tens of metres off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, MonotonicStamp
from fusiond.configuration.schema import Config
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

Array = NDArray[np.float64]

RATE_HZ, SPACING_S, SD_M, LATE_S = 25.0, 11.0, 20.0, 1.5
SECONDS = 150.0
BIAS_RAD_S = math.radians(0.6)
IN_DEGREES = 180.0 / math.pi
OFF = (Leg(10), Leg(8, speed_m_s=15.0))
# At 4 deg/s: rates that a vehicle can turn with in either unit.
BENDS = (Leg(20, turn_deg=80.0), Leg(20, turn_deg=-75.0), Leg(20), Leg(22, turn_deg=90.0))
LEGS = (*OFF, Leg(12), *BENDS, Leg(80))
STRAIGHT = (*OFF, Leg(SECONDS))
CONFIG = Config.model_validate({"imu": {"rate_hz": RATE_HZ}, "aiding": {"rdss": {}}})


class Drive:
    """A vehicle with an RDSS terminal; `factor` is the unit that its gyros speak in."""

    def __init__(self, legs: tuple[Leg, ...], factor: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        course_deg = float(rng.uniform(0.0, 360.0))
        truth = Truth(follow(legs, SECONDS, course_deg=course_deg), runs.ORIGIN, RATE_HZ, SECONDS)
        self.times = runs.sample_times(truth)
        self.samples = runs.imu_run(CONFIG.imu, truth, seed).samples
        # A gyro in rad/s with a bias of no data sheet, or one of its sheet in deg/s.
        if factor == 1.0:
            self.samples[:, 2] += BIAS_RAD_S
        self.samples[:, :3] *= factor
        self.fixes = []
        for t_s in np.arange(5.0, SECONDS - LATE_S, SPACING_S).tolist():
            true = truth.at(np.array([t_s])).position[0]
            lat, lon, _ = true + SD_M * rng.standard_normal(3) / runs.metres_per_unit(
                true[0], true[2]
            )
            t_ns, seen_ns = round(t_s * 1e9), round((t_s + LATE_S) * 1e9)
            stamp, height = MonotonicStamp(t_ns), float(true[2])
            fix = DelayedFix("rdss", seen_ns, stamp, float(lat), float(lon), height, SD_M)
            self.fixes.append((t_ns, fix))

    def feed(self, navigator: Navigator) -> None:
        """What the sensors say, in order of arrival."""
        waiting = list(self.fixes)
        for row in range(0, len(self.times), 25):
            navigator.add_imu(self.times[row : row + 25], self.samples[row : row + 25])
            while waiting and waiting[0][1].t_seen_ns <= navigator.imu.latest_ns:
                t_ns, fix = waiting.pop(0)
                assert navigator.add(fix, t_ns, seen_ns=fix.t_seen_ns) == "accepted"


def fed(drive: Drive) -> tuple[str | None, list[tuple[str, str]]]:
    """Why a bias of no data sheet is not vouched for at the drive's end, and what was told."""
    told: list[tuple[str, str]] = []
    navigator = Navigator(CONFIG, on_event=lambda code, text: told.append((code, text)))
    drive.feed(navigator)
    navigator.estimator.xi[navigator.model.slots_of("gyro_bias")[2]] = BIAS_RAD_S
    return navigator._units.unproven(navigator.estimator)[0], told


@pytest.mark.parametrize("seed", range(3))
def test_bends_between_fixes_show_that_rates_are_in_rad_s(seed: int) -> None:
    why, told = fed(Drive(LEGS, 1.0, seed))
    assert why is None
    assert "imu_units" not in [code for code, _ in told]


@pytest.mark.parametrize("seed", range(3))
def test_and_that_they_are_in_deg_s(seed: int) -> None:
    why, told = fed(Drive(LEGS, IN_DEGREES, seed))
    assert str(why).startswith("Gyro bias of 0.6 deg/s is 6 sigma of [imu]")
    [text] = [text for code, text in told if code == "imu_units"]
    assert text == reason("rate_path")


def test_straight_on_nobody_can_tell() -> None:
    why, told = fed(Drive(STRAIGHT, 1.0, 3))
    assert str(why).startswith("Gyro bias of 0.6 deg/s is 6 sigma of [imu]")
    assert "imu_units" not in [code for code, _ in told]
