"""Errors of a computed navigation state, as the filters define them: computed minus true.

A navigation state (10,) is latitude, longitude (rad), height (m), velocity north, east, down (m/s)
and the attitude's quaternion; an error (9,) is phi (rad), dv (m/s), dr (m), north, east, down.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    quaternion_from_rpy,
    rotate_quaternion,
    rotation_vector_from_dcm,
)
from fusiond.simulation.imu_truth import Truth

Array = NDArray[np.float64]


def true_nav(truth: Truth, t_s: Array) -> Array:
    """Navigation states (n, 10) at the instants (n,)."""
    states = truth.at(t_s)
    q = np.array([quaternion_from_rpy(*rpy) for rpy in states.rpy])
    return np.column_stack([states.position, states.v_ned, q])


def metres(lat: float, height: float) -> Array:
    """Metres north, east, down a unit of latitude, longitude (rad) and height (m)."""
    east = (transverse_radius(lat) + height) * math.cos(lat)
    return np.array([meridian_radius(lat) + height, east, -1.0])


def nav_error(computed: Array, true: Array) -> Array:
    """Error (9,) of the state `computed` (10,)."""
    turn = dcm_from_quaternion(computed[6:]) @ dcm_from_quaternion(true[6:]).T
    dr = (computed[:3] - true[:3]) * metres(float(true[0]), float(true[2]))
    return np.concatenate([-rotation_vector_from_dcm(turn), computed[3:6] - true[3:6], dr])


def with_error(true: Array, error: Array) -> Array:
    """The computed state (10,) that is off from `true` by `error` (9,)."""
    nav = true.copy()
    rotate_quaternion(nav[6:], -float(error[0]), -float(error[1]), -float(error[2]), True)
    nav[3:6] += error[3:6]
    nav[:3] += error[6:9] / metres(float(true[0]), float(true[2]))
    return nav
