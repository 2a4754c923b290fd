"""Times of day without date or zone: GNSS sentences and the RDSS stamping rule."""

from __future__ import annotations

import pytest

from drivers.measurements import TimeOfDayStamp, TimeReport
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions
from tests.clock.host_time import MS, Host, S, utc

DAY_S = 86400.0


def tod(utc_ns: int, zone_h: int = 0) -> float:
    """What a terminal in that zone prints for a UTC instant."""
    return (utc_ns / S + zone_h * 3600) % DAY_S


def rdss_fix(
    clock: Clock, host: Host, *, zone_h: int, latency: int = 1500 * MS, asked: bool = True
) -> tuple[int, str, float]:
    """One cycle: ask, answer burst 100 ms later, reply `latency` after it. Error, rule, sigma."""
    host.mono += 60 * S
    requested = host.mono
    true = requested + 100 * MS
    host.mono = true + latency
    stamp = TimeOfDayStamp(tod(host.utc(true), zone_h), (0, 8), requested if asked else None)
    instant = clock.resolve(stamp, "rdss", host.mono)
    return instant.t_valid_ns - true, instant.how, instant.sd_s


# ------------------------------------------------------------------ GNSS


@pytest.mark.parametrize(
    ("now", "printed"),
    [
        ("2026-11-20T23:33:07.12", 23 * 3600 + 33 * 60 + 7.0),
        ("2026-11-21T00:00:00.10", 86399.98),
        ("2026-11-20T00:00:00.05", 0.0),
    ],
)
def test_gnss_time_of_day_takes_the_nearest_day(now: str, printed: float) -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    seen = host.at_utc(now)
    instant = clock.resolve(TimeOfDayStamp(printed), "gnss", seen)
    assert abs(instant.t_valid_ns - (seen - 120 * MS)) <= 70 * MS
    assert abs(tod(host.utc(instant.t_valid_ns)) - printed) < 1e-6


def test_gnss_time_of_day_at_the_leap_second() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    seen = host.at_utc("2026-12-31T23:59:59.60")  # POSIX shows the last second again
    instant = clock.resolve(TimeOfDayStamp(86400.5), "gnss", seen)
    assert instant.t_valid_ns == seen - 100 * MS


def test_gnss_time_of_day_with_a_hopeless_clock_falls_back_to_arrival() -> None:
    host = Host(system_error=-5 * 3600 * S)
    clock = Clock(ClockOptions(), host)
    instant = clock.resolve(TimeOfDayStamp(tod(host.utc())), "gnss", host.mono)
    assert instant[::2] == (host.mono - 50 * MS, "arrival")


# ------------------------------------------------------------------ RDSS


@pytest.mark.parametrize("zone_h", [0, 8])
@pytest.mark.parametrize("asked", [True, False])
@pytest.mark.parametrize(
    "start",
    [
        "2026-11-20T12:00:00",
        "2026-11-20T15:58:59.50",  # the answer falls on midnight in Beijing
        "2026-11-20T23:58:58.70",  # and on midnight UTC
        "2026-11-20T23:58:59.90",
        "2026-12-31T23:58:59.95",
    ],
)
def test_rdss_fix_is_stamped_with_its_answer_burst(zone_h: int, asked: bool, start: str) -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    host.at_utc(start)
    error, how, _ = rdss_fix(clock, host, zone_h=zone_h, asked=asked)
    assert abs(error) < 1000
    assert how == "time_of_day"


def test_worked_replies_around_midnight() -> None:
    """The two worked frames of the sheet: 23:59:59.80 and 00:00:00.30, seen 0.9 s later."""
    for printed, seen_text in (
        (86399.80, "2026-11-21T00:00:00.70"),
        (0.30, "2026-11-21T00:00:01.2"),
    ):
        host = Host()
        clock = Clock(ClockOptions(), host)
        seen = host.at_utc(seen_text)
        stamp = TimeOfDayStamp(printed, (0, 8), seen - 1000 * MS)
        instant = clock.resolve(stamp, "rdss", seen)
        assert abs(instant.t_valid_ns - (seen - 900 * MS)) < 1000


