"""Initial alignment through the navigator: each source of heading, and none."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from drivers.measurements import Heading, Measurement, MonotonicStamp, PositionFix
from fusiond.configuration.alignment import Alignment
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.si_units import DEG
from fusiond.navigation.alignment import gyrocompass, level
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.rotation import dcm_from_rpy, wrap_angle
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_state import SavedState
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import AIRCRAFT_IMU
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

Array = NDArray[np.float64]

RATE_HZ = 50.0
MEMS = Imu(rate_hz=RATE_HZ)
TACTICAL = AIRCRAFT_IMU.model_copy(update={"rate_hz": RATE_HZ})
YAW_DEG = 40.0
START_NS = 100 * runs.SECOND
LAT_DEG, LON_DEG = 30.5, 114.3
POSITION = (LAT_DEG, LON_DEG, 40.0)


def _truth(legs: Iterable[Leg], seconds: float) -> Truth:
    path = follow(legs, seconds, course_deg=YAW_DEG)
    return Truth(path, runs.ORIGIN, RATE_HZ, seconds)


def _parked(seconds: float) -> Truth:
    return _truth([Leg(seconds)], seconds)


def _fixes(truth: Truth, seed: int, first_s: float = 0.5) -> list[Measurement]:
    rng = np.random.default_rng(seed)
    t = np.arange(first_s, truth.duration_s - 0.5, 1.0)
    states = truth.at(t)
    found: list[Measurement] = []
    for t_s, p, v in zip(t, states.position, states.v_ned, strict=True):
        lat, lon, height = (
            float(x) for x in p + rng.standard_normal(3) / runs.metres_per_unit(p[0], p[2])
        )
        n, e, d = (float(x) for x in v + rng.standard_normal(3) * 0.05)
        t_ns = START_NS + round(t_s * 1e9)
        fix = PositionFix("gnss", t_ns, MonotonicStamp(t_ns), lat, lon, height)
        sd: Any = {"sd_ned_m": (1.0, 1.0, 1.0), "sd_v_ned_m_s": (0.05, 0.05, 0.05)}
        found.append(replace(fix, v_ned_m_s=(n, e, d), **sd))
    return found


@dataclass
class Story:
    """What a navigator said while a drive was fed to it."""

    navigator: Navigator
    modes: list[tuple[float, Mode, str]] = field(default_factory=list)

    def before_start(self) -> set[Mode]:
        start = self.navigator.started
        end = math.inf if start is None else (start.t_ns - START_NS) * 1e-9
        return {mode for t, mode, _ in self.modes if t < end}


def _tell(
    truth: Truth,
    imu: Imu,
    measurements: list[Measurement],
    *,
    saved: SavedState | None = None,
    from_s: float = 0.0,
    seed: int = 1,
    stop_at_start: bool = False,
    **alignment: Any,
) -> Story:
    """Feed a navigator half a second at a time."""
    config = Config(imu=imu, alignment=Alignment(**alignment))
    story = Story(Navigator(config, saved))
    navigator = story.navigator
    samples = runs.imu_run(imu, truth, seed).samples
    times = runs.sample_times(truth, START_NS)
    waiting = sorted(measurements, key=lambda m: m.t_seen_ns)
    first = round(from_s * RATE_HZ)
    for row in range(first, len(times), 25):
        rows = slice(row, row + 25)
        navigator.add_imu(times[rows], samples[rows])
        now = int(times[rows][-1])
        while waiting and waiting[0].t_seen_ns <= now:
            m = waiting.pop(0)
            if m.t_seen_ns >= times[first]:
                navigator.add(m, m.t_seen_ns, seen_ns=m.t_seen_ns)
        navigator.advance()
        solution = navigator.solution(now)
        story.modes.append(((now - START_NS) * 1e-9, solution.mode, solution.reason))
        if solution.mode in (Mode.WAITING, Mode.ALIGNING):
            assert navigator.started is None
            assert all(math.isnan(a) for a in solution.rpy_rad)
        if stop_at_start and navigator.started is not None:
            break
    return story


def _start_error(story: Story, truth: Truth) -> tuple[Array, Array]:
    """phi (3,) of the start and its covariance (3, 3)."""
    start = story.navigator.started
    assert start is not None
    true = runs.true_nav(truth, np.array([(start.t_ns - START_NS) * 1e-9]))[0]
    return runs.nav_error(start.nav, true)[:3], start.covariance[:3, :3]


def _assert_started(
    story: Story, truth: Truth, how: str, sigmas: float = 4.0, *, confirmed: bool = True
) -> None:
    start = story.navigator.started
    assert start is not None, story.modes[-1]
    assert start.how == how
    assert story.before_start() <= {Mode.WAITING, Mode.ALIGNING}
    phi, p = _start_error(story, truth)
    assert np.abs(phi / np.sqrt(np.diag(p))).max() < sigmas
    mode, reason = story.modes[-1][1:]
    if confirmed:
        assert (mode, reason) == (Mode.NAVIGATING, f"Heading from {how}")
    else:
        assert (mode, reason) == (
            Mode.COASTING,
            f"Heading from {how}; not confirmed by motion yet",
        )
    end = runs.true_nav(truth, np.array([story.modes[-1][0]]))[0]
    e = story.navigator.estimator
    error, sd = runs.nav_error(e.nav, end), np.sqrt(np.diag(e.covariance)[:9])
    assert (np.abs(error) < sigmas * sd).all(), error / sd


SAVED = SavedState(0.0, tuple(runs.ORIGIN), 2.0, (YAW_DEG + 1.5) * DEG, 2.0 * DEG)  # type: ignore[arg-type]


@pytest.mark.parametrize("confirmed", [True, False])
def test_saved_heading(*, confirmed: bool) -> None:
    """A claim does not become knowledge because the daemon was restarted."""
    truth, saved = _parked(20.0), replace(SAVED, confirmed=confirmed)
    story = _tell(truth, MEMS, _fixes(truth, 2), saved=saved, heading=("saved",))
    _assert_started(story, truth, "saved state", confirmed=confirmed)


def test_saved_position_too_where_no_fix_comes() -> None:
    truth = _parked(8.0)
    story = _tell(truth, MEMS, [], saved=SAVED, heading=("saved",))
    assert story.navigator.started is not None
    sd = np.sqrt(np.diag(story.navigator.started.covariance)[6:8])
    assert sd == pytest.approx([2.0, 2.0], rel=0.1)


def test_configured_heading() -> None:
    truth = _parked(20.0)
    story = _tell(truth, MEMS, _fixes(truth, 3), heading=("config",), heading_deg=YAW_DEG - 4.0)
    _assert_started(story, truth, "configured heading", confirmed=False)


def test_dual_antenna() -> None:
    truth = _parked(20.0)
    headings: list[Measurement] = [
        Heading("compass", t, MonotonicStamp(t), (YAW_DEG + 0.3) * DEG, 0.5 * DEG)
        for t in range(START_NS + runs.SECOND, START_NS + 19 * runs.SECOND, runs.SECOND)
    ]
    story = _tell(truth, MEMS, _fixes(truth, 4) + headings, heading=("dual_antenna",))
    _assert_started(story, truth, "dual antenna")


def test_an_old_heading_is_not_used() -> None:
    """The antenna's last word is ten seconds old when the position comes."""
    truth = _parked(20.0)
    t = START_NS + runs.SECOND
    heading = Heading("compass", t, MonotonicStamp(t), YAW_DEG * DEG, 0.5 * DEG)
    story = _tell(truth, MEMS, [heading, *_fixes(truth, 4, 12.0)], heading=("dual_antenna",))
    assert story.navigator.started is None
    assert "dual_antenna" in story.modes[-1][2]


