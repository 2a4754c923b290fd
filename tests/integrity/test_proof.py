"""Whether a position goes with the motion: what a drift does to a mean, and what a line tells."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.base import State
from fusiond.aiding.offers import PositionOffer
from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.base import Outcome, gate_threshold
from fusiond.integrity.isolation import Action, Isolation
from fusiond.integrity.proof import (
    DRIFT_SD_M_S,
    SETTLED_NS,
    SLOWEST_M_S,
    UNPROVEN_SIGMAS,
    Proof,
    apart,
    metres_a_radian,
    settled,
)
from fusiond.integrity.returns import coming
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle import ANTENNA_LEVER, FIX_TIME
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.navigation.strapdown import LAT, LON, Q0, STEP_SIZE, VE, VN
from tests.aiding.aid_bench import (
    RPY,
    VELOCITY,
    innovation_of,
    position_aid,
    state_of,
    vehicle_model,
)

S = 1_000_000_000
RATE_HZ = 5.0
SD_M, SD_M_S = 0.8, 0.05
LIMIT = gate_threshold(1.0 - 1e-6, 2)
START = np.array([0.53, 1.99, 40.0, 8.0, 3.0, 0.0, 1.0, 0.0, 0.0, 0.0])


class Journey:
    """A vehicle that goes straight on, its velocity as the filter has it, and the fixes of an
    antenna at `lever` (m, body axes); `turn_rad_s` turns the body, not the way."""

    def __init__(
        self, seed: int, lever: tuple[float, float, float] = (0.0,) * 3, turn_rad_s: float = 0.0
    ) -> None:
        self._rng = np.random.default_rng(seed)
        self._lever, self._turn = lever, turn_rad_s

    def at(self, k: int, drift_m_s: float = 0.0) -> tuple[PositionOffer, np.ndarray]:
        """Fix k, which has drifted to the north, and the filter's state (10,) then."""
        t_s = k / RATE_HZ
        nav = START.copy()
        nav[VN : VE + 1] += SD_M_S * self._rng.standard_normal(2)
        yaw = self._turn * t_s
        nav[Q0:] = quaternion_from_rpy(0.0, 0.0, yaw)
        x, y, _ = self._lever
        antenna = (
            START[VN] * t_s + x * math.cos(yaw) - y * math.sin(yaw) + drift_m_s * t_s,
            START[VE] * t_s + x * math.sin(yaw) + y * math.cos(yaw),
        )
        north, east = np.array(antenna) + SD_M * self._rng.standard_normal(2)
        to_m = metres_a_radian(START)
        place = START[LAT] + north / to_m[0], START[LON] + east / to_m[1], 40.0
        return PositionOffer(round(t_s * S), *place, (SD_M,) * 3, self._lever), nav

    def proof(self, seconds: float, drift_m_s: float = 0.0) -> Proof:
        """Of all fixes in so many seconds."""
        proof = Proof.begun(*self.at(0), colour=1.0)
        for k in range(1, round(seconds * RATE_HZ) + 1):
            proof = proof.with_one(*self.at(k, drift_m_s), SD_M_S, 0.1)
        return proof


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


MODEL = make_model("ins15", imu_noise(Imu()))


def state_at(nav: np.ndarray) -> State:
    return State(nav, np.zeros(MODEL.size), np.zeros(STEP_SIZE), MODEL)


