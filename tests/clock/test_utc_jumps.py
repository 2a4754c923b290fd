"""UTC and lateness: what is only late moves nothing, what is a jump is found, and told."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import TimeReport, UtcStamp
from fusiond.clock.results import Instant
from fusiond.clock.stamp_mapping import Clock
from fusiond.clock.utc_from_arrivals import UtcEnvelope, UtcKnown, whole_seconds_ns
from fusiond.configuration.schema import ClockOptions
from tests.clock.host_time import MS, Host, S, utc

DELAY = 60 * MS
DRIFT_PPM = 100


class Receiver:
    """A receiver of `rate_hz` on a serial line: reports time, then stamps a fix."""

    def __init__(self, clock: Clock, host: Host, rate_hz: int = 10) -> None:
        self.clock, self.host = clock, host
        self.period = S // rate_hz
        self.lead = 0
        self.reports = self.trusted = True
        self.events: list[tuple[str, str]] = []
        clock.on_event = lambda code, text: self.events.append((code, text))

    def epoch(self, late: int = 0) -> tuple[Instant, int]:
        """The next epoch, `late` beyond its usual delay: its instant and how wrong that is."""
        self.host.mono += self.period
        true = self.host.mono
        seen = true + DELAY + late
        stated = self.host.utc(true) + self.lead
        now, self.host.mono = self.host.mono, seen
        if self.reports:
            self.clock.report(TimeReport("gnss", seen, stated, self.trusted))
        instant = self.clock.resolve(UtcStamp(stated), "gnss", seen)
        self.host.mono = now
        return instant, instant.t_valid_ns - true

    def run(self, seconds: float, late: int = 0) -> tuple[int, float]:
        """The largest error in ns and the largest error in sigma."""
        worst, ratio = 0, 0.0
        for _ in range(round(seconds * S / self.period)):
            instant, error = self.epoch(late)
            worst = max(worst, abs(error))
            ratio = max(ratio, abs(error - (DELAY - 50 * MS)) / S / instant.sd_s)
        return worst, ratio

    def utc_error(self) -> int:
        now = self.clock.utc_ns(self.host.mono)
        assert now is not None
        return now - self.host.utc()


@pytest.fixture
def receiver() -> Receiver:
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host)
    receiver.run(60)
    return receiver


# ------------------------------------------------------------------ lateness


@pytest.mark.parametrize("late", [200 * MS, 800 * MS, 1000 * MS, 3 * S, 7_300 * MS, 20 * S])
def test_lateness_for_half_a_minute_moves_nothing(receiver: Receiver, late: int) -> None:
    for seconds, by in ((30, late), (30, 0)):
        worst, _ = receiver.run(seconds, by)
        assert worst < 16 * MS  # 10 ms of latency unknown to the configuration, 100 ppm
        assert abs(receiver.utc_error()) < 20 * MS
    assert receiver.clock.status().settled
    assert not receiver.events
    assert receiver.clock.counters["utc_jump"] == 0


def test_a_jump_that_may_be_lateness_is_in_sigma(receiver: Receiver) -> None:
    """Three seconds late after reports were lost: sigma says that it may be UTC."""
    receiver.host.mono += 5 * S
    instant, error = receiver.epoch(3 * S)
    assert abs(error) < 11 * MS
    assert instant.sd_s == pytest.approx(3.0, abs=0.01)
    assert not receiver.clock.status().settled
    instant, _ = receiver.epoch(3_800 * MS)  # UTC does not jump by that
    assert instant.sd_s < 0.01
    receiver.epoch()
    assert receiver.clock.status().settled
    for _ in range(10):
        instant, _ = receiver.epoch(3 * S)  # nothing is missing in the sequence
        assert instant.sd_s < 0.01
        assert receiver.clock.status().settled


def test_a_second_that_the_driver_did_not_trust_is_evidence() -> None:
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host, 1)
    receiver.run(60)
    receiver.lead = -S
    receiver.trusted = False
    receiver.run(2)
    receiver.trusted = True
    receiver.run(3)
    assert receiver.run(10)[0] < 11 * MS
    assert receiver.clock.counters["utc_jump"] == 1


def test_a_jump_while_reports_were_missing_is_believed_after_two_minutes(
    receiver: Receiver,
) -> None:
    """UTC back by 2 s in an outage looks like lateness, and like a jump only by lasting."""
    receiver.host.mono += 30 * S
    receiver.lead = -2 * S
    for _ in range(1195):
        instant, error = receiver.epoch()
        assert abs(error) / S < 1.05 * instant.sd_s
    assert not receiver.clock.status().settled
    assert not receiver.events
    receiver.run(1)
    assert receiver.run(10)[0] < 11 * MS
    assert receiver.clock.status().settled
    assert receiver.events == [
        ("utc_jumped", "UTC jumped by -2.000 s: gnss has said so for minutes")
    ]
    assert receiver.utc_error() == pytest.approx(-2 * S, abs=20 * MS)


@given(st.lists(st.tuples(st.integers(1, 3000), st.integers(0, 30_000)), max_size=60))
@settings(max_examples=200, deadline=None)
def test_no_lateness_moves_the_mapping_later_than_drift(steps: list[tuple[int, int]]) -> None:
    """After a settled start, whatever the delays in [0, 30] s: up by the drift at most, and
    never before what a report proves."""
    envelope = UtcEnvelope(DRIFT_PPM, counters := Counter[str]())
    t = 5_000 * S
    offset = -1_790_000_000 * S
    for _ in range(40):
        t += 100 * MS
        envelope.update(t - offset, t)
    settled, since, seen = envelope.offset_ns, t, t
    for advance, delay in steps:
        t += advance * MS
        if t - since > 100 * S:
            break
        seen = max(seen, t + delay * MS)  # a serial line keeps its order
        if seen - since > 110 * S:
            break
        envelope.update(t - offset, seen)
        assert settled <= envelope.offset_ns <= settled + (seen - since) * DRIFT_PPM // 10**6 + 1
        assert envelope.offset_ns <= seen - (t - offset)  # nothing true after it has come
        assert envelope.believed_offset_ns == envelope.offset_ns
    assert counters["utc_jump"] == counters["utc_relearned"] == 0


@given(
    st.lists(st.integers(0, 400), min_size=12, max_size=80),
    st.integers(-5, 5).filter(bool),
    st.integers(0, 100),
)
@settings(max_examples=100, deadline=None)
def test_a_jump_by_whole_seconds_keeps_the_mapping(
    delays: list[int], jump: int, jitter: int
) -> None:
    """A jump in the receiver's own sequence is followed by exactly its seconds."""
    envelope = UtcEnvelope(DRIFT_PPM, Counter())
    offset, t, seen = -1_790_000_000 * S, 5_000 * S, 0
    for delay in [0, *delays]:
        t += 100 * MS
        seen = max(seen, t + delay * MS)
        envelope.update(t - offset, seen)
    before = envelope.offset_ns
    for i in range(20):
        t += 100 * MS
        seen = max(seen, t + (jitter * MS if i % 2 else 0))
        envelope.update(t - offset + jump * S, seen)
    assert envelope.offset_ns == pytest.approx(before - jump * S, abs=MS)
    assert envelope.believed_offset_ns == pytest.approx(before, abs=MS)


