"""Rest as a hypothesis: what refutes it, and what does not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.base import Innovation, State
from fusiond.aiding.body_velocity import WheelSpeedMeasurement
from fusiond.aiding.rest_evidence import SMOOTH_WINDOWS, RestEvidence
from fusiond.aiding.standstill import ZeroAngularRateUpdate
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.models.catalogue import make_model
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs

MODEL = make_model("ins21", imu_noise(Imu()))
DEG = math.pi / 180.0
END_S = 10.0


def _state(speed_m_s: float, sd_m_s: float, sd_bias_deg_s: float = 0.002) -> State:
    sd = runs.initial_sd(MODEL, np.full(3, 0.01), sd_m_s, 1.0)
    for axis in range(3):
        sd[MODEL.parameters(9 + axis)] = sd_bias_deg_s * DEG
    nav = runs.level_nav((0.0, 0.0, 0.0), (speed_m_s, 0.0, 0.0))
    return State(nav, np.zeros(MODEL.size), np.zeros(STEP_SIZE), MODEL, np.diag(sd**2))


def _fixes(speed_m_s: float, count: int, sd_m_s: float = 0.1) -> RestEvidence:
    """`count` fixes in the last second before END_S, whose errors have the stated sigma."""
    rest_evidence, rng = RestEvidence(), np.random.default_rng(3)
    for k in range(count):
        t_ns = round((END_S - 0.9 * k / count) * 1e9)
        north, east = (float(e) for e in sd_m_s * rng.standard_normal(2))
        v = (speed_m_s + north, east, 0.0)
        measurement = VelocityMeasurement(
            "gnss_velocity", t_ns, 0.999, v, (sd_m_s,) * 3, (0.0, 0.0, 0.0)
        )
        rest_evidence.receive([measurement])
    return rest_evidence


def test_nothing_speaks_against_a_vehicle_that_stands() -> None:
    assert runs.rest(rest_evidence=_fixes(0.0, 10)).doubt(_state(0.01, 0.02)) is None


@pytest.mark.parametrize(
    ("speed_m_s", "sd_m_s", "doubt"),
    [(0.6, 5.0, "moving"), (0.2, 0.03, "moving"), (0.2, 0.3, None), (20.0, 0.1, "moving")],
)
def test_the_filter_s_own_velocity_must_be_near_zero_within_its_sigma(
    speed_m_s: float, sd_m_s: float, doubt: str | None
) -> None:
    assert runs.rest().doubt(_state(speed_m_s, sd_m_s)) == doubt


@pytest.mark.parametrize(("speed_m_s", "doubt"), [(0.0, None), (0.2, "moving"), (0.45, "moving")])
def test_fixes_average(speed_m_s: float, doubt: str | None) -> None:
    """A filter that believes to stand cannot see the creeping that five fixes show."""
    assert runs.rest(rest_evidence=_fixes(speed_m_s, 5)).doubt(_state(0.0, 0.01)) == doubt


def test_a_fix_before_the_quiet_windows_says_nothing() -> None:
    rest_evidence = RestEvidence()
    before_ns = round((END_S - 1.5) * 1e9)
    sd = (0.1, 0.1, 0.1)
    measurement = VelocityMeasurement(
        "gnss_velocity", before_ns, 0.999, (5.0, 0.0, 0.0), sd, (0.0, 0.0, 0.0)
    )
    rest_evidence.receive([measurement])
    assert runs.rest(rest_evidence=rest_evidence).doubt(_state(0.0, 0.02)) is None
    assert runs.rest(rest_evidence=rest_evidence, run=2).doubt(_state(0.0, 0.02)) == "moving"


def test_windows_of_half_a_second_look_at_their_own() -> None:
    """What was measured 0.75 s before the end was measured before the window."""
    rest_evidence, sd = RestEvidence(), (0.1, 0.1, 0.1)
    before_ns = round((END_S - 0.75) * 1e9)
    measurement = VelocityMeasurement(
        "gnss_velocity", before_ns, 0.999, (5.0, 0.0, 0.0), sd, (0.0, 0.0, 0.0)
    )
    rest_evidence.receive([measurement])
    rest = replace(runs.rest(rest_evidence=rest_evidence), window_s=0.5)
    assert rest.doubt(_state(0.0, 0.02)) is None
    assert replace(rest, window_s=1.0).doubt(_state(0.0, 0.02)) == "moving"


def test_a_vehicle_that_turns_back_is_not_at_rest() -> None:
    """Three quiet windows of a vehicle that rolls to a stop and on the other way: the mean of what
    was measured in them is nothing, that of the last is not. The filter's own velocity, a second
    after the last fix, says as little."""
    rest_evidence, sd = RestEvidence(), (0.05, 0.05, 0.05)
    for ago_s, north in ((2.9, -0.35), (1.9, -0.05), (0.9, 0.25)):
        t_ns = round((END_S - ago_s) * 1e9)
        v = (north, 0.0, 0.0)
        rest_evidence.receive(
            [VelocityMeasurement("gnss_velocity", t_ns, 0.999, v, sd, (0.0, 0.0, 0.0))]
        )
    span = round((END_S - 3.0) * 1e9), round(END_S * 1e9)
    assert not rest_evidence.measured(*span).contradicts
    assert runs.rest(rest_evidence=rest_evidence, run=3).doubt(_state(0.4, 0.15)) == "moving"


def test_a_wheel_that_turns_is_no_rest() -> None:
    rest_evidence = RestEvidence()
    t_ns = round((END_S - 0.5) * 1e9)
    rest_evidence.receive([WheelSpeedMeasurement("wheel", t_ns, 0.999, 0.4, 0.1, (0.0, 0.0, 0.0))])
    assert runs.rest(rest_evidence=rest_evidence).doubt(_state(0.0, 0.02)) == "moving"


def test_a_turn_is_no_bias() -> None:
    """0.6 deg/s are seen in one window, 0.2 deg/s in ten; what the bias's prior allows is none."""
    sure, unsure = _state(0.0, 0.5), _state(0.0, 0.5, sd_bias_deg_s=0.3)
    fast, slow = (0.0, 0.0, 0.6 * DEG), (0.0, 0.0, 0.2 * DEG)
    assert runs.rest(mean_rate=fast).doubt(sure) == "turning"
    assert runs.rest(mean_rate=slow).doubt(sure) is None
    assert runs.rest(mean_rate=slow, run=10).doubt(sure) == "turning"
    assert runs.rest(mean_rate=fast, run=10).doubt(unsure) is None


