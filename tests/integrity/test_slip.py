"""A heading that has turned, where the filter may take it for slip, or for the gyros' bias."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.aiding.base import Innovation, State
from fusiond.aiding.body_velocity import NonHolonomicAid
from fusiond.estimators.base import Outcome
from fusiond.integrity.hedge import AT_REST, NOTHING
from fusiond.integrity.isolation import Isolation
from fusiond.models.vehicle import SIDE_DRIFT
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.navigation.strapdown import STEP_SIZE
from tests.aiding.aid_bench import vehicle_model
from tests.integrity.series_bench import GATE, LEVER, NAV, Bench, S
from tests.navigator.vehicle import START_NS, drive, started


@pytest.mark.parametrize("to_and_fro", [False, True])
def test_a_slip_that_lasts_may_be_a_heading_that_has_turned(to_and_fro: bool) -> None:
    """A heading that has turned by a degree at 14 m/s is 0.24 m/s across. Where the filter holds
    0.1 m/s of slip to be likely it takes most of that for slip, and its innovations are chance.
    Backward, all of it goes to the other side."""
    model, p = vehicle_model(), np.diag([1e-6] * 9)
    isolation, speed = Isolation(), 14.0

    def told(epochs: range, turned_deg: float, told_m_s: float) -> None:
        nav = NAV.copy()
        nav[6:] = quaternion_from_rpy(0.0, 0.0, math.radians(-turned_deg))
        for k in epochs:
            xi, way = np.zeros(model.size), (-1.0) ** (k // 10 * to_and_fro)
            xi[model.slots_of(SIDE_DRIFT)[0]] = way * told_m_s
            nav[3:6] = way * speed, 0.0, 0.0
            state = State(nav, xi, np.zeros(STEP_SIZE), model, p)
            aid = NonHolonomicAid("non_holonomic", k * S // 10, GATE, 0.2, 0.5, 2.0, LEVER)
            innovation = aid.innovation(state)
            assert isinstance(innovation, Innovation)
            y = float(innovation.z[0]) / 0.23
            assert abs(y) < 0.3
            isolation.judge(aid, Outcome("fused", y * y, 2, (y, 0.0)), nav, p, state)

    told(range(300), 0.5, 0.1)
    assert isolation.hedge.wider is NOTHING
    told(range(300, 500), 1.0, 0.18)
    wider = isolation.hedge.wider["non_holonomic across"]
    assert not wider[:8].any()
    assert 0.4 < math.degrees(math.sqrt(wider[8])) < 1.0
    assert np.array_equal(isolation.snapshot().wider["non_holonomic across"], wider)
    told(range(500, 700), 0.5, 0.1)
    assert isolation.hedge.wider is NOTHING


def test_a_turn_that_gyros_feel_at_rest_leaves_the_heading_open() -> None:
    """A gyro is off by 0.35 deg/s from some second of a stop on: too much for its bias, too little
    in each window for a turn that is none of chance. Driving on answers it."""
    navigator, row = started()
    d = drive()
    samples, errors = d.samples.copy(), []
    begin_ns = START_NS + 38_500_000_000
    samples[d.times > begin_ns, 2] += math.radians(0.35)
    measurements = list(d.measurements)
    while row < len(d.times):
        navigator.add_imu(d.times[row : row + 10], samples[row : row + 10])
        row += 10
        now = int(d.times[min(row, len(d.times)) - 1])
        while measurements and measurements[0].t_seen_ns <= now:
            m = measurements.pop(0)
            assert navigator.add(m, m.t_seen_ns) == "accepted"
        navigator.advance()
        if now < begin_ns:
            assert AT_REST not in navigator.timeline.isolation.hedge.wider
        if now >= begin_ns - 1_000_000_000:
            found = navigator.solution(now)
            errors.append((found.rpy_rad[2], found.sd_rpy_rad[2]))
    turned = abs(errors[-1][0] - errors[0][0])
    assert math.degrees(turned) > 1.0
    assert turned < 3.0 * errors[-1][1]
    wider = navigator.timeline.isolation.hedge.wider
    assert 0.5 * turned < math.sqrt(wider[AT_REST][8]) < 1.5 * turned


def test_a_heading_that_was_open_at_rest_is_answered_by_driving_on() -> None:
    made, model = Bench(), vehicle_model()
    made.isolation.turns_at_rest(0.02)
    assert made.isolation.hedge.wider is NOTHING  # a ship turns as it likes
    nav = NAV.copy()
    nav[6:] = quaternion_from_rpy(0.0, 0.0, math.atan2(NAV[4], NAV[3]))
    p = np.diag([1e-6] * 9)
    state = State(nav, np.zeros(model.size), np.zeros(STEP_SIZE), model, p)
    for k in range(400):
        aid = NonHolonomicAid("non_holonomic", k * S // 10, GATE, 0.1, 0.1, 1.0, LEVER)
        made.isolation.judge(aid, Outcome("fused", 0.0, 2, (0.0, 0.0)), nav, p, state)
        if k == 100:
            for _ in range(3):
                made.isolation.turns_at_rest(0.02)
            kept = made.isolation.snapshot()
            assert kept.wider[AT_REST][8] == pytest.approx(0.06**2)
        if k == 130:
            assert 0.01**2 < made.isolation.hedge.wider[AT_REST][8] < 0.03**2
    assert made.isolation.hedge.wider is NOTHING
