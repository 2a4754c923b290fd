"""Sentences of one instant make one epoch: when it closes, what comes late, again or in pieces."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drivers.nmea.sentences import (
    GGA,
    GSA,
    GST,
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
