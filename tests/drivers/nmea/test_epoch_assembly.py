"""Sentences of one instant make one epoch: when it closes, what comes late, again or in pieces."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.measurements import ArrivalStamp, Heading, Measurement, UtcStamp
from tests.drivers.nmea.sentences import (
    GGA,
    GSA,
    GST,
    HDT,
    RMC,
    VTG,
    ZDA,
    at,
    changed,
    decode,
    decoder,
    fixes,
    wire,
)


def seconds(start: int, count: int, *cycle: str) -> list[list[str]]:
    """`count` epochs of a cycle of golden sentences, one second apart."""
    return [
        [at(s, f"0214{start + i:02d}.00") if "021429.00" in s else s for s in cycle]
        for i in range(count)
    ]


def test_epoch_closes_on_the_next_time() -> None:
    one = decoder()
    first, second = seconds(10, 2, GGA, RMC)
    assert not fixes(one.feed(wire(*first), 1))
    (fix,) = fixes(one.feed(wire(second[0]), 2))
    assert fix.t_seen_ns == 1  # what came later belongs to the next


def test_epoch_closes_on_silence() -> None:
    one = decoder()
    one.feed(wire(GGA), 1)
    assert one.epoch_open
    assert len(fixes(one.silence())) == 1
    assert not one.epoch_open
    assert one.silence() == []


def test_epoch_closes_on_the_configured_last_sentence() -> None:
    one = decoder(last_sentence="GST")
    for epoch in seconds(10, 3, GGA, RMC, GST):
        assert len(fixes(one.feed(wire(*epoch), 1))) == 1


def test_last_sentence_is_learned_from_two_equal_cycles() -> None:
    one = decoder()
    closed_at_once = []
    for epoch in seconds(10, 6, RMC, VTG, GGA, GSA, GSA, GST):
        for sentence in epoch[:-1]:
            one.feed(wire(sentence), 1)
        closed_at_once.append(len(fixes(one.feed(wire(epoch[-1]), 2))))
    assert closed_at_once == [0, 0, 1, 1, 1, 1]
    assert one.counters["fixes"] == 6


def test_a_lost_sentence_only_delays_its_own_epoch() -> None:
    one = decoder()
    epochs = seconds(10, 8, RMC, GGA, GST)
    del epochs[4][2]
    found = [m for epoch in epochs for m in one.feed(wire(*epoch), 1)]
    assert [f.sd_ned_m is None for f in fixes(found)] == [i == 4 for i in range(8)]
    assert one.counters["late_sentence"] == 0


def test_slower_sentences_make_it_unlearn() -> None:
    """GGA at every epoch, RMC at every fourth: a cycle of GGA alone was too short to learn."""
    one = decoder()
    found = []
    for i, (gga, rmc) in enumerate(seconds(10, 24, GGA, RMC)):
        found += one.feed(wire(*([gga, rmc] if i % 4 == 3 else [gga])), 1)
    found += one.flush()
    assert len(fixes(found)) == 24
    assert one.counters["late_sentence"] == 1
    with_velocity = [i for i, f in enumerate(fixes(found)) if f.v_ned_m_s is not None]
    assert with_velocity == [7, 11, 15, 19, 23]


def test_slower_sentence_without_a_time_never_moves_to_the_next_epoch() -> None:
    one = decoder()
    found = []
    for i, (gga, vtg) in enumerate(seconds(10, 16, GGA, VTG)):
        found += one.feed(wire(*([gga, vtg] if i % 4 == 3 else [gga])), 1)
    found += one.flush()
    with_velocity = [i for i, f in enumerate(fixes(found)) if f.v_ned_m_s is not None]
    assert with_velocity == [7, 11, 15]
    assert one.counters["late_sentence"] == 1


def test_what_comes_after_the_configured_last_sentence_is_late() -> None:
    one = decoder(last_sentence="GGA")
    for epoch in seconds(10, 4, GGA, VTG):
        assert [f.v_ned_m_s for f in fixes(one.feed(wire(*epoch), 1))] == [None]
    assert one.counters["late_sentence"] == 4


def test_repeated_sentences_of_one_epoch() -> None:
    found, one = decode(GGA, changed(GGA, "GN", "GP"), RMC)
    assert len(fixes(found)) == 1
    assert one.counters["repeated_sentence"] == 1


@pytest.mark.parametrize("burst", [(GGA, VTG, RMC), (RMC, GGA), (VTG, GGA, RMC), (RMC, VTG, GGA)])
@pytest.mark.parametrize("doubled", ["each", "burst"])
def test_a_line_that_says_everything_twice(burst: tuple[bytes, ...], doubled: str) -> None:
    """Two ports of one receiver in one log: each epoch once, with all that it has."""
    epochs = [
        [*epoch, *epoch] if doubled == "burst" else [s for s in epoch for _ in range(2)]
        for epoch in seconds(10, 8, *burst)
    ]
    one = decoder()
    found = one.feed(b"".join(wire(*epoch) for epoch in epochs), 1) + one.flush()
    assert [fix.v_ned_m_s is not None for fix in fixes(found)] == [True] * 8
    assert one.counters["late_sentence"] <= len(burst), "until the cycle is learned"


def test_repeated_and_backward_epochs() -> None:
    one = decoder(last_sentence="RMC")
    for time in ("021430.00", "021430.00", "021429.00", "021431.00", "021430.50", "021432.00"):
        one.feed(wire(at(GGA, time), at(RMC, time)), 1)
    assert one.counters["fixes"] == 3
    assert one.counters["duplicate_epoch"] == 1
    assert one.counters["backward_epoch"] == 2


def test_a_receiver_that_sets_its_clock_back_is_followed() -> None:
    one = decoder(last_sentence="RMC")
    times = ["021450.00"] + [f"0214{s}.00" for s in range(32, 37)]
    found = [m for t in times for m in one.feed(wire(at(GGA, t), at(RMC, t)), 1)]
    assert len(fixes(found)) == 1 + 3
    assert one.counters["backward_epoch"] == 2
    assert one.counters["time_set_back"] == 1


def test_an_endless_epoch_is_bounded() -> None:
    one = decoder()
    one.feed(wire(GGA, *[GSA] * 1000), 1)
    assert one.counters["epochs"] >= 40


@given(st.integers(1, 60))
@settings(max_examples=20)
def test_any_chunks_give_the_same_measurements(size: int) -> None:
    stream = wire(*(s for epoch in seconds(10, 5, RMC, VTG, GGA, GSA, GST, ZDA) for s in epoch))
    one = decoder()
    found = [m for i in range(0, len(stream), size) for m in one.feed(stream[i : i + size], 1)]
    other = decoder()
    assert found + one.flush() == other.feed(stream, 1) + other.flush()
    assert one.counters == other.counters


def test_a_time_with_other_decimals_is_the_same_time() -> None:
    """Magellan 315 prints .76 in GGA and .758 elsewhere; a ZDA has whole seconds."""
    one = decoder()
    found = []
    for gga, rmc, zda in seconds(10, 4, GGA, RMC, ZDA):
        sentences = (
            changed(gga, ".00,", ".76,"),
            changed(rmc, ".00,", ".758,"),
            changed(zda, ".00,", ","),
        )
        found += one.feed(wire(*sentences), 1)
    found += one.flush()
    assert [f.v_ned_m_s is not None for f in fixes(found)] == [True] * 4
    assert one.counters["epochs"] == 4
    assert one.counters["late_sentence"] == 0


def test_epochs_a_step_of_the_last_digit_apart_are_two() -> None:
    fine, _ = decode(*(changed(GGA, "29.00,", f"29.{i:02d},") for i in range(10)))
    assert len(fixes(fine)) == 10
    whole, _ = decode(*(changed(GGA, "021429.00,", f"0214{29 + i},") for i in range(10)))
    assert len(fixes(whole)) == 10


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("29.76", "29.758", True),
        ("29.76", "29.754", False),
        ("29.76", "29.764", True),
        ("29.76", "29.7699", True),
        ("29", "29.90", True),
        ("30", "29.90", False),
        ("29.9", "29.95", True),
        ("29.90", "29.91", False),
        ("29.00", "29", True),
    ],
)
def test_decimals_that_are_cut_or_rounded(one: str, other: str, same: bool) -> None:
    for first, second in ((one, other), (other, one)):
        pair = changed(GGA, "29.00", first), changed(RMC, "29.00", second)
        (fix,) = fixes(decode(*pair)[0])
        assert (fix.v_ned_m_s is not None) is same
        if same:  # and the time with more decimals is that of the fix
            assert isinstance(fix.stamp, UtcStamp)
            finer = max(one, other, key=lambda text: len(text.partition(".")[2]))
            assert fix.stamp.utc_ns % 60_000_000_000 == round(float(finer) * 1e9)


class Line:
    """A decoder on a line with a clock: bursts, and silences of more than 50 ms between them."""

    def __init__(self) -> None:
        self.decoder = decoder()
        self.now_ms = 0
        self.found: list[Measurement] = []

    def burst(self, *sentences: str, after_ms: int) -> None:
        """`sentences` come together, `after_ms` after what came before."""
        if after_ms > 50:
            self.found += self.decoder.silence()
        self.now_ms += after_ms
        self.found += self.decoder.feed(wire(*sentences), self.now_ms * 1_000_000)

    @property
    def velocities(self) -> list[bool]:
        """Of each fix, whether it has one."""
        return [f.v_ned_m_s is not None for f in fixes(self.found)]


def test_a_pause_inside_an_epoch_is_learned_at_once() -> None:
    """GGA, 120 ms, RMC of the same hhmmss.ss."""
    line = Line()
    for gga, rmc in seconds(10, 8, GGA, RMC):
        line.burst(gga, after_ms=880)
        line.burst(rmc, after_ms=120)
    assert line.velocities == [False] + [True] * 7
    assert line.decoder.counters["late_sentence"] == 1
    assert line.decoder.counters["epochs"] == 9
    seen_ms = [f.t_seen_ns // 1_000_000 for f in fixes(line.found)]
    assert seen_ms[1:] == [1000 * i for i in range(2, 9)]


def test_several_pauses_inside_an_epoch() -> None:
    line = Line()
    for gga, rmc, gst in seconds(10, 9, GGA, RMC, GST):
        line.burst(gga, after_ms=700)
        line.burst(rmc, after_ms=150)
        line.burst(gst, after_ms=150)
    assert line.velocities[2:] == [True] * 7
    assert all(f.sd_ned_m is not None for f in fixes(line.found)[3:])


def test_an_epoch_that_begins_with_rmc_and_pauses() -> None:
    line = Line()
    for rmc, gga in seconds(10, 8, RMC, GGA):
        line.burst(rmc, after_ms=880)
        line.burst(gga, after_ms=120)
    assert line.velocities == [False] + [True] * 7
    assert line.decoder.counters["rmc_alone"] == 0


def test_rmc_takes_no_place_of_a_gga_that_comes_behind_two_pauses() -> None:
    """RMC, GSA and GGA of one instant, 120 ms apart: while that is learned nothing is RMC's."""
    line = Line()
    for rmc, gga in seconds(10, 8, RMC, GGA):
        line.burst(rmc, after_ms=760)
        line.burst(GSA, after_ms=120)
        line.burst(gga, after_ms=120)
    assert all(f.height_m is not None for f in fixes(line.found))
    assert line.decoder.counters["rmc_alone"] == 0
    assert line.velocities[2:] == [True] * (len(line.velocities) - 2)


