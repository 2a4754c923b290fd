"""Counters of devices on the host's clock: jitter, restarts, wraps, and counts that are wrong."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import DeviceStamp
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions
from tests.clock.host_time import MS, Host, S


@given(
    jitter=st.lists(st.integers(0, 16 * MS), min_size=60, max_size=300),
    drift_ppm=st.integers(-80, 80),
    start=st.integers(0, 2**40),
)
@settings(max_examples=60)
def test_device_clock_under_jitter(jitter: list[int], drift_ppm: int, start: int) -> None:
    """Causal, in order, never further from the truth than the smallest delay so far and drift."""
    clock = Clock(ClockOptions(), Host())
    period = 5 * MS
    last, seen = 0, 0
    least, error = 16 * MS, 16 * MS
    for i, delay in enumerate(jitter):
        true = 1000 * S + i * period
        ticks = start + i * period + i * period * drift_ppm // 1_000_000
        seen = max(seen, true + delay)  # a line keeps its order
        t = clock.resolve(DeviceStamp("imu", ticks), "imu", seen).t_valid_ns
        assert last < t <= seen + i
        least = min(least, seen - true)
        # What is in order cannot improve faster than a period a sample; 180 ppm of relative
        # drift over at most 1.5 s is 0.27 ms.
        error = max(least, error - period)
        assert -300_000 <= t - true <= error + 300_000
        last = t
    assert clock.counters["device_clock_restarted"] == 0


def test_device_spacing_follows_the_device_not_the_arrivals() -> None:
    clock = Clock(ClockOptions(), Host())
    period, spacing, last = 5 * MS, [], None
    for i in range(2000):
        delay = 200_000 + (i * 7919 % 97) * 100_000  # 0.2 to 9.8 ms, its least once in 97
        t = clock.resolve(
            DeviceStamp("imu", i * period), "imu", 100 * S + i * period + delay
        ).t_valid_ns
        if last is not None and i > 200:
            spacing.append(t - last)
        last = t
    assert max(abs(s - period) for s in spacing) <= 50_000  # 100 ppm of 97 samples, at most


@pytest.mark.parametrize("ticks_after", [0, 3_600 * S])
def test_device_restart_is_counted_and_learnt_again(ticks_after: int) -> None:
    clock = Clock(ClockOptions(), Host())
    t = 0
    for i in range(100):
        t = clock.resolve(
            DeviceStamp("imu", 600 * S + i * 10 * MS), "imu", 100 * S + i * 10 * MS + MS
        ).t_valid_ns
    for i in range(100):
        seen = 102 * S + i * 10 * MS + MS
        after = clock.resolve(DeviceStamp("imu", ticks_after + i * 10 * MS), "imu", seen).t_valid_ns
        assert t < after <= seen
        assert seen - after < 100_000
        t = after
    assert clock.counters["device_clock_restarted"] == 1


def test_late_burst_of_a_device_keeps_its_true_instants() -> None:
    clock = Clock(ClockOptions(), Host())
    for i in range(200):
        clock.resolve(DeviceStamp("imu", i * 10 * MS), "imu", 100 * S + i * 10 * MS)
    stalled = 100 * S + 400 * 10 * MS  # the host read nothing for 2 s, then all at once
    for i in range(200, 400):
        t = clock.resolve(DeviceStamp("imu", i * 10 * MS), "imu", stalled).t_valid_ns
        assert abs(t - (100 * S + i * 10 * MS)) < MS
    assert clock.counters["device_clock_restarted"] == 0


@pytest.mark.parametrize("glitch", [100, 300, 700, 900, 5_000, -100, -700, -900, -5_000])
def test_one_wrong_device_count_is_stamped_like_its_neighbours(glitch: int) -> None:
    clock = Clock(ClockOptions(), Host())
    last = 0
    for i in range(3000):
        delay = (i * 37 % 13) * MS
        ticks = i * 10 * MS + (glitch * MS if i == 500 else 0)
        t = clock.resolve(DeviceStamp("imu", ticks), "imu", 100 * S + i * 10 * MS + delay)
        assert t.t_valid_ns > last
        assert abs(t.t_valid_ns - (100 * S + i * 10 * MS)) <= 13 * MS
        last = t.t_valid_ns
    assert clock.counters["device_tick_odd"] == 1
    assert clock.counters["device_clock_restarted"] == 0


def test_samples_of_a_busy_host_keep_their_instants_for_two_minutes() -> None:
    clock = Clock(ClockOptions(), Host())
    for i in range(6000):
        late = 800 * MS if 1000 <= i < 4000 else 0
        t = clock.resolve(DeviceStamp("imu", i * 10 * MS), "imu", 100 * S + i * 10 * MS + late)
        assert abs(t.t_valid_ns - (100 * S + i * 10 * MS)) <= 4 * MS  # 100 ppm of 30 s
    assert clock.counters["device_clock_relearned"] == 0


def test_a_device_clock_that_stood_still_is_learnt_after_two_minutes() -> None:
    clock = Clock(ClockOptions(), Host())
    error = 0
    for i in range(15000):
        if 1000 <= i <= 1030:
            continue
        stood = 300 * MS if i > 1030 else 0
        seen = 100 * S + i * 10 * MS
        error = seen - clock.resolve(DeviceStamp("imu", i * 10 * MS - stood), "imu", seen)[0]
    assert error == 0
    assert clock.counters["device_clock_relearned"] == 1


def test_a_counter_wrap_that_the_driver_missed_is_a_restart() -> None:
    clock = Clock(ClockOptions(), Host())
    start = 2**32 * 1000 - 5 * S  # a 32-bit count of microseconds
    for i in range(1000):
        seen = 100 * S + i * 10 * MS
        ticks = (start + i * 10 * MS) % (2**32 * 1000)
        assert clock.resolve(DeviceStamp("imu", ticks), "imu", seen)[0] == seen
    assert clock.counters["device_clock_restarted"] == 1


def test_device_out_of_order_on_the_line() -> None:
    clock = Clock(ClockOptions(), Host())
    ticks = [0, 10, 30, 20, 40]
    seen = 100 * S
    out = [clock.resolve(DeviceStamp("d", t * MS), "d", seen + 50 * MS).t_valid_ns for t in ticks]
    out = [
        clock.resolve(DeviceStamp("d", 1000 * MS + t * MS), "d", seen + S + 50 * MS).t_valid_ns
        for t in ticks
    ]
    assert sorted(out) == [out[0], out[1], out[3], out[2], out[4]]
    same = [clock.resolve(DeviceStamp("d", 2 * S), "d", seen + 3 * S).t_valid_ns for _ in range(2)]
    assert same[0] == same[1]
