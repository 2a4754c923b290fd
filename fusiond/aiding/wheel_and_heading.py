r"""Wheel speed and heading for a vehicle of unknown attitude.

A vehicle that does not slide moves along its heading psi, or backwards. With f = (cos psi, sin psi,
0), s the side slip, and the wheel's errors as in fusiond.aiding.body_velocity

    heading:  z = v_e^ cos psi - v_n^ sin psi - s                     psi = y - dev^
              dz = (-sin psi, cos psi) dv - (f . v) d dev + noise     (f . v)^2 sd^2 + sd_slip^2
    wheel:    z = (1 + k^) f . v^ + s_w^ - q sign(y) p^ - y
              dz = (1 + k) f dv - (f . v) dk - ds_w + q sign(y) dp + noise

f of a wheel is that of the last heading; without one it is the direction of v^ itself, if v^
exceeds `SIGN_SIGMAS` of its sigma (f . v is then the ground speed, and a wheel that turns backwards
has -f). A wheel speed within its noise means rest at any heading: v_n = v_e = 0. Otherwise the
outcome is `direction_unknown`. A heading error d makes a speed too small by d^2 / 2. The
acceleration is unknown, so a latency is noise, of `BRAKES_M_S2`.

dev is a compass's deviation (fusiond.aiding.compass). Source: as of those two modules.
"""

from __future__ import annotations

import math
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.navigation.strapdown import VD, VE, VN

Array = NDArray[np.float64]

SIGN_SIGMAS = 3.0
"""Sigmas beyond which a velocity's sign is wrong once in 740."""
BRAKES_M_S2 = 1.0
"""One sigma of a car's acceleration or braking at a comfortable limit."""
FIRST = 3
"""First row of the velocity in the error state."""


def _variance(p: Array | None, axis: Array) -> float:
    """Variance of the velocity along an axis (3,)."""
    if p is None:
        return 0.0
    return max(float(axis @ p[FIRST : FIRST + 3, FIRST : FIRST + 3] @ axis), 0.0)


@immutable()
class CourseMeasurement(AidingMeasurement):
    """Zero velocity across a heading `yaw_rad` with `sd_rad`, with a slip of sigma `slips_m_s`.

    `blocks` name the model's blocks of the heading's errors, in the order of `shares` (k,): the
    effect of each of their states on the heading.
    """

    yaw_rad: float
    sd_rad: float
    slips_m_s: float
    blocks: tuple[str, ...] = ()
    by: tuple[float, ...] = ()

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav, xi, model = state.nav, state.xi, state.model
        slots = [slot for block in self.blocks for slot in model.slots_of(block)]
        by = np.array(self.by)
        psi = self.yaw_rad - float(by @ xi[slots])
        forward = np.array([math.cos(psi), math.sin(psi), 0.0])
        across = np.array([-math.sin(psi), math.cos(psi), 0.0])
        v = nav[VN : VD + 1]
        along = float(forward @ v)
        square = along * along + _variance(state.covariance, forward)
        h = np.zeros((1, model.size))
        h[0, FIRST : FIRST + 2] = across[:2]
        h[0, slots] = -along * by
        r = self.slips_m_s**2 + square * self.sd_rad**2
        return Innovation(np.array([float(across @ v)]), h, np.array([r]))


@immutable()
class GroundSpeed(AidingMeasurement):
    """A wheel's speed (m/s) with `sd_m_s`; all else as `WheelSpeedMeasurement` has it, and the
    `way` that the vehicle faces."""

    rolls: ClassVar[bool] = True
    shown: ClassVar[attrgetter[Any] | None] = attrgetter("speed_m_s")

    speed_m_s: float
    sd_m_s: float
    signed: bool
    drift: str
    scale: str
    latency: str
    rounding: str
    shared_step_m_s: float
    way: HeadingHistory

    def innovation(self, state: State) -> Innovation | NotApplicable:
        model, y = state.model, self.speed_m_s
        latency_s = sum(float(model.initial[slot]) for slot in model.slots_of(self.latency))
        variance = self.sd_m_s**2 + (BRAKES_M_S2 * latency_s) ** 2
        forward = self._forward(state)
        if forward is None:
            lasts = sum(float(model.initial[slot]) for slot in model.slots_of(self.drift))
            sd = math.sqrt(variance + lasts * lasts)
            if abs(y) > SIGN_SIGMAS * sd:
                return NotApplicable("direction_unknown")
            h = np.zeros((2, model.size))
            h[0, FIRST] = h[1, FIRST + 1] = 1.0
            v = np.array([state.nav[VN], state.nav[VE]])
            return Innovation(v, h, np.full(2, sd * sd + y * y))
        axis, sd_rad = forward
        along = float(axis @ state.nav[VN : VD + 1])
        if not self.signed:
            y = math.copysign(y, along)
        z, h = along, np.zeros((1, model.size))
        h[0, FIRST : FIRST + 3] = axis
        for slot in model.slots_of(self.scale):
            gain = 1.0 + float(state.xi[slot])
            z, h = z * gain, h * gain
            h[0, slot] = -along
        for slot in model.slots_of(self.drift):
            z += float(state.xi[slot])
            h[0, slot] = -1.0
        step = math.copysign(self.shared_step_m_s, y)
        for slot in model.slots_of(self.rounding):
            z -= step * float(state.xi[slot])
            h[0, slot] = step
            variance -= (step * float(model.initial[slot])) ** 2
        square = along * along + _variance(state.covariance, axis)
        variance += square * (0.5 * sd_rad * sd_rad) ** 2
        return Innovation(np.array([z - y]), h, np.array([variance]))

    def _forward(self, state: State) -> tuple[Array, float] | None:
        """Vehicle's forward axis (3,) and the sigma (rad) of its heading; None if unknown, or if
        the direction of travel is unknown for a wheel without sign."""
        v, p = state.nav[VN : VD + 1], state.covariance
        faced, sd_rad = self.way.at(self.t_ns), 0.0
        if faced is not None:
            axis = np.array([math.cos(faced.yaw_rad), math.sin(faced.yaw_rad), 0.0])
            sd_rad = faced.sd_rad
            if self.signed:
                return axis, sd_rad
        else:
            speed = float(np.linalg.norm(v))
            if speed == 0.0:
                return None
            axis = v / speed
        if abs(float(axis @ v)) <= SIGN_SIGMAS * math.sqrt(_variance(p, axis)):
            return None
        if faced is None and self.signed and self.speed_m_s < 0.0:
            axis = -axis
        return axis, sd_rad