def test_gyrocompass() -> None:
    truth = _parked(150.0)
    options: dict[str, Any] = {"heading": ("gyrocompass",), "gyrocompass_max_sd_deg": 8.0}
    story = _tell(truth, TACTICAL, _fixes(truth, 5), **options)
    _assert_started(story, truth, "gyrocompass")
    assert story.navigator.started is not None
    assert story.navigator.started.t_ns - START_NS >= 119 * runs.SECOND


def test_a_gyro_that_is_too_poor_never_gyrocompasses() -> None:
    truth = _parked(150.0)
    story = _tell(truth, MEMS, _fixes(truth, 5), heading=("gyrocompass",))
    assert story.navigator.started is None
    mode, reason = story.modes[-1][1:]
    assert mode is Mode.ALIGNING
    assert "cannot gyrocompass: 5 deg take 1.1 deg/h" in reason


FORWARD = [Leg(15), Leg(8, speed_m_s=12.0), Leg(20), Leg(6, turn_deg=60.0)]
BACKWARD = [
    Leg(15),
    Leg(6, speed_m_s=-4.5),
    Leg(6),
    Leg(6, speed_m_s=0.0),
    Leg(8, speed_m_s=12.0),
]


@pytest.mark.parametrize("seed", range(4))
def test_course_forward(seed: int) -> None:
    truth = _truth(FORWARD, 50.0)
    story = _tell(truth, MEMS, _fixes(truth, seed), seed=seed, heading=("gnss_course",))
    _assert_started(story, truth, "GNSS course")


