"""A position that is back after an outage, or after a failure: how it counts until it is seen to go
along and to be on time, and what is published until then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import State
from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.base import Outcome
from fusiond.integrity.action import Action
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.proof import (
    UNPROVEN_SIGMAS,
    metres_a_radian,
)
from fusiond.integrity.punctual import MOST_LATE_S, MOST_SIGMAS
from fusiond.integrity.returns import coming
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.navigation.strapdown import LAT, LON, STEP_SIZE, VE, VN
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.recording import Drive
from fusiond.studies.faults.runs import VEHICLE, navigate
from tests.integrity.journey import (
    BACK,
    LAST,
    MODEL,
    RATE,
    RATE_HZ,
    SD_M,
    SD_M_S,
    START,
    Journey,
    Returned,
    S,
    state_at,
)

Array = NDArray[np.float64]
OUTAGE_S = (40.0, 80.0)
SECONDS = 120.0


@pytest.mark.parametrize("white", [True, False])
def test_what_may_drift_is_open_where_sigma_would_shrink(white: bool) -> None:
    """Fixes that are configured to share nothing take the filter along within seconds, faster than
    a drift can be told. Where they share an error, P never falls below it."""
    gnss = {} if white else {"bias_sd_m": 1.0}
    made = VEHICLE.model_dump(exclude_unset=True)
    made["aiding"]["gnss"].update(gnss)
    config = Config.model_validate(made)
    truth, recording = Drive(duration_s=SECONDS, gnss_rate_hz=1.0).recorded(config, seed=5)
    opened: list[float] = []

    def watch(navigator: Navigator) -> None:
        e = navigator.estimator
        if e.t_ns * 1e-9 > OUTAGE_S[1] + 2.0:
            wider = navigator.timeline.isolation.hedge.wider.get("gnss", np.zeros(9))
            opened.append(float(wider[0] / e.covariance[6, 6]))

    navigate(config, recording.withheld(*OUTAGE_S), truth, watch)
    assert max(opened) > 0.2 if white else max(opened) < 0.05


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


def test_a_fix_that_is_off_tilts_the_filter_that_follows() -> None:
    """By the regression of the tilt on the position, of what is beyond chance."""
    north_m, own = 12.0, 3.0
    place = float(START[LAT]) + north_m / metres_a_radian(START)[0], START[LON], 40.0
    aid = PositionAid("gnss", 0, 0.9999, *place, (SD_M,) * 3, (0.0,) * 3)
    p = np.zeros((MODEL.size, MODEL.size))
    p[:2, :2], p[6:8, 6:8] = 0.01**2 * np.eye(2), own**2 * np.eye(2)
    p[1, 6] = p[6, 1] = 0.5 * 0.01 * own
    comes = coming(aid, state_at(START), p)
    beyond = north_m**2 - 3.84 * (own**2 + SD_M**2)
    assert comes.beyond[0] == pytest.approx(beyond, rel=1e-3)
    assert comes.tilt == pytest.approx((0.5 * 0.01 / own) ** 2 * beyond, rel=1e-3)


def _back(wander: str, seconds: float) -> list[tuple[Array, Array]]:
    """Of a receiver that is back, for so long, after 40 s without, on a straight and then braking
    and turning: what is open, and the velocity."""
    isolation, p = Isolation(), 0.2**2 * np.eye(MODEL.size)
    found: list[tuple[Array, Array]] = []
    for k in [*range(50), *range(250, 250 + round(seconds * RATE_HZ))]:
        t_s = k / RATE_HZ
        nav, turned = START.copy(), 0.2 * max(0.0, t_s - 60.0)
        nav[VN : VE + 1] = 8.0 * math.cos(turned), 8.0 * math.sin(turned)
        nav[LAT] += 8.0 * t_s / metres_a_radian(START)[0]
        place = float(nav[LAT]), float(nav[LON]), 40.0
        aid = PositionAid("gnss", round(t_s * S), 0.9999, *place, (0.02,) * 3, (0.0,) * 3)
        if isolation.unproven("gnss", aid.t_ns):
            before = p.copy()
            before[6:8, 6:8] = 30.0**2 * np.eye(2)
            isolation.comes(aid, state_at(nav), before if k == 250 else p)
        aid = replace(aid, wander=wander)
        isolation.judge(aid, Outcome("fused", 1.0, 3, ()), nav, p)
        if k >= 250:
            wider = isolation.hedge.wider.get("gnss late", np.zeros(9))
            found.append((wider, nav[VN : VE + 1]))
    return found


def test_what_is_back_is_no_surer_than_that_it_is_on_time() -> None:
    """Along the track, and until the vehicle has turned; of the filter's own sigma as much less."""
    found = _back("", 30.0)
    straight, _ = found[40]
    most = (8.0 * MOST_LATE_S / MOST_SIGMAS) ** 2
    assert straight == pytest.approx([most - 0.2**2, *[0.0] * 8], abs=1e-6)
    assert not found[-1][0].any()