def test_zone_is_locked_after_three_equal_and_then_the_other_is_refused() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    for i in range(3):
        assert clock.status().rdss_zone_h == {}, i
        rdss_fix(clock, host, zone_h=8)
    assert clock.status().rdss_zone_h == {"rdss": 8}
    assert clock.counters["rdss_zone_locked"] == 1
    error, how, sd_s = rdss_fix(clock, host, zone_h=0)
    assert (how, sd_s) == ("assumed_latency", 0.5)
    assert error == 1500 * MS - 800 * MS
    assert clock.counters["rdss_time_mismatch"] == 1
    assert rdss_fix(clock, host, zone_h=8)[1] == "time_of_day"


def test_lock_needs_three_in_a_row() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    for zone_h in (0, 0, 8, 8):
        rdss_fix(clock, host, zone_h=zone_h)
    assert clock.status().rdss_zone_h == {}


def test_two_readings_that_fit_are_refused() -> None:
    """A request so old that both zones fit its window says nothing about the zone."""
    host = Host()
    clock = Clock(ClockOptions(), host)
    stamp = TimeOfDayStamp(tod(host.utc() - S), (0, 8), host.mono - 9 * 3600 * S)
    instant = clock.resolve(stamp, "rdss", host.mono)
    assert instant[1:] == (0.5, "assumed_latency")
    assert instant.t_valid_ns == host.mono - 800 * MS


def test_answer_outside_request_and_reply_is_refused() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    q = host.mono - 2 * S
    for age, how in (
        (100 * MS, "time_of_day"),
        (2400 * MS, "time_of_day"),
        (2600 * MS, "assumed_latency"),
        (-100 * MS, "assumed_latency"),
    ):
        stamp = TimeOfDayStamp(tod(host.utc() - age), (0, 8), q)
        assert clock.resolve(stamp, "rdss", host.mono).how == how
    printed_to_the_second = TimeOfDayStamp(tod(host.utc() - 2900 * MS), (0, 8), q, 0.5)
    instant = clock.resolve(printed_to_the_second, "rdss", host.mono)
    assert instant.how == "time_of_day"
    assert instant.sd_s == pytest.approx(0.5 / 3**0.5)


@pytest.mark.parametrize("system_error_s", [-400, -7, 30, 3000])
def test_error_of_the_daemons_clock_is_learnt_and_reported(system_error_s: int) -> None:
    host = Host(system_error=system_error_s * S)
    clock = Clock(ClockOptions(), host)
    latencies = [1500, 700, 900, 800, 1100]
    for ms in latencies:
        _, how, _ = rdss_fix(clock, host, zone_h=8, latency=ms * MS)
        assert how == "assumed_latency"
    assert clock.counters["rdss_clock_error_learned"] == 1
    learned = clock.status().rdss_clock_error_s["rdss"]
    assert learned == pytest.approx(system_error_s + 0.1, abs=0.01)  # median 0.9 s less 0.8 s
    for ms in latencies:
        error, how, _ = rdss_fix(clock, host, zone_h=8, latency=ms * MS)
        assert how == "time_of_day_corrected"
        assert abs(error) <= 101 * MS
    # The receiver's time arrives: the plain rule holds again and the learnt error is dropped.
    host.mono += S
    clock.report(TimeReport("gnss", host.mono, host.utc() - 50 * MS, True))
    error, how, _ = rdss_fix(clock, host, zone_h=8)
    assert how == "time_of_day"
    assert abs(error) < 1000
    assert clock.status().rdss_clock_error_s["rdss"] == 0.0


def test_scattered_mismatches_teach_nothing() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    for i in range(20):
        host.mono += 60 * S
        stamp = TimeOfDayStamp((i * 7919.0) % DAY_S, (0, 8), host.mono - S)
        clock.resolve(stamp, "rdss", host.mono)
    assert clock.counters["rdss_clock_error_learned"] == 0
    assert clock.counters["rdss_time_mismatch"] == 20


def test_rdss_survives_steps_of_the_system_clock_between_request_and_reply() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    host.mono += S
    clock.report(TimeReport("gnss", host.mono, host.utc() - 50 * MS, True))
    for step in (3600, -7200):
        requested = host.mono
        host.mono += 2 * S
        host.system_error += step * S
        stamp = TimeOfDayStamp(tod(host.utc(requested)), (0, 8), requested)
        assert clock.resolve(stamp, "rdss", host.mono).t_valid_ns == pytest.approx(
            requested, abs=MS
        )


def test_helpers_agree_on_dates() -> None:
    assert utc("2026-11-20T23:33:07") == 1795217587 * S
