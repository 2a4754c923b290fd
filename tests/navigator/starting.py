"""Drives that starts are tried on, and a navigator that is fed one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import States, Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

Array = NDArray[np.float64]

RATE_HZ, EVERY = 50.0, 10
"""A fix after so many samples."""
SD_M, SD_M_S = 1.5, 0.05
RUNS = 24
HIGH, HIGH_5 = (float(chi2.ppf(0.999, n * RUNS)) / RUNS for n in (3, 5))
"""99.9 % of the mean of as many NEES of three states, and of five."""
TILT_AND_FORCE = [0, 1, 12, 13, 14]
FORWARD, BACKWARD = "GNSS course", "GNSS course, backward"
MOVING, MOVING_BACKWARD = "GNSS course, on the move", "GNSS course, on the move, backward"
LEVER = (3.0, 0.4, -1.0)
BRAKE = (Leg(6), Leg(4, speed_m_s=8.0), Leg(4, speed_m_s=14.0), Leg(8, turn_deg=80.0), Leg(60))


class Case(NamedTuple):
    """A drive, what is heard of it from `from_s` on, and the start that it must lead to."""

    legs: Sequence[Leg]
    how: str
    from_s: float = 0.0
    fixes_from_s: float = 0.0
    lever: tuple[float, float, float] = (0.0, 0.0, -1.0)
    delay_s: float = 0.0
    """How much later than its stamp a velocity is valid."""


TURN_OFF = Leg(8, speed_m_s=9.0, turn_deg=90.0)
RAMP = (Leg(10, turn_deg=300.0), Leg(10, turn_deg=300.0), Leg(10, turn_deg=300.0), Leg(30))
"""Of a multi-storey car park: full turns of 10 m radius, one after another."""
CASES = {
    "straight": Case((Leg(8), Leg(8, speed_m_s=12.0), Leg(30)), FORWARD),
    "in a bend with a long lever": Case((Leg(8), TURN_OFF, Leg(30)), FORWARD, lever=LEVER),
    "backward": Case((Leg(8), Leg(6, speed_m_s=-4.5), Leg(30)), BACKWARD),
    "on a slope": Case(
        (Leg(1, climb_deg=6.0), Leg(8), Leg(8, speed_m_s=10.0), Leg(30)), FORWARD, from_s=2.0
    ),
    "backward up a slope": Case(
        (Leg(1, climb_deg=-6.0), Leg(8), Leg(6, speed_m_s=-4.5), Leg(30)), BACKWARD, from_s=2.0
    ),
    "off into a spiral": Case(
        (Leg(8), Leg(4, speed_m_s=5.0, climb_deg=5.0, turn_deg=90.0), *RAMP), FORWARD, lever=LEVER
    ),
    "in a spiral": Case(
        (Leg(1, climb_deg=5.0), Leg(4, speed_m_s=5.0), Leg(3), *RAMP), MOVING, 9.0, lever=LEVER
    ),
    "down a spiral": Case(
        (Leg(1, climb_deg=-5.0), Leg(4, speed_m_s=5.0), Leg(3), *RAMP), MOVING, 9.0, lever=LEVER
    ),
    "on the move": Case((Leg(1), Leg(6, speed_m_s=14.0), *BRAKE), MOVING, 9.0, lever=LEVER),
    "on the move, velocities late": Case(
        (Leg(1), Leg(6, speed_m_s=14.0), *BRAKE), MOVING, 9.0, lever=LEVER, delay_s=0.12
    ),
    "on the move, backward": Case(
        (Leg(1), Leg(6, speed_m_s=-6.0), Leg(4), Leg(4, speed_m_s=-4.0), Leg(6, turn_deg=-60.0),
         Leg(6, turn_deg=40.0), Leg(40)), MOVING_BACKWARD, 8.0,
    ),
    "quiet all the time, first fixes on the move": Case(
        (Leg(1), Leg(6, speed_m_s=14.0), Leg(20), *BRAKE), MOVING, 9.0, 24.0
    ),
}  # fmt: skip


@lru_cache(maxsize=2)
def truth_of(case: Case, seconds: float = 60.0) -> Truth:
    return Truth(follow(case.legs, seconds, course_deg=40.0), runs.ORIGIN, RATE_HZ, seconds)


@lru_cache(maxsize=2)
def antenna_of(case: Case) -> States:
    """Where the antenna is at each fix, and how fast."""
    truth = truth_of(case)
    return truth.at(truth.t_s[EVERY::EVERY], case.lever)


def fix_of(case: Case, row: int, rng: np.random.Generator) -> PositionFix:
    """What the receiver says at the end of the samples `row` to `row` + `EVERY`."""
    antenna, k = antenna_of(case), row // EVERY
    p, v = antenna.position[k], antenna.v_ned[k]
    if case.delay_s:
        v = truth_of(case).at(antenna.t_s[k : k + 1] + case.delay_s, case.lever).v_ned[0]
    away = SD_M * rng.standard_normal(3) / np.abs(runs.metres_per_unit(float(p[0]), float(p[2])))
    lat, lon, height = (p + away).tolist()
    north, east, down = (v + SD_M_S * rng.standard_normal(3)).tolist()
    t_ns = round(float(antenna.t_s[k]) * 1e9)
    fix = PositionFix("gnss", t_ns, MonotonicStamp(t_ns), lat, lon, height)
    sd: Any = {"sd_ned_m": (SD_M,) * 3, "sd_v_ned_m_s": (SD_M_S,) * 3}
    return replace(fix, v_ned_m_s=(north, east, down), **sd)


def feed(
    navigator: Navigator,
    case: Case,
    samples: Array,
    rows: range,
    rng: np.random.Generator,
    velocities: bool = True,
) -> Iterator[None]:
    """Samples and a fix at a time; the fixes begin at `fixes_from_s`. Yields after each."""
    times = runs.sample_times(truth_of(case))
    for row in rows:
        part = slice(row, row + EVERY)
        navigator.add_imu(times[part], samples[part])
        if times[part][-1] >= case.fixes_from_s * 1e9:
            fix = fix_of(case, row, rng)
            if not velocities:
                fix = replace(fix, v_ned_m_s=None, sd_v_ned_m_s=None)
            navigator.add(fix, fix.t_seen_ns, seen_ns=fix.t_seen_ns)
        navigator.advance()
        yield


SHEET: dict[str, Any] = {"rate_hz": RATE_HZ}


def run_of(case: Case, seed: int, imu: dict[str, Any] = SHEET) -> runs.ImuRun:
    return runs.imu_run(Config.model_validate({"imu": imu}).imu, truth_of(case), seed)


def started(
    case: Case,
    seed: int,
    until_s: float = 60.0,
    imu: dict[str, Any] = SHEET,
    velocities: bool = True,
) -> Navigator:
    """Run until the start, or to `until_s`."""
    config = Config.model_validate(
        {
            "imu": imu,
            "aiding": {"gnss": {"lever_arm_m": case.lever}},
            "alignment": {"heading": ["gnss_course", "positions"]},
        }
    )
    samples = run_of(case, seed, imu).samples
    navigator = Navigator(config)
    rows = range(round(case.from_s * RATE_HZ), round(until_s * RATE_HZ), EVERY)
    for _ in feed(navigator, case, samples, rows, np.random.default_rng(seed), velocities):
        if navigator.started is not None:
            break
    return navigator
