"""A vehicle with a GNSS receiver and a wheel sensor, and how its data reach a navigator."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import Measurement, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs

Array = NDArray[np.float64]

RATE_HZ, SECONDS = 50.0, 44.0
START_NS = 7_003 * runs.SECOND
STARTED_S = 8.0  # by then the filter runs; what follows comes in any way
CONFIG: dict[str, Any] = {
    "imu": {"rate_hz": RATE_HZ},
    "alignment": {
        "heading": ["config"],
        "heading_deg": 41.0,
        "heading_sd_deg": 2.0,
        "position_deg_m": [30.5, 114.3, 40.0],
        "position_sd_m": 5.0,
    },
    "constraints": {"non_holonomic": {"enabled": True, "interval_s": 0.2}},
    "estimator": {"buffer_s": 12.0},
}


@dataclass(frozen=True)
class Drive:
    """Stamps (n,), samples (n, 6) and measurements of a drive that starts and ends at rest."""

    truth: Truth
    times: NDArray[np.int64]
    samples: Array
    measurements: list[Measurement]


@lru_cache(maxsize=1)
def drive() -> Drive:
    legs = [
        Leg(10),
        Leg(6, speed_m_s=10.0),
        Leg(6, turn_deg=60.0),
        Leg(6, turn_deg=-90.0),
        Leg(6, speed_m_s=0.0),
        Leg(10),
    ]
    truth = Truth(follow(legs, SECONDS, course_deg=40.0), runs.ORIGIN, RATE_HZ, SECONDS)
    config = Config.model_validate(CONFIG)
    rng = np.random.default_rng(20)
    found: list[Measurement] = []
    t = np.arange(9.013, SECONDS - 1.0, 1.0)
    states = truth.at(t)
    for t_s, p, v in zip(t, states.position, states.v_ned, strict=True):
        lat, lon, up = (
            float(x) for x in p + rng.standard_normal(3) / runs.metres_per_unit(p[0], p[2])
        )
        n, e, d = (float(x) for x in v + rng.standard_normal(3) * 0.1)
        at = START_NS + round(t_s * 1e9)
        stamp = MonotonicStamp(at)
        fix = PositionFix("gnss", at, stamp, lat, lon, up, sd_ned_m=(1.0, 1.0, 1.0))
        speed = math.hypot(*v[:2])
        found.append(replace(fix, v_ned_m_s=(n, e, d)))
        found.append(WheelSpeed("wheel", at, stamp, speed + 0.05 * float(rng.standard_normal())))
    return Drive(
        truth,
        runs.sample_times(truth, START_NS),
        runs.imu_run(config.imu, truth, 21).samples,
        found,
    )


def started(settings: dict[str, Any] = CONFIG, **callbacks: Any) -> tuple[Navigator, int]:
    """A navigator after the first seconds, always fed alike, and the row that comes next."""
    d = drive()
    navigator = Navigator(Config.model_validate(settings), **callbacks)
    row = round(STARTED_S * RATE_HZ)
    for first in range(0, row, 10):
        navigator.add_imu(d.times[first : first + 10], d.samples[first : first + 10])
        navigator.advance()
    assert navigator.started is not None
    return navigator, row


def feed(navigator: Navigator, row: int, chunks: list[int], delays: list[float]) -> None:
    """Chunks in turn, over and over; measurement i arrives `delays[i]` s after it was true."""
    d = drive()
    arrivals = sorted(
        (m.t_seen_ns + round(s * 1e9), i)
        for i, (m, s) in enumerate(zip(d.measurements, delays, strict=True))
    )
    turn = 0
    while row < len(d.times):
        rows = slice(row, row + chunks[turn % len(chunks)])
        navigator.add_imu(d.times[rows], d.samples[rows])
        row, turn = rows.stop, turn + 1
        now = int(d.times[min(row, len(d.times)) - 1])
        while arrivals and (arrivals[0][0] <= now or row >= len(d.times)):
            m = d.measurements[arrivals.pop(0)[1]]
            assert navigator.add(m, m.t_seen_ns) == "accepted"
        navigator.advance()


def state_bytes(navigator: Navigator) -> tuple[bytes, ...]:
    """All of a filter's state: equal for equal results, to the bit."""
    e = navigator.estimator
    return e.nav.tobytes(), e.xi.tobytes(), e.covariance.tobytes(), e.step.tobytes()


def outcomes_of(navigator: Navigator) -> dict[str, Counter[str]]:
    """How many measurements of each source ended in which way."""
    return {k: +v for k, v in navigator.timeline.counters.outcomes.items() if +v}
