"""The fault matrix: its judge on made-up courses, its faults on a recording, a row end to end."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.measurements import DelayedFix, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.load import load_config
from fusiond.studies.faults import imu_faults, measurement_faults
from fusiond.studies.faults.error_sigma_score import (
    QUANTITIES,
    Course,
    Event,
    Sample,
    axis_ratio,
    longest_lie_s,
    recovered_s,
    row_figures,
)
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.library import FAULTS, PHASES
from fusiond.studies.faults.runs import VEHICLE, Row, rows, run_fault, run_row
from fusiond.studies.faults.sensor_data import Drive, Received, Recording

GOOD = (1.0,) * len(QUANTITIES)
BEGIN_S, END_S = 10.0, 20.0


def course(
    beyond: range = range(0), mode: str = "navigating", events: tuple[Event, ...] = ()
) -> Course:
    """Forty seconds; the yaw is six sigma off in the seconds of `beyond`, in that mode."""
    bad = (1.0, 1.0, 1.0, 6.0, 1.0)
    samples = [
        Sample(float(t), mode, bad, 3.0, -7.0)
        if t in beyond
        else Sample(float(t), "navigating", GOOD, 1.0, 0.5)
        for t in range(1, 41)
    ]
    return Course(samples, events)


def verdict(of: Course) -> str:
    return str(row_figures(of, course(), BEGIN_S, END_S)["verdict"])


def test_two_seconds_beyond_are_no_lie_and_three_are() -> None:
    assert verdict(course(range(12, 14))) == "survived"
    assert verdict(course(range(12, 15))) == "lie"


def test_seconds_beyond_that_are_apart_do_not_add_up() -> None:
    samples = list(course(range(12, 14)).samples)
    samples[14:16] = course(range(15, 17)).samples[14:16]  # one good second between
    assert longest_lie_s(samples) == 2.0


@pytest.mark.parametrize("quantity", range(len(QUANTITIES)))
def test_each_quantity_can_lie(quantity: int) -> None:
    ratios = tuple(5.1 if k == quantity else 0.0 for k in range(len(QUANTITIES)))
    samples = [Sample(float(t), "navigating", ratios) for t in range(1, 5)]
    found = row_figures(Course(samples, ()), course(), 1.0, 2.0)
    assert found["verdict"] == "lie"
    assert found["largest_ratio_of"] == QUANTITIES[quantity]


def test_quantities_that_take_turns_are_one_lie() -> None:
    samples = [
        Sample(float(t), "navigating", tuple(9.0 if k == t else 0.0 for k in range(5)))
        for t in range(4)
    ]
    assert longest_lie_s(samples) == 4.0


def test_exactly_five_sigma_is_no_lie() -> None:
    samples = [Sample(float(t), "navigating", (5.0,) * 5) for t in range(10)]
    assert longest_lie_s(samples) == 0.0


@pytest.mark.parametrize("mode", ["coasting", "invalid"])
def test_a_lie_is_one_in_any_mode_that_publishes(mode: str) -> None:
    found = row_figures(course(range(12, 30), mode), course(), BEGIN_S, END_S)
    assert found["verdict"] == "lie"
    assert found["lie_modes"] == {mode: 18}
    assert found["longest_lie_s"] == 18.0
    assert (found["largest_ratio"], found["largest_ratio_of"]) == (6.0, "yaw")
    assert found["noticed_s"] == 2.0
    assert found["largest_horizontal_m"] == 1.0  # errors in metres are those of `navigating`


def test_what_publishes_nothing_does_not_lie() -> None:
    silent = [Sample(s.t_s, "aligning") if 12.0 <= s.t_s < 30.0 else s for s in course().samples]
    found = row_figures(Course(silent, ()), course(), BEGIN_S, END_S)
    assert found["verdict"] == "degraded and said so"
    assert found["lie_modes"] == {}
    assert (found["noticed_s"], found["recovered_s"]) == (2.0, 10.0)


def test_a_lie_with_an_event_is_a_lie() -> None:
    event = Event(11.0, "verdict_too_small", "gnss")
    found = row_figures(course(range(12, 30), events=(event,)), course(), BEGIN_S, END_S)
    assert found["verdict"] == "lie"
    assert found["noticed_s"] == 1.0


def test_an_event_that_comes_without_the_fault_says_nothing() -> None:
    usual = Event(15.0, "verdict_coloured", "gnss")
    reference = course(events=(usual,))
    assert row_figures(reference, reference, BEGIN_S, END_S)["verdict"] == "survived"
    twice = course(events=(usual, replace(usual, t_s=18.0)))
    assert row_figures(twice, reference, BEGIN_S, END_S)["noticed_s"] == 8.0


def test_an_event_before_the_fault_does_not_notice_it() -> None:
    assert verdict(course(events=(Event(9.0, "isolated", "gnss"),))) == "survived"


def test_a_crash_comes_before_every_other_verdict() -> None:
    assert verdict(replace(course(range(12, 30)), crash="ValueError")) == "crashed"


def test_what_cannot_be_compared_is_beyond() -> None:
    for error, sigma in ((math.nan, 1.0), (1.0, math.nan), (1.0, 0.0), (1.0, math.inf)):
        assert axis_ratio(error, sigma) == math.inf
    assert axis_ratio(-3.0, 2.0) == 1.5
    samples = [Sample(float(t), "navigating", (math.inf,) * 5, math.nan) for t in range(1, 9)]
    found = row_figures(Course(samples, ()), course(), 1.0, 2.0)
    assert found["verdict"] == "lie"
    assert found["largest_ratio"] is None
    assert found["largest_horizontal_m"] is None


def test_recovery_is_five_good_seconds() -> None:
    assert recovered_s(course(range(12, 25)).samples, END_S) == 5.0
    assert recovered_s(course(range(12, 40)).samples, END_S) is None


# --------------------------------------------------------------------------- faults


def recording() -> Recording:
    """Thirty seconds at 10 Hz, a fix a second that comes 0.1 s late, RDSS and wheels."""
    stamps = np.arange(1, 301, dtype=np.int64) * 100_000_000
    samples = np.random.default_rng(0).standard_normal((300, 6))
    received = []
    for t in range(1_000_000_000, 30_000_000_000, 1_000_000_000):
        fix = PositionFix(
            "gnss", t, MonotonicStamp(t), 0.5, 2.0, 40.0, v_ned_m_s=(1.0, 2.0, float(t) * 1e-9)
        )
        late = DelayedFix("rdss", t, MonotonicStamp(t), 0.5, 2.0, 40.0, 20.0)
        wheel = WheelSpeed("wheel", t, MonotonicStamp(t), t * 1e-9)
        received += [Received(t, t + 100_000_000, m) for m in (fix, late, wheel)]
    return Recording(stamps, stamps, samples, tuple(received))


@pytest.mark.parametrize("name", sorted(EVERY))
def test_a_fault_alters_nothing_before_it_begins(name: str) -> None:
    alter = EVERY[name].alter
    if alter is None:
        assert (
            EVERY[name].configure is not None
            or name in {"none", "start_in_reverse"}
            or (EVERY[name].drive != EVERY["none"].drive)
        )
        return
    whole = recording()
    found = alter(whole, 10.0, 5.0)
    early = whole.imu_seen < 10_000_000_000
    np.testing.assert_array_equal(found.stamps[: early.sum()], whole.stamps[early])
    np.testing.assert_array_equal(found.samples[: early.sum()], whole.samples[early])

    def before(r: Recording) -> list[Received]:
        return [item for item in r.received if item.t_ns < 9_999_000_000]

    assert before(found) == before(whole)
    same_imu = np.array_equal(found.samples, whole.samples, equal_nan=True)
    same_stamps = np.array_equal(found.stamps, whole.stamps)
    assert not (same_imu and same_stamps and found.received == whole.received)


def test_a_step_is_500_m_to_the_north_in_the_window_alone() -> None:
    whole = recording()
    found = measurement_faults.position_step(whole, 10.0, 5.0)
    for was, now in zip(whole.received, found.received, strict=True):
        assert now.seen_ns == was.seen_ns
        if not isinstance(was.measurement, PositionFix):
            assert now == was
            continue
        assert isinstance(now.measurement, PositionFix)
        moved_m = (now.measurement.lat_rad - was.measurement.lat_rad) * 6.37e6
        inside = 10_000_000_000 <= was.t_ns < 15_000_000_000
        assert moved_m == pytest.approx(500.0 if inside else 0.0, rel=0.01)


def test_silence_is_a_gap_and_a_turned_mount_keeps_lengths() -> None:
    whole = recording()
    quiet = imu_faults.silent(whole, 10.0, 5.0)
    assert len(quiet.stamps) == len(whole.stamps) - 50
    assert np.diff(quiet.stamps).max() == 5_100_000_000
    turned = imu_faults.mount_turned(whole, 10.0, 5.0).samples
    for part in (slice(0, 3), slice(3, 6)):
        lengths = np.linalg.norm(turned[:, part], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(whole.samples[:, part], axis=1))


def test_stamps_and_rate_of_the_imu() -> None:
    whole = recording()
    halved = imu_faults.half_rate(whole, 10.0, 5.0)
    inside = (halved.imu_seen >= 10_000_000_000) & (halved.imu_seen < 15_000_000_000)
    pairs = whole.samples[99:149].reshape(25, 2, 6)
    np.testing.assert_allclose(halved.samples[inside], pairs.mean(axis=1))
    assert np.array_equal(halved.stamps[inside], whole.stamps[100:149:2])
    fast = imu_faults.clock_fast(whole, 10.0, 30.0, ppm=200.0)
    assert fast.stamps[-1] - whole.stamps[-1] == pytest.approx(200e-6 * 20e9, rel=0.01)
    behind = imu_faults.stamps_off(whole, 10.0, 5.0, -0.9)
    assert (whole.stamps - behind.stamps).max() == 900_000_000
    assert np.array_equal(behind.imu_seen, whole.imu_seen)


def test_noise_is_so_many_times_what_there_was() -> None:
    found = imu_faults.noisy(recording(), 0.0, 30.0, times=10.0)
    np.testing.assert_allclose(found.samples.std(axis=0), math.sqrt(101.0), rtol=0.2)


def test_absent_and_late_are_of_their_kinds() -> None:
    whole = recording()
    assert len(measurement_faults.removed(whole, 10.0, 5.0).received) == len(whole.received) - 15
    wheels = measurement_faults.removed(whole, 10.0, 5.0, WheelSpeed).received
    assert len(wheels) == len(whole.received) - 5
    assert len(measurement_faults.intermittent(whole, 10.0, 10.0, WheelSpeed).received) == 81
    late = [
        item
        for item in measurement_faults.wheels_delayed(whole, 10.0, 5.0, delay_s=0.5).received
        if item.t_ns % 1_000_000_000
    ]
    assert [item.t_ns for item in late] == [s * 1_000_000_000 + 500_000_000 for s in range(10, 15)]
    assert all(isinstance(item.measurement, WheelSpeed) for item in late)


def test_multipath_jumps_again_behind_the_tunnel() -> None:
    found = measurement_faults.multipath_tunnel_jump(recording(), 10.0, 10.0)
    moved = [
        item.t_ns // 1_000_000_000
        for item in found.received
        if isinstance(item.measurement, PositionFix) and item.measurement.lat_rad != 0.5
    ]
    assert moved == [10, 20]
    fixes = {
        item.t_ns // 1_000_000_000
        for item in found.received
        if isinstance(item.measurement, PositionFix | DelayedFix)
    }
    assert fixes == {*range(1, 11), *range(20, 30)}
    ends = measurement_faults.multipath_tunnel_jump(recording(), 10.0, 25.0)
    assert not any(
        item.t_ns > 11 * 10**9 for item in ends.received if item.measurement.source == "gnss"
    )


def test_every_fault_has_rows_and_begins_inside_the_drive() -> None:
    found = rows()
    assert {row.fault for row in found} == set(FAULTS)
    assert all(0.0 <= FAULTS[r.fault].begins_s(r.phase) < 220.0 for r in found)
    assert rows("none", "coasting") == [Row("none", "coasting")]
    begin, end = PHASES["coasting"].outage_s or (0.0, 0.0)
    assert begin + 10.0 < PHASES["coasting"].imu_s < end == PHASES["coasting"].fix_s


def test_the_vehicle_is_the_shipped_one() -> None:
    shipped = load_config(Path(__file__).parents[2] / "config" / "vehicle.toml")
    white = shipped.aiding["gnss"].model_copy(update={"bias_sd_m": 0.0})
    assert VEHICLE.aiding == {**shipped.aiding, "gnss": white}
    for section in ("imu", "constraints", "alignment", "estimator", "consistency"):
        assert getattr(VEHICLE, section) == getattr(shipped, section)


def test_a_row_repeats_and_nothing_wrong_is_survived() -> None:
    found = run_row(Row("none", "navigating"), seed=0)
    assert found["verdict"] == "survived"
    assert found["recovered_s"] is not None
    assert found["crash"] is None


def test_a_spare_says_that_it_may_sit_askew() -> None:
    """It does, by half a degree: its own tilt is soon known to a tenth of that."""
    drive = Drive(spare=True, duration_s=46.0)
    fault = replace(FAULTS["imu_silent_spare"], begin_s=26.0, drive=drive)
    found = run_fault(fault, "navigating", seed=0)
    assert found["verdict"] == "degraded and said so", found
    assert [event["code"] for event in found["events"]] == ["imu_spare"]
    assert found["largest_ratio"] < 5.0
    assert found["recovered_s"] is None  # it lasts
