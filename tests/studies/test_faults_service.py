"""Service: what is drawn and told, what a fault of fixes does, and what counts as out and lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.measurements import PositionFix
from fusiond.studies.faults.matched_noise_drives import (
    CODE,
    RTK,
    SHARED_S,
    SHARES,
    SHARING,
    Vehicle,
    part_generator,
    scene,
)
from fusiond.studies.faults.measurement_faults import frozen_fix
from fusiond.studies.faults.runs import ANTENNA_M
from fusiond.studies.faults.sensor_data import Recording
from fusiond.studies.faults.service import (
    AFTER_OUTAGES,
    BEGINS_S,
    FAULTS,
    IMU,
    LASTS_S,
    NONE,
    OUTAGES_S,
    RECEIVERS,
    Job,
    figures,
    jobs,
    service_run,
    stale_fixes,
)
from fusiond.studies.faults.solution_errors import (
    STEP_S,
    Published,
    lasting_from,
    longest_s,
    published_errors,
)
from fusiond.studies.faults.tables import TABLES


def fixes(recording: Recording) -> list[PositionFix]:
    return [r.measurement for r in recording.received if isinstance(r.measurement, PositionFix)]


def course(seconds: float = 100.0, error_m: float = 0.0, sigma: float = 1.0) -> Published:
    """One that navigates, with one error to the north."""
    n = round(seconds / STEP_S)
    errors = np.zeros((n, 9))
    errors[:, 0] = error_m
    modes = np.full(n, "navigating", dtype="<U12")
    t_s = np.arange(1.0, n + 0.5) * STEP_S
    return Published(t_s, errors, np.full((n, 9), sigma), modes, (), None)


def test_what_is_scored_is_not_what_is_looked_at() -> None:
    firsts = {(s, k): float(part_generator(s, k, 0).uniform()) for s in SHARES for k in range(50)}
    assert len(set(firsts.values())) == 100
    assert firsts["looked", 3] == part_generator("looked", 3, 0).uniform()
    vehicle = Vehicle("mems", CODE)
    one, same, other = (scene(vehicle, s, 0, 60.0) for s in ("looked", "looked", "scored"))
    assert np.array_equal(one.recording.samples, same.recording.samples)
    assert fixes(one.recording) == fixes(same.recording) != fixes(other.recording)


def test_a_drive_has_the_same_motion_with_any_receiver() -> None:
    by_code, by_phase = (scene(Vehicle("mems", r), "looked", 1, 60.0) for r in (CODE, RTK))
    assert np.array_equal(by_code.recording.samples, by_phase.recording.samples)
    assert {fix.quality for fix in fixes(by_phase.recording)} == {RTK.quality}


def test_fixes_state_what_they_have_of_their_own_where_the_rest_is_told() -> None:
    told = scene(Vehicle("mems", SHARING), "looked", 0, 30.0)
    section = told.config.aiding["gnss"].model_dump()
    assert (section["bias_sd_m"], section["bias_down_sd_m"]) == SHARING.shared_m
    assert section["bias_correlation_s"] == SHARED_S
    assert {fix.sd_ned_m for fix in fixes(told.recording)} == {(0.8, 0.8, 1.6)}
    by_class = scene(Vehicle("mems", SHARING, told="class"), "looked", 0, 30.0)
    assert all(fix.sd_ned_m == pytest.approx((1.7, 1.7, 3.4)) for fix in fixes(by_class.recording))
    assert by_class.config.aiding["gnss"].model_dump()["bias_sd_m"] is None


def test_a_lever_arm_that_is_not_given_is_there() -> None:
    vehicle = Vehicle("mems", RTK, lever_given=False)
    assert "lever_arm_m" not in vehicle.config().aiding["gnss"].model_fields_set
    found = []
    for number in range(3):
        on = scene(vehicle, "looked", number, 14.0)  # at rest
        heights = [fix.height_m for fix in fixes(on.recording)]
        found.append(float(np.mean(heights)) - on.truth.position[0, 2])  # type: ignore[arg-type]
    assert len({round(up, 2) for up in found}) == 3
    assert max(abs(up + ANTENNA_M[2]) for up in found) > 0.1


def test_a_typical_unit_is_better_than_its_class_and_no_less_noisy() -> None:
    vehicle = Vehicle("mems", CODE, told="class")
    config, unit = vehicle.config().imu, vehicle.unit().imu
    assert unit.gyro_bias_initial_deg_h == config.gyro_bias_initial_deg_h / 3.0
    assert unit.gyro_noise_deg_sqrt_h == config.gyro_noise_deg_sqrt_h
    assert Vehicle("mems", CODE).unit() == Vehicle("mems", CODE).config()


def test_late_fixes_say_what_was_true_before() -> None:
    recording = scene(Vehicle("mems", CODE), "looked", 0, 60.0).recording
    before, after = fixes(recording), fixes(stale_fixes(recording, 40.0, 10.0, 3.0))
    assert [fix.stamp for fix in before] == [fix.stamp for fix in after]
    moved = [k for k in range(len(before)) if before[k] != after[k]]
    assert moved == list(range(39, 49))  # those that are valid from 40 s to before 50 s
    for k in moved:
        assert after[k].lat_rad == before[k - 3].lat_rad
        assert after[k].v_ned_m_s == before[k - 3].v_ned_m_s


def test_what_has_no_number_is_infinite_and_what_is_not_published_nothing() -> None:
    run = course(1.0)
    run.sigmas[2, 8] = np.nan
    run.sigmas[3, 0] = 0.0
    run.modes[4:6] = "aligning"
    run.errors[4:6] = np.nan
    assert np.flatnonzero(run.beyond).tolist() == [2, 3]
    assert not run.there[4:6].any()


@pytest.mark.parametrize(("text", "longest"), [("", 0.0), ("0110111", 0.3), ("1", 0.1)])
def test_longest(text: str, longest: float) -> None:
    assert longest_s(np.array([c == "1" for c in text], dtype=bool)) == pytest.approx(longest)


def test_lasting() -> None:
    where = np.array([True, False, True, True, True])
    assert lasting_from(where, 1) == 0
    assert lasting_from(where, 3) == 2
    assert lasting_from(where, 4) is None


def test_time_out_lies_and_settling_count_from_the_begin() -> None:
    steady = course()
    run = replace(course(), errors=steady.errors.copy(), sigmas=steady.sigmas.copy())
    run.errors[300:330, 0] = 7.0  # 3 s in a mode that does not vouch
    run.errors[100:110, 0] = 9.0  # before the fault
    run.modes[290:460] = "coasting"
    run.sigmas[400:650, :3] = 1.6
    found = figures(run, steady, begin_s=20.0, end_s=40.0)
    assert found["out_s"] == pytest.approx(17.0)
    assert found["out_after_s"] == pytest.approx(6.1)
    assert found["longest_lie_s"] == pytest.approx(3.0)
    assert found["lies"]
    assert found["lie_modes"] == {"coasting": 30}
    assert found["longest_lie_of_s"]["position"] == pytest.approx(3.0)
    assert found["longest_lie_of_s"]["yaw"] == 0.0
    assert found["largest_m"] == 7.0
    assert found["settled_s"]["position"] == pytest.approx(25.1)
    assert found["settled_s"]["yaw"] == 0.0
    run.sigmas[-20:, 8] = 2.0
    run.sigmas[400:-20, 8] = 1.51
    assert figures(run, steady, 20.0, 40.0)["settled_s"]["yaw"] is None


def test_every_fault_begins_where_there_is_time_before_and_after() -> None:
    assert len(FAULTS) == 19
    assert len(jobs(2)) == 2 * (len(RECEIVERS) * 20 + len(AFTER_OUTAGES))
    assert sum(group == IMU for group, _ in FAULTS.values()) == 5


def test_one_of_each_is_run_and_told() -> None:
    none, step, outages = (
        service_run(Job(0, receiver, fault), "looked")
        for receiver, fault in (("code", ""), ("code", "position off by 10 m"), ("RTK, 1 Hz", None))
    )
    assert none["out_s"] == 0.0
    assert not none["lies"]
    assert none["largest_m"] < 6.0
    assert BEGINS_S[0] <= step["begin_s"] <= BEGINS_S[1]
    assert step["begin_s"] != none["begin_s"]
    assert step["crash"] is None
    assert [each["length_s"] for each in outages["outages"]] == list(OUTAGES_S.values())
    assert all(each["navigating_s"] < 30.0 for each in outages["outages"])
    text = TABLES["service"]([none, {**step, "lies": True, "out_s": 61.0}, outages])
    assert f"| {NONE} | code | 1 | 0 |" in text
    assert "| position off by 10 m | code | 1 | 1 (100 %) |" in text
    assert "| 61 | 61 |" in text
    assert "| RTK, 1 Hz | 30 |" in text
    assert "3 runs on 1 drives; 0 ended the navigator." in text


def test_what_is_published_is_compared_with_the_truth_at_10_hz() -> None:
    on = scene(Vehicle("mems", RTK), "looked", 0, 60.0)
    run = published_errors(on.config, on.recording, on.truth)
    assert len(run.t_s) == 600
    late = run.there & (run.t_s > 50.0)
    assert late.sum() == 100
    assert run.horizontal_m[late].max() < 0.2
    held = published_errors(on.config, frozen_fix(on.recording, 40.0, LASTS_S), on.truth)
    assert np.nanmax(abs(held.errors[held.t_s < 40.0] - run.errors[run.t_s < 40.0])) == 0.0