def test_busy_at_the_start(receiver: Receiver) -> None:
    """All reports since the start were 0.8 s late: found as soon as they are not."""
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host)
    receiver.run(20, 800 * MS)
    receiver.run(1.2)
    assert receiver.run(10)[0] < 11 * MS
    assert abs(receiver.utc_error()) < 20 * MS
    assert receiver.clock.counters["utc_relearned"] == 1
    assert receiver.clock.counters["utc_jump"] == 0


# ------------------------------------------------------------------ jumps


@pytest.mark.parametrize("jump", [-3600, -18, -2, -1, 1, 2, 18, 3600])
@pytest.mark.parametrize("rate_hz", [1, 10])
def test_a_jump_in_the_sequence_is_followed_and_told_after_minutes(jump: int, rate_hz: int) -> None:
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host, rate_hz)
    receiver.run(60)
    receiver.lead = jump * S
    assert receiver.run(4)[1] < 1.1  # by arrival for a second, and sigma says so
    assert receiver.run(100)[0] < 11 * MS
    assert abs(receiver.utc_error()) < 20 * MS, "not believed before it has lasted"
    assert not receiver.clock.status().settled
    receiver.run(20)
    assert receiver.utc_error() == pytest.approx(jump * S, abs=20 * MS)
    assert receiver.clock.status().settled
    assert [code for code, _ in receiver.events] == ["utc_jumped"]
    assert f"{jump:+d}.000 s" in receiver.events[0][1]