def test_a_velocity_without_a_time_after_a_pause_stays_with_its_own_epoch() -> None:
    """VTG has no time: it belongs to the epoch that is nearer, before it or after."""
    line = Line()
    kmh = [changed(VTG, "19.438", f"{10 + i}.000") for i in range(8)]
    for (gga,), vtg in zip(seconds(10, 8, GGA), kmh, strict=True):
        line.burst(gga, after_ms=880)
        line.burst(vtg, after_ms=120)
    line.found += line.decoder.flush()
    speeds = [f.v_ned_m_s and f.v_ned_m_s[1] * 3600 / 1852 for f in fixes(line.found)]
    assert speeds[0] is None
    assert [round(s or 0.0) for s in speeds[1:]] == [11, 12, 13, 14, 15, 16, 17]
    ahead = Line()
    for (gga,), vtg in zip(seconds(10, 8, GGA), kmh, strict=True):
        ahead.burst(vtg, after_ms=880)
        ahead.burst(gga, after_ms=120)
    ahead.found += ahead.decoder.flush()
    speeds = [f.v_ned_m_s and f.v_ned_m_s[1] * 3600 / 1852 for f in fixes(ahead.found)]
    assert [round(s or 0.0) for s in speeds] == [10, 11, 12, 13, 14, 15, 16, 17]


