"""Hours with faults now and then: what is drawn, into what it is put, a few minutes, the tables."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from drivers.measurements import MonotonicStamp, PositionFix, WheelSpeed
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.faulty_hours import (
    JUDGED_S,
    LASTS_S,
    SETTLED_S,
    SPACING_S,
    TimedFault,
    by_fault,
    faults_of,
    faulty_hour_of,
    timed_faults,
)
from fusiond.studies.faults.hours import (
    CORRECTED,
    FALSE,
    KINDS,
    beyond_s,
    hour_of,
    rates,
    stated_per_h,
)
from fusiond.studies.faults.library import TO_THE_END
from fusiond.studies.faults.sensor_data import Received, Recording
from fusiond.studies.faults.tables import TABLES

HOURS = range(40)


def test_what_needs_another_drive_or_configuration_does_not_happen() -> None:
    town, wheels = faults_of(KINDS["town"]), faults_of(KINDS["wheels"])
    assert {"step_500m", "drift_0.1_m_s", "gyro_bias_1_deg_s", "no_aids", "imu_lost_5s"} <= {*town}
    assert not {"none", "imu_upside_down", "imu_silent_spare", "force_in_g"} & {*wheels}
    assert not {"creeping_0.2_m_s", "first_fixes_at_90s", "imu_silent_5s_bend"} & {*wheels}
    assert {*wheels} - {*town} == {n for n in wheels if EVERY[n].drive.wheels}
    assert {"wheels_frozen", "drift_and_slip"} <= {*wheels} - {*town}


@pytest.mark.parametrize("name", KINDS)
def test_one_is_over_and_settled_before_the_next(name: str) -> None:
    kind, lengths = KINDS[name], set[float]()
    for seed in HOURS:
        found = timed_faults(kind, seed, 3600.0)
        assert found == timed_faults(kind, seed, 3600.0) != timed_faults(kind, seed + 1, 3600.0)
        assert SPACING_S[0] <= found[0].begin_s <= SPACING_S[1]
        assert 3600.0 - sum(SPACING_S) < found[-1].begin_s <= 3600.0 - SPACING_S[0]
        for one, other in pairwise(found):
            assert SPACING_S[0] - 0.1 <= other.begin_s - one.begin_s <= SPACING_S[1] + 0.1
            assert one.end_s + SETTLED_S < other.begin_s
        for h in found:
            length_s, whole_s = h.end_s - h.begin_s, EVERY[h.fault].length_s
            if whole_s == TO_THE_END:
                assert LASTS_S[0] <= round(length_s, 6) <= LASTS_S[1]
                lengths.add(round(length_s, 6))
            else:
                assert length_s == pytest.approx(whole_s)
    assert len(lengths) > 20


def test_of_two_receivers_either_or_both_are_wrong() -> None:
    spared = {
        (EVERY[h.fault].of_imu, h.spares)
        for seed in HOURS
        for h in timed_faults(KINDS["two receivers"], seed, 3600.0)
    }
    assert spared == {(False, None), (False, "gnss"), (False, "second"), (True, None)}
    alone = {h.spares for seed in HOURS for h in timed_faults(KINDS["town"], seed, 3600.0)}
    assert alone == {None}


def recording() -> Recording:
    """Thirty seconds at 10 Hz, each second a fix of two receivers and a wheel speed."""
    stamps = np.arange(1, 301, dtype=np.int64) * 100_000_000
    samples = np.random.default_rng(0).standard_normal((300, 6))
    received = []
    for t in range(1_000_000_000, 30_000_000_000, 1_000_000_000):
        at = MonotonicStamp(t)
        for k, source in enumerate(("gnss", "second")):
            fix = PositionFix(source, t, at, 0.5 + t * 1e-18, 2.0, 40.0 + k)
            received.append(Received(t, t, fix))
        received.append(Received(t, t, WheelSpeed("wheel", t, at, 1.0)))
    return Recording(stamps, stamps, samples, tuple(received))


def changed(was: Recording, now: Recording) -> dict[str, list[int]]:
    """By source, the seconds of the measurements that are others."""
    assert len(was.received) == len(now.received)
    gone = {*was.received} - {*now.received}
    found: dict[str, list[int]] = {}
    for item in sorted(gone, key=lambda r: r.t_ns):
        found.setdefault(item.measurement.source, []).append(item.t_ns // 1_000_000_000)
    return found


@pytest.mark.parametrize(
    ("spares", "wrong"),
    [(None, {"gnss", "second"}), ("gnss", {"second"}), ("second", {"gnss"})],
)
def test_a_fault_spares_what_it_names(spares: str | None, wrong: set[str]) -> None:
    whole = recording()
    stepped = TimedFault("step_500m", 10.0, 15.0, spares).put_into(whole)
    assert changed(whole, stepped) == {source: [10, 11, 12, 13, 14] for source in wrong}
    assert [r.seen_ns for r in stepped.received] == [r.seen_ns for r in whole.received]
    assert np.array_equal(stepped.samples, whole.samples)
    both = TimedFault("step_and_gyro_bias", 10.0, 15.0, spares).put_into(whole)
    assert {*changed(whole, both)} == wrong
    off = (both.samples - whole.samples)[:, 2]
    assert np.flatnonzero(off).tolist() == list(range(99, 149))
    assert np.ptp(off[99:149]) < 1e-12


def test_two_receivers_freeze_each_at_its_own() -> None:
    whole = recording()
    frozen = TimedFault("fix_frozen", 10.0, 15.0).put_into(whole)
    assert changed(whole, frozen) == {source: [11, 12, 13, 14] for source in ("gnss", "second")}
    for item in frozen.received:
        m = item.measurement
        if isinstance(m, PositionFix):
            assert m.height_m == (40.0 if m.source == "gnss" else 41.0)


MINUTES_S = 450.0
FROZEN = 35
"""A seed of the town whose only fault so soon is `fix_frozen`."""


@pytest.fixture(scope="module")
def minutes() -> dict[str, Any]:
    return faulty_hour_of(FROZEN, MINUTES_S)


def test_it_is_noticed_recovered_from_and_no_alarm(minutes: dict[str, Any]) -> None:
    assert (minutes["kind"], minutes["crash"]) == ("town", None)
    [fault] = minutes["faults"]
    assert (fault["fault"], fault["mode"], fault["spares"]) == ("fix_frozen", "navigating", None)
    assert fault["noticed_s"] <= 5.0
    assert fault["recovered_s"] <= 30.0
    assert fault["longest_lie_s"] <= 2.0
    assert "isolated" in {event["code"] for event in fault["events"]}
    assert not any(what.startswith(("isolated", *CORRECTED)) for what in minutes["told"])
    assert minutes["longest_lie_s"] == 0.0


def test_quiet_is_what_is_far_from_the_fault_and_navigating(minutes: dict[str, Any]) -> None:
    [fault] = minutes["faults"]
    quiet_s = 3600.0 * minutes["hours"]
    near_s = fault["end_s"] + SETTLED_S - fault["begin_s"]
    assert MINUTES_S - near_s - 60.0 < quiet_s < MINUTES_S - near_s - 10.0  # it aligns first
    for series in ("gnss", "gnss_velocity"):
        assert minutes["tests"][series] == pytest.approx(quiet_s, abs=2.0)
        assert minutes["judged"][series] == pytest.approx(quiet_s - JUDGED_S, abs=2.0)


def test_its_noise_is_that_of_the_hour_with_nothing_wrong(minutes: dict[str, Any]) -> None:
    """Before its only fault begins, both tell the same."""
    [fault] = minutes["faults"]
    short_s = fault["begin_s"] // 1.0
    assert timed_faults(KINDS["town"], FROZEN, short_s) == []
    quiet, calm = faulty_hour_of(FROZEN, short_s), hour_of(FROZEN, short_s)
    assert quiet["faults"] == []
    for key in ("kind", "beyond_s", "not_navigating_s", "longest_lie_s", "told"):
        assert quiet[key] == calm[key]


def test_false_decisions_are_stated_by_odds_and_rates() -> None:
    """Each once an hour: a receiver is off or runs away, by position or velocity; a terminal is
    off; the vehicle slips."""
    one, two = (stated_per_h(KINDS[name].config()) for name in ("town", "two receivers"))
    assert one["isolated"] == pytest.approx(6.0 * FALSE, rel=0.01)
    assert two["isolated"] == pytest.approx(10.0 * FALSE, rel=0.01)
    assert one["corrected"] > one["isolated"]
    hour = {"kind": "town", "hours": 1.0, "tests": {}, "limits": False, "stated_per_h": one}
    told = {"isolated gnss": 1, "sensor_fault": 2, "fault_over": 1, "imu_gap": 1}
    found = {row["what"]: row for row in rates([{**hour, "told": told}])}
    assert {what: row["times"] for what, row in found.items()} == {
        **{"isolated": 1, "corrected": 3, "anything else": 1}
    }
    assert found["isolated"]["stated_per_24_h"] == 24.0 * one["isolated"]


def test_seconds_beyond_are_those_of_any_mode() -> None:
    assert beyond_s([(6.0, 0.0, 0.0, 0.0, 5.0), (6.0, 0.0, 0.0, 5.1, 0.0)]) == {
        **{"horizontal": 2, "height": 0, "velocity": 0, "yaw": 1, "tilt": 0}
    }


def test_the_tables_hold_both(minutes: dict[str, Any]) -> None:
    text = TABLES["faulty"]([minutes])
    judged_h = minutes["judged"]["gnss"] / minutes["tests"]["gnss"] * minutes["hours"]
    assert f"| town | {judged_h:.4g} | verdict of gnss | 0 |" in text
    assert "| fix_frozen | 1 | 1 of 1 |" in text
    assert f"| town | {minutes['hours']:.4g} | isolated | 0 | 0 |" in text
    assert "1 faults in 0.125 hours simulated; 0 ended the navigator." in text


def test_what_is_counted_of_a_fault() -> None:
    def row(
        mode: str, noticed_s: float | None, lie_s: float, ratio: float | None
    ) -> dict[str, Any]:
        figures = {"noticed_s": noticed_s, "recovered_s": noticed_s, "largest_ratio": ratio}
        seconds = {"longest_lie_s": lie_s, "beyond_s": lie_s}
        return {"faults": [{"fault": "step_3m", "mode": mode, **figures, **seconds}]}

    found = [
        row("navigating", 4.0, 0.0, 2.0),
        row("navigating", 8.0, 3.0, 7.0),
        row("navigating", None, 2.0, 6.0),
        row("coasting", 0.0, 0.0, 1.0),
    ]
    [line] = by_fault(found)
    assert (line["times"], line["begun"], line["noticed"], line["recovered"]) == (4, 3, 2, 2)
    assert (line["noticed_median_s"], line["noticed_slowest_s"]) == (6.0, 8.0)
    assert (line["lies"], line["longest_lie_s"], line["beyond_s"]) == (1, 3.0, 5.0)
    assert line["largest_ratio"] == 7.0
    [infinite] = by_fault([*found, row("navigating", 1.0, 3.0, None)])
    assert (infinite["largest_ratio"], infinite["lies"]) == (None, 2)