@pytest.mark.parametrize("seed", range(4))
def test_course_backward_out_of_a_parking_lot(seed: int) -> None:
    truth = _truth(BACKWARD, 45.0)
    story = _tell(truth, MEMS, _fixes(truth, seed), seed=seed, heading=("gnss_course",))
    _assert_started(story, truth, "GNSS course, backward")


@pytest.mark.parametrize("seed", range(4))
def test_already_moving(seed: int) -> None:
    truth = _truth([Leg(5), Leg(8, speed_m_s=12.0), Leg(60)], 60.0)
    story = _tell(
        truth, MEMS, _fixes(truth, seed), seed=seed, from_s=20.0, heading=("gnss_course",)
    )
    _assert_started(story, truth, "GNSS course, on the move")


@pytest.mark.parametrize("climb_deg", [4.0, -4.0])
def test_already_moving_on_a_hill_with_a_receiver_that_says_no_vertical_velocity(
    climb_deg: float,
) -> None:
    legs = [Leg(5), Leg(8, speed_m_s=15.0), Leg(4, climb_deg=climb_deg), Leg(60)]
    truth = _truth(legs, 60.0)
    fixes = [
        replace(f, v_ned_m_s=(*f.v_ned_m_s[:2], None))
        for f in _fixes(truth, 3)
        if isinstance(f, PositionFix) and f.v_ned_m_s is not None
    ]
    story = _tell(truth, MEMS, fixes, from_s=20.0, heading=("gnss_course",))
    _assert_started(story, truth, "GNSS course, on the move")
    start = story.navigator.started
    assert start is not None
    true = runs.true_nav(truth, np.array([(start.t_ns - START_NS) * 1e-9]))[0]
    assert abs(start.nav[5] - true[5]) == pytest.approx(15.0 * math.sin(math.radians(4.0)), abs=0.1)
    assert abs(start.nav[5] - true[5]) < 2.0 * math.sqrt(start.covariance[5, 5])


def test_saved_heading_is_void_once_the_vehicle_has_moved() -> None:
    """Pushed or driven before the first fix came: the saved heading says nothing any more."""
    legs = [Leg(0.5), Leg(4, speed_m_s=3.0), Leg(4, turn_deg=70.0), Leg(4, speed_m_s=0.0), Leg(20)]
    truth = _truth(legs, 30.0)
    story = _tell(truth, MEMS, _fixes(truth, 6, 14.0), saved=SAVED, heading=("saved",))
    # The saved position would do, were it not for the motion: `moved` comes before level is known.
    assert story.navigator.started is None
    assert {mode for _, mode, _ in story.modes} == {Mode.ALIGNING}


def test_after_a_ferry_the_saved_heading_is_void() -> None:
    """Parked 5 km away: who moved the vehicle while it was off has turned it, too."""
    truth = _parked(10.0)
    lat, lon, height = runs.ORIGIN
    elsewhere = replace(SAVED, position=(lat + 5000.0 / 6.37e6, lon, height))
    story = _tell(truth, MEMS, _fixes(truth, 2), saved=elsewhere, heading=("saved", "gnss_course"))
    assert story.navigator.started is None
    assert "m from the parking place: moved while off" in story.modes[-1][2]


def test_a_claim_that_is_poor_is_no_start_where_driving_tells_the_heading() -> None:
    """A filter is linear in the heading: with 60 deg it would be sure of what it cannot know."""
    truth = _truth(FORWARD, 40.0)
    claim = {"heading_deg": YAW_DEG + 70.0, "heading_sd_deg": 60.0}
    story = _tell(truth, MEMS, _fixes(truth, 2), heading=("config", "gnss_course"), **claim)
    waiting = [reason for _, mode, reason in story.modes if mode is Mode.ALIGNING]
    assert any("is only known to 60 deg: drive off" in why for why in waiting)
    start = story.navigator.started
    assert start is not None
    assert start.how.startswith("GNSS course")
    error, p = _start_error(story, truth)
    assert error @ np.linalg.solve(p, error) < float(chi2.ppf(0.9999, 3))


