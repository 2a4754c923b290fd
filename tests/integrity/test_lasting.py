"""Whether a fault lasts: what looks have in common tells nothing, what changes does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.base import Looked, gate_threshold
from fusiond.estimators.fault_odds import APART
from fusiond.integrity.catalogue import Kind, position_kinds
from fusiond.integrity.fault_finding import Finding
from fusiond.integrity.lasting import Effect, Lasting
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle import fix_wander

Array = NDArray[np.float64]

S = 1_000_000_000
MODEL = make_model("ins15", imu_noise(Imu(rate_hz=50.0)), fix_wander("wander", 60.0))
WANDER = MODEL.slots_of("wander")
STEP, DRIFT = position_kinds("gnss")
GATE = gate_threshold(0.9999, 2)
WHITE_M = 0.5


def finding(kind: Kind, north: float, sd: float) -> Finding:
    return Finding(kind, 0, 0.0, (north, 0.0, 0.0), (sd, sd, sd), 20.0)


def lasting(*findings: Finding) -> Lasting:
    effect = Effect(np.zeros(MODEL.size), np.zeros((MODEL.size, 3)))
    return Lasting(findings, (effect,) * len(findings))


def covariance(position_m: float, wander: float = 0.0) -> Array:
    p = np.zeros((MODEL.size, MODEL.size))
    p[6, 6] = p[7, 7] = position_m**2
    for slot in WANDER:
        p[slot, slot] = wander**2
    return p


def look(z: Array, p: Array, wander_m: float = 0.0) -> Looked:
    h = np.zeros((2, MODEL.size))
    h[0, 6] = h[1, 7] = 1.0
    h[0, WANDER[0]] = h[1, WANDER[1]] = -wander_m
    return Looked(z, h, np.full(2, WHITE_M**2), p)


def adds(kind: Kind, t_s: float) -> Array:
    d = np.zeros((2, 3))
    d[0, 0] = d[1, 1] = -1.0 if kind is STEP else -t_s
    return d


def after(known: Lasting, t_s: float, z: Array, p: Array, wander_m: float = 0.0) -> Lasting:
    terms = [adds(each.kind, t_s) for each in known.findings]
    return known.looked(round(t_s * S), look(z, p, wander_m), terms, MODEL.noise, GATE)


def test_a_step_that_ends_is_over_within_two_looks() -> None:
    rng, known = np.random.default_rng(1), lasting(finding(STEP, 10.0, 0.4))
    for t_s in range(1, 40):
        z = rng.standard_normal(2) * WHITE_M - (10.0 if t_s < 30 else 0.0) * np.array([1.0, 0.0])
        known = after(known, t_s, z, covariance(0.3))
        assert (known.log_odds > APART) is (t_s > 30), (t_s, known.log_odds)


@pytest.mark.parametrize("off_m", [-3.0, 0.0, 3.0])
def test_what_looks_share_says_neither(off_m: float) -> None:
    """A drift known to a third of itself, and a filter that is off by one and a half sigma: each
    look alone has an opinion, and sixty would be sure."""
    for lasts in (True, False):
        rng, known = np.random.default_rng(2), lasting(finding(DRIFT, 0.1, 0.03))
        said = []
        for t_s in range(1, 31):
            z = rng.standard_normal(2) * WHITE_M + np.array([off_m, 0.0])
            z[0] -= 0.1 * t_s if lasts or t_s <= 20 else 0.0
            known = after(known, t_s, z, covariance(2.0))
            said.append(known.log_odds)
        assert max(said[:20]) < 0.0
        assert (said[-1] > APART) is not lasts, (lasts, said[-6:])


def test_a_drift_that_ends_is_over_though_errors_last() -> None:
    """Of a receiver whose fixes share 1.5 m for a minute: what wanders so is no fault."""
    step = math.exp(-1.0 / 60.0)
    late, wrong = [], 0
    for seed in range(20):
        rng, known = np.random.default_rng(seed), lasting(finding(DRIFT, 0.1, 0.03))
        wander = 1.5 * rng.standard_normal(2)
        for t_s in range(30, 200):
            wander = step * wander + 1.5 * math.sqrt(1.0 - step * step) * rng.standard_normal(2)
            z = rng.standard_normal(2) * WHITE_M - wander
            z[0] -= 0.1 * t_s if t_s < 60 else 0.0
            known = after(known, t_s, z, covariance(0.3, 1.0), 1.5)
            wrong += t_s < 60 and known.log_odds > APART
            if t_s >= 60 and known.log_odds > APART:
                late.append(t_s - 60)
                break
        else:
            late.append(200)
    assert wrong <= 12  # of 600 looks, fifty to one
    assert sorted(late)[10] <= 5, late
    assert max(late) <= 60, late


def test_of_two_faults_that_fitted_alike_one_remains() -> None:
    rng, known = (
        np.random.default_rng(4),
        lasting(finding(STEP, 3.0, 0.4), finding(DRIFT, 0.3, 0.05)),
    )
    for t_s in range(10, 60):
        z = rng.standard_normal(2) * WHITE_M - np.array([0.3 * t_s, 0.0])
        known = after(known, t_s, z, covariance(0.3))
    assert known.shared is not None
    step, drift, _ = known.shared.modes
    assert step.weight < 1e-3 * drift.weight
    assert known.log_odds < 0.0


def test_what_nothing_explains_tells_nothing() -> None:
    known = after(lasting(finding(STEP, 10.0, 0.4)), 1.0, np.array([-10.0, 0.0]), covariance(0.3))
    for t_s in range(2, 10):
        known = after(known, t_s, np.array([500.0, 0.0]), covariance(0.3))
    assert known.log_odds < 0.0
    # That it has ended is a chance that time has made larger; two looks show it.
    for t_s in (10, 11):
        known = after(known, t_s, np.zeros(2), covariance(0.3))
    assert known.log_odds > APART


def test_before_a_look_nothing_is_known() -> None:
    known = lasting(finding(STEP, 10.0, 0.4))
    assert math.isnan(known.log_odds)
    assert known.log_likelihood == 0.0
    other = lasting(finding(DRIFT, 0.1, 0.1))
    assert known.without(known).findings == ()
    assert known.without(other) is known


def test_other_rows_begin_anew_with_what_is_known_of_the_fault() -> None:
    """A fix without height behind ones with it, or one that shares no error."""
    rng, known = np.random.default_rng(5), lasting(finding(STEP, 10.0, 4.0))
    for t_s in range(1, 10):
        z = rng.standard_normal(2) * WHITE_M - np.array([8.0, 0.0])
        known = after(known, t_s, z, covariance(0.3), 1.0 if t_s < 8 else 0.0)
    assert known.shared is not None
    b = known.shared.modes[0].mean[-3]
    assert abs(b - 8.0) < 1.0
    assert known.log_odds < 0.0
