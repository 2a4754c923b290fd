r"""Bearing of a known point: azimuth and elevation, as from a radar (SAR) on the vehicle.

    d = C_ne (p - r) - C l                 from the antenna to the point, north-east-down (m)
    u = exp[m x]^T C^T d                   the same in sensor axes
    A = atan2(u_y, u_x),   E = atan2(-u_z, sqrt(u_x^2 + u_y^2))

p and r point and vehicle, Earth-fixed (m); l the lever arm to the antenna, body axes; m the
misalignment (rad, body axes) that turns the body's axes into the sensor's, a block of the model, if
it has one. Azimuth runs from the sensor's x to its y, elevation is positive upwards.

With C^ = (I - [phi x]) C, position error dr and what is left of m, e = m - m^, computed minus true:

    du = S^T ( -[d' x] phi + (-I + [d_0 x] T) dr ) - [u x] e,     S = C exp[m x]
    dA = (-u_y du_x + u_x du_y) / rho^2,   dE = (u_z (u_x du_x + u_y du_y) / rho - rho du_z) / D^2

d_0 = C_ne (p - r) and d' = d_0: the lever arm turns with the body. T dr is the turn of the
north-east-down axes that goes with a displacement dr (1/R: 3 % of dr at 200 km). rho and D are the
lengths of (u_x, u_y) and of u.

A timing error of sigma s_t changes the angles by their rate times s_t, from du/dt = -w x u - S^T v.

The angles are taken as linear in the errors. A displacement s across a distance rho bends them by
(s / rho)^2, so a point nearer than `least_range_m` is `too_close`; beyond `STEEPEST_ELEVATION_RAD`
azimuth loses its meaning: `too_steep`.

Without an inertial unit nothing estimates C. A bearing has two angles and an attitude three,
different at each later point, so any number of bearings alone gives no position. With the attitude
of another sensor at about that instant,

    C^ = C_y exp[s^ x]^T,   phi = theta - C (s - s^),   cov(theta) = J diag(sd^2) J^T

C_y measured, J as in fusiond.aiding.attitude, s the misalignment of its sensor, a block of the
model. theta is noise beside the angles' own, cov = dA/dphi cov(theta) dA/dphi^T, and both rows are
whitened. For a vehicle on a road a heading is enough (fusiond.aiding.heading_history).

Source: paper 002, section 2.2 (SAR azimuth and elevation); derived here, checked numerically.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import (
    AidingMeasurement,
    Array,
    Innovation,
    NotApplicable,
    State,
    Vector3,
    misaligned_axes,
)
from fusiond.aiding.heading_history import HeadingHistory, Oriented
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.models.blocks import SAR_MISALIGNMENT
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    quaternion_from_rpy,
    rotation_vector_to_quaternion,
    rpy_from_dcm,
    skew,
    wrap_angle,
)
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

SAR_BLOCK = SAR_MISALIGNMENT
STEEPEST_ELEVATION_RAD = math.radians(80.0)
"""Largest elevation, as for heading: the azimuth's errors grow as 1 / cos(E), here almost sixfold.
"""


def line_of_sight(place: Vector3, point: Vector3) -> Array:
    """Vector (3,), m, NED from one position to another, both lat, lon (rad), height (m)."""
    separation = np.subtract(to_ecef(*point), to_ecef(*place))
    return np.asarray(ned_axes(place[0], place[1]).T @ separation, dtype=np.float64)


@immutable()
class BearingMeasurement(AidingMeasurement):
    """Azimuth and elevation (rad) with `sd` of `point` (lat, lon in rad, height in m).

    `block` names the model's block of the sensor's misalignment; a model without it has none.
    `attitude` is that of a vehicle whose own is not estimated but was measured.
    """

    period: ClassVar[float] = 2.0 * math.pi

    azimuth_rad: float
    elevation_rad: float
    sd: tuple[float, float]
    point: Vector3
    lever: Vector3
    least_range_m: float
    sd_time_s: float = 0.0
    block: str = ""
    attitude: Oriented | None = None

    def without_attitude(self, way: HeadingHistory) -> BearingMeasurement | None:
        attitude = way.oriented_at(self.t_ns)
        return None if attitude is None else replace(self, attitude=attitude)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if self.attitude is not None:
            return self._oriented(state, self.attitude)
        found = self._linearised(state)
        if isinstance(found, Innovation):
            found.h[:, :9][:, ~state.model.active[:9]] = 0.0
        return found

    def _oriented(self, state: State, of: Oriented) -> Innovation | NotApplicable:
        """Innovation at a measured attitude, whose noise is added to the rows'."""
        model, measured = state.model, dcm_from_rpy(*of.rpy)
        slots = model.slots_of(of.block) if of.block else []
        x, y, z = (float(state.xi[slot]) for slot in slots) if slots else (0.0, 0.0, 0.0)
        dcm = measured @ dcm_from_quaternion(np.array(rotation_vector_to_quaternion(x, y, z))).T
        nav = state.nav.copy()
        nav[Q0:] = quaternion_from_rpy(*rpy_from_dcm(dcm))
        found = self._linearised(state._replace(nav=nav))
        if isinstance(found, NotApplicable):
            return found
        yaw, h = of.rpy[2], found.h
        axes = np.column_stack(
            [measured[:, 0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        )
        turned = h[:, :3] @ (axes * np.array(of.sd))
        if slots:
            h[:, slots] -= h[:, :3] @ dcm
        h[:, :9][:, ~model.active[:9]] = 0.0
        root = np.linalg.cholesky(np.diag(found.r) + turned @ turned.T)
        z_and_h = np.linalg.solve(root, np.column_stack([found.z, h]))
        return Innovation(z_and_h[:, 0].copy(), z_and_h[:, 1:].copy(), np.ones(2))

    def _linearised(self, state: State) -> Innovation | NotApplicable:
        """Innovation with its derivatives by all navigation errors, estimated or held."""
        nav = state.nav
        lat, lon, height = float(nav[LAT]), float(nav[LON]), float(nav[HEIGHT])
        to_ned, slots = misaligned_axes(state, self.block)
        sight = line_of_sight((lat, lon, height), self.point)
        u = to_ned.T @ (sight - state.dcm @ np.array(self.lever))
        x, y, z = (float(c) for c in u)
        rho = math.hypot(x, y)
        if abs(z) > rho * math.tan(STEEPEST_ELEVATION_RAD):
            return NotApplicable("too_steep")
        if rho < self.least_range_m:
            return NotApplicable("too_close")
        square = rho * rho + z * z
        angles = np.array(
            [
                [-y / rho**2, x / rho**2, 0.0],
                [z * x / (rho * square), z * y / (rho * square), -rho / square],
            ]
        )
        n, m = 1.0 / (transverse_radius(lat) + height), 1.0 / (meridian_radius(lat) + height)
        turn = np.array([[0.0, n, 0.0], [-m, 0.0, 0.0], [0.0, -math.tan(lat) * n, 0.0]])
        in_ned = angles @ to_ned.T
        h = np.zeros((2, state.model.size))
        h[:, 0:3] = -in_ned @ skew(sight)
        h[:, 6:9] = in_ned @ (skew(sight) @ turn - np.eye(3))
        if slots:
            h[:, slots] = -angles @ skew(u)
        innovation = np.array(
            [
                wrap_angle(math.atan2(y, x) - self.azimuth_rad),
                math.atan2(-z, rho) - self.elevation_rad,
            ]
        )
        # w in body axes turns u as well as in sensor axes, but for the misalignment: 1e-3 of it
        rate = angles @ (-np.cross(state.rate_b, u)) - in_ned @ nav[VN : VN + 3]
        r = np.square(self.sd) + np.square(rate * self.sd_time_s)
        return Innovation(innovation, h, r)
