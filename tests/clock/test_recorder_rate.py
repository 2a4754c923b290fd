"""Rates of a recorder's clock by reports of UTC: found where they are, and nowhere else."""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
import pytest

from fusiond.clock.recorder_clock import RecorderClock, Slew
from fusiond.clock.recorder_rate import slews

S, MS = 1_000_000_000, 1_000_000
BEGIN = 1_760_000_000 * S
DRIFT_PPM = 100.0


def reports(
    ahead_s: Callable[[float], float],
    seconds: int = 120,
    rate_hz: int = 1,
    jitter_s: float = 0.02,
    utc_step_s: float = 0.0,
) -> list[tuple[int, int]]:
    """Of a receiver 50 ms late with jitter; `ahead_s` what the recorder's clock has gained."""
    draw, found = random.Random(7), []
    for k in range(seconds * rate_hz):
        t_s = k / rate_hz
        told_s = t_s if not utc_step_s else t_s // utc_step_s * utc_step_s
        came_s = t_s + 0.05 + jitter_s * draw.random()
        stamp = BEGIN + round((came_s + ahead_s(came_s)) * S)
        found.append((stamp, BEGIN + round(told_s * S)))
    return found


def ramp(rate: float, begin_s: float, end_s: float) -> Callable[[float], float]:
    return lambda t_s: rate * min(max(0.0, t_s - begin_s), end_s - begin_s)


@pytest.mark.parametrize("rate", [0.1, -0.1, 0.0833, -0.02, 0.3, -0.3, 0.01])
@pytest.mark.parametrize("rate_hz", [1, 10])
def test_a_slew_is_found_where_it_is(rate: float, rate_hz: int) -> None:
    found = slews(reports(ramp(rate, 30.0, 90.0), rate_hz=rate_hz), DRIFT_PPM)
    slew = max(found, key=lambda each: each.end_ns - each.begin_ns)
    assert slew.rate == pytest.approx(rate, abs=2e-3)
    # Where two lines meet is known to a report's jitter by the difference of their rates.
    off_s = 0.3 + 0.04 / abs(rate)
    assert (slew.begin_ns - BEGIN) / S == pytest.approx(30.0, abs=off_s)
    end_s = 90.0 + 60.0 * rate
    assert (slew.end_ns - BEGIN) / S == pytest.approx(end_s, abs=off_s)
    spans = [(each.end_ns - each.begin_ns) / S * each.rate / (1.0 + each.rate) for each in found]
    assert sum(spans) == pytest.approx(60.0 * rate, abs=0.03)


def test_a_bad_oscillator_is_off_all_the_time() -> None:
    (slew,) = slews(reports(lambda t_s: 0.005 * t_s), DRIFT_PPM)
    assert slew.rate == pytest.approx(0.005, abs=3e-4)
    # Before and behind the reports, too, for as long as it was seen.
    assert slew.begin_ns < BEGIN - 100 * S < BEGIN + 230 * S < slew.end_ns


def test_reports_of_whole_seconds() -> None:
    told = reports(ramp(0.1, 30.0, 90.0), rate_hz=10, utc_step_s=1.0)
    (slew,) = slews(told, DRIFT_PPM)
    assert slew.rate == pytest.approx(0.1, abs=5e-3)


@pytest.mark.parametrize(
    "ahead_s",
    [
        lambda t_s: 0.0,
        lambda t_s: 1e-4 * t_s,
        lambda t_s: 5.0 * (t_s > 60.0),  # the receiver's own UTC has jumped
        lambda t_s: 0.15 * (40.0 < t_s < 50.0),  # a line that was busy
        lambda t_s: max(0.0, 1.0 - (t_s - 60.0) / 5.0) * (t_s > 60.0),  # a queue that is drained
        lambda t_s: (t_s - 60.0) / 5.0 * (60.0 < t_s < 66.0),  # one that is thrown away
    ],
)
def test_no_slew_where_there_is_none(ahead_s: Callable[[float], float]) -> None:
    assert slews(reports(ahead_s), DRIFT_PPM) == ()


def test_too_few_reports() -> None:
    assert slews(reports(ramp(0.1, 0.0, 9.0), seconds=5), DRIFT_PPM) == ()
    assert slews([], DRIFT_PPM) == ()


@pytest.mark.parametrize("seed", range(20))
def test_any_reports_at_all(seed: int) -> None:
    draw = random.Random(seed)
    told = [(BEGIN + draw.randrange(300 * S), BEGIN + draw.randrange(300 * S)) for _ in range(200)]
    for slew in slews(told, DRIFT_PPM):
        assert slew.begin_ns <= slew.end_ns
        assert abs(slew.rate) <= 0.5


def test_time_passes_by_the_stamps_less_what_they_gain() -> None:
    clock = RecorderClock((Slew(BEGIN + 10 * S, BEGIN + 21 * S, 0.1),))
    clock.take(BEGIN, (0, 9), [], lambda: None)
    for k in range(1, 3001):
        clock.next(BEGIN + k * 10 * MS, (0, 9))
    assert clock.slewed_ns == pytest.approx(1 * S, abs=3001)
    assert clock.t_ns + clock.ahead_ns == BEGIN + 30 * S


def test_many_reports_take_no_longer_than_their_number() -> None:
    """An hour at 10 Hz with a change each minute."""
    told = reports(lambda t_s: 0.05 * abs((t_s / 60.0) % 2.0 - 1.0) * 60.0, 3600, 10)
    found = slews(told, DRIFT_PPM)
    assert len(found) >= 55
    assert np.mean([abs(slew.rate) for slew in found]) == pytest.approx(0.05, abs=3e-3)
