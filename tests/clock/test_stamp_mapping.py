"""Stamps of every class, on a host whose two clocks the test owns."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import (
    ArrivalStamp,
    DeviceStamp,
    KernelStamp,
    MonotonicStamp,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions
from tests.clock.host_time import MS, Host, S, utc


@pytest.fixture
def host() -> Host:
    return Host()


def learn(clock: Clock, host: Host, reports: int = 20, delay: int = 60 * MS, lead: int = 0) -> None:
    """Feed `reports` of 10 Hz GNSS time that arrive `delay` after their epoch."""
    for _ in range(reports):
        host.mono += 100 * MS
        seen = host.mono
        clock.report(TimeReport("gnss", seen, host.utc(seen - delay) + lead, True))


# ------------------------------------------------------------------ simple stamps


def test_arrival_and_monotonic_stamps(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    assert clock.now_ns() == host.mono
    assert clock.resolve(ArrivalStamp(0.004), "imu", 10 * S)[::2] == (10 * S - 4 * MS, "arrival")
    assert clock.resolve(MonotonicStamp(7), "imu", 10 * S) == (7, 0.0, "monotonic")


# ------------------------------------------------------------------ kernel stamps


def kernel(clock: Clock, host: Host, age: int) -> int:
    """A frame stamped now and read `age` later; the error of the resolved instant."""
    stamp = KernelStamp(host.realtime_ns())
    true = host.mono
    host.mono += age
    return clock.resolve(stamp, "imu", host.mono).t_valid_ns - true


def test_kernel_stamp_is_exact_and_takes_off_the_latency(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    assert kernel(clock, host, 300_000) == 0
    stamp = KernelStamp(host.realtime_ns(), latency_s=0.002)
    assert clock.resolve(stamp, "imu", host.mono + 1).t_valid_ns == host.mono - 2 * MS


@pytest.mark.parametrize("step", [-3600 * S, -5 * S, -300 * MS, 300 * MS, 5 * S, 3600 * S])
def test_kernel_stamps_survive_steps_of_the_system_clock(host: Host, step: int) -> None:
    clock = Clock(ClockOptions(), host)
    for _ in range(10):
        host.mono += 10 * MS
        assert kernel(clock, host, 200_000) == 0
    # One frame is stamped before the step and read after it; the rest come after.
    stamp, true = KernelStamp(host.realtime_ns()), host.mono
    host.mono += 100_000
    host.system_error += step
    assert clock.resolve(stamp, "imu", host.mono).t_valid_ns == true
    for _ in range(300):
        host.mono += 10 * MS
        assert kernel(clock, host, 200_000) == 0
    assert clock.counters["system_clock_stepped"] == 1
    assert clock.counters["kernel_stamp_remapped"] == 1


def test_ntp_slew_is_not_a_step(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    for _ in range(200):
        host.mono += 100 * MS
        host.system_error += 50_000  # 500 ppm
        assert kernel(clock, host, 200_000) == 0
    assert clock.counters["system_clock_stepped"] == 0


def test_impossible_kernel_stamps_fall_back_to_arrival(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    future = KernelStamp(host.realtime_ns() + S, latency_s=0.001)
    assert clock.resolve(future, "imu", host.mono)[::2] == (host.mono - MS, "arrival")
    old = KernelStamp(host.realtime_ns() - 2 * S)
    assert clock.resolve(old, "imu", host.mono)[::2] == (host.mono, "arrival")
    assert clock.counters["kernel_stamp_future"] == clock.counters["kernel_stamp_old"] == 1


# ------------------------------------------------------------------ UTC


def test_utc_before_the_receiver_comes_from_the_system_clock(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    valid = host.mono - 120 * MS
    instant = clock.resolve(UtcStamp(host.utc(valid)), "gnss", host.mono)
    assert (instant.t_valid_ns, instant.how) == (valid, "system")
    assert clock.utc_ns(host.mono) == host.utc()
    assert clock.status().utc_source == "system"


def test_first_report_gives_tens_of_ms_and_later_few(host: Host) -> None:
    host.system_error = 3600 * S
    clock = Clock(ClockOptions(serial_latency_s=0.05), host)
    worst_late = 0
    for i in range(600):
        host.mono += 100 * MS
        seen, delay = host.mono, 50 * MS + (i * 37 % 41) * MS
        clock.report(TimeReport("gnss", seen, host.utc(seen - delay), True))
        t = clock.resolve(UtcStamp(host.utc(seen - delay)), "gnss", seen).t_valid_ns
        error = abs(t - (seen - delay))
        assert error <= 41 * MS
        if i > 60:
            worst_late = max(worst_late, error)
    assert worst_late <= 3 * MS
    assert clock.status().system_error_s == pytest.approx(3600.0, abs=0.003)
    assert clock.status().utc_source == "gnss"


@pytest.mark.parametrize("step", [-86400 * S, -2 * S, 2 * S, 86400 * S])
def test_steps_of_the_system_clock_do_not_move_gnss_time(host: Host, step: int) -> None:
    clock = Clock(ClockOptions(), host)
    learn(clock, host, delay=50 * MS)
    host.system_error += step
    t = clock.resolve(UtcStamp(host.utc() - 80 * MS), "gnss", host.mono).t_valid_ns
    assert abs(t - (host.mono - 80 * MS)) < MS
    now = clock.utc_ns(host.mono)
    assert now is not None
    assert abs(now - host.utc()) < MS


def test_untrusted_time_moves_nothing(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    learn(clock, host, delay=50 * MS)
    before = clock.utc_ns(host.mono)
    for i in range(50):
        clock.report(TimeReport("gnss", host.mono + i * S, utc("2026-01-01T00:00:00"), False))
    assert clock.utc_ns(host.mono) == before
    assert clock.counters["utc_report_untrusted"] == 50


def test_leap_seconds_learnt_after_a_cold_start(host: Host) -> None:
    """GPS time for UTC (18 s ahead), then the almanac arrives and UTC jumps back by 18 s."""
    clock = Clock(ClockOptions(), host)
    learn(clock, host, delay=50 * MS, lead=18 * S)
    for i in range(40):
        host.mono += 100 * MS
        clock.report(TimeReport("gnss", host.mono, host.utc() - 50 * MS, True))
        # Nothing is ever stamped 18 s wrong: while it is open, arrival stands in.
        instant = clock.resolve(UtcStamp(host.utc() - 50 * MS), "gnss", host.mono)
        assert abs(instant.t_valid_ns - (host.mono - 50 * MS)) < MS, i
        assert instant.how == ("arrival" if i < 10 else "utc")
    assert clock.counters["utc_jump"] == 1
    # UTC itself is believed after minutes.
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc() + 18 * S, abs=MS)
    assert not clock.status().settled
    learn(clock, host, delay=50 * MS, reports=1200)
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=MS)
    assert clock.status().settled
    assert clock.counters["utc_jumped"] == 1


def test_leap_second_repeats_and_is_learnt(host: Host) -> None:
    """At 2027-01-01 a leap second is inserted: POSIX UTC counts 23:59:59 twice."""
    clock = Clock(ClockOptions(), host)
    host.at_utc("2026-12-31T23:59:50")
    inserted = utc("2027-01-01T00:00:00")
    for i in range(200):
        host.mono += 100 * MS
        epoch = host.utc(host.mono - 60 * MS)
        printed = epoch - S if epoch >= inserted else epoch
        clock.report(TimeReport("gnss", host.mono, printed, True))
        t = clock.resolve(UtcStamp(printed), "gnss", host.mono).t_valid_ns
        assert abs(t - (host.mono - 60 * MS)) <= 11 * MS, i
    assert clock.counters["utc_jump"] == 1


def test_a_stall_that_delivers_late_lines_is_no_jump(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    learn(clock, host, reports=50, delay=50 * MS)
    first = host.mono
    host.mono += 5 * S
    for i in range(1, 50):
        epoch = first + i * 100 * MS - 50 * MS
        clock.report(TimeReport("gnss", host.mono, host.utc(epoch), True))
    learn(clock, host, reports=20, delay=50 * MS)
    assert clock.counters["utc_jump"] == 0
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=2 * MS)


def test_one_odd_report_moves_nothing(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    learn(clock, host, delay=50 * MS)
    clock.report(TimeReport("gnss", host.mono, host.utc() + 3600 * S, True))
    assert not clock.status().settled
    learn(clock, host, delay=50 * MS, reports=1)
    assert clock.status().settled
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=MS)
    assert clock.counters["utc_report_odd"] == 1


def test_week_rollover_is_undone_and_a_dead_battery_date_refused(host: Host) -> None:
    clock = Clock(ClockOptions(), host)
    weeks = 1024 * 7 * 86400 * S
    host.mono += S
    clock.report(TimeReport("gnss", host.mono, host.utc() - 50 * MS - weeks, True))
    assert clock.counters["gps_week_rollover"] == 1
    assert clock.utc_ns(host.mono) == host.utc()
    stamp = UtcStamp(host.utc() - 70 * MS - weeks)
    assert clock.resolve(stamp, "gnss", host.mono).t_valid_ns == host.mono - 70 * MS
    clock.report(TimeReport("other", host.mono, utc("1980-01-06T00:00:00"), True))
    assert clock.counters["utc_report_implausible"] == 1


def test_no_utc_on_a_machine_without_a_battery(host: Host) -> None:
    host.system_error = -host.utc() + 60 * S  # 1970
    clock = Clock(ClockOptions(), host)
    assert clock.utc_ns(host.mono) is None
    assert clock.status().utc_source == "none"
    instant = clock.resolve(UtcStamp(host.utc()), "gnss", host.mono)
    assert instant.t_valid_ns == host.mono - 50 * MS
    assert clock.counters["utc_stamp_future"] == 1
    learn(clock, host, reports=1, delay=50 * MS)
    assert clock.utc_ns(host.mono) == host.utc()


def test_system_option_ignores_the_receiver(host: Host) -> None:
    clock = Clock(ClockOptions(utc="system"), host)
    learn(clock, host, lead=7 * S)
    assert clock.utc_ns(host.mono) == host.utc()
    assert clock.status().utc_source == "system"


def test_coarse_rdss_time_yields_to_the_receiver_and_takes_over_when_it_is_gone(
    host: Host,
) -> None:
    host.system_error = -7200 * S
    clock = Clock(ClockOptions(), host)

    def rdss_report() -> None:
        host.mono += 1100 * MS
        whole = (host.utc() - 300 * MS) // S * S
        clock.report(TimeReport("rdss", host.mono, whole, True))

    for _ in range(20):
        rdss_report()
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=500 * MS)
    learn(clock, host, delay=50 * MS)
    assert clock.status().utc_source == "gnss"
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=MS)
    for _ in range(60):
        rdss_report()
    assert clock.status().utc_source == "rdss"
    assert clock.utc_ns(host.mono) == pytest.approx(host.utc(), abs=S)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 300 * MS),
            st.integers(-20 * S, 20 * S),
            st.booleans(),
            st.sampled_from(["gnss", "rdss"]),
        ),
        max_size=60,
    )
)
@settings(max_examples=60)
def test_same_inputs_give_same_outputs_and_nothing_from_the_future(
    inputs: list[tuple[int, int, bool, str]],
) -> None:
    def run() -> tuple[list[tuple[object, ...]], dict[str, int]]:
        host = Host()
        clock = Clock(ClockOptions(), host)
        out: list[tuple[object, ...]] = []
        for advance, error, trusted, source in inputs:
            host.mono += advance
            clock.report(TimeReport(source, host.mono, host.utc() + error, trusted))
            tod = (host.utc() + error) % (86400 * S) / S
            for stamp in (
                UtcStamp(host.utc() + error),
                KernelStamp(host.realtime_ns() + error),
                DeviceStamp(source, host.mono + error),
                TimeOfDayStamp(tod),
                TimeOfDayStamp(tod, (0, 8), host.mono - S),
            ):
                instant = clock.resolve(stamp, source, host.mono)
                assert instant.t_valid_ns <= host.mono + 1000  # distinct device ticks: 1 ns each
                out.append(tuple(instant))
            out.append((clock.utc_ns(host.mono),))
        return out, dict(clock.counters)

    assert run() == run()
