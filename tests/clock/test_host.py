"""The host's clocks: set, slewed, and standing still while the host is suspended."""

from __future__ import annotations

import pytest

from drivers.measurements import DeviceStamp, KernelStamp, TimeReport, UtcStamp
from fusiond.clock.host import SystemTime
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions
from tests.clock.host_time import MS, Host, S, utc

HOUR, YEAR = 3600 * S, 365 * 86400 * S


def with_events(options: ClockOptions, host: Host) -> tuple[Clock, list[str]]:
    clock = Clock(options, host)
    events: list[str] = []
    clock.on_event = lambda code, text: events.append(code)
    return clock, events


def epochs(clock: Clock, host: Host, seconds: float, *, reports: bool = True) -> tuple[int, float]:
    """Ten fixes a second, 60 ms after their epoch: the largest error (ns), and it in sigmas."""
    worst, ratio = 0, 0.0
    for _ in range(round(seconds * 10)):
        host.mono += 100 * MS
        epoch = host.mono - 60 * MS
        if reports:
            clock.report(TimeReport("gnss", host.mono, host.utc(epoch), True))
        t_ns, sd_s, _ = clock.resolve(UtcStamp(host.utc(epoch)), "gnss", host.mono)
        worst = max(worst, abs(t_ns - epoch))
        ratio = max(ratio, abs(t_ns - epoch) / S / sd_s)
    return worst, ratio


def test_the_clocks_of_this_machine() -> None:
    assert SystemTime.boottime_ns() >= SystemTime.monotonic_ns() - MS


# ------------------------------------------------------------------ steps


@pytest.mark.parametrize("step", [-10 * YEAR, -HOUR, -1, 1, HOUR, 10 * YEAR])
def test_a_step_moves_no_instant_and_is_told(step: int) -> None:
    """F23, with a receiver that tells the time: only frames stamped by the kernel look at it."""
    host = Host()
    step = step * S if abs(step) == 1 else step
    clock, events = with_events(ClockOptions(), host)
    epochs(clock, host, 60)
    host.system_error += step
    stamp = KernelStamp(host.realtime_ns())
    assert clock.resolve(stamp, "imu", host.mono + MS).t_valid_ns == host.mono
    assert epochs(clock, host, 300)[0] < 11 * MS
    assert events == ["system_clock_stepped"]
    now = clock.utc_ns(host.mono)
    assert now is not None
    assert abs(now - host.utc()) < 20 * MS


@pytest.mark.parametrize("step", [-10 * YEAR, -HOUR, -2 * S, -300 * MS, 300 * MS, 2 * S, HOUR])
def test_with_utc_of_the_system_a_step_does_not_move_instants(step: int) -> None:
    """A step says that the reference changed, not whether for the better: sigma is the step."""
    host = Host()
    clock, events = with_events(ClockOptions(utc="system"), host)
    assert epochs(clock, host, 60, reports=False)[0] == 0
    host.system_error += step
    for reports in (False, True):
        worst, _ = epochs(clock, host, 50, reports=reports)
        assert worst == 0
    instant = clock.resolve(UtcStamp(host.utc()), "gnss", host.mono + 60 * MS)
    assert instant.sd_s >= min(0.5, abs(step) / S)
    assert events == ["system_clock_stepped"]
    # After two minutes the system clock is believed, as configured; where it cannot be, arrival.
    epochs(clock, host, 30, reports=False)
    worst, ratio = epochs(clock, host, 60, reports=False)
    if abs(step) > S:
        assert ratio < 1.0
        assert worst < 11 * MS


def test_a_system_clock_of_the_year_2100_is_not_utc() -> None:
    host = Host()
    host.system_error = utc("2100-01-01T00:00:00") - host.utc()
    clock, _ = with_events(ClockOptions(utc="system"), host)
    assert clock.utc_ns(host.mono) is None
    assert clock.status().utc_source == "none"
    worst, ratio = epochs(clock, host, 60, reports=False)
    assert worst < 11 * MS
    assert ratio < 1.0


