"""How long a doubt and a failed start weigh, and a mounting that is not the configured one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.support import Lost
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle import MOUNTING, mounting
from fusiond.navigation.strapdown import VE, VN
from fusiond.navigator.standing import Standing

S = 1_000_000_000
IMU = Imu()


class Doubted(Isolation):
    """An isolation that has doubted the filter at these seconds."""

    def __init__(self, *at_s: float) -> None:
        super().__init__()
        self._doubts = tuple(round(t * S) for t in at_s)


class WithoutVelocity(Isolation):
    """An isolation that leaves out a velocity that comes."""

    def velocity_left_out(self, t_ns: int) -> bool:
        return True


def at(t_s: float) -> KalmanEstimator:
    """A filter at an instant; its IMU is mounted to within 5 deg."""
    model = make_model("ins15", imu_noise(IMU), mounting(math.radians(5.0)))
    estimator = KalmanEstimator(model, IMU.gap_s)
    estimator.t_ns = round(t_s * S)
    return estimator


def coasts_until_s(isolation: Isolation, last_s: int) -> int:
    """The first second from the last doubt on at which nothing is doubted any more."""
    standing = Standing(150.0)
    return next(
        t for t in range(last_s, last_s + 1000) if standing.shaken(at(t), isolation) is None
    )


def test_each_doubt_in_a_row_takes_twice_as_long_to_prove() -> None:
    assert Standing(150.0).shaken(at(0.0), Isolation()) is None
    assert coasts_until_s(Doubted(100), 100) == 110
    assert coasts_until_s(Doubted(100, 130), 130) == 150
    assert coasts_until_s(Doubted(100, 130, 200), 200) == 240
    assert coasts_until_s(Doubted(100, 100.2, 102), 102) == 112  # one, told thrice
    assert coasts_until_s(Doubted(100, 130, 900), 900) == 910  # forgotten by then
    many = Doubted(*range(100, 180, 10))
    assert coasts_until_s(many, 170) == 170 + 320


def test_a_start_after_failures_in_a_row_is_longer_on_trial() -> None:
    standing = Standing(150.0)
    standing.started(0)
    assert standing.unproven(0) is None
    standing.given_up(5 * S)
    standing.started(6 * S)
    assert standing.unproven(15 * S) is not None
    assert standing.unproven(16 * S) is None
    standing.given_up(20 * S)
    standing.started(21 * S)
    assert standing.unproven(40 * S) is not None
    assert standing.unproven(41 * S) is None
    standing.given_up(400 * S)  # it went well for long
    standing.started(401 * S)
    assert standing.unproven(410 * S) is not None
    assert standing.unproven(411 * S) is None


def test_an_imu_that_sits_askew_beyond_its_sigma_is_told() -> None:
    """Attitude is the IMU's: by then it is not the vehicle's that was configured."""
    estimator = at(100.0)
    yaw = estimator.model.slots_of(MOUNTING)[1]
    estimator.xi[yaw] = math.radians(-19.0)
    assert Standing(150.0).shaken(estimator, Isolation()) is None
    estimator.xi[yaw] = math.radians(-30.0)
    why = Standing(150.0).shaken(estimator, Isolation())
    assert why is not None
    assert "-30 deg askew" in why


def test_a_turn_felt_at_rest_is_believed_once_the_vehicle_has_moved() -> None:
    """Of one on wheels; a ship turns as it likes."""
    nav = np.zeros(10)
    ship, car = Standing(150.0), Standing(150.0, wheeled=True)
    for standing in (ship, car):
        standing.started(0)
        assert standing.failure(S, Isolation(), nav) is None
        standing.turned(2 * S)
        assert standing.failure(3 * S, Isolation(), nav) is None
    assert ship.shaken(at(3.0), Isolation()) is None
    why = car.shaken(at(3.0), Isolation())
    assert why is not None
    assert "felt at rest" in why
    nav[VN] = 6.0
    assert car.failure(10 * S, WithoutVelocity(), nav) is None
    assert car.shaken(at(10.0), Isolation()) is not None  # its velocity does not go along
    nav[VN] = 0.0
    assert car.failure(11 * S, Isolation(), nav) is None
    assert car.shaken(at(11.0), Isolation()) is None
    assert car.failure(12 * S, WithoutVelocity(), nav) is None
    assert car.shaken(at(12.0), Isolation()) is None  # that turn is over
    car.turned(12 * S)
    car.started(13 * S)
    assert car.failure(13 * S, Isolation(), nav) is None
    assert car.shaken(at(13.0), Isolation()) is None


def test_after_a_failure_driving_straight_on_proves_nothing() -> None:
    standing, isolation = Standing(150.0), Isolation()
    nav = np.zeros(10)
    nav[VN] = 20.0
    standing.started(0)
    assert standing.failure(S, isolation, nav) is None
    assert standing.shaken(at(30.0), isolation) is None  # there was no failure
    standing.given_up(30 * S)
    standing.started(31 * S)
    for t in range(31, 90):
        assert standing.failure(t * S, isolation, nav) is None
    assert standing.unproven(90 * S) is None
    why = standing.shaken(at(90.0), isolation)
    assert why is not None
    assert "no change of speed" in why
    nav[VN], nav[VE] = 12.0, 16.0  # nor does a bend: late stamps are a heading there
    assert standing.failure(91 * S, isolation, nav) is None
    assert standing.shaken(at(91.0), isolation) is not None
    nav[VN], nav[VE] = 9.0, 12.0
    assert standing.failure(92 * S, isolation, nav) is None
    assert standing.shaken(at(92.0), isolation) is None
    isolation = WithoutVelocity()  # braking that its velocity does not go along with
    standing.given_up(100 * S)
    standing.started(101 * S)
    assert standing.failure(102 * S, isolation, nav) is None
    nav[VN], nav[VE] = 0.0, 9.0
    assert standing.failure(190 * S, isolation, nav) is None
    assert standing.shaken(at(190.0), isolation) is not None
    nav[VN], nav[VE] = 0.0, 15.0
    assert standing.failure(191 * S, Isolation(), nav) is None
    assert standing.shaken(at(191.0), Isolation()) is None
    again = Doubted(192)  # what was proven before a doubt is not after it
    assert standing.failure(193 * S, again, nav) is None
    assert standing.shaken(at(210.0), again) is not None


def test_what_never_drives_fast_proves_itself_by_most_of_its_speed() -> None:
    standing, isolation, nav = Standing(150.0), Isolation(), np.zeros(10)
    standing.started(0)
    for t, speed in ((1, 0.0), (2, 2.0)):
        nav[VN] = speed
        assert standing.failure(t * S, isolation, nav) is None
    standing.given_up(3 * S)
    standing.started(4 * S)
    assert standing.failure(30 * S, isolation, nav) is None
    assert standing.shaken(at(30.0), isolation) is not None
    nav[VN] = 0.3
    assert standing.failure(31 * S, isolation, nav) is None
    assert standing.shaken(at(31.0), isolation) is None


class Left(Isolation):
    """An isolation of a receiver that has left the filter by a jump, until another device is
    fused."""

    def __init__(self) -> None:
        super().__init__()
        self.since_ns: int | None = 0
        self.cause = "source"
        self.supported = self.returning = False

    def lost(self, t_ns: int) -> Lost | None:
        if self.since_ns is None:
            return None
        reason = "jumped" if self.cause == "source" else "disagrees"
        away_m, disputed = 50.0, False
        return Lost(self.since_ns, self.cause, "gnss", reason, away_m, disputed, self.returning)

    def supported_by_another(self, device: str) -> bool:
        assert device == "gnss"
        return self.supported


def test_a_start_from_a_receiver_that_had_jumped_away_coasts_until_another_device_agrees() -> None:
    isolation, standing = Left(), Standing(150.0)
    still = np.zeros(10)
    assert standing.failure(59 * S, isolation, still) is None
    assert standing.failure(61 * S, isolation, still) is not None
    isolation.since_ns = None
    standing.started(62 * S)
    for t_s in (63, 1000, 100_000):
        assert "nothing else can check it" in (standing.shaken(at(t_s), isolation) or "")
    isolation.supported = True
    assert standing.shaken(at(100_001), isolation) is None
    isolation.supported = False
    assert standing.shaken(at(100_002), isolation) is None


def test_what_a_start_may_be_off_by_outlasts_a_failure_of_the_filter() -> None:
    isolation, standing = Left(), Standing(150.0)
    still = np.zeros(10)
    assert standing.failure(61 * S, isolation, still) is not None
    standing.ended(isolation)
    moved = standing.moved
    assert moved is not None
    assert (moved.device, moved.since_ns, moved.lasted_ns) == ("gnss", 61 * S, 61 * S)
    assert moved.squares == (1250.0, 1250.0, 1250.0)
    isolation.reset(failed=True, moved=moved)
    isolation.cause = "filter"
    assert standing.failure(90 * S, isolation, still) is not None
    standing.ended(isolation)
    assert standing.moved == moved  # nobody has told meanwhile
    isolation.reset(failed=True, moved=moved)
    isolation.cause = "source"
    assert standing.failure(200 * S, isolation, still) is not None
    standing.ended(isolation)
    assert standing.moved is not None
    faded = 1250.0 * 61.0 / 200.0
    assert standing.moved.squares == pytest.approx((1250.0 + faded,) * 3)


def test_what_is_on_its_way_back_is_waited_for() -> None:
    isolation, standing = Left(), Standing(150.0)
    still = np.zeros(10)
    isolation.returning = True
    assert standing.failure(61 * S, isolation, still) is None
    assert "nothing else can check it" in (standing.shaken(at(61.0), isolation) or "")
    isolation.returning = False
    assert standing.failure(62 * S, isolation, still) is not None
