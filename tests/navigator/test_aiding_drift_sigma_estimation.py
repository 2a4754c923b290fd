"""How much of a typed drift a vehicle has, as the filter's own estimates of it show."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.measurements import MagneticHeading, MonotonicStamp, WheelSpeed
from fusiond.aiding.body_velocity import WheelSpeedMeasurement
from fusiond.aiding.compass import CompassMeasurement
from fusiond.configuration.aiding import CompassAiding, WheelAiding
from fusiond.configuration.schema import Config
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import SIDE_DRIFT, WHEEL_DRIFT
from fusiond.navigator.aiding_drift_sigma_estimation import FIRST, DriftLevels
from fusiond.navigator.assembly import model_of
from fusiond.navigator.imu_vibration_noise_share import COUNTS_NS, EVERY_NS
from fusiond.navigator.intake import Intake
from fusiond.navigator.motion_constraints import vehicle_blocks
from tests import runs

CONFIG = Config.model_validate(
    {
        "imu": {"sensor_class": "mems"},
        "aiding": {"gnss": {}, "wheel": {}, "compass": {"declination_deg": 0.0}},
        "constraints": {"non_holonomic": {"enabled": True}},
    }
)
SLIP = CONFIG.constraints.non_holonomic
AIDING = {"wheel": WheelAiding(), "compass": CompassAiding(declination_deg=0.0)}


def _model() -> Model:
    return model_of(CONFIG, *vehicle_blocks(SLIP), *Intake(CONFIG.aiding).extra_blocks())


def _levels(
    share: float, seed: int, noise: float = 1.0, speed_m_s: float = 10.0, instants: int = 180
) -> tuple[DriftLevels, int]:
    """After so many instants at that speed, the side drift being `share` of what is typed and
    measured with a noise that is `noise` of it; and when."""
    model, rng = _model(), np.random.default_rng(seed)
    levels, e, s = DriftLevels(model), KalmanEstimator(model, 1.0), SLIP.drift_sd_m_s
    (slot,) = model.slots_of(SIDE_DRIFT)
    t_ns = 0
    for k in range(1, instants + 1):
        t_ns = k * EVERY_NS
        c = levels.counts(SIDE_DRIFT, t_ns)
        # z = c x + v, of a state x of typed sigma s.
        z = share * s * rng.standard_normal() + noise * s * rng.standard_normal()
        total = (c * s) ** 2 + (noise * s) ** 2
        xi, p = np.zeros(model.size), np.diag(np.square(model.initial))
        xi[slot], p[slot, slot] = c * s * s / total * z, s * s * (1.0 - (c * s) ** 2 / total)
        nav = runs.level_nav((0.0, 0.0, 0.0), (speed_m_s, 0.0, 0.0))
        e.initialise(t_ns, 0, nav, xi, p)
        levels.look(e)
    return levels, t_ns + COUNTS_NS


@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_a_drift_counts_as_much_as_there_is_and_no_more_than_is_typed(share: float) -> None:
    """Of 20 vehicles each, half an hour: variances are right to a third in the mean, with what
    counts at first: some instants of which all is there."""
    found, expected = [], []
    for seed in range(20):
        levels, t_ns = _levels(share, seed)
        found.append(levels.counts(SIDE_DRIFT, t_ns))
        n = levels.shown[SIDE_DRIFT][0]
        expected.append((n * share**2 + FIRST) / (n + FIRST))
    ratio = np.mean(np.square(found)) / np.mean(expected)
    print(share, round(ratio, 3), np.round(sorted(found), 2))
    assert max(found) <= 1.0
    assert 0.67 < ratio < 1.5


def test_what_is_hardly_measured_counts_little_and_a_vehicle_at_rest_shows_nothing() -> None:
    hardly, t_ns = _levels(0.2, 1, noise=10.0, instants=20)
    assert hardly.counts(SIDE_DRIFT, t_ns) > 0.98
    resting, t_ns = _levels(0.2, 1, speed_m_s=1.0)
    assert resting.counts(SIDE_DRIFT, t_ns) == 1.0
    assert DriftLevels(_model()).counts("gyro_bias", t_ns) == 1.0


def test_it_counts_once_nothing_comes_any_more_that_is_earlier() -> None:
    levels, t_ns = _levels(0.2, 3, instants=1)
    assert levels.counts(SIDE_DRIFT, t_ns - 1) == 1.0
    assert levels.counts(SIDE_DRIFT, t_ns) < 1.0


def test_the_next_start_begins_with_what_was_shown() -> None:
    levels, t_ns = _levels(0.2, 4)
    after = DriftLevels(_model())
    after.take_up({**levels.shown, "wheel_drift_of_another": (1.0,)})
    assert after.counts(SIDE_DRIFT, 0) == pytest.approx(levels.counts(SIDE_DRIFT, t_ns))
    assert after.counts(WHEEL_DRIFT, 0) == 1.0
    fifth = {name: tuple(0.2 * x for x in each) for name, each in levels.shown.items()}
    faded = DriftLevels(_model())
    faded.take_up(fifth)
    assert levels.counts(SIDE_DRIFT, t_ns) < faded.counts(SIDE_DRIFT, 0) < 1.0
    assert levels.shown[SIDE_DRIFT][0] > FIRST


def test_wheel_and_compass_count_their_drifts() -> None:
    """As the door makes them; one without levels counts all."""
    intake = Intake(AIDING)
    stamp = MonotonicStamp(5)
    wheel = WheelSpeed("wheel", 5, stamp, 10.0)
    compass = MagneticHeading("compass", 5, stamp, 1.0)

    def made() -> tuple[WheelSpeedMeasurement, CompassMeasurement]:
        (one,), (other,) = (
            intake.measurements_of(wheel, 5, 0.0),
            intake.measurements_of(compass, 5, 0.0),
        )
        assert isinstance(one, WheelSpeedMeasurement)
        assert isinstance(other, CompassMeasurement)
        return one, other

    speed, heading = made()
    assert (speed.drift_counts, heading.disturbed) == (1.0, 1.0)
    levels = DriftLevels(_model())
    low = (50.0, 0.0, *(-1e3,) * 12)
    levels.take_up({WHEEL_DRIFT: low, "compass_disturbance": low})
    intake.count_drifts(levels)
    speed, heading = made()
    least = math.sqrt((50.0 / 64.0 + FIRST) / (50.0 + FIRST))
    assert speed.drift_counts == pytest.approx(least)
    assert heading.disturbed == pytest.approx(least)
    assert speed.candidates()[0].drifts == pytest.approx((0.1 * least, 1.0))
    assert heading.candidates()[0].shared[1][1] == pytest.approx((least,))
