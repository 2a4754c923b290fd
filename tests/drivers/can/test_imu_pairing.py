"""Which CAN frames make one IMU sample, when it was true, and what was lost."""

from __future__ import annotations

import math

import pytest

from drivers.measurements import ArrivalStamp, DeviceStamp, KernelStamp
from tests.drivers.can.imu_frames import (
    EPOCH,
    MM7,
    MS,
    SBG,
    SBG_UNTIMED,
    T0,
    Line,
    mm7,
    sbg_accel,
    sbg_gyro,
    sbg_time,
)


def test_device_time_wraps_and_counts_losses() -> None:
    line = Line(SBG)
    first_us = 2**32 - 20_000
    kept = [k for k in range(40) if k not in (10, 11, 25)]
    for k in kept:
        us = first_us + 5000 * k
        line.burst(T0 + 5 * MS * k, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    ticks = [s.stamp.ticks_ns for s in line.samples if isinstance(s.stamp, DeviceStamp)]
    assert ticks == [(first_us + 5000 * k) * 1000 for k in kept]
    assert line.counters["lost_samples"] == 3
    assert line.counters["device_restarts"] == 0


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_a_stamp_message_ahead_or_behind_lends_its_time_to_its_own_sample(
    order: tuple[int, int, int],
) -> None:
    line = Line(SBG)
    for k in range(30):
        parts = (sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
        line.burst(T0 + 5 * MS * k, *(parts[i] for i in order))
    assert len(line.samples) >= 24
    for sample in line.samples[-20:]:
        assert isinstance(sample.stamp, DeviceStamp)
        k = sample.stamp.ticks_ns // (5 * MS)
        assert sample.gyro_rad_s[0] == pytest.approx(k * 0.001)
        assert sample.accel_m_s2[0] == pytest.approx(k * 0.01)


def test_device_restart_begins_a_new_clock() -> None:
    line = Line(SBG)
    for k in range(20):
        line.burst(T0 + 5 * MS * k, sbg_time(900_000_000 + 5000 * k), sbg_accel(k), sbg_gyro(k))
    for k in range(20):
        line.burst(T0 + 5000 * MS + 5 * MS * k, sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 1
    assert line.samples[-1].stamp == DeviceStamp("imu/1", 95 * MS)
    assert line.counters["lost_samples"] == 0


def test_setting_the_system_clock_is_no_restart() -> None:
    line = Line(SBG)
    for k in range(40):
        if k == 20:
            line.offset_ns += 3600 * 1000 * MS
        line.burst(T0 + 5 * MS * k, sbg_time(5000 * k), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 0
    assert len(line.samples) == 40


def device_us(line: Line) -> list[int]:
    stamps = [sample.stamp for sample in line.samples]
    assert all(isinstance(s, DeviceStamp) and s.device == "imu" for s in stamps)
    return [s.ticks_ns // 1000 for s in stamps if isinstance(s, DeviceStamp)]


def timed(k: int) -> tuple[tuple[int, bytes], ...]:
    return sbg_time(900_000_000 + 5000 * k), sbg_accel(k), sbg_gyro(k)


def test_a_stalled_reader_sees_a_burst_and_no_restart() -> None:
    """Nothing for 3.5 and 4 s, then all that was queued; the bus gives no stamps."""
    line = Line(SBG, kernel=False)
    for k in range(3000):
        due_ms = 5 * k
        for stalled, again in ((500, 4000), (6000, 10_000)):
            due_ms = again if stalled <= due_ms < again else due_ms
        line.burst(T0 + due_ms * MS, *timed(k))
    assert line.counters["device_restarts"] == 0
    assert device_us(line) == [900_000_000 + 5000 * k for k in range(3000)]
    assert line.counters["lost_samples"] == 0


def test_repeated_and_overtaken_frames_are_no_restart() -> None:
    """Every sample ten times; old ones again, seconds later, one by one and in a burst."""
    line = Line(SBG)
    for k in range(1200):
        for _ in range(10 if k % 50 == 0 else 1):
            line.burst(T0 + 5 * MS * k, *timed(k))
        if k % 100 == 99:
            line.burst(T0 + 5 * MS * k, *timed(max(0, k - 600)))
        if k == 1000:
            for old in range(100, 200):
                line.burst(T0 + 5 * MS * k, *timed(old))
    assert line.counters["device_restarts"] == 0
    assert device_us(line) == [900_000_000 + 5000 * k for k in range(1200)]
    assert line.counters["time_backward"] > 0


def test_a_restart_to_a_later_time_is_told_by_lateness_that_stays() -> None:
    """Two minutes dark, then a clock that goes on ten seconds behind where it was."""
    line = Line(SBG)
    for k in range(200):
        line.burst(T0 + 5 * MS * k, *timed(k))
    for k in range(1000):
        line.burst(T0 + 120_000 * MS + 5 * MS * k, *timed(2200 + k))
    assert line.counters["device_restarts"] == 1
    assert line.samples[-1].stamp == DeviceStamp("imu/1", (900_000_000 + 5000 * 3199) * 1000)


@pytest.mark.parametrize("back_ms", [20, 500, 900])
def test_a_clock_that_is_set_back_is_no_lateness(back_ms: int) -> None:
    """Two samples show it, and from the third on the new time holds: none is taken for late."""
    line = Line(SBG)
    for k in range(400):
        us = 900_000_000 + 5000 * k - (1000 * back_ms if k >= 200 else 0)
        line.burst(T0 + 5 * MS * k, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 1
    assert line.counters["time_backward"] == 2
    after = [s.stamp for s in line.samples[200:]]
    first = 900_000_000 + 5000 * 202 - 1000 * back_ms
    assert after == [DeviceStamp("imu/1", (first + 5000 * k) * 1000) for k in range(198)]


def test_a_stall_while_the_clock_is_set_back_is_over_with_it() -> None:
    """Half a second of frames in one burst hides the set clock; what comes on time shows it."""
    line = Line(SBG, kernel=False)
    for k in range(400):
        us = 900_000_000 + 5000 * k - (500_000 if k >= 200 else 0)
        due = 290 if 190 <= k < 290 else k
        line.burst(T0 + 5 * MS * due, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    assert line.counters["device_restarts"] == 1
    stamp = line.samples[-1].stamp
    assert stamp == DeviceStamp("imu/1", (900_000_000 + 5000 * 399 - 500_000) * 1000)


def test_device_time_that_goes_back_is_refused() -> None:
    line = Line(SBG)
    for k, us in enumerate([0, 5000, 10_000, 15_000, 20_000, 12_000, 30_000]):
        line.burst(T0 + 5 * MS * k, sbg_time(us), sbg_accel(k), sbg_gyro(k))
    ticks = [s.stamp.ticks_ns for s in line.samples if isinstance(s.stamp, DeviceStamp)]
    assert ticks == [us * 1000 for us in (0, 5000, 10_000, 15_000, 20_000, 30_000)]
    assert line.counters["time_backward"] == 1


def test_pairing_by_counter_needs_no_arrival_times() -> None:
    """Frames of two samples interleaved, all with the same stamp."""
    line = Line(MM7)
    for k in range(0, 40, 2):
        line.burst(T0, mm7(k, 1), mm7(k + 1, 1), mm7(k, 2), mm7(k + 1, 2))
        line.burst(T0, mm7(k, 3), mm7(k + 1, 3))
    assert len(line.samples) == 40
    for k, sample in enumerate(line.samples):
        rate = math.radians(0.005 * k)
        assert sample.gyro_rad_s == pytest.approx((-rate, rate, rate), abs=1e-9)
    assert line.counters["unpaired"] == 0


def test_counter_counts_losses_beyond_its_modulus() -> None:
    line = Line(MM7)
    kept = [*range(20), *range(20 + 37, 80)]
    for k in kept:
        line.burst(T0 + 5 * MS * k, mm7(k, 1), mm7(k, 2), mm7(k, 3))
    assert line.counters["lost_samples"] == 37
    assert len(line.samples) == len(kept)


def test_a_frame_missing_makes_no_sample() -> None:
    line = Line(MM7)
    for k in range(20):
        frames = [mm7(k, 1), mm7(k, 2), mm7(k, 3)]
        if k == 8:
            del frames[1]
        line.burst(T0 + 5 * MS * k, *frames)
    assert len(line.samples) == 19
    assert line.counters["unpaired"] == 2
    assert line.counters["lost_samples"] == 1


def test_pairing_by_arrival_learns_the_interval_and_counts_losses() -> None:
    line = Line(SBG_UNTIMED)
    for k in range(60):
        if k in (30, 31):
            continue
        frames = [sbg_accel(k), sbg_gyro(k)]
        if k == 45:
            del frames[0]
        line.burst(T0 + 5 * MS * k, *frames)
    for sample in line.samples:
        assert sample.gyro_rad_s[0] * 10.0 == pytest.approx(sample.accel_m_s2[0])
        assert isinstance(sample.stamp, KernelStamp)
    assert line.samples[-1].stamp == KernelStamp(EPOCH + T0 + 59 * 5 * MS)
    assert line.counters["lost_samples"] == 3
    assert len(line.samples) >= 50


def test_jitter_of_arrival_is_no_loss() -> None:
    line = Line(SBG_UNTIMED, kernel=False)
    late = {20: 9.0, 21: 4.5, 22: 0.5, 40: 2.0}
    for k in range(60):
        line.burst(T0 + int((5.0 * k + late.get(k, 0.0)) * MS), sbg_accel(k), sbg_gyro(k))
    assert line.counters["lost_samples"] == 0
    assert line.samples[-1].stamp == ArrivalStamp(0.0)


def test_duplicates_are_dropped() -> None:
    for options in (SBG, SBG_UNTIMED):
        line = Line(options)
        for k in range(20):
            frames = [sbg_time(5000 * k)] if options is SBG else []
            frames += [sbg_accel(k), sbg_gyro(k)]
            if k > 10:
                frames += frames[-2:]
            line.burst(T0 + 5 * MS * k, *frames)
        values = [s.gyro_rad_s[0] for s in line.samples]
        assert values == sorted(set(values))
        assert values[-1] == pytest.approx(0.019)
        assert line.counters["duplicates"] == 18


def test_equal_readings_at_rest_are_no_duplicates() -> None:
    line = Line(SBG_UNTIMED)
    for k in range(30):
        line.burst(T0 + 5 * MS * k, sbg_accel(0), sbg_gyro(0))
    assert line.counters["duplicates"] == 0
    assert len(line.samples) >= 24