def test_a_burst_without_a_pause_loses_no_latency() -> None:
    line = Line()
    for i, epoch in enumerate(seconds(10, 4, GGA, RMC)):
        line.burst(*epoch, after_ms=1000)
        assert len(fixes(line.found)) == (i + 1 if i >= 2 else i)


def test_headings_between_the_fixes_are_never_given_the_time_of_one() -> None:
    """HDT at 5 Hz beside GGA and RMC at 1 Hz."""
    line = Line()
    for gga, rmc in seconds(10, 6, GGA, RMC):
        line.burst(gga, rmc, after_ms=200)
        for _ in range(4):
            line.burst(HDT, after_ms=200)
    line.found += line.decoder.flush()
    assert line.velocities == [True] * 6
    headings = [m for m in line.found if isinstance(m, Heading)]
    assert len(headings) == 24
    assert all(m.stamp == ArrivalStamp() for m in headings)


def test_pauses_at_ever_new_places_are_bounded() -> None:
    line = Line()
    for i, (gga, rmc, gst) in enumerate(seconds(0, 59, GGA, RMC, GST)):
        line.burst(*[GSA] * (i % 20), gga, after_ms=700)
        line.burst(rmc, after_ms=100)
        line.burst(gst, after_ms=200)
    assert line.decoder.counters["fixes"] == 59


