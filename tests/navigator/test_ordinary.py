"""Aids that are taken in by one call end as they do step by step, to the bit."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.measurements import Measurement, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.schema import Config
from fusiond.estimators.base import Estimator
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.update import Plain
from fusiond.integrity.isolation import Isolation
from fusiond.models.model import Model
from fusiond.navigator.filters import estimator_of
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.timeline import Entry
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs
from tests.navigator.vehicle import CONFIG, RATE_HZ, START_NS, outcomes_of, state_bytes

SECONDS, FIRST_S = 96.0, 8.013
KINDS = "gnss", "gnss_velocity", "wheel", "non_holonomic"
LEGS = [
    Leg(10),
    Leg(6, speed_m_s=12.0),
    Leg(8, turn_deg=60.0),
    Leg(8, turn_deg=-90.0),
    Leg(30, speed_m_s=15.0),
    Leg(10, turn_deg=80.0),
    Leg(8, speed_m_s=0.0),
    Leg(16),
]
SETTINGS: dict[str, Any] = {
    **CONFIG,
    "aiding": {"gnss": {}, "other": {"kind": "gnss"}, "wheel": {}},
}


class StepByStep(InvariantFilter):
    """The same filter, of which no kernel knows how it updates."""

    def plain(self) -> Plain | None:
        return None


def _measurements(truth: Truth, seed: int) -> list[tuple[float, Measurement]]:
    """When each arrives (s), in that order: a receiver that is wrong in most ways, a wheel that
    rounds, and of odd seeds knows no direction, and another receiver's fixes two seconds late."""
    rng = np.random.default_rng(seed)
    found: list[tuple[float, Measurement]] = []
    t = np.arange(FIRST_S, SECONDS - 1.0, 0.2)
    states = truth.at(t)
    frozen: tuple[float, ...] = ()
    for k, (t_s, p, v) in enumerate(zip(t.tolist(), states.position, states.v_ned, strict=True)):
        at = START_NS + round(t_s * 1e9)
        north, east, down = rng.standard_normal(3).tolist()
        if 22.0 < t_s < 25.0:
            north += 60.0
        if t_s > 60.0:
            east += 0.8 * (t_s - 60.0)
        lat, lon, up = (p + np.array([north, east, down]) / runs.metres(p[0], p[2])).tolist()
        n, e, d = (v + rng.standard_normal(3) * (5.0 if round(10 * t_s) == 190 else 0.1)).tolist()
        if 50.0 < t_s < 52.0:
            frozen = lat, lon, up, n, e, d = frozen or (lat, lon, up, n, e, d)
        stamp, delay_s = MonotonicStamp(at), float(rng.uniform(0.0, 0.5))
        fix = PositionFix("gnss", at, stamp, lat, lon, up, sd_ned_m=(1.0, 1.0, 1.0))
        fix = replace(fix, v_ned_m_s=(n, e, d), sd_v_ned_m_s=(0.1, 0.1, 0.1))
        if not 30.0 < t_s < 44.0:
            found.append((t_s + delay_s, fix))
        speed = round(math.hypot(*v[:2]) + 0.03 * float(rng.standard_normal()), 1)
        wheel = WheelSpeed("wheel", at, stamp, speed, signed=seed % 2 == 0)
        found.append((t_s + 0.05, wheel))
        if k % 15 == 0:
            lat, lon, up = (p + rng.standard_normal(3) * 2.0 / runs.metres(p[0], p[2])).tolist()
            late = PositionFix("other", at, stamp, lat, lon, up, sd_ned_m=(2.0, 2.0, 3.0))
            found.append((t_s + 2.1, late))
    return sorted(found, key=lambda each: each[0])


def _drive(
    make: Any, seed: int, raw: bool
) -> tuple[list[tuple[Any, ...]], list[tuple[str, str]], Navigator, Counter[str]]:
    """Every outcome and state of a drive, all events, and the navigator after it."""
    truth = Truth(follow(LEGS, SECONDS, course_deg=40.0), runs.ORIGIN, RATE_HZ, SECONDS)
    config = Config.model_validate(SETTINGS)
    times = runs.sample_times(truth, START_NS)
    samples = runs.imu_run(config.imu, truth, seed).samples
    found: list[tuple[Any, ...]] = []
    events: list[tuple[str, str]] = []

    def heard(entry: Entry) -> None:
        found.append((entry.key, entry.outcome, entry.assumed, entry.error, entry.raw))

    navigator = Navigator(config, None, lambda *event: events.append(event), heard, estimator=make)
    navigator.timeline.keeps_raw = raw
    arrivals, wrong = _measurements(truth, seed), Counter[str]()
    for first in range(0, len(times), 7):
        rows = slice(first, first + 7)
        navigator.add_imu(times[rows], samples[rows])
        now_s = (int(times[rows][-1]) - START_NS) * 1e-9
        while arrivals and arrivals[0][0] <= now_s:
            _, m = arrivals.pop(0)
            navigator.add(m, m.t_seen_ns)
        navigator.advance()
        isolation = navigator.timeline.isolation
        wrong.update(isolation.excluded.values())
        kept = isolation.snapshot()
        records = {name: record.copied() for name, record in kept.records.items()}
        opened = {name: wider.tobytes() for name, wider in kept.wider.items()}
        found.append((state_bytes(navigator), kept.doubts, records, kept.tilting, opened))
        if first % 490 == 0:
            found.append((repr(navigator.solution(int(times[first]) - 1_300_000_000)),))
    return found, events, navigator, wrong


def _stepwise(config: Config, model: Model) -> Estimator:
    return StepByStep(model, config.imu.gap_s)


@pytest.mark.parametrize(("seed", "raw"), [(3, False), (4, True)])
def test_one_call_is_all_steps(seed: int, raw: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a drive with a jump, an outlier, an outage, a receiver that hangs and one that drifts,
    fixes that come late, and rewinds on the way."""
    taken: Counter[str] = Counter()
    take = Isolation.take

    def counted(self: Isolation, aid: Any, *others: Any) -> Any:
        found = take(self, aid, *others)
        taken[aid.source] += found is not None
        return found

    monkeypatch.setattr(Isolation, "take", counted)
    at_once = _drive(estimator_of, seed, raw)
    assert all(taken[source] > 150 for source in KINDS)
    before = taken.copy()
    stepwise = _drive(_stepwise, seed, raw)
    assert taken == before
    for one, other in zip(at_once[0], stepwise[0], strict=True):
        assert one == other
    assert at_once[1] == stepwise[1]
    a, b = at_once[2], stepwise[2]
    assert outcomes_of(a) == outcomes_of(b)
    assert a.timeline.counters.rewinds == b.timeline.counters.rewinds > 100
    assert repr(a.verdicts.reports()) == repr(b.verdicts.reports())
    assert {"jumped", "repeats itself"} <= set(at_once[3])
