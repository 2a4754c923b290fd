"""A vehicle that goes straight on, the fixes of its antenna, and the isolation that judges them."""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.base import State
from fusiond.aiding.offers import PositionOffer
from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.base import Outcome, gate_threshold
from fusiond.integrity.action import Action
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.proof import (
    Proof,
    metres_a_radian,
)
from fusiond.models.catalogue import make_model
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.navigation.strapdown import LAT, LON, Q0, STEP_SIZE, VE, VN

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


MODEL = make_model("ins15", imu_noise(Imu()))


def state_at(nav: np.ndarray) -> State:
    return State(nav, np.zeros(MODEL.size), np.zeros(STEP_SIZE), MODEL)


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
            name = "fused" if "gnss" not in self.isolation.excluded else "isolated"
            outcome = Outcome(name, 1.0, 3, () if less else self._white(3))
            found.append((less, self.isolation.judge(aid, outcome, nav)))
            if self._velocities:
                v, sd = (8.0, 3.0), (SD_M_S, SD_M_S)
                moving = VelocityAid("gnss_velocity", aid.t_ns, 0.9999, v, sd, offer.lever)
                self.isolation.judge(moving, Outcome("fused", 1.0, 2, self._white(2)), nav)
        return found


RATE = round(RATE_HZ)


LAST, BACK = 600, 800
