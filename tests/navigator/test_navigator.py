"""The navigator: whatever the chunks and delays, one result; bad input named, counted, survived."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import (
    Attitude,
    DelayedFix,
    Height,
    Measurement,
    MonotonicStamp,
    PositionFix,
    TimeReport,
)
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.timeline import Entry
from tests import runs
from tests.navigator.vehicle import (
    CONFIG,
    RATE_HZ,
    SECONDS,
    START_NS,
    STARTED_S,
    drive,
    feed,
    outcomes_of,
    started,
    state_bytes,
)


@lru_cache(maxsize=1)
def _in_order() -> Navigator:
    navigator, row = started()
    feed(navigator, row, [1], [0.0] * len(drive().measurements))
    return navigator


def test_the_drive_is_navigated() -> None:
    navigator = _in_order()
    true = runs.true_nav(drive().truth, np.array([SECONDS]))[0]
    error = runs.nav_error(navigator.estimator.nav, true)
    sd = np.sqrt(np.diag(navigator.estimator.covariance)[:9])
    assert (np.abs(error) < 4.0 * sd).all()
    outcomes = outcomes_of(navigator)
    assert outcomes["zero_velocity"]["fused"] >= 8
    assert outcomes["zero_rate"]["fused"] >= 8
    assert outcomes["non_holonomic"]["fused"] > 60
    assert outcomes["non_holonomic"]["too_slow"] > 30
    assert outcomes["gnss"]["fused"] == outcomes["wheel"]["fused"] == 34
    assert outcomes["gnss_velocity"]["fused"] == 34


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    st.lists(st.integers(1, 120), min_size=1, max_size=6),
    st.lists(st.sampled_from([0.0, 0.1, 1.5, 5.0, 8.0]), min_size=68, max_size=68),
)
def test_chunks_and_delays_leave_no_trace(chunks: list[int], delays: list[float]) -> None:
    """Standstill windows and the no-slip constraint come of the samples: they too are the same."""
    navigator, row = started()
    feed(navigator, row, chunks, delays)
    assert state_bytes(navigator) == state_bytes(_in_order())
    assert outcomes_of(navigator) == outcomes_of(_in_order())


def test_outcomes_are_heard_and_each_measurement_ends_in_one() -> None:
    last: dict[Any, Entry] = {}

    def receive(entry: Entry) -> None:
        last[id(entry)] = entry

    navigator, row = started(on_outcome=receive)
    feed(navigator, row, [33], [3.0] * 68)
    heard = Counter(
        (e.measurement.source, e.outcome.name) for e in last.values() if e.outcome is not None
    )
    counted = {(s, n): c for s, names in outcomes_of(navigator).items() for n, c in names.items()}
    assert {k: c for k, c in heard.items() if k in counted} == counted


def test_refusals_are_named_and_counted() -> None:
    navigator, _ = started()
    now = navigator.imu.latest_ns
    stamp = MonotonicStamp(now)
    lat, lon, up = runs.ORIGIN
    fix = PositionFix("gnss", now, stamp, lat, lon, up, sd_ned_m=(1.0, 1.0, 1.0))
    rdss = DelayedFix("rdss", now, stamp, lat, lon, up, 20.0, multi_value=True)
    cases: list[tuple[Measurement, int, str]] = [
        (fix, now + 250_000_000, "from_future"),
        (replace(fix, lat_rad=math.nan), now, "not_finite"),
        (replace(fix, sd_ned_m=(1.0, 0.0, 1.0)), now, "no_sigma"),
        (rdss, now, "multi_value"),
        (replace(rdss, multi_value=False, precision_class_m=0.0), now, "no_sigma"),
        (Attitude("star", now, stamp, (0.0, 0.0, 0.0), (0.1, 0.1, 0.0)), now, "no_sigma"),
        (TimeReport("gnss", now, 0, True), now, "not_a_measurement"),
    ]
    expected: dict[str, Counter[str]] = {}
    for m, t_ns, name in cases:
        assert navigator.add(m, t_ns, seen_ns=now) == name
        expected.setdefault(m.source, Counter())[name] += 1
    assert navigator.add(fix, now, sd_time_s=1.0, seen_ns=now) == "time_unknown"
    expected["gnss"]["time_unknown"] += 1
    assert navigator.outcome_watch.refused == expected
    before = state_bytes(navigator)
    navigator.advance()
    assert state_bytes(navigator) == before
    assert navigator.add(fix, now + 150_000_000, seen_ns=now) == "accepted"
    old = now - 40 * runs.SECOND
    assert navigator.add(Height("baro", now, MonotonicStamp(old), 40.0), old) == "accepted"
    assert outcomes_of(navigator)["baro"] == {"too_old": 1}


def test_bad_samples_leave_no_trace() -> None:
    """NaN, absurd values, repeated and backward stamps between the good ones."""
    d = drive()
    navigator, row = started()
    rng = np.random.default_rng(5)
    for first in range(row, len(d.times), 20):
        times, samples = d.times[first : first + 20], d.samples[first : first + 20]
        bad = samples[:3].copy()
        bad[0, rng.integers(6)] = math.nan
        bad[1, rng.integers(3)] = 1e6
        at = np.array([times[0] - 1_000, times[0] - 900, times[0] - 20_000_000])
        order = [0, 1, 2] if first else [2]
        navigator.add_imu(
            np.concatenate([at[order[:2]], times, times[-1:], at[2:]]),
            np.concatenate([bad[order[:2]], samples, samples[-1:], bad[2:]]),
        )
        now = int(times[-1])
        for m in d.measurements:
            if times[0] <= m.t_seen_ns + 20_000_000 <= now:
                navigator.add(m, m.t_seen_ns)
        navigator.advance()
    chunks = math.ceil((len(d.times) - row) / 20)
    assert +navigator.imu.counters == {
        "not_finite": chunks,
        "out_of_range": chunks,
        "duplicate_stamp": chunks,
        "backward_stamp": chunks,
    }
    assert navigator.estimator.t_ns == d.times[-1]
    true = runs.true_nav(d.truth, np.array([SECONDS]))[0]
    sd = np.sqrt(np.diag(navigator.estimator.covariance)[:9])
    assert (np.abs(runs.nav_error(navigator.estimator.nav, true)) < 4.0 * sd).all()


@pytest.mark.parametrize("gap_s", [1.0, 2.0])
def test_a_gap_is_invalid_while_it_lasts_and_honest_after(gap_s: float) -> None:
    d = drive()
    navigator, row = started()
    stop = round(18.0 * RATE_HZ)
    _feed_until(navigator, row, stop)
    before = navigator.estimator.sigmas()
    silent = int(d.times[stop - 1]) + 2 * runs.SECOND
    solution = navigator.solution(silent)
    assert solution.mode is Mode.INVALID
    assert solution.reason == "IMU silent for 2.0 s"
    _feed_until(navigator, stop + round(gap_s * RATE_HZ), len(d.times))
    assert navigator.imu.counters["gap"] == 1
    assert navigator.started is not None
    true = runs.true_nav(d.truth, np.array([SECONDS]))[0]
    sd = np.sqrt(np.diag(navigator.estimator.covariance)[:9])
    assert (np.abs(runs.nav_error(navigator.estimator.nav, true)) < 4.0 * sd).all()
    assert before[0] < 1.5


@pytest.mark.parametrize("gap_s", [2.5, 3.0, 4.0])
def test_a_gap_that_a_bend_makes_unbearable_ends_navigation(gap_s: float) -> None:
    """The vehicle turns by 15 deg/s meanwhile: no sigma of a linear filter is honest after it."""
    d = drive()
    events: list[str] = []
    navigator, row = started(on_event=lambda code, text: events.append(code))
    stop = round(18.0 * RATE_HZ)
    _feed_until(navigator, row, stop)
    _feed_until(navigator, stop + round(gap_s * RATE_HZ), len(d.times))
    assert "imu_gap" in events
    assert navigator.started is None
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.ALIGNING


def _feed_until(navigator: Navigator, row: int, stop: int) -> None:
    d = drive()
    for first in range(row, stop, 25):
        rows = slice(first, min(first + 25, stop))
        navigator.add_imu(d.times[rows], d.samples[rows])
        for m in d.measurements:
            if d.times[rows][0] - 20_000_000 < m.t_seen_ns <= d.times[rows][-1]:
                navigator.add(m, m.t_seen_ns)
        navigator.advance()


def test_a_long_silence_aligns_anew() -> None:
    d = drive()
    events: list[tuple[str, str]] = []
    navigator, row = started(on_event=lambda code, text: events.append((code, text)))
    late = d.times + 100 * runs.SECOND
    navigator.add_imu(late[row : row + 10], d.samples[row : row + 10])
    navigator.advance()
    assert navigator.started is None
    assert [code for code, _ in events] == ["aligned", "imu_gap"]
    assert navigator.solution(int(late[row + 9])).mode is Mode.ALIGNING
    parked = d.times[: round(8 * RATE_HZ)] + 101 * runs.SECOND + int(d.times[row] - d.times[0])
    for first in range(0, len(parked), 10):
        navigator.add_imu(parked[first : first + 10], d.samples[first : first + 10])
        navigator.advance()
    assert navigator.started is not None
    assert navigator.solution(int(parked[-1])).mode is Mode.COASTING  # heading as configured


def test_a_stamp_far_ahead_does_not_silence_the_imu() -> None:
    """Two samples an hour ahead: what follows is backward, until that is plain; then anew."""
    d = drive()
    events: list[str] = []
    navigator, row = started(on_event=lambda code, text: events.append(code))
    hour = 3600 * runs.SECOND
    navigator.add_imu(d.times[row : row + 2] + hour, d.samples[row : row + 2])
    navigator.advance()
    parked = d.times[:400] + int(d.times[row] - d.times[0]) + 40_000_000
    for first in range(0, len(parked), 10):
        navigator.add_imu(parked[first : first + 10], d.samples[first : first + 10])
        navigator.advance()
    assert events == ["aligned", "imu_gap", "imu_time", "imu_sound", "aligned"]
    # Half a second of samples, by chunks of ten, is what it took to believe them.
    assert navigator.imu.counters["backward_stamp"] == 30
    assert navigator.estimator.t_ns == parked[-1]
    assert navigator.started is not None
    assert navigator.solution(int(parked[-1])).mode is Mode.COASTING  # heading as configured


def test_coasting_and_invalid() -> None:
    d = drive()
    settings_ = {**CONFIG, "estimator": {"coast_after_s": 5.0, "invalid_sd_m": 20.0}}
    settings_["constraints"] = {"zero_velocity": {"enabled": False}}
    settings_["alignment"] = {**CONFIG["alignment"], "heading": ["saved"]}
    lat, lon, height = runs.ORIGIN
    saved = SavedState(0.0, (lat, lon, height), 5.0, math.radians(41.0), math.radians(2.0))
    navigator = Navigator(Config.model_validate(settings_), saved)
    seen: list[Mode] = []
    for row in range(0, len(d.times), 10):
        navigator.add_imu(d.times[row : row + 10], d.samples[row : row + 10])
        navigator.advance()
        seen.append(navigator.solution(navigator.imu.latest_ns).mode)
    order = [m for i, m in enumerate(seen) if i == 0 or seen[i - 1] is not m]
    assert order == [Mode.ALIGNING, Mode.NAVIGATING, Mode.COASTING, Mode.INVALID]


@pytest.mark.parametrize("started", [False, True])
def test_everything_at_once(started: bool) -> None:
    """Two minutes of samples in one call, as after a suspended process: nothing is read twice."""
    d = drive()
    count = 6000
    step = int(d.times[1] - d.times[0])
    config = {**CONFIG, "imu": {"rate_hz": 10.0}}  # a small buffer
    navigator = Navigator(Config.model_validate(config))
    begin = 0
    if started:
        begin = round(STARTED_S * RATE_HZ)
        navigator.add_imu(d.times[:begin], d.samples[:begin])
        navigator.advance()
        assert navigator.started is not None
    times = int(d.times[0]) + step * np.arange(begin, begin + count)
    samples = np.tile(d.samples[:400], (count // 400, 1))
    assert navigator.add_imu(times, samples) == count
    navigator.advance()
    assert navigator.started is not None
    assert navigator.estimator.t_ns == times[-1]
    assert navigator.estimator.sigmas()[3:5].max() < 0.5
    assert np.abs(navigator.estimator.nav[3:6]).max() < 0.5
    assert len(navigator.imu.times) < 4 * count


def test_the_solution_is_carried_ahead_of_the_last_sample() -> None:
    d = drive()
    navigator, row = started()
    _feed_until(navigator, row, round(20.0 * RATE_HZ))
    now = navigator.imu.latest_ns
    later = navigator.solution(now + 60_000_000)
    t_s = (now - START_NS) * 1e-9
    moved = d.truth.at(np.array([t_s, t_s + 0.06])).position
    base = navigator.solution(now)
    expected = (moved[1] - moved[0]) * runs.metres_per_unit(*moved[0, [0, 2]])
    scale = runs.metres_per_unit(*moved[0, [0, 2]])
    found = (
        np.array([later.lat_rad, later.lon_rad, later.height_m])
        - [base.lat_rad, base.lon_rad, base.height_m]
    ) * scale
    assert found == pytest.approx(expected, abs=0.03)  # 0.3 m/s of velocity error over 0.06 s
    assert np.linalg.norm(expected) > 0.5
    assert navigator.solution(now).t_ns == now
    assert navigator.estimator.t_ns == now  # reading changes nothing


def test_a_long_wait_for_alignment_does_not_grow() -> None:
    """No heading for ten minutes: constraints and fixes come on and on."""
    config = {**CONFIG, "alignment": {"heading": ["dual_antenna"]}}
    navigator = Navigator(Config.model_validate(config))
    d = drive()
    step = int(d.times[1] - d.times[0])
    for k in range(600):
        times = START_NS + step * np.arange(1 + 50 * k, 51 + 50 * k)
        navigator.add_imu(times, d.samples[:50])
        m = replace(d.measurements[0], t_seen_ns=int(times[-1]))
        navigator.add(m, int(times[-1]))
        navigator.advance()
    assert navigator.started is None
    assert navigator.timeline.waiting <= 4096
    total = sum(c.total() for c in navigator.timeline.counters.outcomes.values())
    # A fix and a velocity, five instants of the constraint (and the very first), two of standstill.
    assert total + navigator.timeline.waiting == 600 * (2 + 5 + 2) + 1


def test_a_height_that_we_gave_does_not_come_back_as_a_measurement() -> None:
    navigator, _ = started()
    now = navigator.imu.latest_ns
    lat, lon, up = runs.ORIGIN
    fix = DelayedFix("rdss", now, MonotonicStamp(now), lat, lon, up, 20.0)
    assert navigator.add(replace(fix, height_given=True), now, seen_ns=now) == "accepted"
    navigator.advance()
    assert set(outcomes_of(navigator)) & {"rdss", "rdss_height"} == {"rdss"}
    later = now - 1_000_000
    assert navigator.add(fix, later, seen_ns=now) == "accepted"
    navigator.advance()
    assert set(outcomes_of(navigator)) & {"rdss", "rdss_height"} == {"rdss", "rdss_height"}
