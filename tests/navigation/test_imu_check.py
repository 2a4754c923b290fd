"""What cannot be a measurement is named; what real sensors say, coarse ones too, is believed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusiond.navigation.imu_check import OUTCOMES, Checked, ImuCheck
from tests.places import DATA

Array = NDArray[np.float64]

RATE_HZ = 100
STEP = 10_000_000
HOLD_NS = 35_000_000
FULL_RATE, FULL_FORCE = 35.0, 100.0
UP = [0.0, 0.0, 0.0, 0.0, 0.0, -9.8]


@dataclass(frozen=True)
class Sensor:
    """Its noise and its steps, of rate (rad/s) and force (m/s^2)."""

    noise: tuple[float, float]
    step: tuple[float, float]

    def samples(self, seconds: float, seed: int = 1) -> tuple[NDArray[np.int64], Array]:
        """A slow swing of all axes, noise, steps."""
        rng = np.random.default_rng(seed)
        count = round(seconds * RATE_HZ)
        t = np.arange(1, count + 1) / RATE_HZ
        swing = np.sin(0.7 * t[:, None] + np.arange(6)) * np.repeat([0.1, 0.5], 3)
        noise = rng.standard_normal((count, 6)) * np.repeat(self.noise, 3)
        step = np.repeat(self.step, 3)
        return STEP * np.arange(1, count + 1), np.rint((UP + swing + noise) / step) * step


FINE = Sensor((3e-3, 0.05), (1.2e-4, 9.8e-3))
COARSE = Sensor((1e-3, 0.03), (4.4e-3, 0.125))


def _feed(check: ImuCheck, times: NDArray[np.int64], samples: Array, chunk: int = 10) -> Checked:
    got = [
        check.feed(times[i : i + chunk], samples[i : i + chunk], HOLD_NS)
        for i in range(0, len(times), chunk)
    ]
    return Checked(*(np.concatenate(c) for c in zip(*got, strict=True)))


def _names(checked: Checked) -> dict[str, int]:
    return dict(Counter(OUTCOMES[c] for c in checked.codes if c))


def _check(full: bool = False) -> ImuCheck:
    limits = (FULL_RATE, FULL_FORCE) if full else (np.inf, np.inf)
    return ImuCheck(RATE_HZ, *limits)


@pytest.mark.parametrize("sensor", [FINE, COARSE])
def test_a_sound_sensor_is_believed(sensor: Sensor) -> None:
    times, samples = sensor.samples(60.0)
    assert _names(_feed(_check(full=True), times, samples)) == {}


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("factor", [5.0, -40.0])
def test_one_sample_that_nothing_can_follow(axis: int, factor: float) -> None:
    times, samples = FINE.samples(10.0)
    samples[700, axis] += factor * (1.0 if axis < 3 else 9.8)
    checked = _feed(_check(), times, samples)
    assert np.flatnonzero(checked.codes).tolist() == [700]
    assert _names(checked) == {"spike": 1}


@pytest.mark.parametrize("axis", range(6))
def test_a_leap_that_the_next_sample_takes_back_is_smaller_than_a_shock(axis: int) -> None:
    leap = 0.3 if axis < 3 else 4.0
    times, samples = FINE.samples(10.0)
    samples[700, axis] += leap
    checked = _feed(_check(), times, samples)
    assert np.flatnonzero(checked.codes).tolist() == [700]
    assert _names(checked) == {"spike": 1}
    samples[700:710, axis] += leap  # what lasts is a shock
    assert _names(_feed(_check(), times, samples)) == {}


def test_full_scale() -> None:
    times, samples = FINE.samples(10.0)
    samples[700:800, 1] = -FULL_RATE
    samples[800:850, 5] = FULL_FORCE
    assert _names(_feed(_check(full=True), times, samples)) == {"saturated": 150}


def test_full_scale_of_an_unknown_range_never_gets_in() -> None:
    times, samples = FINE.samples(10.0)
    samples[700:800] = [FULL_RATE] * 3 + [FULL_FORCE] * 3
    checked = _feed(_check(), times, samples)
    assert np.flatnonzero(checked.codes).tolist() == list(range(700, 800))


def test_full_scale_of_one_axis_is_not_believed_by_patience() -> None:
    times, samples = FINE.samples(20.0)
    samples[700:1200, 2] = 5.0
    checked = _feed(_check(), times, samples)
    assert np.flatnonzero(checked.codes).tolist() == list(range(700, 1200))
    assert _names(checked).keys() == {"spike", "axis_dead"}


@pytest.mark.parametrize(("sensor", "soon"), [(FINE, 15), (COARSE, 60)])
def test_stuck(sensor: Sensor, soon: int) -> None:
    times, samples = sensor.samples(30.0)
    samples[1000:2000] = samples[1000]
    checked = _feed(_check(), times, samples)
    refused = np.flatnonzero(checked.codes == OUTCOMES.index("repeated"))
    assert 1000 < refused[0] <= 1000 + soon
    assert refused.tolist() == list(range(int(refused[0]), 2000))
    assert _names(checked) == {"repeated": len(refused)}


def test_a_sensor_that_always_repeats_is_not_stuck() -> None:
    """Nothing is known of it that would speak against it."""
    times = STEP * np.arange(1, 6001)
    assert _names(_feed(_check(), times, np.tile(UP, (6000, 1)))) == {}


def test_what_never_repeats_is_remembered_in_normal_numbers() -> None:
    # After five minutes at 1 kHz, and no other than after one.
    for count in (20_000, 350_000):
        rng = np.random.default_rng(5)
        times = 1_000_000 * np.arange(1, count + 41, dtype=np.int64)
        samples = UP + 0.01 * rng.standard_normal((count + 40, 6))
        samples[count:] = samples[count]
        check = ImuCheck(1000.0, np.inf, np.inf)
        codes = _feed(check, times, samples, chunk=5000).codes
        assert np.flatnonzero(codes).tolist() == list(range(count + 10, count + 40))
        memory = check._memory[np.isfinite(check._memory)]
        assert (np.abs(memory[memory != 0.0]) >= np.finfo(np.float64).tiny).all()


def test_quiet_rest_is_learned() -> None:
    """A coarse sensor that shows rest by one step less: refused once at most, then known."""
    times, samples = COARSE.samples(90.0)
    for first in (2000, 4000, 6000):
        samples[first : first + 100] = samples[first - 1]
        samples[first + 100 :] += samples[first + 99] - samples[first + 100]
        samples[first + 100 :, 2] += COARSE.step[0]
    checked = _feed(_check(), times, samples)
    assert not checked.codes[4000:].any()


@pytest.mark.parametrize("axis", [0, 2, 4])
@pytest.mark.parametrize("value", [None, 0.0])
def test_a_dead_axis(axis: int, value: float | None) -> None:
    times, samples = FINE.samples(30.0)
    samples[1000:2000, axis] = samples[1000, axis] if value is None else value
    checked = _feed(_check(), times, samples)
    dead = np.flatnonzero(checked.codes == OUTCOMES.index("axis_dead"))
    assert 1090 <= dead[0] <= 1110
    assert dead.tolist() == list(range(int(dead[0]), 2000))
    assert _names(checked) == {"axis_dead": len(dead)}


def test_no_gravity() -> None:
    times, samples = FINE.samples(30.0)
    samples[1000:1500, 3:] = 0.0
    samples[2000:2008, 3:] *= 0.1  # a wheel has left the ground: 0.08 s
    samples[2500:, 3:] /= 9.80665
    checked = _feed(_check(), times, samples)
    assert checked.codes[:1000].max() == 0
    assert _names(checked).keys() == {"no_gravity"}
    refused = np.flatnonzero(checked.codes)
    assert refused[:500].tolist() == list(range(1000, 1500))
    assert 2500 < refused[500] <= 2512
    assert refused[-1] == len(times) - 1


def test_one_stamp_ahead() -> None:
    times, samples = FINE.samples(10.0)
    stamps = times.copy()
    stamps[500] += 700_000_000
    checked = _feed(_check(), stamps, samples, chunk=1)
    assert np.flatnonzero(checked.codes).tolist() == [500]
    assert _names(checked) == {"stamp_ahead": 1}


def test_a_true_pause_is_told_by_the_sample_after_it() -> None:
    times, samples = FINE.samples(10.0)
    times[500:] += 3_000_000_000
    check = _check()
    _feed(check, times[:500], samples[:500])
    assert len(check.feed(times[500:501], samples[500:501], HOLD_NS).times) == 0
    then = check.feed(times[501:502], samples[501:502], HOLD_NS)
    assert then.times.tolist() == times[500:502].tolist()
    assert not then.codes.any()


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 700), min_size=1, max_size=10))
def test_chunks_leave_no_trace(chunks: list[int]) -> None:
    times, samples = FINE.samples(12.0)
    samples[300, 2] = 99.0
    samples[500:600] = samples[500]
    times[700:] += 2_000_000_000
    times[800] += 900_000_000
    samples[850:, 0] = 0.0
    whole = _check().feed(times, samples, HOLD_NS)
    found: list[Checked] = []
    check, row = _check(), 0
    while row < len(times):
        size = chunks[len(found) % len(chunks)]
        found.append(check.feed(times[row : row + size], samples[row : row + size], HOLD_NS))
        row += size
    assert np.array_equal(np.concatenate([f.codes for f in found]), whole.codes)
    assert np.array_equal(np.concatenate([f.times for f in found]), whole.times)
    assert {"spike", "repeated", "stamp_ahead", "axis_dead"} == _names(whole).keys()


@pytest.mark.parametrize(
    ("file", "rate_hz", "bad"),
    [
        ("drive_0708/imu.csv", 100.0, {}),
        ("walk_0827/imu.csv", 167.0, {}),
        ("comma2k19_40/imu.csv", 104.0, {}),
        # Three samples in 40 minutes say -64 m/s^2 on all axes and no rate: the sensor's own sign
        # of an error.
        ("css_164/imu.csv.gz", 100.0, {"spike": 3}),
    ],
)
def test_real_drives_lose_nothing(file: str, rate_hz: float, bad: dict[str, int]) -> None:
    path = DATA / file
    if not path.is_file():
        pytest.skip(f"real drive is absent: {path} (set FUSIOND_DATA)")
    t_s, *columns = np.loadtxt(path, delimiter=",", skiprows=1).T
    times = np.rint(t_s * 1e9).astype(np.int64)
    samples = np.column_stack(columns)
    checked = ImuCheck(rate_hz, np.inf, np.inf).feed(times, samples, HOLD_NS)
    assert _names(checked) == bad