@pytest.mark.parametrize("first", ["GGA", "RMC"])
@pytest.mark.parametrize(("fast_hz", "slow_hz"), [(50, 1), (20, 5), (10, 1)])
def test_mixed_rates_are_learned_by_the_phase_of_the_second(
    first: str, fast_hz: int, slow_hz: int
) -> None:
    """RMC at 50 Hz and GGA at 1 Hz: no epoch waits for the next one to know that it is over."""
    one = decoder()
    for k in range(6 * fast_hz):
        seconds, hundredths = divmod(100 * k // fast_hz, 100)
        time = f"0214{seconds:02d}.{hundredths:02d}"
        burst = [at(RMC, time)]
        if k % (fast_hz // slow_hz) == 0:
            burst.insert(0 if first == "GGA" else 1, at(GGA, time))
        found = fixes(one.feed(wire(*burst), k * 1_000_000_000 // fast_hz))
        if seconds >= 4:
            assert [fix.v_ned_m_s is not None for fix in found] == [True], time
            assert (found[0].height_m is None) == (len(burst) == 1)
    assert one.counters["late_sentence"] <= 1
    assert one.counters["gga_awaited"] <= 2 * slow_hz, "until it is learned"


def test_a_sentence_once_in_five_seconds_costs_one_fix_and_is_waited_for_from_then_on() -> None:
    one = decoder()
    found = []
    for k in range(200):
        time = f"02{14 + k // 600:02d}{k // 10 % 60:02d}.{k % 10}0"
        burst = [at(GGA, time)] + [at(RMC, time)] * (k % 50 == 49)
        found += fixes(one.feed(wire(*burst), k * 100_000_000))
    found += fixes(one.flush())
    assert len(found) == 200
    with_velocity = [k for k, fix in enumerate(found) if fix.v_ned_m_s is not None]
    assert with_velocity == [99, 149, 199]
    assert one.counters["late_sentence"] == 1