@pytest.mark.parametrize(
    ("along_m", "across_m", "down_m", "late"),
    [(2.7, 0.0, 0.0, True), (2.5, 0.0, 0.0, False), (-9.0, 0.0, 0.0, False), (2.7, 9.0, 9.0, True)],
)
def test_behind_is_along_the_track(
    along_m: float, across_m: float, down_m: float, late: bool
) -> None:
    """Of a sigma of hypot(1.1, 0.8) along it and 1.96 of them; whatever lies beside it."""
    nav, speed = START.copy(), math.hypot(*START[VN : VE + 1])
    u = START[VN : VE + 1] / speed
    north, east = np.array([-along_m * u[0] - across_m * u[1], -along_m * u[1] + across_m * u[0]])
    to_m = metres_a_radian(START)
    place = START[LAT] + north / to_m[0], START[LON] + east / to_m[1], 40.0 + down_m
    aid = PositionAid("gnss", 0, 0.9999, *place, (SD_M,) * 3, (0.0, 0.0, 0.0))
    p, across = np.zeros((MODEL.size, MODEL.size)), np.array([-u[1], u[0]])
    p[6:8, 6:8] = 1.1**2 * np.outer(u, u) + 4.0 * np.outer(across, across)
    assert coming(aid, state_at(nav), p).behind is late
    still = nav.copy()
    still[VN : VE + 1] = 0.0
    assert not coming(aid, state_at(still), p).behind


def test_a_filter_that_knows_its_place_hardly_follows() -> None:
    """Errors that the fixes share are no place that it knows less well."""
    model = make_model("ins15", imu_noise(Imu()), position_bias("bias", 1.0, 600.0))
    nav = START.copy()
    state = State(nav, np.zeros(model.size), np.zeros(STEP_SIZE), model)
    place = START[LAT], START[LON], 40.0
    own, shared = 0.2, 1.0
    p = np.zeros((model.size, model.size))
    bias = model.slots_of("bias")
    assert len(bias) == 2
    for axis in range(2):
        p[6 + axis, 6 + axis] = own**2 + shared**2
        p[bias[axis], bias[axis]] = shared**2
        p[6 + axis, bias[axis]] = p[bias[axis], 6 + axis] = shared**2
    aid = PositionAid("gnss", 0, 0.9999, *place, (SD_M,) * 3, (0.0,) * 3, bias=("bias",))
    r = (UNPROVEN_SIGMAS * SD_M) ** 2
    assert coming(aid, state, p).gain == pytest.approx(own**2 / (own**2 + r))
    p[bias] = 0.0
    p[:, bias] = 0.0
    p[6:9, 6:9] = 100.0 * np.eye(3)
    assert coming(aid, state, p).gain == pytest.approx(100.0 / (100.0 + r))


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


class Returned:
    """A receiver that is back after an outage, in the eyes of an isolation: what it believed."""

    def __init__(self, velocities: bool, contradicted: bool = False) -> None:
        self.isolation = Isolation()
        self.isolation.reset(contradicted)
        self._journey = Journey(1)
        self._noise = np.random.default_rng(2)
        self._velocities = velocities

    def _white(self, count: int) -> tuple[float, ...]:
        return tuple(self._noise.standard_normal(count).tolist())

    def fixes(self, first: int, last: int, drift_m_s: float = 0.0) -> list[tuple[bool, Action]]:
        """Of fixes `first` to before `last`: whether each counts less, and what follows."""
        found = []
        for k in range(first, last):
            offer, nav = self._journey.at(k, drift_m_s)
            aid = PositionAid(
                "gnss",
                offer.t_ns,
                0.9999,
                offer.lat_rad,
                offer.lon_rad,
                offer.height_m,
                offer.sd,
                offer.lever,
            )
            # The filter is where it believes to be: its state is of no matter but for the way.
            nav[LAT], nav[LON] = offer.lat_rad, offer.lon_rad
            less = self.isolation.unproven("gnss", aid.t_ns)
            name = "fused" if self.isolation.believes("gnss") else "isolated"
            outcome = Outcome(name, 1.0, 3, () if less else self._white(3))
            found.append((less, self.isolation.judge(aid, outcome, nav)))
            if self._velocities:
                v, sd = (8.0, 3.0), (SD_M_S, SD_M_S)
                moving = VelocityAid("gnss_velocity", aid.t_ns, 0.9999, v, sd, offer.lever)
                self.isolation.judge(moving, Outcome("fused", 1.0, 2, self._white(2)), nav)
        return found


RATE = round(RATE_HZ)
# After fix 600 there is an outage of 40 s. By then the series has shown that its noise is white.
LAST, BACK = 600, 800