def test_never_navigating_without_heading_and_reasons() -> None:
    """Half a minute of driving with everything but an allowed source of heading."""
    truth = _truth(FORWARD, 50.0)
    story = _tell(truth, MEMS, _fixes(truth, 7, 5.5), heading=("dual_antenna",))
    assert story.navigator.started is None
    assert {mode for _, mode, _ in story.modes} == {Mode.ALIGNING}
    reasons = list(dict.fromkeys(reason for _, _, reason in story.modes))
    assert reasons[0] == "Waiting for a first position fix"
    assert reasons[-1] == (
        "No heading: waiting for dual_antenna; no two-antenna heading received; "
        "allowed: dual_antenna"
    )
    navigator = Navigator(Config())
    assert navigator.solution(0).mode is Mode.WAITING
    navigator.advance()
    assert navigator.solution(0).reason == "Waiting for IMU data"
    silent = story.navigator.imu.latest_ns + 10 * runs.SECOND
    assert story.navigator.solution(silent).mode is Mode.WAITING


RUNS = 60


def _bounds(count: int, degrees: int) -> tuple[float, float]:
    """Two-sided 99 % of the mean of `count` chi-square variables."""
    low, high = (float(chi2.ppf(p, count * degrees)) / count for p in (0.005, 0.995))
    return low, high


def test_sigma_of_levelling_is_honest() -> None:
    """Heading from the configuration, off by its sigma; tilt from the accelerometer's bias."""
    truth = _parked(8.0)
    rng = np.random.default_rng(9)
    nees, nees_all = [], []
    for seed in range(RUNS):
        story = _tell(
            truth,
            MEMS,
            [],
            seed=100 + seed,
            stop_at_start=True,
            heading=("config",),
            heading_deg=YAW_DEG + 5.0 * float(rng.standard_normal()),
            heading_sd_deg=5.0,
            position_deg_m=POSITION,
        )
        phi, p = _start_error(story, truth)
        nees.append(phi @ np.linalg.solve(p, phi))
        start = story.navigator.started
        assert start is not None
        run = runs.imu_run(MEMS, truth, 100 + seed)
        row = round((start.t_ns - START_NS) * 1e-9 * RATE_HZ) - 1
        x = np.concatenate([phi, np.concatenate([run.biases[row], run.scales]) - start.xi[9:]])
        keep = np.r_[0:3, 9:21]
        nees_all.append(x @ np.linalg.solve(start.covariance[np.ix_(keep, keep)], x))
    low, high = _bounds(RUNS, 3)
    print(f"levelling: mean NEES of attitude {np.mean(nees):.2f} [{low:.2f}, {high:.2f}]")
    print(f"with biases and scale factors {np.mean(nees_all):.2f} of 15")
    assert low < np.mean(nees) < high
    # The gyro's bias is given room for a vehicle that settles, which this one does not.
    assert np.mean(nees_all) < _bounds(RUNS, 15)[1]
    assert np.mean(nees_all) > 9.0


def test_sigma_of_gyrocompass_is_honest() -> None:
    truth = _parked(124.0)
    z, nees = [], []
    for seed in range(RUNS):
        story = _tell(
            truth,
            TACTICAL,
            [],
            seed=300 + seed,
            stop_at_start=True,
            heading=("gyrocompass",),
            gyrocompass_max_sd_deg=8.0,
            position_deg_m=POSITION,
        )
        phi, p = _start_error(story, truth)
        z.append(phi[2] ** 2 / p[2, 2])
        nees.append(phi @ np.linalg.solve(p, phi))
    low, high = _bounds(RUNS, 1)
    print(f"gyrocompass: mean NEES of heading {np.mean(z):.2f} [{low:.2f}, {high:.2f}]")
    assert low < np.mean(z) < high
    assert np.mean(nees) < _bounds(RUNS, 3)[1]


def test_closed_forms_at_rest() -> None:
    """Level and gyrocompass give back the attitude that made the signals."""
    rng = np.random.default_rng(10)
    lat, _, height = runs.ORIGIN
    g = gravity(lat, height)
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    for _ in range(50):
        rpy = runs.random_attitude(rng)
        dcm = dcm_from_rpy(*rpy)
        roll, pitch = level(dcm.T @ [0.0, 0.0, -g])
        assert (roll, pitch) == pytest.approx(rpy[:2], abs=1e-12)
        yaw = gyrocompass(dcm.T @ earth, roll, pitch)
        assert wrap_angle(yaw - rpy[2]) == pytest.approx(0.0, abs=1e-9)
