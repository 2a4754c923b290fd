"""Federated filter: sigma is honest or conservative, faults are isolated, named and forgiven."""

from __future__ import annotations

import math
from collections import Counter
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.stats import chi2

from drivers.measurements import Measurement, MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.estimators.federated.isolation import (
    DIFFERENCE,
    INNOVATION,
    READMISSION,
    RECENT_NS,
    FaultDetection,
)
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from fusiond.studies.federated import runs as study
from fusiond.studies.federated.runs import EQUAL_M, UNEQUAL_M, Filter, Trace
from tests import runs

Array = NDArray[np.float64]
GATE = float(chi2.ppf(0.9999, 3))
OWN = Filter("no_reset", FederatedOptions())
OFF = Filter("unisolated", FederatedOptions(fault_detection=False))
RESET = Filter("fusion_reset", FederatedOptions(mode="fusion_reset"))
RESCALE = Filter("rescale", FederatedOptions(mode="rescale"))
CENTRALISED = Filter("centralised", isolates=True)
RUNS = 24


@lru_cache(maxsize=8)
def traces(fault: study.FaultKind, sd_m: tuple[float, ...], count: int) -> list[dict[str, Trace]]:
    filters = (OWN, OFF, CENTRALISED) if fault else (OWN, RESET)
    if not fault and sd_m == EQUAL_M:
        filters += (RESCALE,)
    return study.monte_carlo(filters, fault, sd_m, count, seed=5)


# --------------------------------------------------------------------------- honesty


def _nees(name: str, sd_m: tuple[float, ...]) -> tuple[float, float, float]:
    """Average over runs and instants, with the 99.9 % interval at one instant."""
    found = np.array([t[name].nees for t in traces("", sd_m, RUNS)])
    low, high = chi2.ppf([0.0005, 0.9995], study.NEES_DOF * RUNS) / RUNS
    return float(found.mean()), float(low), float(high)


def test_sigma_is_honest_with_a_reset() -> None:
    for sd_m in (EQUAL_M, UNEQUAL_M):
        nees, low, high = _nees("fusion_reset", sd_m)
        assert low <= nees <= high


def test_sigma_without_reset_is_honest_for_equal_sources_and_conservative_for_others() -> None:
    nees, low, high = _nees("no_reset", EQUAL_M)
    assert low <= nees <= high
    assert _nees("no_reset", UNEQUAL_M)[0] < _nees("fusion_reset", UNEQUAL_M)[0]


def test_rescaling_is_conservative() -> None:
    assert _nees("rescale", EQUAL_M)[0] < 0.95 * _nees("fusion_reset", EQUAL_M)[0]


def test_nobody_is_isolated_without_a_fault() -> None:
    for sd_m in (EQUAL_M, UNEQUAL_M):
        for found in traces("", sd_m, RUNS):
            assert all(trace.false_alarms == 0 for trace in found.values())


# --------------------------------------------------------------------------- faults


@pytest.mark.parametrize(("fault", "within_s"), [("step", 8.0), ("drift", 45.0), ("frozen", 15.0)])
def test_a_fault_is_isolated_and_costs_little(fault: study.FaultKind, within_s: float) -> None:
    found = traces(fault, EQUAL_M, 6)
    during = study.grid()[0] >= study.FAULT_START_S

    def rms(name: str) -> float:
        errors = np.array([t[name].error[during, 6:8] for t in found])
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=2))))

    for t in found:
        assert t["no_reset"].isolated_s - study.FAULT_START_S <= within_s
        assert t["no_reset"].false_alarms == 0
        assert math.isnan(t["unisolated"].isolated_s)
    assert rms("no_reset") < 2.5
    assert rms("unisolated") > 2.0 * rms("no_reset")
    assert rms("centralised") < 2.5  # with the daemon's isolation