def test_a_jump_that_is_taken_back_was_a_mistake(receiver: Receiver) -> None:
    receiver.lead = 5 * S
    receiver.run(60)
    receiver.lead = 0
    receiver.run(150)
    assert abs(receiver.utc_error()) < 20 * MS
    assert not receiver.events
    assert receiver.clock.counters["utc_jump"] == 2
    assert receiver.clock.status().settled


@pytest.mark.parametrize("lead", [-600 * MS, 300 * MS, 700 * MS, 3600 * S])
def test_one_wrong_report_moves_nothing(receiver: Receiver, lead: int) -> None:
    receiver.lead = lead
    receiver.run(0.1)
    receiver.lead = 0
    assert receiver.run(30)[0] < 11 * MS
    assert receiver.clock.counters["utc_jump"] == 0


@pytest.mark.parametrize("rate_hz", [1, 10])
@pytest.mark.parametrize("repeats", [True, False])
def test_leap_second(rate_hz: int, repeats: bool) -> None:
    """F24: 23:59:60 repeats a second of POSIX time; no fix is stamped wrong by it.

    A driver may keep a time that it has reported already to itself.
    """
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host, rate_hz)
    host.at_utc("2026-12-31T23:59:00")
    for i in range(200 * rate_hz):
        receiver.lead = -S if host.mono + receiver.period >= leap(host) else 0
        receiver.reports = repeats or not 0 <= host.mono + receiver.period - leap(host) < S
        instant, error = receiver.epoch()
        assert abs(error) / S <= max(0.011, 1.05 * instant.sd_s), i
        if host.mono > leap(host) + 4 * S:
            assert abs(error) < 11 * MS
    assert [code for code, _ in receiver.events] == ["utc_jumped"]
    assert receiver.utc_error() == pytest.approx(-S, abs=20 * MS)


def leap(host: Host) -> int:
    """Monotonic time of the first second after the one that was inserted."""
    return utc("2027-01-01T00:00:00") - host.true_utc_at_zero


# ------------------------------------------------------------------ dates that cannot be

DAY = 86400 * S


@pytest.mark.parametrize(
    "lead",
    [utc("2100-01-01T00:00:00") - utc("2026-11-20T00:00:00"), 1024 * 7 * DAY, 8192 * 7 * DAY],
)
def test_an_impossible_date_maps_its_own_stamps_and_is_not_utc(
    receiver: Receiver, lead: int
) -> None:
    """F25: a rollover moved once too often, a BDT week counted past 8191, the year 2100."""
    receiver.lead = lead
    assert receiver.run(5)[1] < 1.1
    assert receiver.run(300)[0] < 11 * MS
    assert abs(receiver.utc_error()) < 40 * MS
    assert not receiver.clock.status().settled
    assert receiver.clock.counters["utc_report_implausible"] == 3050
    receiver.lead = 0
    receiver.run(130)
    assert abs(receiver.utc_error()) < 60 * MS
    assert receiver.clock.status().settled
    year = 1970 + int((receiver.host.utc() + lead) / (365.2425 * DAY))
    assert receiver.events == [("utc_implausible", f"gnss tells the year {year}: not believed")]


