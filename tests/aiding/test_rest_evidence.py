"""Speeds of a span say the same, however often and in whatever order they were asked for."""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fusiond.aiding.initialisation_candidates import SpeedCandidate, VelocityCandidate
from fusiond.aiding.rest_evidence import KEEP_NS, Measured, RestEvidence
from fusiond.simulation.markov import gauss_markov

SECOND_NS = 1_000_000_000


def _measurement(source: str, t_ns: int, v: float, sd: float) -> Any:
    return _of(source, VelocityCandidate(t_ns, (v, -v, 0.0), (sd, sd, sd)))


def _of(source: str, candidate: VelocityCandidate | SpeedCandidate) -> Any:
    return SimpleNamespace(
        source=source, screened=False, locates=False, candidates=lambda: (candidate,)
    )


def _at_once(heard: list[Any], begin_ns: int, end_ns: int) -> Measured:
    rest_evidence = RestEvidence()
    rest_evidence.receive(sorted(heard, key=lambda measurement: measurement.candidates()[0].t_ns))
    return rest_evidence.measured(begin_ns, end_ns)


def test_sums_that_grow_have_the_bits_of_those_made_at_once() -> None:
    """Some speeds come late, and some after so long that the oldest are forgotten."""
    rng = random.Random(1)
    rest_evidence, heard, contradicted = RestEvidence(), [], 0
    t_ns = 0
    for _ in range(120):
        t_ns += rng.choice((1, 1, 1, 2)) * SECOND_NS
        late_ns = rng.choice((0,) * 9 + (5,)) * SECOND_NS
        measurement = _measurement(
            rng.choice("ab"), t_ns - late_ns, rng.gauss(0.1, 0.1), rng.uniform(0.05, 0.2)
        )
        heard.append(measurement)
        rest_evidence.receive([measurement])
        for begin_ns in (0, 20 * SECOND_NS, t_ns - 3 * SECOND_NS):
            for end_ns in (t_ns, t_ns + SECOND_NS, t_ns - SECOND_NS):
                found = rest_evidence.measured(begin_ns, end_ns)
                assert found == _at_once(heard, begin_ns, end_ns)
                contradicted += found.contradicts
    assert contradicted  # and not for nothing
    rest_evidence.receive([_measurement("a", t_ns + 3 * KEEP_NS, 0.0, 0.1)])
    assert rest_evidence.measured(0, t_ns + 4 * KEEP_NS).sd < 0.1


def test_what_was_said_of_spans_holds_until_a_speed_comes_into_one() -> None:
    """A rewind asks for the spans of all windows again; one late speed is in some of them."""
    rng = random.Random(2)
    rest_evidence, heard = RestEvidence(), []
    windows = [(k * SECOND_NS, (k + 1) * SECOND_NS) for k in range(20)]
    for begin_ns, _ in windows:
        for t_ns in (begin_ns + SECOND_NS // 4, begin_ns + 3 * SECOND_NS // 4):
            heard.append(_measurement("a", t_ns, rng.gauss(0.0, 0.1), 0.1))
            rest_evidence.receive(heard[-1:])
        for span in windows:
            assert rest_evidence.measured(*span) == _at_once(heard, *span)
    late = _measurement("b", windows[3][0], 5.0, 0.1)
    before = [rest_evidence.measured(*span) for span in windows]
    rest_evidence.receive([late])
    after = [rest_evidence.measured(*span) for span in windows]
    assert after == [_at_once([*heard, late], *span) for span in windows]
    changed = [k for k in range(len(windows)) if after[k] != before[k]]
    assert changed == [2, 3]


@pytest.mark.parametrize("windows", [1, 10])
def test_wheels_that_drift_as_they_may_are_no_motion(windows: int) -> None:
    """A vehicle at rest whose wheels err by what the filter estimates of them: the mean of a span
    has the sigma that is stated, and refutes rest once in a thousand spans."""
    runs, each, drifts = 2000, 10, (0.1, 1.0)
    rng = np.random.default_rng(windows)
    count = windows * each
    drift = gauss_markov(rng, (count, runs), step_s=0.1, correlation_s=drifts[1], sigma=drifts[0])
    speeds = drift + 0.1 * rng.standard_normal((count, runs))
    refuted, sd = 0, 0.0
    for run in range(runs):
        rest_evidence = RestEvidence()
        for k, v in enumerate(speeds[:, run].tolist()):
            candidate = SpeedCandidate(k * SECOND_NS // each, v, 0.1, 0.0, drifts)
            rest_evidence.receive([_of("wheel", candidate)])
        _, sd, surely = rest_evidence.measured(0, windows * SECOND_NS)
        refuted += surely
    # Chi-square of 2000 variances: 1 +- 3.3 sqrt(2 / 2000); more than 8 of Poisson's 2 once in
    # four thousand.
    assert np.var(speeds.mean(axis=0)) / sd**2 == pytest.approx(1.0, abs=0.105)
    assert refuted <= 8


def test_a_wheel_that_creeps_is_motion_whatever_may_drift() -> None:
    """Ten seconds at 0.3 m/s; one speed alone says no more than its noise and its drift do."""
    rest_evidence = RestEvidence()
    for k in range(100):
        candidate = SpeedCandidate(k * SECOND_NS // 10, 0.3, 0.1, 0.0, (0.1, 1.0))
        rest_evidence.receive([_of("wheel", candidate)])
    assert rest_evidence.measured(0, 10 * SECOND_NS).surely
    _, sd, surely = rest_evidence.measured(0, 0)
    assert not surely
    assert sd == pytest.approx(np.hypot(0.1, 0.1))