def test_arrivals_in_bursts_are_mapped_by_the_devices_own_stamps() -> None:
    """No UTC at all and a host that reads once in two seconds: instants are still the device's."""
    host = Host(system_error=40 * YEAR)
    clock, _ = with_events(ClockOptions(utc="system"), host)
    epochs(clock, host, 5, reports=False)
    first, host.mono = host.mono, host.mono + 2 * S
    for i in range(1, 20):
        epoch = first + i * 100 * MS - 60 * MS
        instant = clock.resolve(UtcStamp(host.utc(epoch)), "gnss", host.mono)
        assert abs(instant.t_valid_ns - epoch) < 11 * MS
        assert instant.sd_s >= 0.5


# ------------------------------------------------------------------ suspend


@pytest.mark.parametrize("asleep", [300 * MS, 20 * S, 9 * HOUR])
@pytest.mark.parametrize("rtc_error", [0, -900 * MS, 900 * MS])
def test_suspend_is_found_at_once(asleep: int, rtc_error: int) -> None:
    """F28: UTC minus monotonic jumps by the sleep. Boottime says so, to a second where the
    hardware clock that measured it counts seconds."""
    host = Host()
    clock, events = with_events(ClockOptions(), host)
    epochs(clock, host, 60)
    host.suspend(asleep)
    host.slept += max(rtc_error, -asleep // 2)
    host.system_error += max(rtc_error, -asleep // 2)
    now = clock.utc_ns(host.mono)
    assert now is not None
    assert abs(now - host.utc()) <= abs(rtc_error) + 20 * MS
    worst, ratio = epochs(clock, host, 5)
    assert worst < 11 * MS
    assert ratio < 4.0
    assert events == ["host_resumed"]
    assert clock.counters["system_clock_stepped"] == 0
    assert clock.counters["utc_jump"] == 0
    assert clock.status().settled


@pytest.mark.parametrize("noticed", [True, False])
def test_devices_are_learnt_anew_after_a_suspend(noticed: bool) -> None:
    """One counted on, the other stood still with the host."""
    host = Host()
    clock = Clock(ClockOptions(), host)
    ticks = 7 * S
    for i in range(600):
        host.mono += 10 * MS
        ticks += 10 * MS
        if i == 300:
            host.suspend(30 * S)
            if noticed:
                clock.utc_ns(host.mono)
        on = DeviceStamp("on", host.mono + host.slept)
        assert clock.resolve(on, "imu", host.mono).t_valid_ns == host.mono
        assert clock.resolve(DeviceStamp("off", ticks), "imu", host.mono)[0] == host.mono
    assert clock.counters["device_tick_odd"] == (0 if noticed else 3)


def test_a_frame_stamped_before_the_suspend_and_read_after_it() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    stamp, true = KernelStamp(host.realtime_ns()), host.mono
    host.mono += MS
    host.suspend(HOUR)
    host.mono += MS
    assert clock.resolve(stamp, "imu", host.mono).t_valid_ns == true
    assert clock.resolve(KernelStamp(host.realtime_ns()), "imu", host.mono)[0] == host.mono


# ------------------------------------------------------------------ slews


def drive(
    clock: Clock, host: Host, ppm: int, seconds: float, every: int = 2 * MS
) -> tuple[float, float]:
    """The system clock is slewed by `ppm`: the largest error (ms) of fixes of a receiver, ten a
    second, and of frames that the kernel stamped and that waited 30 ms."""
    fix_ns = frame_ns = 0
    host.slew(ppm)
    waiting: list[tuple[int, KernelStamp]] = []
    for step in range(round(seconds * S) // every):
        host.mono += every
        waiting.append((host.mono, KernelStamp(host.realtime_ns())))
        while waiting and waiting[0][0] <= host.mono - 30 * MS:
            true, stamp = waiting.pop(0)
            frame_ns = max(frame_ns, abs(clock.resolve(stamp, "imu", host.mono)[0] - true))
        if step % max(1, 100 * MS // every) == 0:
            epoch = host.mono - 60 * MS
            clock.report(TimeReport("gnss", host.mono, host.utc(epoch), True))
            instant = clock.resolve(UtcStamp(host.utc(epoch)), "gnss", host.mono)
            fix_ns = max(fix_ns, abs(instant.t_valid_ns - epoch))
    return fix_ns / MS, frame_ns / MS


@pytest.mark.parametrize("ppm", [-100_000, -83_333, -1_500, 500, 83_333, 100_000])
@pytest.mark.parametrize("every", [2 * MS, 50 * MS])
def test_a_slewed_system_clock_moves_no_instant(ppm: int, every: int) -> None:
    """chrony slews by 8.3 % (`maxslewrate`), adjtimex(2) by 10 %."""
    host = Host(system_error=-S)
    clock, events = with_events(ClockOptions(), host)
    before = drive(clock, host, 0, 20, every)
    assert before[0] <= 10.0
    assert before[1] == 0.0
    fix_ms, frame_ms = drive(clock, host, ppm, 12, every)
    assert fix_ms <= 10.0
    # The rate is known a tenth of a second later: until then by the wait.
    assert frame_ms <= abs(ppm) * 1e-6 * max(30.0, every / MS) + 0.001
    assert drive(clock, host, ppm, 5, every)[1] < 0.03
    assert drive(clock, host, 0, 5, every)[0] <= 10.0
    assert not events
    assert clock.status().system_error_s == pytest.approx(
        (host.system_error + host.slewed) / S, abs=0.012
    )


@pytest.mark.parametrize("step", [-2 * S, 5 * MS, 400 * MS, 3600 * S])
def test_a_step_in_a_slew_is_told_by_its_size(step: int) -> None:
    host = Host()
    clock, events = with_events(ClockOptions(), host)
    texts: list[str] = []
    clock.on_event = lambda code, text: texts.append(f"{code} {text}")
    drive(clock, host, 0, 20)
    drive(clock, host, 83_333, 3)
    host.system_error += step
    fix_ms, frame_ms = drive(clock, host, 83_333, 3)
    assert fix_ms <= 10.0
    # Which side of a step shorter than its wait a frame was stamped on cannot be told.
    assert frame_ms < (0.03 if abs(step) > 30 * MS else 5.03)
    assert texts == [f"system_clock_stepped the system clock was set by {step / S:+.3f} s"]
    assert not events


def test_a_suspended_host_in_a_slew() -> None:
    host = Host()
    clock, events = with_events(ClockOptions(), host)
    drive(clock, host, 0, 20)
    drive(clock, host, 83_333, 3)
    host.suspend(20 * S)
    assert drive(clock, host, 83_333, 3)[0] <= 11.0
    assert events == ["host_resumed"]
    assert clock.counters["system_clock_stepped"] == 0


@pytest.mark.parametrize("every", [2 * MS, 50 * MS, S])
def test_utc_of_the_system_follows_a_slew(every: int) -> None:
    """Whoever keeps UTC by it has it slewed to what is right."""
    host = Host(system_error=-S)
    clock, events = with_events(ClockOptions(utc="system"), host)
    drive(clock, host, 83_333, 12, every)
    stamp = host.realtime_ns() - 60 * MS
    assert abs(clock.resolve(UtcStamp(stamp), "gnss", host.mono)[0] - host.mono + 60 * MS) < MS
    now = clock.utc_ns(host.mono)
    assert now is not None
    assert abs(now - host.realtime_ns()) < 2 * MS
    assert not events


def test_a_state_of_a_log_whose_instants_are_of_the_slewed_clock() -> None:
    """Before 2026-11-28: nothing was slewed against them."""
    host = Host()
    clock = Clock(ClockOptions(), host)
    new = {"_slewed_ns", "_unslewed_ns", "_rate_ppb", "_rated_ns", "_rated_offset_ns"}
    known = {name: of for name, of in clock.system_state().items() if name not in new}
    host.mono += S
    clock.restore_system(known)
    host.system_error += 2 * S
    clock.look()
    assert clock.counters["system_clock_stepped"] == 1