def test_positions_count_less_after_an_outage_until_they_are_proven() -> None:
    returned = Returned(velocities=True)
    assert not any(less for less, _ in returned.fixes(0, LAST))
    found = returned.fixes(BACK, BACK + 150)
    less = [less for less, _ in found]
    until = less.index(False)
    # sqrt(12) s / (T sqrt(n)) is DRIFT_SD_M_S after 15.7 s.
    assert 15.0 * RATE_HZ < until < 25.0 * RATE_HZ
    assert not any(less[until:])
    assert {action for _, action in found} == {Action.NONE}


def test_one_that_drifts_from_its_first_fix_on_is_left_out() -> None:
    returned = Returned(velocities=True)
    returned.fixes(0, LAST)
    found = returned.fixes(BACK, BACK + 150, drift_m_s=0.15)
    assert Action.DOUBT_MEASURED in {action for _, action in found}
    assert returned.isolation.excluded == {"gnss": "drifts"}


def test_one_that_ran_away_before_the_start_is_to_prove_itself() -> None:
    """Nothing less than the whole proof will do, and a drift ends it."""
    returned = Returned(velocities=True, contradicted=True)
    assert all(less for less, _ in returned.fixes(0, 50)[1:])
    assert "not yet seen to go with" in (returned.isolation.contested(50 * S // RATE) or "")
    assert not returned.fixes(50, 200)[-1][0]
    assert returned.isolation.contested(200 * S // RATE) is None
    drifting = Returned(velocities=True, contradicted=True)
    drifting.fixes(0, 110, drift_m_s=0.3)
    assert drifting.isolation.excluded == {"gnss": "drifts"}


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
        name = "fused" if isolation.believes("gnss") else "isolated"
        outcome = Outcome(name, 1.0, 3, y)
        aid = replace(aid, time=FIX_TIME, shares_nothing=True)
        isolation.judge(aid, outcome, nav, None, state)
        v = 5.0 + t_s, 1e-9 * k
        moving = VelocityAid("gnss_velocity", aid.t_ns, 0.9999, v, (SD_M_S,) * 2, (0.0,) * 3)
        isolation.judge(moving, Outcome("fused", 1.0, 2, (0.0, 0.0)), nav)
    assert isolation.excluded == ({"gnss": "drifts"} if known else {})


def test_without_a_velocity_nobody_can_say_that_it_drifts() -> None:
    """The way is then the filter's own, which follows the fixes."""
    returned = Returned(velocities=False)
    returned.fixes(0, LAST)
    returned.fixes(BACK, BACK + 150, drift_m_s=0.15)
    assert not returned.isolation.excluded
    assert returned.isolation.contested((BACK + 149) * S // round(RATE_HZ)) is not None


@pytest.mark.parametrize(
    ("late_m", "surprising", "waits"), [(2.0, True, True), (2.0, False, False), (-2.0, True, False)]
)
def test_one_that_comes_back_behind_the_filter_waits_for_a_change_of_velocity(
    late_m: float, surprising: bool, waits: bool
) -> None:
    """Its first fix lies behind, by more than is likely: on a straight nobody can tell whether it
    is late."""
    isolation, journey = Isolation(), Journey(1)
    rng = np.random.default_rng(2)
    told = []
    p = np.diag([1e-6] * 6 + [0.01 if surprising else 9.0] * 3 + [1e-9] * (MODEL.size - 9))
    for k in [*range(LAST), *range(BACK, BACK + 300)]:
        offer, nav = journey.at(k, 0.0)
        v = np.array((8.0, 3.0))
        if k >= BACK + 200:  # speeds up
            v = v * (1.0 + (k - BACK - 200) / (10.0 * RATE_HZ))
        nav[VN], nav[VE] = v
        along = late_m / float(np.hypot(*v))
        nav[LAT] = offer.lat_rad + along * v[0] / metres_a_radian(nav)[0]
        nav[LON] = offer.lon_rad + along * v[1] / metres_a_radian(nav)[1]
        place = offer.lat_rad, offer.lon_rad, offer.height_m
        aid = PositionAid("gnss", offer.t_ns, 0.9999, *place, offer.sd, offer.lever)
        y = tuple(rng.standard_normal(3).tolist()) if k < LAST else ()
        if isolation.unproven("gnss", aid.t_ns):
            isolation.comes(aid, state_at(nav), p)
        isolation.judge(aid, Outcome("fused", 1.0, 3, y), nav)
        told.append("on time" in (isolation.contested(aid.t_ns) or ""))
    assert not any(told[:LAST])
    assert any(told[LAST:]) is waits
    assert told[LAST + 199] is waits
    assert not told[-1]


def test_a_start_after_a_failure_still_waits_when_an_outage_follows() -> None:
    """Nothing has told meanwhile, and the first fix that is back does not lie behind."""
    isolation, journey, told = Isolation(), Journey(1), []
    isolation.reset(failed=True)
    for k in [*range(50), *range(200, 250)]:
        offer, nav = journey.at(k)
        nav[LAT], nav[LON] = offer.lat_rad, offer.lon_rad
        place = offer.lat_rad, offer.lon_rad, offer.height_m
        aid = PositionAid("gnss", offer.t_ns, 0.9999, *place, offer.sd, offer.lever)
        if isolation.unproven("gnss", aid.t_ns):
            isolation.comes(aid, state_at(nav), np.eye(MODEL.size))
        isolation.judge(aid, Outcome("fused", 1.0, 3), nav)
        punctual = isolation._records["gnss"].punctual
        told.append(punctual is not None and punctual.started)
    assert all(told)


def test_one_whose_own_velocity_was_left_out_since_is_to_prove_itself_wholly() -> None:
    """Late fixes take a filter along, and the velocities that had contradicted it pass again."""
    contested = []
    for refused in (False, True):
        returned = Returned(velocities=True)
        returned.fixes(0, LAST)
        returned.fixes(BACK, BACK + 10)
        if refused:
            nav = START.copy()
            for k in range(3):
                t_ns = (BACK + 10) * S // RATE + k
                v = VelocityAid(
                    "gnss_velocity", t_ns, 0.9999, (9.0, 3.0), (SD_M_S,) * 2, (0.0,) * 3
                )
                returned.isolation.judge(v, Outcome("gated", 400.0, 2, (20.0, 0.0)), nav)
            assert not returned.isolation.believes("gnss_velocity")
        returned.fixes(BACK + 11, BACK + 60)
        assert returned.isolation.believes("gnss_velocity")
        contested.append(returned.isolation.contested((BACK + 60) * S // RATE))
        returned.fixes(BACK + 60, BACK + 150)
        assert returned.isolation.contested((BACK + 150) * S // RATE) is None
    assert contested[0] is None
    assert "not yet seen to go with" in (contested[1] or "")


@pytest.mark.parametrize("failed", [True, False])
def test_a_start_after_a_failure_waits_until_an_even_braking_ends(failed: bool) -> None:
    """By then its speed has changed by 10 m/s, which says nothing of how late its fixes are."""
    isolation, journey, told = Isolation(), Journey(1), []
    isolation.reset(failed=failed)
    for k in range(150):
        offer, nav = journey.at(k)
        nav[VN], nav[VE] = 10.0 + max(0.65 * (75 - k), 3.0 * (k - 75)) / RATE_HZ, 0.0
        nav[LAT], nav[LON] = offer.lat_rad, offer.lon_rad
        place = offer.lat_rad, offer.lon_rad, offer.height_m
        aid = PositionAid("gnss", offer.t_ns, 0.9999, *place, offer.sd, offer.lever)
        isolation.judge(aid, Outcome("fused", 1.0, 3), nav)
        told.append("began anew" in (isolation.contested(aid.t_ns) or ""))
    assert told[:76] == [failed] * 76
    assert not told[-1]
