"""When an NMEA epoch was: midnight, leap second, week rollover, and trust in the receiver's UTC."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, date, datetime, timedelta
from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.measurements import Measurement, PositionFix, TimeOfDayStamp, TimeReport, UtcStamp
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.time import (
    SECOND_NS,
    Calendar,
    EpochOrder,
    TimeTrust,
    parse_time_of_day,
    posix_ns,
)


def nmea(body: str) -> bytes:
    return b"$%s*%02X\r\n" % (body.encode(), reduce(xor, body.encode(), 0))


def gga(time: str) -> bytes:
    return nmea(f"GNGGA,{time},3958.12345,N,11619.54321,E,1,18,0.62,45.3,M,-9.1,M,,")


def rmc(time: str, day: str, status: str = "A") -> bytes:
    return nmea(f"GNRMC,{time},{status},3958.12345,N,11619.54321,E,1.0,90.0,{day},,,A,V")


def zda(time: str, day: str) -> bytes:
    return nmea(f"GNZDA,{time},{day},00,00")


def utc_ns(*when: int) -> int:
    return int(datetime(*when, tzinfo=UTC).timestamp()) * SECOND_NS


def decoder(earliest: date = date(2016, 1, 1), **options: object) -> NmeaDecoder:
    return NmeaDecoder("gnss", NmeaDecoding.model_validate({"earliest_date": earliest, **options}))


def stamps(found: list[Measurement]) -> list[object]:
    return [m.stamp for m in found if isinstance(m, PositionFix)]


def reports(found: list[Measurement]) -> list[tuple[int, bool]]:
    return [(m.utc_ns, m.trusted) for m in found if isinstance(m, TimeReport)]


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("", None),
        ("000000", 0),
        ("000000.1", 100_000_000),
        ("021429.00", 8069 * SECOND_NS),
        ("074150.799", 27710 * SECOND_NS + 799_000_000),
        ("235959.999999999", 86400 * SECOND_NS - 1),
        ("235960", 86400 * SECOND_NS),
        ("235960.50", 86400 * SECOND_NS + 500_000_000),
    ],
)
def test_time_of_day(text: str, ns: int | None) -> None:
    assert parse_time_of_day(text) == ns


@pytest.mark.parametrize(
    "text", ["240000", "236000", "120060", "225960", "12", "1200.0", "-10000", "12000a", "120000."]
)
def test_times_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="time of day"):
        parse_time_of_day(text)


def test_position_before_the_date_of_the_new_day() -> None:
    """GGA comes before RMC, and at 00:00:00 RMC has the new date in the same epoch."""
    one = decoder()
    found = one.feed(gga("235959.00") + rmc("235959.00", "311225"), 0)
    found += one.feed(gga("000000.00") + rmc("000000.00", "010126"), SECOND_NS)
    found += one.flush()
    first = utc_ns(2025, 12, 31, 23, 59, 59)
    assert stamps(found) == [UtcStamp(first), UtcStamp(first + SECOND_NS)]


def test_undated_epochs_cross_midnight() -> None:
    """The date came once, an hour before; GGA alone carries on."""
    one = decoder()
    found = one.feed(gga("233000.00") + rmc("233000.00", "311225"), 0)
    for i, time in enumerate(("235959.90", "000000.00", "000000.10")):
        found += one.feed(gga(time), 1_799_900_000_000 + i * 100_000_000)
    found += one.flush()
    start = utc_ns(2025, 12, 31, 23, 59, 59)
    assert stamps(found)[1:] == [
        UtcStamp(start + 900_000_000),
        UtcStamp(start + 1_000_000_000),
        UtcStamp(start + 1_100_000_000),
    ]


def test_leap_second_repeats_the_count_of_the_second_before() -> None:
    """31 December 2016: 23:59:60 is an epoch of its own, in order, and keeps the date."""
    one = decoder()
    found: list[Measurement] = []
    for i, (time, day) in enumerate(
        [("235959.00", "311216"), ("235960.00", "311216"), ("000000.00", "010117")]
    ):
        found += one.feed(gga(time) + rmc(time, day), i * SECOND_NS)
    found += one.flush()
    last = utc_ns(2016, 12, 31, 23, 59, 59)
    assert stamps(found) == [UtcStamp(last), UtcStamp(last), UtcStamp(last + SECOND_NS)]
    assert one.counters["duplicate_epoch"] == one.counters["backward_epoch"] == 0


def test_leap_second_without_a_date() -> None:
    one = decoder()
    found = one.feed(gga("235959.50") + gga("235960.00") + gga("235960.50") + gga("000000.00"), 0)
    found += one.flush()
    assert stamps(found) == [TimeOfDayStamp(t) for t in (86399.5, 86400.0, 86400.5, 0.0)]


def test_a_date_before_the_build_is_a_week_rollover() -> None:
    """1024 weeks early: refused by name; the fix keeps its time of day."""
    early = datetime(2026, 12, 1, tzinfo=UTC) - timedelta(weeks=1024)
    one = NmeaDecoder("gnss")
    found = one.feed(gga("120000.00") + rmc("120000.00", f"{early:%d%m%y}"), 0) + one.flush()
    assert stamps(found) == [TimeOfDayStamp(43200.0)]
    assert reports(found) == []
    assert one.counters["implausible_date"] == 1
    found = one.feed(gga("120001.00") + rmc("120001.00", "011226"), 0) + one.flush()
    assert stamps(found) == [UtcStamp(utc_ns(2026, 12, 1, 12, 0, 1))]


@pytest.mark.parametrize("day", ["060180", "010100", "191126"])
def test_dates_of_cold_receivers(day: str) -> None:
    one = NmeaDecoder("gnss")
    one.feed(rmc("120000.00", day), 0)
    one.flush()
    assert one.counters["implausible_date"] == 1


def test_zda_far_in_the_future() -> None:
    one = decoder()
    found = one.feed(gga("120000.00") + zda("120000.00", "31,12,9999") + gga("120001.00"), 0)
    found += one.flush()
    assert one.counters["implausible_date"] == 1
    assert stamps(found) == [TimeOfDayStamp(43200.0), TimeOfDayStamp(43201.0)]


# --------------------------------------------------------------------------- trust


def seconds(count: int, *, start: int = 0, status: str = "A") -> list[bytes]:
    return [rmc(f"1200{start + i:02d}.00", "190625", status) for i in range(count)]


def test_time_is_trusted_after_two_even_steps() -> None:
    one = decoder(last_sentence="RMC")
    found = [m for i, s in enumerate(seconds(5)) for m in one.feed(s, i * SECOND_NS)]
    assert [trusted for _, trusted in reports(found)] == [False, False, True, True, True]
    assert reports(found)[0][0] == utc_ns(2025, 6, 19, 12, 0, 0)


def test_steps_count_without_a_clock() -> None:
    """Read from a file every byte is seen at once: equal steps are enough."""
    one = decoder()
    found = one.feed(b"".join(seconds(6)), 0) + one.flush()
    assert [trusted for _, trusted in reports(found)] == [False, False, False, True, True, True]


def test_time_is_not_trusted_while_the_receiver_says_void() -> None:
    one = decoder(last_sentence="RMC")
    found = [m for i, s in enumerate(seconds(4, status="V")) for m in one.feed(s, i * SECOND_NS)]
    for i, sentence in enumerate(seconds(4, start=4)):
        found += one.feed(sentence, (4 + i) * SECOND_NS)
    assert [t for _, t in reports(found)] == [False] * 4 + [False, True, True, True]


def test_a_jump_costs_the_trust() -> None:
    """18 leap seconds are learned in the middle."""
    one = decoder(last_sentence="RMC")
    sentences = seconds(4, start=30) + seconds(4, start=16)
    found = [m for i, s in enumerate(sentences) for m in one.feed(s, i * SECOND_NS)]
    assert [t for _, t in reports(found)] == [False, False, True, True, False, False, True, True]


def test_a_lost_sentence_does_not_cost_the_trust() -> None:
    one = decoder(last_sentence="RMC")
    found: list[Measurement] = []
    for i, sentence in enumerate(seconds(8)):
        if i != 4:
            found += one.feed(sentence, i * SECOND_NS + (i % 3) * 40_000_000)
    assert [t for _, t in reports(found)] == [False, False, True, True, True, True, True]


def test_one_report_an_epoch_seen_when_the_sentence_came() -> None:
    one = decoder()
    one.feed(gga("120000.00"), 100)
    one.feed(rmc("120000.00", "190625"), 200)
    one.feed(zda("120000.00", "19,06,2025"), 300)
    (report, fix) = one.flush()
    assert isinstance(report, TimeReport)
    assert report.t_seen_ns == 200
    assert fix.t_seen_ns == 300


def test_zda_is_as_valid_as_the_position_beside_it() -> None:
    one = decoder(last_sentence="ZDA")
    found: list[Measurement] = []
    for i in range(3):
        time = f"12000{i}.00"
        found += one.feed(zda(time, "19,06,2025"), i * SECOND_NS)
    for i in range(3, 7):
        time = f"12000{i}.00"
        found += one.feed(gga(time) + zda(time, "19,06,2025"), i * SECOND_NS)
    assert [t for _, t in reports(found)] == [False] * 4 + [True] * 3


# --------------------------------------------------------------------------- properties


@given(
    st.dates(date(2020, 1, 1), date(2060, 1, 1)),
    st.integers(0, 86_399),
    st.integers(-43_000, 43_000),
)
def test_calendar_finds_the_date_up_to_half_a_day_away(day: date, second: int, away: int) -> None:
    calendar = Calendar(date(2020, 1, 1), Counter())
    calendar.dated(day, second * SECOND_NS, 0)
    truth = datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(seconds=second + away)
    since_midnight = truth - truth.replace(hour=0, minute=0, second=0)
    assert calendar.date_of(since_midnight.seconds * SECOND_NS, 0) == truth.date()


@given(st.integers(0, 10**6), st.lists(st.integers(1, 40_000), max_size=20))
def test_order_accepts_every_forward_step_across_midnights(start: int, steps: list[int]) -> None:
    order = EpochOrder(Counter())
    second = start
    for step in [0, *steps]:
        second += step
        assert order.accept(None, second % 86_400 * SECOND_NS)
        assert not order.accept(None, second % 86_400 * SECOND_NS)


def test_posix_time_and_trust_of_a_repeated_report() -> None:
    assert posix_ns(date(1970, 1, 2), 0) == 86_400 * SECOND_NS
    trust = TimeTrust()
    assert trust.report(0, 0, valid=True) is False
    assert trust.report(0, 50, valid=True) is None


def test_a_second_that_comes_twice_is_told_and_not_trusted() -> None:
    """A leap second at 1 Hz, or a receiver that learns its leap seconds: the clock must hear."""
    trust = TimeTrust()
    said = [trust.report(t * SECOND_NS, t * SECOND_NS, valid=True) for t in range(5)]
    assert said == [False, False, True, True, True]
    said = [trust.report((t - 1) * SECOND_NS, t * SECOND_NS, valid=True) for t in range(5, 9)]
    assert said == [False, False, True, True]
