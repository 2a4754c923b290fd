r"""Samples of an ideal IMU on a trajectory, and the vehicle's true state at any instant.

    w_ib^b = w_nb^b(rpy, rpy') + C_bn (w_ie^n + w_en^n)
    f^b    = C_bn (v' + (2 w_ie + w_en) x v - g)
    phi'   = v_N / (R_M + h)    lambda' = v_E / ((R_N + h) cos phi)    h' = -v_D

A sample at t_k is the mean of w_ib^b and of f^b, in the turning body axes, over (t_{k-1}, t_k].
Position is integrated by three-stage Gauss collocation (order 6) and the means by the same
three-point rule, exact to rounding at 100 Hz because the trajectory is analytic between samples.

Source: Groves, 2nd ed., sections 2.2.1 and 5.4; Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, table II.7.4; gravity as in `fusiond.navigation.earth`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import (
    EARTH_RATE_RAD_S,
    gravity,
    meridian_radius,
    transverse_radius,
)
from fusiond.simulation.trajectories import Path, body_rate, dcm_from_rpy

Array = NDArray[np.float64]

_S15 = math.sqrt(15.0)
_NODES = np.array([0.5 - _S15 / 10.0, 0.5, 0.5 + _S15 / 10.0])
_A = np.array(
    [
        [5 / 36, 2 / 9 - _S15 / 15, 5 / 36 - _S15 / 30],
        [5 / 36 + _S15 / 24, 2 / 9, 5 / 36 - _S15 / 24],
        [5 / 36 + _S15 / 30, 2 / 9 + _S15 / 15, 5 / 36],
    ]
)
_ITERATIONS = 4
"""Fixed-point steps per interval; each gains a factor v dt / R < 1e-6."""
_CHUNK = 12_000
"""Samples evaluated at a time: keeps the work arrays at a few MB."""


@compiled("void(f8[::1], f8[::1], f8[::1])")
def _position_rate(position: Array, v: Array, rate: Array) -> None:
    """Write the rates of latitude, longitude (rad/s) and height (m/s)."""
    rate[0] = v[0] / (meridian_radius(position[0]) + position[2])
    rate[1] = v[1] / ((transverse_radius(position[0]) + position[2]) * math.cos(position[0]))
    rate[2] = -v[2]


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _inverse_strapdown(
    position: Array, v: Array, v_rate: Array, rpy: Array, rpy_rate: Array, gyro: Array, accel: Array
) -> None:
    """Write body rate and specific force at one instant."""
    lat, height = position[0], position[2]
    earth_n, earth_d = EARTH_RATE_RAD_S * math.cos(lat), -EARTH_RATE_RAD_S * math.sin(lat)
    radius_n = transverse_radius(lat) + height
    transport_n = v[1] / radius_n
    transport_e = -v[0] / (meridian_radius(lat) + height)
    transport_d = -v[1] * math.tan(lat) / radius_n
    c0, c1, c2 = 2.0 * earth_n + transport_n, transport_e, 2.0 * earth_d + transport_d
    f0 = v_rate[0] + c1 * v[2] - c2 * v[1]
    f1 = v_rate[1] + c2 * v[0] - c0 * v[2]
    f2 = v_rate[2] + c0 * v[1] - c1 * v[0] - gravity(lat, height)
    w0, w1, w2 = earth_n + transport_n, transport_e, earth_d + transport_d
    sr, cr = math.sin(rpy[0]), math.cos(rpy[0])
    sp, cp = math.sin(rpy[1]), math.cos(rpy[1])
    sy, cy = math.sin(rpy[2]), math.cos(rpy[2])
    m10, m11, m12 = sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp
    m20, m21, m22 = cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp
    accel[0] = cp * cy * f0 + cp * sy * f1 - sp * f2
    accel[1] = m10 * f0 + m11 * f1 + m12 * f2
    accel[2] = m20 * f0 + m21 * f1 + m22 * f2
    gyro[0] = rpy_rate[0] - rpy_rate[2] * sp + cp * cy * w0 + cp * sy * w1 - sp * w2
    gyro[1] = rpy_rate[1] * cr + rpy_rate[2] * sr * cp + m10 * w0 + m11 * w1 + m12 * w2
    gyro[2] = rpy_rate[2] * cr * cp - rpy_rate[1] * sr + m20 * w0 + m21 * w1 + m22 * w2


@compiled(
    "void(f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8, f8[:, ::1], f8[:, ::1],"
    "f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def _integrate(
    v: Array,
    v_rate: Array,
    rpy: Array,
    rpy_rate: Array,
    dt: float,
    a: Array,
    position: Array,
    gyro: Array,
    accel: Array,
) -> None:
    """Fill `position` (n + 1, 3) from its first row, `gyro` and `accel` (n, 3); nodes (n, 3, 3)."""
    rates = np.empty((3, 3))
    stage = np.empty((3, 3))
    w = np.empty(3)
    f = np.empty(3)
    for k in range(v.shape[0]):
        for i in range(3):
            _position_rate(position[k], v[k, i], rates[i])
        for _ in range(_ITERATIONS):
            for i in range(3):
                for j in range(3):
                    stage[i, j] = position[k, j] + dt * (
                        a[i, 0] * rates[0, j] + a[i, 1] * rates[1, j] + a[i, 2] * rates[2, j]
                    )
            for i in range(3):
                _position_rate(stage[i], v[k, i], rates[i])
        for j in range(3):
            position[k + 1, j] = position[k, j] + dt * (
                (rates[0, j] + rates[2, j]) * (5.0 / 18.0) + rates[1, j] * (4.0 / 9.0)
            )
            gyro[k, j] = 0.0
            accel[k, j] = 0.0
        for i in range(3):
            weight = 4.0 / 9.0 if i == 1 else 5.0 / 18.0
            _inverse_strapdown(stage[i], v[k, i], v_rate[k, i], rpy[k, i], rpy_rate[k, i], w, f)
            for j in range(3):
                gyro[k, j] += weight * w[j]
                accel[k, j] += weight * f[j]


@dataclass(frozen=True, slots=True)
class States:
    """True states: t_s (n,); position lat, lon (rad), height (m), v_ned, rpy (rad), all (n, 3)."""

    t_s: Array
    position: Array
    v_ned: Array
    rpy: Array


class Truth:
    """Trajectory from `origin` (lat, lon in rad, height in m), sampled at `rate_hz`.

    `t_s` (n + 1,) are the sample instants from 0; `gyro` and `accel` (n, 3) are the means over the
    intervals that end at t_s[1:], body axes, rad/s and m/s^2.
    """

    def __init__(
        self, path: Path, origin: tuple[float, float, float], rate_hz: float, duration_s: float
    ) -> None:
        n = max(1, round(duration_s * rate_hz))
        dt = 1.0 / rate_hz
        self.path = path
        self.rate_hz = rate_hz
        self.t_s = np.arange(n + 1) / rate_hz
        self.position = np.empty((n + 1, 3))
        self.position[0] = origin
        self.gyro = np.empty((n, 3))
        self.accel = np.empty((n, 3))
        for first in range(0, n, _CHUNK):
            last = min(first + _CHUNK, n)
            nodes = self.t_s[first:last, None] + dt * _NODES
            motion = path.kinematics(nodes)
            _integrate(
                motion.v_ned,
                motion.v_ned_rate,
                motion.rpy,
                motion.rpy_rate,
                dt,
                _A,
                self.position[first : last + 1],
                self.gyro[first:last],
                self.accel[first:last],
            )

    @property
    def duration_s(self) -> float:
        """Length of the trajectory in s."""
        return float(self.t_s[-1])

    def at(self, t_s: Array, lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> States:
        """True states at any instants (n,), clipped to the trajectory; yaw not wrapped.

        With a lever arm (body axes, m) position and velocity are those of that point.
        """
        t = np.clip(np.asarray(t_s, dtype=np.float64), 0.0, self.t_s[-1])
        i = np.minimum((t * self.rate_hz).astype(np.int64), len(self.t_s) - 2)
        motion = self.path.kinematics(t)
        before = self.path.kinematics(self.t_s[i])
        # Simpson's rule from the last sample: far below a micrometre within one interval.
        tau = t - self.t_s[i]
        middle = self.path.kinematics(self.t_s[i] + 0.5 * tau).v_ned
        mean_v = (before.v_ned + 4.0 * middle + motion.v_ned) / 6.0
        lat, height = self.position[i, 0], self.position[i, 2]
        position = self.position[i] + metres_to_geodetic(lat, height, mean_v * tau[:, None])
        v_ned = motion.v_ned
        if any(lever_arm_m):
            arm = np.asarray(lever_arm_m, dtype=np.float64)
            dcm = dcm_from_rpy(motion.rpy)
            rate, _ = body_rate(motion.rpy, motion.rpy_rate, np.zeros_like(motion.rpy))
            offset = np.einsum("nij,j->ni", dcm, arm)
            position = position + metres_to_geodetic(position[:, 0], position[:, 2], offset)
            v_ned = v_ned + np.einsum("nij,nj->ni", dcm, np.cross(rate, arm))
        return States(t, position, v_ned, motion.rpy)


_meridian_radii = np.vectorize(meridian_radius, otypes=[np.float64])
_transverse_radii = np.vectorize(transverse_radius, otypes=[np.float64])


def metres_to_geodetic(lat: Array, height: Array, ned_m: Array) -> Array:
    """Convert displacements (n, 3) in m, NED, to changes of latitude, longitude (rad), height
    (m)."""
    return np.stack(
        (
            ned_m[:, 0] / (_meridian_radii(lat) + height),
            ned_m[:, 1] / ((_transverse_radii(lat) + height) * np.cos(lat)),
            -ned_m[:, 2],
        ),
        axis=-1,
    )