def test_no_reset_keeps_a_faulty_filter_out_of_the_others() -> None:
    """Once isolated, master and others are those of a run in which the source said nothing else
    before: after the fault the two healthy sources decide alone."""
    model = study.make_model("ins15", study.imu_noise(study.STUDY_IMU))
    others = []
    for value in (0.0, 30.0):
        # No test fails: what the faulty filter has been told is to be in it and nowhere else.
        options = FederatedOptions(false_alarm=1e-300)
        e = study.federated(model, 0.5, study.SOURCES, options)
        sd = study.initial_sd(model)
        nav = runs.true_nav(study.truth(), np.zeros(1))[0]
        e.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
        measurements = study.fixes(np.random.default_rng(1), "")[:6]
        moved = np.array([value, 0.0, 0.0]) / runs.metres_per_unit(float(nav[0]), float(nav[2]))
        for measurement in measurements:
            lat = measurement.lat_rad + (float(moved[0]) if measurement.source == "first" else 0.0)
            fix = study.PositionMeasurement(
                *(
                    measurement.source,
                    0,
                    1.0 - 1e-15,
                    lat,
                    measurement.lon_rad,
                    measurement.height_m,
                    measurement.sd,
                    measurement.lever,
                )
            )
            assert e.update(fix).name == "fused"
        assert e._isolate(0, INNOVATION)
        others.append((e.nav, e.covariance, e.isolated))
    assert others[0][2] == {"first": INNOVATION}
    apart = runs.nav_error(others[0][0], others[1][0])[6:9]
    assert np.abs(apart).max() < 1e-3  # 30 m in the faulty source; second order remains
    assert others[0][1] == pytest.approx(others[1][1], rel=1e-6, abs=1e-12)


# --------------------------------------------------------------------------- the tests' arithmetic


def _detection(count: int = 3) -> FaultDetection:
    faults = FaultDetection(count, 1e-6, 10, 5)
    for i in range(count):
        faults.received(i, 0)
    return faults


def test_one_outlier_isolates_nobody_and_a_burst_does() -> None:
    faults = _detection()
    passed = [faults.innovation(0, 1e9, 3, GATE) for _ in range(6)]
    assert passed[0]
    assert not all(passed)
    faults = _detection()
    for k in range(100):
        assert faults.innovation(0, 1e9 if k % 12 == 0 else 3.0, 3, GATE)


def test_false_alarms_of_the_innovation_test_stay_below_what_is_stated() -> None:
    faults = FaultDetection(1, 1e-3, 10, 5)
    rng = np.random.default_rng(0)
    nis = rng.chisquare(3, 20000)
    # Every tenth: windows that share no innovation.
    failed = [not faults.innovation(0, float(x), 3, GATE) for x in nis][9::10]
    assert 0 < sum(failed) <= chi2.ppf(0.999, 2 * (2000 * 1e-3 + 1)) / 2


def test_the_worst_of_three_is_named_and_of_two_nobody() -> None:
    faults = _detection()
    assert faults.worst({0: 50.0, 1: 90.0, 2: 60.0}, 6) == 1
    assert faults.worst({0: 1.0, 1: 9.0, 2: 6.0}, 6) is None
    assert faults.worst({0: 90.0, 1: 90.0}, 6) is None


def test_the_last_one_heard_is_never_isolated() -> None:
    faults = _detection(2)
    faults.received(0, 20 * runs.SECOND)
    assert faults.may_isolate(1, RECENT_NS + 20 * runs.SECOND)
    assert not faults.may_isolate(0, RECENT_NS + 20 * runs.SECOND)
    faults.isolate(1, INNOVATION)
    assert not faults.may_isolate(0, 0)


def test_a_source_returns_after_good_innovations_in_a_row() -> None:
    faults = _detection()
    faults.isolate(1, DIFFERENCE)
    assert [faults.behaves(1, 3.0, 3, GATE) for _ in range(4)] == [False] * 4
    assert not faults.behaves(1, 1e3, 3, GATE)  # begins anew
    assert [faults.behaves(1, 3.0, 3, GATE) for _ in range(5)] == [False] * 4 + [True]
    assert not faults.is_isolated(1)
    faults.isolate(1, DIFFERENCE)
    biased = float(chi2.ppf(READMISSION, 15)) / 5.0 + 0.1  # inside the gate, too much together
    assert biased < GATE
    assert not any(faults.behaves(1, biased, 3, GATE) for _ in range(30))


# --------------------------------------------------------------------------- through the navigator


