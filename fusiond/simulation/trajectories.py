r"""Trajectories: speed, course and climb angle of a vehicle as smooth functions of time.

    v_n = s [cos(gamma) cos(chi), cos(gamma) sin(chi), -sin(gamma)]
    roll = k atan(s chi' / g),   pitch = gamma + alpha,   yaw = chi + c |s| chi'

s speed (m/s), chi course and gamma climb angle (rad), each a chain of minimum-jerk steps
10 x^3 - 15 x^4 + 6 x^5 between knots: twice continuously differentiable, and exactly constant where
two knots hold the same value, so that a stop is a real standstill. k is 1 for an aircraft in
coordinated turns and slightly negative for a car, which leans outwards; alpha is the incidence.
v_n is the velocity of the point that follows the path; for a car that is the middle of the rear
axle, where it lies along the forward axis (alpha = 0) but for the slip angle c |s chi'| of the rear
tyres, outwards and in proportion to the force that they give. The IMU sits at l from it:

    v = v_n + C_nb (w x l),   v' = v_n' + C_nb (w' x l + w x (w x l)),   w = w_nb^b

Source: Flash and Hogan, J. Neuroscience 5 (1985), for the step; Groves, 2nd ed., section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2

Array = NDArray[np.float64]


@compiled("void(f8[::1], f8[::1], f8[::1], f8[:, ::1])")
def _steps(knots: Array, values: Array, t_s: Array, out: Array) -> None:
    """Write `out` (4, n), a profile and its derivatives at instants (n,); knots and values (k,)."""
    last = knots.shape[0] - 1
    for k in range(t_s.shape[0]):
        low, high = 0, last + 1  # the first knot later than t lies in between
        while low < high:
            middle = (low + high) // 2
            if t_s[k] < knots[middle]:
                high = middle
            else:
                low = middle + 1
        i = min(max(low - 1, 0), max(last - 1, 0))
        j = min(i + 1, last)
        length = knots[j] - knots[i] if j > i else 1.0
        x = (t_s[k] - knots[i]) / length
        inside = 0.0 <= x < 1.0
        x = min(max(x, 0.0), 1.0)
        rise = values[j] - values[i]
        x2, y = x * x, 1.0 - x
        out[0, k] = values[i] + rise * x2 * x * (10.0 - 15.0 * x + 6.0 * x2)
        out[1, k] = rise / length * 30.0 * x2 * (y * y)
        out[2, k] = rise / (length * length) * 60.0 * x * (1.0 - 3.0 * x + 2.0 * x2)
        bent = rise / (length * length * length) * 60.0 * (1.0 - 6.0 * x + 6.0 * x2)
        out[3, k] = bent if inside else 0.0


class Profile:
    """Function of time through knots (t_s increasing, values), constant outside them."""

    def __init__(self, t_s: Sequence[float], values: Sequence[float]) -> None:
        self._t = np.asarray(t_s, dtype=np.float64)
        self._values = np.asarray(values, dtype=np.float64)
        if self._t.shape != self._values.shape or np.any(np.diff(self._t) <= 0):
            raise ValueError("knots: equally many times and values, times increasing")

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Value and its first, second and third derivative in time at each of `t_s`.

        The third jumps at the knots, where it is that of the piece that begins.
        """
        at = np.asarray(t_s, dtype=np.float64)
        out = np.empty((4, *at.shape))
        _steps(self._t, self._values, np.ascontiguousarray(at).ravel(), out.reshape(4, -1))
        return out[0], out[1], out[2], out[3]


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Arrays (..., 3): velocity and its derivative in NED, roll-pitch-yaw and their rates, SI."""

    v_ned: Array
    v_ned_rate: Array
    rpy: Array
    rpy_rate: Array


@dataclass(frozen=True, slots=True)
class Path:
    """Speed (m/s), course and climb angle (rad) over time.

    `bank_ratio` is k, `slip_rad_s2_m` is c and `arm_m` is l (body axes: forward, right, down) of
    the module's text.
    """

    speed: Profile
    course: Profile
    climb: Profile
    bank_ratio: float = 0.0
    incidence_rad: float = 0.0
    arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slip_rad_s2_m: float = 0.0

    def kinematics(self, t_s: Array) -> Kinematics:
        """Motion of the IMU at the instants `t_s` (any shape); yaw is not wrapped."""
        s, s1, s2, _ = self.speed(t_s)
        chi, chi1, chi2, chi3 = self.course(t_s)
        gamma, gamma1, gamma2, _ = self.climb(t_s)
        sc, cc, sg, cg = np.sin(chi), np.cos(chi), np.sin(gamma), np.cos(gamma)
        v_ned = np.stack((s * cg * cc, s * cg * sc, -s * sg), axis=-1)
        horizontal1 = s1 * cg - s * sg * gamma1
        v_ned_rate = np.stack(
            (
                horizontal1 * cc - s * cg * sc * chi1,
                horizontal1 * sc + s * cg * cc * chi1,
                -s1 * sg - s * cg * gamma1,
            ),
            axis=-1,
        )
        g = STANDARD_GRAVITY_M_S2
        u = s * chi1 / g
        u1 = (s1 * chi1 + s * chi2) / g
        w = 1.0 + u * u
        slip = np.copysign(self.slip_rad_s2_m * g, s)
        bank, pitch, yaw = (
            self.bank_ratio * np.arctan(u),
            gamma + self.incidence_rad,
            chi + slip * u,
        )
        rpy = np.stack((bank, pitch, yaw), axis=-1)
        rpy_rate = np.stack((self.bank_ratio * u1 / w, gamma1, chi1 + slip * u1), axis=-1)
        if any(self.arm_m):
            u2 = (s2 * chi1 + 2.0 * s1 * chi2 + s * chi3) / g
            roll2 = self.bank_ratio * (u2 / w - 2.0 * u * u1 * u1 / (w * w))
            turning = np.stack((roll2, gamma2, chi2 + slip * u2), axis=-1)
            rate, acceleration = body_rate(rpy, rpy_rate, turning)
            arm = np.asarray(self.arm_m, dtype=np.float64)
            across = np.cross(rate, arm)
            dcm = dcm_from_rpy(rpy)
            v_ned += _rotate(dcm, across)
            v_ned_rate += _rotate(dcm, np.cross(acceleration, arm) + np.cross(rate, across))
        return Kinematics(v_ned, v_ned_rate, rpy, rpy_rate)


def _rotate(dcm: Array, vectors: Array) -> Array:
    product: Array = (dcm @ vectors[..., None])[..., 0]
    return product


def dcm_from_rpy(rpy: Array) -> Array:
    """C_nb (..., 3, 3) from roll, pitch, yaw (..., 3) in rad."""
    sr, cr = np.sin(rpy[..., 0]), np.cos(rpy[..., 0])
    sp, cp = np.sin(rpy[..., 1]), np.cos(rpy[..., 1])
    sy, cy = np.sin(rpy[..., 2]), np.cos(rpy[..., 2])
    rows = (
        (cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy),
        (cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy),
        (-sp, sr * cp, cr * cp),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def body_rate(rpy: Array, rate: Array, acceleration: Array) -> tuple[Array, Array]:
    """Body rate w_nb^b (..., 3) and its time derivative from Euler angles and their two
    derivatives."""
    sr, cr = np.sin(rpy[..., 0]), np.cos(rpy[..., 0])
    sp, cp = np.sin(rpy[..., 1]), np.cos(rpy[..., 1])
    a, b, c = rate[..., 0], rate[..., 1], rate[..., 2]
    a2, b2, c2 = acceleration[..., 0], acceleration[..., 1], acceleration[..., 2]
    first = np.stack((a - c * sp, b * cr + c * sr * cp, c * cr * cp - b * sr), axis=-1)
    second = np.stack(
        (
            a2 - c2 * sp - c * b * cp,
            b2 * cr - b * a * sr + c2 * sr * cp + c * (a * cr * cp - b * sr * sp),
            c2 * cr * cp - c * (a * sr * cp + b * cr * sp) - b2 * sr - b * a * cr,
        ),
        axis=-1,
    )
    return first, second


@dataclass(frozen=True, slots=True)
class Leg:
    """Leg: time in which speed and climb reach a new value (None: unchanged) and the course
    turns."""

    duration_s: float
    speed_m_s: float | None = None
    turn_deg: float = 0.0
    climb_deg: float | None = None


def follow(
    legs: Iterable[Leg],
    duration_s: float,
    *,
    course_deg: float = 0.0,
    bank_ratio: float = 0.0,
    incidence_deg: float = 0.0,
) -> Path:
    """Path of a vehicle that starts at rest and repeats the legs until `duration_s`."""
    t, speed, course, climb = [0.0], [0.0], [course_deg], [0.0]
    for leg in legs:
        if t[-1] >= duration_s:
            break
        t.append(t[-1] + leg.duration_s)
        speed.append(speed[-1] if leg.speed_m_s is None else leg.speed_m_s)
        course.append(course[-1] + leg.turn_deg)
        climb.append(climb[-1] if leg.climb_deg is None else leg.climb_deg)
    return Path(
        Profile(t, speed),
        Profile(t, [float(np.radians(x)) for x in course]),
        Profile(t, [float(np.radians(x)) for x in climb]),
        bank_ratio,
        float(np.radians(incidence_deg)),
    )


_BLOCK = (  # net turn 90 deg, net height 0: four of them close a ring
    Leg(12, speed_m_s=14.0),
    Leg(18),
    Leg(6, speed_m_s=8.0),
    Leg(8, turn_deg=90.0),
    Leg(12, speed_m_s=20.0),
    Leg(20),
    Leg(3, turn_deg=6.0),
    Leg(3, turn_deg=-6.0),
    Leg(11, speed_m_s=0.0),
    Leg(20),
    Leg(9, speed_m_s=9.0),
    Leg(8, turn_deg=-90.0),
    Leg(8, speed_m_s=15.0),
    Leg(6, climb_deg=4.0),
    Leg(20),
    Leg(8, climb_deg=-4.0),
    Leg(20),
    Leg(6, climb_deg=0.0),
    Leg(8, speed_m_s=7.0),
    Leg(24, turn_deg=270.0),
    Leg(14, speed_m_s=26.0),
    Leg(14, turn_deg=20.0),
    Leg(14, turn_deg=-20.0),
    Leg(13, speed_m_s=7.0),
    Leg(12, turn_deg=-180.0),
    Leg(6, speed_m_s=0.0),
    Leg(13),
)
_CRUISE = (  # 1000 s at 300 m/s
    Leg(200),
    Leg(180, turn_deg=90.0),
    Leg(120, climb_deg=2.0),
    Leg(120, climb_deg=-2.0),
    Leg(60, climb_deg=0.0),
    Leg(180, turn_deg=-90.0),
    Leg(140),
)


def _for_ever(legs: Sequence[Leg]) -> Iterable[Leg]:
    while True:
        yield from legs


def static(duration_s: float) -> Path:
    """Path of a vehicle at rest, facing north-east."""
    return follow([Leg(duration_s)], duration_s, course_deg=45.0)


def drive(duration_s: float, rest_s: float = 60.0) -> Path:
    """Path of a car: rest, then repeatedly town, hill, roundabout and fast road with stops."""
    return follow(
        chain([Leg(rest_s)], _for_ever(_BLOCK)), duration_s, course_deg=40.0, bank_ratio=-0.08
    )


def flight(duration_s: float, rest_s: float = 150.0) -> Path:
    """Path of an aircraft: 150 s at rest, take-off, climb to about 10 km, cruise at 300 m/s with
    turns."""
    climb_out = (
        Leg(rest_s),  # time to gyrocompass
        Leg(40, speed_m_s=80.0),
        Leg(15, climb_deg=10.0),
        Leg(60, speed_m_s=160.0),
        Leg(90, turn_deg=60.0),
        Leg(120, speed_m_s=240.0),
        Leg(60, climb_deg=0.0),
        Leg(120, speed_m_s=300.0),
    )
    return follow(
        chain(climb_out, _for_ever(_CRUISE)),
        duration_s,
        course_deg=110.0,
        bank_ratio=1.0,
        incidence_deg=2.0,
    )


def level_flight(duration_s: float, rest_s: float = 30.0) -> Path:
    """Path of a micro air vehicle, level and due east as paper 001 begins: half a minute at rest,
    then 12 m/s."""
    return follow(
        [Leg(rest_s), Leg(10, speed_m_s=12.0), Leg(duration_s)], duration_s, course_deg=90.0
    )
