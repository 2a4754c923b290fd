"""Cars whose tilt is known by its sum with the force biases alone: the filter stays honest.

Consumer sensors (50 mg, 3 deg/s), a heading known to 3 deg, ten seconds at rest, half a minute
straight on and a bend. What a filter makes of headings that it only thinks has turned tilt and
biases apart (fusiond.estimators.tilt_frame_after_heading_update).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.standstill import ZeroAngularRateUpdate, ZeroVelocityUpdate
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.covariance_propagation import mirror
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.tilt_axes_propagation import TURN_SIZE, rest_axes, rest_rows, turn_at_rest
from fusiond.estimators.tilt_axes_rotation_after_update import turn_rows
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.error_model import CORE_SIZE, DV, FORCE_ERROR, PHI, RATE_ERROR
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion, quaternion_from_rpy
from fusiond.navigation.strapdown import STEP_RESTS_S, STEP_SIZE, strapdown_step
from fusiond.navigator.timeline import Entry, Timeline
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import drive
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error
from tests import runs
from tests.estimators.monte_carlo import interval

Array = NDArray[np.float64]

RATE_HZ, SECONDS, CARS = 50.0, 60, 24
IMU = Imu(sensor_class="consumer", rate_hz=RATE_HZ)
START_SD = np.array([2e-3, 2e-3, math.radians(3.0), 0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
FIX_SD_M, VELOCITY_SD_M_S, SLIP_SD_M_S = 1.0, 0.1, 0.05
REST = (0.0, 0.0, 0.0)
G = 9.79


def _tied(attitude: Array, model: Model) -> Array:
    """T (n, n): the tilt of an attitude (4,) hides the biases, C b - g z x t = 0, and no more."""
    c, t = dcm_from_quaternion(attitude), np.eye(model.size)
    biases = [model.parameters(FORCE_ERROR + axis)[0] for axis in range(3)]
    t[PHI, biases], t[PHI + 1, biases] = c[1] / G, -c[0] / G
    return t


@cache
def _nees(kind: type[KalmanEstimator], number: int) -> tuple[float, float]:
    """NEES (2 degrees each) of tilt and horizontal velocity at the end of one car's drive."""
    rng = np.random.default_rng([700, number])
    noise, truth = imu_noise(IMU), Truth(drive(SECONDS + 1.0, 10.0), runs.ORIGIN, RATE_HZ, SECONDS)
    model = make_model("ins21", noise)
    sd = model.initial.copy()
    sd[:9] = START_SD
    drawn = rng.standard_normal(model.size) * sd
    begin = true_nav(truth, np.array([0.0]))[0]
    turned = with_error(begin, np.array([0.0, 0.0, drawn[PHI + 2], *[0.0] * 6]))
    tied = _tied(turned[6:], model)
    error = tied @ drawn
    biases = [error[model.parameters(column)[0]] for column in range(RATE_ERROR, FORCE_ERROR + 3)]
    white = np.repeat([noise.rate_noise, noise.force_noise], 3) * math.sqrt(RATE_HZ)
    sensed = np.hstack([truth.gyro, truth.accel]) + biases
    sensed += rng.standard_normal(sensed.shape) * white
    imu = ImuBuffer(RATE_HZ, SECONDS + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(runs.sample_times(truth), sensed)
    filter_ = kind(model, 0.5)
    start = with_error(begin, error[:9])
    filter_.initialise(0, 0, start, np.zeros(model.size), tied @ np.diag(sd**2) @ tied.T)
    t_s = np.arange(1.003, SECONDS, 1.0)
    true = truth.at(t_s, REST)
    for k, t_ns in enumerate(np.rint(t_s * 1e9).astype(np.int64).tolist()):
        filter_.propagate(imu, t_ns)
        to_metres = metres_per_unit(float(true.position[k, 0]), float(true.position[k, 2]))
        lat, lon, height = true.position[k] + rng.standard_normal(3) * FIX_SD_M / to_metres
        north, east, down = true.v_ned[k] + rng.standard_normal(3) * VELOCITY_SD_M_S
        sd_v, sd_p = (VELOCITY_SD_M_S,) * 3, (FIX_SD_M,) * 3
        filter_.update(
            NonHolonomicConstraint("slip", t_ns, 1.0, SLIP_SD_M_S, SLIP_SD_M_S, 1.0, REST)
        )
        filter_.update(VelocityMeasurement("velocity", t_ns, 1.0, (north, east, down), sd_v, REST))
        filter_.update(PositionMeasurement("fix", t_ns, 1.0, lat, lon, height, sd_p, REST))
    end_s = SECONDS - 0.5
    filter_.propagate(imu, round(end_s * 1e9))
    left = nav_error(filter_.nav, true_nav(truth, np.array([end_s]))[0])
    tilt, velocity = (slice(first, first + 2) for first in (PHI, DV))
    p = filter_.covariance
    a, b = (float(left[s] @ np.linalg.solve(p[s, s], left[s])) for s in (tilt, velocity))
    return a, b


def test_a_turn_that_was_none_tells_nothing_of_the_biases() -> None:
    total = np.sum([_nees(TiltAxesFilter, number) for number in range(CARS)], axis=0)
    low, high = interval(2 * CARS, 0.99)
    print(
        f"NEES a degree {total / (2 * CARS)}, 99 %: {low / (2 * CARS):.2f}, {high / (2 * CARS):.2f}"
    )
    assert (total >= low).all()
    assert (total <= high).all()


def test_the_plain_filter_takes_it_for_one() -> None:
    """The cars are such that it matters: sigma is many times too small."""
    total = np.sum([_nees(KalmanEstimator, number) for number in range(CARS)], axis=0)
    assert (total > 10.0 * 2 * CARS).all()


@pytest.mark.parametrize("turning", [True, False])
def test_an_unknown_turn_turns_the_axes_of_a_tilt(turning: bool) -> None:
    model = make_model("ins21", imu_noise(IMU))
    samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -G], (10, 1))
    covariances = []
    for kind in (TiltAxesFilter, KalmanEstimator):
        imu = ImuBuffer(RATE_HZ, 2.0, np.eye(3), 0.0, 0.5)
        imu.append(np.arange(1, 11) * round(1e9 / RATE_HZ), samples)
        p = np.diag(model.initial**2)
        p[:3, :3] = np.diag([0.05, 0.02, 0.1]) ** 2 + 4e-4 * np.outer([1, 1, 0], [1, 1, 0])
        if not turning:  # a gyro without noise or error about the vertical
            down = model.parameters(RATE_ERROR + 2)
            p[down], p[:, down] = 0.0, 0.0
        f = kind(model, 0.5)
        nav = runs.level_nav((0.0, 0.0, 0.7), REST)
        f.initialise(0, 0, nav, np.zeros(model.size), p)
        f.propagate(imu, imu.latest_ns)
        covariances.append(f.covariance[:3, :3].copy())
    grown = covariances[0] - covariances[1]
    turn = covariances[1][2, 2] - 0.01
    assert turn > (1e-5 if turning else 0.0)
    north, east, both = covariances[1][0, 0], covariances[1][1, 1], covariances[1][0, 1]
    expected = turn * np.array([[east, -both], [-both, north]])
    assert grown[:2, :2] == pytest.approx(expected, rel=0.2)
    assert grown[2] == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_tilt_turns_what_the_biases_make_downward() -> None:
    """Var((C b)_D) grows by those of the tilt that gyros pretend, times the biases' across."""
    model = make_model("ins21", imu_noise(IMU))
    samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -G], (10, 1))
    across = [model.parameters(FORCE_ERROR + axis)[0] for axis in range(2)]
    vertical = model.parameters(FORCE_ERROR + 2)[0]
    found = []
    for kind in (TiltAxesFilter, KalmanEstimator):
        imu = ImuBuffer(RATE_HZ, 2.0, np.eye(3), 0.0, 0.5)
        imu.append(np.arange(1, 11) * round(1e9 / RATE_HZ), samples)
        p = np.diag(model.initial**2)
        p[:3, :3] = np.diag([0.01, 0.02, 0.001]) ** 2
        p[across, across] = 0.3**2, 0.6**2
        filter_ = kind(model, 0.5)
        nav = np.array([*runs.ORIGIN, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        filter_.initialise(0, 0, nav, np.zeros(model.size), p)
        filter_.propagate(imu, round(10e9 / RATE_HZ))
        found.append(filter_.covariance.copy())
    tilts, plain = found
    grown = np.diag(plain)[:2] - np.array([0.01, 0.02]) ** 2
    more = grown[0] * plain[across[1], across[1]] + grown[1] * plain[across[0], across[0]]
    assert more > 1e-6
    assert tilts[vertical, vertical] - plain[vertical, vertical] == pytest.approx(more, rel=0.02)


def _apart(f: TiltAxesFilter) -> Array:
    """P (2, 2) of the tilt, given what tilt and force biases make of the acceleration."""
    sensed, c = np.zeros((2, f.model.size)), dcm_from_quaternion(f.nav[6:])
    sensed[:, :2] = G * np.array([[0.0, 1.0], [-1.0, 0.0]])
    sensed[:, [f.model.parameters(FORCE_ERROR + axis)[0] for axis in range(3)]] = c[:2]
    both = f.covariance @ sensed.T
    apart: Array = f.covariance - both @ np.linalg.solve(sensed @ both + 1e-12 * np.eye(2), both.T)
    return apart[:2, :2]


@pytest.mark.parametrize("turns", [False, True])
def test_a_parked_vehicle_is_told_nothing_of_its_tilt(turns: bool) -> None:
    """What tilt and force biases are apart stays as unknown as it was, however long it is looked
    at: taken for noise, what moves C^ told a fifth of it in five minutes."""
    seconds, noise = 300, imu_noise(IMU)
    rng, model = np.random.default_rng(701), make_model("ins21", noise)
    nav = runs.level_nav((0.03, -0.02, 0.7), REST)
    c, (lat, _, height) = dcm_from_quaternion(nav[6:]), runs.ORIGIN
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    still = np.hstack([c.T @ earth, c.T @ [0.0, 0.0, -gravity(lat, height)]])
    white = np.repeat([noise.rate_noise, noise.force_noise], 3) * math.sqrt(RATE_HZ)
    samples = still + rng.standard_normal((round(RATE_HZ * seconds), 6)) * white
    imu = ImuBuffer(RATE_HZ, seconds + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(np.rint(np.arange(1, len(samples) + 1) / RATE_HZ * 1e9).astype(np.int64), samples)
    p = np.diag(model.initial**2)
    p[:9, :9] = np.diag([0.01, 0.01, 0.03, 0.1, 0.1, 0.1, 1.0, 1.0, 1.0]) ** 2
    loose = (PHI, math.radians(3.0)), (RATE_ERROR, math.radians(1.0)), (FORCE_ERROR, 0.5)
    for first, sd in loose:
        slots = [model.parameters(k)[0] if k > 8 else k for k in range(first, first + 3)]
        p[slots, slots] += sd**2
    filter_ = InvariantFilter(model, 0.5, settles=False)
    filter_.initialise(0, 0, nav, np.zeros(model.size), p)
    filter_.turns = turns
    sigmas = []

    def look(entry: Entry) -> None:
        assert entry.outcome is not None
        assert entry.outcome.name == "fused"
        sigmas.append(np.degrees(np.sqrt(np.linalg.eigvalsh(_apart(filter_)))))

    timeline = Timeline(filter_, imu, 15.0, 0.5, look)
    timeline.start()
    for t_s in range(1, seconds):
        rest = runs.rest(mean_rate=(still[0], still[1], still[2]), end_s=t_s)
        t_ns, gyros = t_s * runs.SECOND, (still[0], still[1], still[2])
        timeline.insert(ZeroAngularRateUpdate("rate", t_ns, 0.9999, gyros, math.radians(0.1), rest))
        timeline.insert(ZeroVelocityUpdate("velocity", t_ns, 0.9999, 0.05, rest))
    timeline.advance()
    print(sigmas[59], sigmas[-1])
    assert (sigmas[59] > 2.0).all()
    assert (sigmas[-1] > 0.9 * sigmas[59]).all()


def test_a_turn_at_rest_is_that_of_an_update() -> None:
    """Of P, whose P21 is made afterwards, of a transition and of an estimate that is carried."""
    model, rng = make_model("ins21", imu_noise(IMU)), np.random.default_rng(702)
    n, width, terms = model.size, model.width, model.sensor_terms
    before = np.array(quaternion_from_rpy(0.1, -0.2, 0.7))
    after = np.array(quaternion_from_rpy(0.13, -0.17, 0.75))
    turn = np.empty(TURN_SIZE)
    turn_at_rest(*before.tolist(), after, turn)
    slots = np.array([model.parameters(FORCE_ERROR + axis)[0] for axis in (2, 0, 1)])
    t = np.eye(n)
    turn_rows(t, before, after, slots, np.array([2, 0, 1]))
    half = rng.standard_normal((n, n))
    p, phi, dx = half @ half.T, rng.standard_normal((n, n)), rng.standard_normal(n)
    flat = np.zeros((width, width))
    flat[:n, :n] = p
    flat[CORE_SIZE:, :CORE_SIZE] = np.nan
    rest_axes(flat.ravel(), width, n, turn, *terms)
    mirror(flat.ravel(), width, n)
    assert flat[:n, :n] == pytest.approx(t @ p @ t.T, abs=1e-12)
    moved, carried = phi.copy(), dx.copy()
    rest_rows(moved.ravel(), n, n, turn, *terms)
    rest_rows(carried, 1, 1, turn, *terms)
    assert moved == pytest.approx(t @ phi, abs=1e-12)
    assert carried == pytest.approx(t @ dx, abs=1e-12)


@pytest.mark.parametrize(("force", "rests_s"), [(0.05, 0.9), (0.2, 0.0)])
def test_a_vehicle_that_pulls_away_rests_no_more(force: float, rests_s: float) -> None:
    nav, step, none = runs.level_nav(REST, REST), np.zeros(STEP_SIZE), np.zeros(3)
    step[STEP_RESTS_S] = 1.0
    for _ in range(10):
        strapdown_step(nav, none, np.array([force, 0.0, -G]), none, none, 0.01, False, step)
    assert step[STEP_RESTS_S] == pytest.approx(rests_s)


def test_rest_that_is_refused_ends_at_once() -> None:
    model = make_model("ins21", imu_noise(IMU))
    imu, n = ImuBuffer(RATE_HZ, 4.0, np.eye(3), 0.0, 0.5), round(2 * RATE_HZ)
    samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -G], (n, 1))
    imu.append(np.arange(1, n + 1) * round(1e9 / RATE_HZ), samples)
    filter_ = TiltAxesFilter(model, 0.5)
    p = np.diag(model.initial**2)
    p[:9, :9] = 0.01 * np.eye(9)
    filter_.initialise(0, 0, runs.level_nav(REST, REST), np.zeros(model.size), p)
    left = []
    timeline = Timeline(
        filter_, imu, 15.0, 0.5, lambda _: left.append(filter_.step.item(STEP_RESTS_S))
    )
    timeline.start()
    for t_s, most_m_s in ((1, 0.5), (2, -1.0)):
        rest = runs.rest(max_speed_m_s=most_m_s, end_s=t_s)
        timeline.insert(ZeroVelocityUpdate("rest", t_s * runs.SECOND, 0.9999, 0.05, rest))
    timeline.advance()
    assert left == [1.5, 0.0]
