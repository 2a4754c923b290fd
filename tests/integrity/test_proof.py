"""Whether a position goes with the motion: what a drift does to a mean, and what a line tells."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.estimators.base import Outcome
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.proof import (
    DRIFT_SD_M_S,
    SETTLED_NS,
    SLOWEST_M_S,
    UNPROVEN_SIGMAS,
    Proof,
    apart,
    metres_a_radian,
    residual,
    settled,
)
from fusiond.models.vehicle import ANTENNA_LEVER, FIX_TIME
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.navigation.strapdown import LAT, LON, Q0, VE, VN
from tests.aiding.aid_bench import (
    RPY,
    VELOCITY,
    innovation_of,
    position_aid,
    state_of,
    vehicle_model,
)
from tests.integrity.journey import (
    LIMIT,
    RATE_HZ,
    SD_M,
    SD_M_S,
    START,
    Journey,
    S,
)


def test_the_slope_has_the_sigma_that_it_states() -> None:
    slopes = []
    for seed in range(60):
        proof = Journey(seed).proof(12.0)
        slopes.append(proof.trend.slope[0] / proof.sigma)
    # Mean square of a radius of two axes: 2 +- 0.26.
    assert np.mean(np.square(slopes)) == pytest.approx(2.0, abs=4.0 * 0.26)


def test_a_drift_shows_in_the_slope_before_it_is_beyond_the_widened_sigma() -> None:
    """Of errors of 5 sigma the slope has 5.8, where chance is at 5.3."""
    drift_m_s = 0.2
    n = 10.0 * RATE_HZ
    sigma = UNPROVEN_SIGMAS * SD_M / math.sqrt(n)
    beyond_s = 2.0 * 5.0 * sigma / drift_m_s  # when half the way that it has drifted is 5 sigma
    assert beyond_s > 10.0
    slope_sd = math.sqrt(12.0) * SD_M / (beyond_s * math.sqrt(beyond_s * RATE_HZ))
    assert drift_m_s / slope_sd > math.sqrt(LIMIT)


@pytest.mark.parametrize("lever", [(0.0, 0.0, -1.0), (1.5, -0.8, -1.0)])
def test_what_goes_along_is_proven_whatever_the_antenna_does(
    lever: tuple[float, float, float],
) -> None:
    """The body turns by half a turn under an antenna that does not sit in its middle."""
    for seed in range(5):
        proof = Journey(seed, lever, turn_rad_s=math.pi / 20.0).proof(20.0)
        assert proof.trend.slope[1] < DRIFT_SD_M_S
        assert proof.proven
        assert proof.goes_along
        assert not proof.drifts(LIMIT)


@pytest.mark.parametrize("drift_m_s", [0.15, 0.5])
def test_what_drifts_is_told_and_never_proven(drift_m_s: float) -> None:
    settled_s = SETTLED_NS / S
    for seed in range(5):
        early = Journey(seed).proof(0.8 * settled_s, drift_m_s)
        late = Journey(seed).proof(1.2 * settled_s, drift_m_s)
        assert not early.goes_along
        assert not early.proven
        # Until the filter's velocity has settled a slow drift may be the filter's.
        assert early.drifts(LIMIT) is (drift_m_s > 0.4)
        assert late.drifts(LIMIT)


def test_the_slowest_drift_that_shows_is_not_taken_for_none() -> None:
    """As soon as one could be proven its slope is known to a fifth of that drift."""
    for seed in range(60):
        proof = Journey(seed).proof(16.5, SLOWEST_M_S)
        assert proof.trend.slope[1] == pytest.approx(DRIFT_SD_M_S, rel=0.1)
        assert not proof.proven


def followed(seed: int, drift_m_s: float, way_sd_m_s: float) -> list[tuple[float, float, float]]:
    """A filter of one axis that follows fixes, once a second, by a way of velocities of that sigma:
    its error, its own sigma and that with what the proof leaves open, until the drift is told."""
    rng, journey = np.random.default_rng(seed), Journey(seed)
    proof, error, p, found, way_m = None, 0.0, 1e4, list[tuple[float, float, float]](), 0.0
    r = (UNPROVEN_SIGMAS * SD_M) ** 2
    for t in range(80):
        offer, nav = journey.at(0)
        noise = SD_M * rng.standard_normal(2)
        walked = way_sd_m_s * rng.standard_normal(2)
        nav[VN], nav[VE] = walked  # at rest in truth
        way_m += walked[0] if t else 0.0
        fix = START[LAT] + (drift_m_s * t + noise[0]) / metres_a_radian(START)[0]
        east = START[LON] + noise[1] / metres_a_radian(START)[1]
        offer = offer._replace(t_ns=t * S, lat_rad=fix, lon_rad=east)
        error, p = error + (walked[0] if t else 0.0), p + way_sd_m_s**2
        k = p / (p + r)
        error, p = error + k * (drift_m_s * t + noise[0] - error), (1.0 - k) * p
        if proof is None:
            proof = Proof.begun(offer, nav, colour=1.0)
            continue
        proof = proof.with_one(offer, nav, way_sd_m_s, p / r)
        if proof.proven or (drift_m_s and proof.drifts(LIMIT)):
            break
        wider = proof.leaves_open((p, p))
        found.append((error, math.sqrt(p), math.sqrt(p + wider[0])))
    return found


@pytest.mark.parametrize("way_sd_m_s", [0.0, 0.12])
def test_what_the_slope_leaves_open_is_published_and_a_sound_fix_hardly_wider(
    way_sd_m_s: float,
) -> None:
    """A drift of 0.1 m/s; by a way that is known exactly, and as velocities once a second know it.
    Of a sound receiver sigma is larger by a few percent in the first case; in the second by half,
    until it is proven, for that is what a line knows."""
    beyond, before, grown, errors = 0, 0, [], []
    for seed in range(100):
        drifting = [each for each in followed(seed, 0.1, way_sd_m_s) if each]
        before += any(abs(e) > 5.0 * own for e, own, _ in drifting)
        beyond += any(abs(e) > 5.0 * sd for e, _, sd in drifting[8:])
        sound = followed(seed, 0.0, way_sd_m_s)[8:]
        grown += [sd / own for _, own, sd in sound]
        errors += [abs(e) / sd for e, _, sd in sound]
    print(f"beyond 5 sigma {before} before, {beyond} now; wider by {np.mean(grown):.3f}")
    assert beyond <= (before if way_sd_m_s == 0.0 else 0.2 * before)
    assert np.mean(grown) < (1.1 if way_sd_m_s == 0.0 else 1.6)
    assert max(errors) < 5.0


def test_what_is_known_of_a_fix_is_taken_out_of_it() -> None:
    """But for the antenna's turn meanwhile and the square of the offset in time it is then as far
    from the filter as its innovation says."""
    model = vehicle_model()
    nav, xi = START.copy(), np.zeros(model.size)
    nav[VN : VE + 1] = VELOCITY[:2]
    nav[Q0:] = quaternion_from_rpy(*RPY)
    xi[list(model.slots_of(FIX_TIME))] = 0.12
    xi[list(model.slots_of(ANTENNA_LEVER))] = -0.1, 0.05, 0.2
    aid = replace(position_aid(nav), time=FIX_TIME, rest=ANTENNA_LEVER)
    state = state_of(model, nav, xi)
    (offer,) = aid.offers()
    z = innovation_of(aid, state).z[:2]
    known = apart(settled(offer, state), nav[LAT], nav[LON], nav)
    assert np.hypot(known.north - z[0], known.east - z[1]) < 0.1
    assert residual(offer, state) == known
    plain = apart(offer, nav[LAT], nav[LON], nav)
    assert np.hypot(plain.north - z[0], plain.east - z[1]) > 1.5
    assert settled(replace(aid, time="", rest="").offers()[0], state) == offer._replace(
        time="", rest=""
    )


@pytest.mark.parametrize("known", [True, False])
def test_a_drift_does_not_hide_behind_an_offset_in_time(known: bool) -> None:
    """A receiver that is 0.1 s late and a vehicle that gets faster by 1 m/s^2 move a fix by 0.1 m/s
    against what the filter knows of the offset: a drift as fast as that looked like none."""
    isolation, model, sd_m = Isolation(), vehicle_model(), 0.3
    to_north, _ = metres_a_radian(START)
    xi = np.zeros(model.size)
    xi[list(model.slots_of(FIX_TIME))] = 0.1
    for k in range(200):
        t_s = k / RATE_HZ
        nav = START.copy()
        nav[VN], nav[VE] = 5.0 + t_s, 0.0
        drift_m = 0.1 * max(0.0, t_s - 10.0)
        lat = START[LAT] - (drift_m - 0.1 * nav[VN]) / to_north
        place = lat, START[LON] + 1e-12 * k, 40.0
        aid = PositionAid("gnss", round(t_s * S), 0.9999, *place, (sd_m,) * 3, (0.0,) * 3)
        state = state_of(model, nav, xi) if known else None
        biased = 10.0 <= t_s < 14.0
        y = (2.5, 0.0, 0.0) if biased else (0.01 * (-1) ** k, 0.0, 0.0)
        name = "fused" if "gnss" not in isolation.excluded else "isolated"
        outcome = Outcome(name, 1.0, 3, y)
        aid = replace(aid, time=FIX_TIME, shares_nothing=True)
        isolation.judge(aid, outcome, nav, None, state)
        v = 5.0 + t_s, 1e-9 * k
        moving = VelocityAid("gnss_velocity", aid.t_ns, 0.9999, v, (SD_M_S,) * 2, (0.0,) * 3)
        isolation.judge(moving, Outcome("fused", 1.0, 2, (0.0, 0.0)), nav)
    assert isolation.excluded == ({"gnss": "drifts"} if known else {})