@pytest.mark.parametrize("date", ["1989-05-01T00:00:00", "2100-01-01T00:00:00"])
def test_a_receiver_that_never_knew_the_date(date: str) -> None:
    host = Host()
    receiver = Receiver(Clock(ClockOptions(), host), host)
    receiver.lead = utc(date) - host.utc()
    receiver.run(1)
    worst, ratio = receiver.run(60)
    assert worst < 11 * MS
    assert ratio < 1.0
    assert receiver.clock.status().utc_source == "system"
    assert receiver.utc_error() == 0
    year = int(date[:4])
    assert receiver.events == [("utc_implausible", f"gnss tells the year {year}: not believed")]


def test_a_bdt_week_before_its_epoch_is_refused(receiver: Receiver) -> None:
    """8192 weeks too few: 1869, no POSIX time at all."""
    receiver.lead = -8192 * 7 * DAY
    receiver.run(200)
    assert abs(receiver.utc_error()) < 40 * MS
    assert receiver.clock.counters["utc_report_implausible"] == 2000


def test_a_week_number_1024_too_small_is_undone(receiver: Receiver) -> None:
    receiver.lead = -1024 * 7 * DAY
    assert receiver.run(30)[0] < 11 * MS
    assert receiver.clock.status().settled
    assert receiver.clock.counters["gps_week_rollover"] == 300


def test_whole_seconds() -> None:
    near = {ms: whole_seconds_ns(ms * MS) // MS for ms in (0, 190, 210, 800, 940, 960, 1000, 1190)}
    assert near == {0: 0, 190: 0, 210: 0, 800: 0, 940: 0, 960: 1000, 1000: 1000, 1190: 1000}
    assert whole_seconds_ns(-3_020 * MS) == -3 * S
    assert whole_seconds_ns(-2_850 * MS) == -3 * S
    assert whole_seconds_ns(-2_500 * MS) == 0


# ------------------------------------------------------------------ a process that follows another


def _restarted(pause: int) -> tuple[Receiver, Clock]:
    """A receiver whose UTC one process has learnt for a minute; the clock of the next, later."""
    first = Receiver(Clock(ClockOptions(), Host()), Host())
    first.clock = Clock(ClockOptions(), first.host)
    first.run(60)
    first.host.mono += pause
    clock = Clock(ClockOptions(), first.host)
    clock.resume(first.clock.known())
    return first, clock


@pytest.mark.parametrize("pause", [S, 3 * S, 59 * S])
def test_a_restarted_process_knows_utc_from_its_first_report(pause: int) -> None:
    """Its first sentences come 100 ms later than usual: learnt anew, all fixes would be by that."""
    receiver, clock = _restarted(pause)
    receiver.clock = clock
    assert clock.status().utc_source == "gnss"
    for _ in range(20):
        instant, error = receiver.epoch(late=100 * MS)
        assert abs(error - (DELAY - 50 * MS)) < 10 * MS
        assert instant.sd_s < 10e-3
    assert clock.counters["utc_resumed"] == 1

    receiver.clock = Clock(ClockOptions(), receiver.host)
    assert receiver.epoch(late=100 * MS)[1] > 90 * MS


def test_old_or_future_utc_is_learnt_again() -> None:
    _, clock = _restarted(61 * S)
    assert clock.status().utc_source == "system"
    _, clock = _restarted(-10 * S)
    assert clock.status().utc_source == "system"
    assert clock.counters["utc_resumed"] == 0


def test_a_jump_after_the_restart_is_found_all_the_same() -> None:
    receiver, clock = _restarted(3 * S)
    receiver.clock, receiver.lead = clock, 5 * S
    receiver.run(130)
    assert clock.counters["utc_jump"] == 1


def test_nothing_is_handed_on_while_there_is_a_doubt() -> None:
    receiver, clock = _restarted(3 * S)
    receiver.clock, receiver.lead = clock, 5 * S
    receiver.run(10)
    assert clock.known() == ()


@pytest.mark.parametrize("utc_ns", [0, utc("2018-01-01T00:00:00"), utc("2100-01-01T00:00:00")])
def test_a_date_that_cannot_be_is_not_gone_on_with(utc_ns: int) -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    clock.resume((UtcKnown("gnss", host.mono - utc_ns, utc_ns, host.mono, 100),))
    assert clock.status().utc_source == "system"