def test_a_turn_is_the_gyros_where_the_speed_is_known_to_be_zero() -> None:
    """By the filter or by fixes: nothing on wheels turns on the spot, and the rows of the zero rate
    say that the gyros have changed."""
    mean_rate = (0.0, 0.0, 1.0 * DEG)
    for rest_evidence, sd_m_s in ((RestEvidence(), 0.02), (_fixes(0.0, 10), 0.5)):
        rest = runs.rest(mean_rate=mean_rate, rest_evidence=rest_evidence)
        state = _state(0.0, sd_m_s)
        assert rest.doubt(state) is None
        measurement = ZeroAngularRateUpdate(
            "rate", rest.window.end_ns, 0.9999, mean_rate, 0.1 * DEG, rest
        )
        found = measurement.innovation(state)
        assert isinstance(found, Innovation)
        assert abs(found.z[2]) == pytest.approx(1.0 * DEG, rel=0.01)


def test_what_a_creep_may_turn_is_bounded_by_what_is_known_of_the_speed() -> None:
    """About down alone, by the better of filter and measurements: 5 m are a car's least radius."""
    turns = (0.2 / 5.0) ** 2
    assert runs.rest().creeps(_state(0.0, 0.2)) == pytest.approx([0.0, 0.0, turns], rel=1e-3)
    measured = runs.rest(rest_evidence=_fixes(0.0, 4)).creeps(_state(0.0, 0.2))
    assert measured == pytest.approx([0.0, 0.0, (0.05 / 5.0) ** 2], rel=1e-3)
    measurement = ZeroAngularRateUpdate(
        "zero_rate", round(END_S * 1e9), 0.9999, (0.0,) * 3, 1e-3, runs.rest()
    )
    innovation = measurement.innovation(_state(0.0, 0.2))
    assert isinstance(innovation, Innovation)
    assert innovation.r == pytest.approx([1e-6, 1e-6, 1e-6 + turns], rel=1e-3)


@pytest.mark.parametrize("count", [2, 3, 5, 10])
def test_a_creep_turns_by_no_more_than_its_windows_scatter(count: int) -> None:
    """Rates of first order that last for three seconds: the last one is beyond two sigma of what
    the run says as seldom as of a sigma that is known. What stands scatters by a gyro's noise."""
    rng, rho = np.random.default_rng(5), math.exp(-1.0 / 3.0)
    state, beyond, draws = _state(0.0, 5.0), 0, 2000
    for _ in range(draws):
        rates = np.zeros((count, 3))
        rates[0, 2] = rng.standard_normal()
        for k in range(1, count):
            rates[k, 2] = rho * rates[k - 1, 2] + math.sqrt(1.0 - rho**2) * rng.standard_normal()
        rates *= 0.3 * DEG
        rest = runs.rest(run=count, scatter=rates.var(axis=0, ddof=1))
        beyond += rates[-1, 2] ** 2 > 4.0 * rest.creeps(state)[2]
    assert beyond < 0.0455 * draws
    still = runs.rest(run=count, scatter=np.full(3, (0.01 * DEG) ** 2))
    assert math.sqrt(still.creeps(state)[2]) < 0.3 * DEG / (count - 1)


def test_quiet_proves_nothing_on_a_smooth_ride() -> None:
    """Once quiet windows at speed have been seen, rest takes evidence as good as its claim."""
    rest_evidence = RestEvidence()
    doubtful, sure = _state(0.1, 0.3), _state(0.01, 0.03)
    assert runs.rest(rest_evidence=rest_evidence).doubt(doubtful) is None
    for k in range(SMOOTH_WINDOWS):
        assert (
            runs.rest(rest_evidence=rest_evidence, end_s=5.0 + k).doubt(_state(20.0, 0.3))
            == "moving"
        )
    assert runs.rest(rest_evidence=rest_evidence).doubt(doubtful) == "quiet_at_speed"
    assert runs.rest(rest_evidence=rest_evidence).doubt(sure) is None
    rest_evidence.receive(
        [WheelSpeedMeasurement("wheel", round(END_S * 1e9), 0.9, 0.0, 0.03, (0.0, 0.0, 0.0))]
    )
    assert runs.rest(rest_evidence=rest_evidence).doubt(doubtful) is None


def test_a_rewind_may_take_a_window_at_speed_back() -> None:
    rest_evidence = RestEvidence()
    for k in range(SMOOTH_WINDOWS):
        runs.rest(rest_evidence=rest_evidence, end_s=5.0 + k).doubt(_state(20.0, 0.3))
    assert rest_evidence.smooth_ride(round(END_S * 1e9))
    assert not rest_evidence.smooth_ride(round(5.0 * 1e9))  # what came later is not known yet
    runs.rest(rest_evidence=rest_evidence, end_s=5.0).doubt(_state(0.0, 0.02))
    assert not rest_evidence.smooth_ride(round(END_S * 1e9))