RATE_HZ, SECONDS, FAULT_S, END_S = 50.0, 110.0, 40.0, 65.0
CONFIG: dict[str, Any] = {
    "imu": {"rate_hz": RATE_HZ},
    "aiding": {
        name: {"kind": "gnss", "min_position_sd_m": 2.0} for name in ("gnss", "gnss_b", "rnss")
    },
    "alignment": {
        "heading": ["config"],
        "heading_deg": 41.0,
        "heading_sd_deg": 2.0,
        "position_deg_m": [30.5, 114.3, 40.0],
        "position_sd_m": 5.0,
    },
    "estimator": {"filter": "federated"},
}


def _fixes(truth: Truth, rng: np.random.Generator) -> list[Measurement]:
    found: list[Measurement] = []
    for k, t in enumerate(np.arange(5.0, SECONDS - 1.0, 1.0 / 3.0)):
        source = ("gnss", "gnss_b", "rnss")[k % 3]
        p = truth.at(np.array([t])).position[0]
        north = 50.0 if source == "gnss_b" and FAULT_S <= t < END_S else 0.0
        error = rng.standard_normal(3) * 2.0 + [north, 0.0, 0.0]
        lat, lon, up = (
            float(x) for x in p + error / runs.metres_per_unit(float(p[0]), float(p[2]))
        )
        at = round(t * 1e9)
        sd = (2.0, 2.0, 2.0)
        found.append(PositionFix(source, at, MonotonicStamp(at), lat, lon, up, sd_ned_m=sd))
    return found


@pytest.mark.parametrize("delay_s", [0.0, 0.8])
def test_a_step_in_one_source_is_isolated_told_and_taken_back(delay_s: float) -> None:
    """Live: with all fixes late every one of them rewinds, and each turn is told once."""
    legs = [Leg(12), *(Leg(6, speed_m_s=10.0), Leg(8, turn_deg=60.0), Leg(8, turn_deg=-60.0)) * 5]
    truth = Truth(follow(legs, SECONDS, course_deg=40.0), runs.ORIGIN, RATE_HZ, SECONDS)
    config = Config.model_validate(CONFIG)
    samples = runs.imu_run(config.imu, truth, 3).samples
    times = runs.sample_times(truth)
    events: list[tuple[str, str]] = []
    navigator = Navigator(config, on_event=lambda code, text: events.append((code, text)))
    waiting = _fixes(truth, np.random.default_rng(6))
    given = 0
    worst = 0.0
    seen: dict[str, str | None] = {}
    for row in range(0, len(times), 5):
        navigator.add_imu(times[row : row + 5], samples[row : row + 5])
        now = int(times[min(row + 4, len(times) - 1)])
        while given < len(waiting) and waiting[given].t_seen_ns + delay_s * 1e9 <= now:
            navigator.add(waiting[given], waiting[given].t_seen_ns)
            given += 1
        navigator.advance()
        t = now * 1e-9
        if t > 20.0 and navigator.started is not None:
            true = runs.true_nav(truth, np.array([t]))[0]
            worst = max(worst, float(np.hypot(*runs.nav_error(navigator.estimator.nav, true)[6:8])))
        if FAULT_S + 8.0 < t < END_S:
            seen = {name: navigator.service.reason(name) for name in config.aiding}
            assert navigator.service.reason("gnss_b_velocity") == seen["gnss_b"]
    assert seen == {"gnss": None, "gnss_b": INNOVATION, "rnss": None}
    assert worst < 8.0
    told = Counter(code for code, _ in events)
    assert told["isolated"] == told["readmitted"] == 1
    assert all("gnss_b" in text for code, text in events if code in ("isolated", "readmitted"))
    outcomes = navigator.timeline.counters.outcomes
    # All of the fault's fixes but those few that the gate refused first, and those that brought it
    # back.
    assert 20 <= outcomes["gnss_b"]["isolated"] <= 25 + config.estimator.federated.readmit_after
    assert outcomes["gnss"]["isolated"] == outcomes["rnss"]["isolated"] == 0
    assert navigator.service.reason("gnss_b") is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"aiding": {}}, r"needs \[aiding.NAME\]"),
        ({"estimator": {"filter": "federated", "federated": {"sources": ["x"]}}}, "no .aiding.x"),
        (
            {"estimator": {"filter": "federated", "federated": {"shares": {"gnss": 1.0}}}},
            "every local filter",
        ),
    ],
)
def test_a_configuration_that_names_no_filter_is_refused(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        Config.model_validate({**CONFIG, **change})
