"""Errors of a computed navigation state, by the filters' definition: computed minus true.

A navigation state (10,) is latitude, longitude (rad), height (m), velocity north, east, down (m/s)
and the attitude's quaternion; an error (9,) is phi (rad), dv (m/s), dr (m), north, east, down.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import quaternion_from_rpy, rotate_quaternion
from fusiond.simulation.imu_truth import Truth

Array = NDArray[np.float64]


def true_nav(truth: Truth, t_s: Array) -> Array:
    """Navigation states (n, 10) at the instants (n,)."""
    states = truth.at(t_s)
    q = np.array([quaternion_from_rpy(*rpy) for rpy in states.rpy])
    return np.column_stack([states.position, states.v_ned, q])


def metres_per_unit(lat: float, height: float) -> Array:
    """Metres north, east, down for a unit of latitude, longitude (rad) and height (m)."""
    east = (transverse_radius(lat) + height) * math.cos(lat)
    return np.array([meridian_radius(lat) + height, east, -1.0])


def nav_error(computed: Array, true: Array) -> Array:
    """Error (9,) of the state `computed` (10,)."""
    lat, lon, height, vn, ve, vd, w, x, y, z = computed.tolist()
    lat_0, lon_0, height_0, vn_0, ve_0, vd_0, w_0, x_0, y_0, z_0 = true.tolist()
    # The quaternion of the turn from the true to the computed attitude: q times the conjugate of
    # the true one. In plain numbers: a study asks a hundred thousand times.
    turn = w * w_0 + x * x_0 + y * y_0 + z * z_0
    north = w_0 * x - w * x_0 - y * z_0 + z * y_0
    east = w_0 * y - w * y_0 - z * x_0 + x * z_0
    down = w_0 * z - w * z_0 - x * y_0 + y * x_0
    s = math.sqrt(north * north + east * east + down * down)
    angle = 2.0 * math.atan2(s, abs(turn))
    per = math.copysign(angle / s if s > 1e-12 else 2.0, turn)
    return np.array(
        [
            *(-per * north, -per * east, -per * down),
            *(vn - vn_0, ve - ve_0, vd - vd_0),
            (lat - lat_0) * (meridian_radius(lat_0) + height_0),
            (lon - lon_0) * (transverse_radius(lat_0) + height_0) * math.cos(lat_0),
            height_0 - height,
        ]
    )


def with_error(true: Array, error: Array) -> Array:
    """Computed state (10,) whose error against `true` is `error` (9,)."""
    nav = true.copy()
    rotate_quaternion(nav[6:], -float(error[0]), -float(error[1]), -float(error[2]), True)
    nav[3:6] += error[3:6]
    nav[:3] += error[6:9] / metres_per_unit(float(true[0]), float(true[2]))
    return nav
