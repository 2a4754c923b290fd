"""The table of service, transition by transition, and what repeats."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.integrity.catalogue import carried_kinds, delay_kinds
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.integrity.fault_findings import Finding
from fusiond.integrity.position_velocity_agreement import Agreement
from fusiond.integrity.series_states import (
    DISAGREES,
    FORGET_NS,
    MOST_SURE,
    READMIT_COUNT,
    REFUSED_IN_A_ROW,
    RETURNS,
    STILL,
    Series,
    Service,
)
from fusiond.navigation.earth import meridian_radius

S = 1_000_000_000
GATE = 0.9999


def series() -> Series:
    return Series.of(position(0, 0.0))


def position(t_s: float, north_m: float) -> PositionMeasurement:
    lat = 0.5 + north_m / meridian_radius(0.5)
    return PositionMeasurement("gnss", round(t_s * S), GATE, lat, 2.0, 50.0, (1.5,) * 3, (0.0,) * 3)


def velocity(t_s: float, north_m_s: float) -> VelocityMeasurement:
    at = round(t_s * S)
    return VelocityMeasurement(
        "gnss_velocity", at, GATE, (north_m_s, 0.0, 0.0), (0.1,) * 3, (0.0,) * 3
    )


def test_one_failure_is_a_suspicion_that_a_pass_ends() -> None:
    one = series()
    one.gated(S, explained=False)
    assert one.state is Service.SUSPECTED
    one.fused(2 * S, (0.1, 0.1, 0.1))
    assert one.state is Service.NOMINAL


def test_three_failures_in_a_row_that_nothing_explains_end_service() -> None:
    one = series()
    for k in range(REFUSED_IN_A_ROW):
        assert not one.out
        one.gated(k * S, explained=False)
    assert one.out
    assert one.reason == DISAGREES
    assert one.since_ns == (REFUSED_IN_A_ROW - 1) * S


def test_failures_that_a_fault_of_the_unit_explains_do_not() -> None:
    one = series()
    for k in range(10):
        one.gated(k * S, explained=True)
    assert one.state is Service.SUSPECTED


def test_it_is_back_after_five_that_pass_in_a_row_and_proves_itself() -> None:
    one = series()
    one.exclude(10 * S, "gnss position is off")
    for k in range(READMIT_COUNT - 1):
        one.looked_at((11 + k) * S, passes=True)
    one.looked_at(15 * S, passes=False)
    assert one.out
    for k in range(READMIT_COUNT):
        assert one.out
        one.looked_at((20 + k) * S, passes=True)
    assert one.state is Service.PROBATION
    one.fused(38 * S, ())
    assert one.state is Service.PROBATION
    one.fused(39 * S, ())
    assert one.state is Service.NOMINAL
    assert not one.reason


def test_on_probation_one_failure_ends_service() -> None:
    """What was wrong comes again: nothing unexplained, which would speak against the filter
    (`Diagnosis.contradicts`)."""
    one = series()
    one.exclude(10 * S, "gnss position is off")
    for k in range(READMIT_COUNT):
        one.looked_at((20 + k) * S, passes=True)
    assert one.state is Service.PROBATION
    one.gated(26 * S, explained=True)
    assert one.out
    assert one.reason == "gnss position is off"


def test_time_alone_readmits_nothing() -> None:
    one = series()
    one.exclude(0, "gnss position is off")
    one.received(3600 * S)
    assert one.out


def test_a_fault_is_over_where_what_else_it_has_spoiled_says_so() -> None:
    """A position that stays where it was carried says nothing of that; the velocity does."""
    place, other = series(), series()
    for one in (place, other):
        one.exclude(0, "gnss is carried off")
    for k in range(READMIT_COUNT + 1):
        place.looked_at((60 + k) * S, passes=False, lasting=-12.0)
        other.looked_at((60 + k) * S, passes=False, lasting=-12.0, others=24.0)
    assert place.reason != STILL
    assert other.reason == STILL
    assert place.out
    assert other.out


def test_nothing_says_endlessly_that_a_fault_is_over() -> None:
    one = series()
    one.exclude(0, "gnss is carried off")
    for k in range(100):
        one.looked_at((60 + k) * S, passes=False, lasting=12.0)
    assert one.over == MOST_SURE


def test_many_innovations_of_one_filter_error_say_no_more_than_it_is_known_to() -> None:
    """Of a velocity that is off by two sigma of the filter's own, chance says that it is over."""
    one = series()
    one.exclude(0, "gnss velocity is off")
    for k in range(100):
        one.looked_at(20 * S + k * S // 5, passes=True, lasting=3.0, limit=4.0)
    assert one.over == 2.0
    assert one.out
    one.looked_at(42 * S, passes=True, lasting=3.0, limit=4.0)  # more likely over by its duration
    assert not one.out
    assert RETURNS < one.sure < RETURNS + 0.1


def test_the_end_of_one_fault_is_no_evidence_of_the_end_of_the_next() -> None:
    one = series()
    one.exclude(0, "a fault")
    for k in range(1, 20):
        one.looked_at(k * S, passes=True, lasting=100.0)
    assert not one.out
    one.exclude(40 * S, "another fault")
    for k in range(41, 61):
        one.looked_at(k * S, passes=False, lasting=-100.0)
        assert (one.out, one.reason) == (True, "another fault")


def test_what_was_not_heard_of_for_long_is_judged_anew() -> None:
    one = series()
    one.received(S)
    one.gated(S, explained=False)
    one.gated(2 * S, explained=False)
    one.received(2 * S + FORGET_NS)
    assert one.state is Service.NOMINAL
    one.gated(2 * S + FORGET_NS, explained=False)
    assert not one.out


@pytest.mark.parametrize("moving", [True, False])
def test_what_stands_may_repeat(moving: bool) -> None:
    one, place = series(), (0.5, 2.0)
    found = [one.repeats_itself(place, moving) for _ in range(5)]
    assert any(found) is moving


def test_a_copy_is_its_own() -> None:
    one = series()
    other = one.copied()
    other.noise[0] = 9.0
    other.gated(S, explained=False)
    assert one.noise[0] == 1.0
    assert one.state is Service.NOMINAL


def test_a_device_that_goes_the_way_it_says_fits_itself() -> None:
    agreement = Agreement()
    for second in range(8):
        agreement = agreement.with_measurement(position(second, 10.0 * second))
        agreement = agreement.with_measurement(velocity(second, 10.0))
    assert agreement.lasted_ns == 7 * S


def test_one_that_stands_and_says_that_it_moves_does_not() -> None:
    agreement = Agreement()
    for second in range(8):
        agreement = agreement.with_measurement(position(second, 0.0)).with_measurement(
            velocity(second, 10.0)
        )
    assert agreement.lasted_ns == 0


def test_what_repeats_itself_does_not_fit_itself() -> None:
    """A receiver that hangs says for a minute that it stands where it stands."""
    place, speed = Series.of(position(0, 0.0)), Series.of(velocity(0, 0.0))
    for repeats in (0, 1):
        diagnosis = Diagnosis()
        place.repeats = speed.repeats = repeats
        for second in range(8):
            diagnosis._agrees(position(second, 0.0), place)
            diagnosis._agrees(velocity(second, 0.0), speed)
        lasted = [known.lasted_ns for known in diagnosis._agreement.values()]
        assert lasted == ([] if repeats else [7 * S])


def excluded(reason: str) -> Diagnosis:
    """A device that has agreed with itself for 61 s, its series excluded."""
    diagnosis, agreement = Diagnosis(), Agreement()
    for second in range(62):
        agreement = agreement.with_measurement(position(second, 0.0))
        agreement = agreement.with_measurement(velocity(second, 0.0))
    diagnosis._agreement = {"gnss": agreement}
    for one in (position(0, 0.0), velocity(0, 0.0)):
        diagnosis.own(one).exclude(0, reason)
    return diagnosis


@pytest.mark.parametrize("passed", [0, 1, READMIT_COUNT])
def test_velocities_that_are_the_filters_leave_only_the_place_in_doubt(passed: int) -> None:
    """One that passes ends the contradiction; five in a row, and the place may be that of the
    device."""
    diagnosis = excluded("carried off")
    assert diagnosis.contradicts == "gnss"
    diagnosis.series["gnss_velocity"].passed = passed
    assert (diagnosis.contradicts is None) == (passed > 0)
    assert diagnosis._goes_its_own_way(diagnosis.series["gnss"]) == (passed == READMIT_COUNT)


@pytest.mark.parametrize("device", ["gnss", "second", "all"])
@pytest.mark.parametrize("late", [True, False])
def test_a_delayed_device_agrees_with_itself_and_is_not_believed(device: str, late: bool) -> None:
    """Its velocities pass at a constant speed; its place is behind, alone or with the others."""
    diagnosis = excluded("left out")
    kind = (delay_kinds if late else carried_kinds)(device)[0]
    if device == "all":
        kind = replace(kind, devices=("gnss", "second"))
    diagnosis.findings = (Finding(kind, 0, 0.0, (0.8,), (0.03,), 9.0),)
    diagnosis.series["gnss_velocity"].passed = READMIT_COUNT
    own_way = diagnosis._goes_its_own_way(diagnosis.series["gnss"])
    assert own_way == (not late or device == "second")


@pytest.mark.parametrize(
    ("reason", "own_way"), [(STILL, True), (DISAGREES, True), ("off by 50 m", False)]
)
def test_an_offset_that_lasts_agrees_with_itself_and_is_not_believed(
    reason: str, own_way: bool
) -> None:
    """The velocity is in service."""
    diagnosis = excluded(reason)
    diagnosis.series["gnss_velocity"].readmit(61 * S)
    assert diagnosis._goes_its_own_way(diagnosis.series["gnss"]) == own_way