def test_of_errors_that_last_a_lateness_leaves_nothing_open() -> None:
    """P is never below them."""
    assert not any(wider.any() for wider, _ in _back("gnss_wander", 5.0))


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
            assert "gnss_velocity" in returned.isolation.excluded
        returned.fixes(BACK + 11, BACK + 60)
        assert "gnss_velocity" not in returned.isolation.excluded
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


def _drifting(drift_m_s: float, wander: str) -> list[tuple[float, float]]:
    """Of a receiver that was sound for ten minutes, is back after 40 s without, and drifts: by how
    much the filter, which follows it, is off to the north, and the variance that is open beside its
    own of 1 m^2."""
    isolation, p, k = Isolation(), np.eye(MODEL.size), 1.0 / (1.0 + UNPROVEN_SIGMAS**2)
    to_m, error_m, rng = metres_a_radian(START)[0], 0.0, np.random.default_rng(7)
    found: list[tuple[float, float]] = []
    for t_s in [*range(600), *range(640, 665)]:
        drifted = drift_m_s * max(0.0, t_s - 640.0)
        error_m += k * (drifted - error_m)
        nav = START.copy()
        nav[VN : VE + 1] = 8.0, 0.0
        nav[LAT] += (8.0 * t_s + error_m) / to_m
        place = START[LAT] + (8.0 * t_s + drifted) / to_m, START[LON], 40.0
        aid = PositionAid("gnss", t_s * S, 0.9999, *place, (1.0,) * 3, (0.0,) * 3)
        moving = VelocityAid("gnss_velocity", t_s * S, 0.9999, (8.0, 0.0), (0.2,) * 2, (0.0,) * 3)
        isolation.judge(moving, Outcome("fused", 0.0, 2, (0.0, 0.0)), nav, p)
        if isolation.unproven("gnss", aid.t_ns):
            isolation.comes(aid, state_at(nav), p)
        aid = replace(aid, wander=wander)
        noise = rng.standard_normal(3) if t_s < 600 else np.zeros(3)
        isolation.judge(aid, Outcome("fused", 1.0, 3, tuple(noise.tolist())), nav, p)
        if t_s >= 640 and "gnss" not in isolation.excluded:
            wider = isolation.hedge.wider.get("gnss", np.zeros(9))
            found.append((error_m, float(wider[0])))
    return found


def test_a_slope_beyond_chance_is_no_error_that_fixes_share() -> None:
    """A state for such an error keeps P above it; a drift that is not told yet goes beyond that."""
    found = _drifting(0.5, "gnss_wander")
    assert max(error for error, _ in found) > 5.0
    assert all(error < 3.0 * math.sqrt(1.0 + opened) for error, opened in found[8:])
    assert not any(opened for _, opened in _drifting(0.0, "gnss_wander"))
