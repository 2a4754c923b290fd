r"""Rotations: quaternion, direction cosine matrix, roll-pitch-yaw, rotation vector.

    q = [q0, q1, q2, q3], scalar first, q_nb turns body axes into navigation axes: v_n = C(q) v_b
    C(q (x) p) = C(q) C(p)
    roll phi, pitch theta, yaw psi (3-2-1): C_nb = R_z(psi) R_y(theta) R_x(phi)

Source: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems,
2nd edition, section 2.2; Savage, Strapdown Analytics, section 3.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]


Nine = tuple[float, float, float, float, float, float, float, float, float]


@compiled("UniTuple(f8, 9)(f8[::1])")
def dcm_elements(q: Array) -> Nine:
    """Nine elements, by rows, of C(q) of a unit quaternion (4,)."""
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    return (
        q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3,
        2.0 * (q1 * q2 - q0 * q3),
        2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q1 * q2 + q0 * q3),
        q0 * q0 - q1 * q1 + q2 * q2 - q3 * q3,
        2.0 * (q2 * q3 - q0 * q1),
        2.0 * (q1 * q3 - q0 * q2),
        2.0 * (q2 * q3 + q0 * q1),
        q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3,
    )


@compiled("void(f8[::1], f8[:, ::1])")
def quaternion_to_dcm(q: Array, dcm: Array) -> None:
    """Write C(q) (3, 3) of a unit quaternion (4,)."""
    elements = dcm_elements(q)
    for i in range(3):
        for j in range(3):
            dcm[i, j] = elements[3 * i + j]


@compiled("UniTuple(f8, 4)(f8, f8, f8)")
def rotation_vector_to_quaternion(
    x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Quaternion of a rotation vector (rad); series below 1 mrad, exact to rounding."""
    n2 = x * x + y * y + z * z
    if n2 < 1e-6:
        c = 1.0 - n2 / 8.0 + n2 * n2 / 384.0
        s = 0.5 - n2 / 48.0 + n2 * n2 / 3840.0
    else:
        n = math.sqrt(n2)
        c = math.cos(0.5 * n)
        s = math.sin(0.5 * n) / n
    return c, s * x, s * y, s * z


@compiled("void(f8, f8, f8, f8[:, ::1])", allocates=True)
def turn_to_dcm(x: float, y: float, z: float, dcm: Array) -> None:
    """Write exp(phi x) (3, 3) of a rotation vector (rad)."""
    quaternion_to_dcm(np.array(rotation_vector_to_quaternion(x, y, z)), dcm)


@compiled("void(f8[::1], f8, f8, f8, b1)")
def rotate_quaternion(q: Array, x: float, y: float, z: float, on_the_left: bool) -> None:
    """q <- exp(v) (x) q (navigation axes) or q (x) exp(v) (body axes); renormalised."""
    p0, p1, p2, p3 = rotation_vector_to_quaternion(x, y, z)
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    sign = -1.0 if on_the_left else 1.0
    r0 = q0 * p0 - q1 * p1 - q2 * p2 - q3 * p3
    r1 = q0 * p1 + q1 * p0 + sign * (q2 * p3 - q3 * p2)
    r2 = q0 * p2 + q2 * p0 + sign * (q3 * p1 - q1 * p3)
    r3 = q0 * p3 + q3 * p0 + sign * (q1 * p2 - q2 * p1)
    k = 1.0 / math.sqrt(r0 * r0 + r1 * r1 + r2 * r2 + r3 * r3)
    q[0], q[1], q[2], q[3] = r0 * k, r1 * k, r2 * k, r3 * k


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Unit quaternion (4,) body to navigation from roll, pitch, yaw in rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def dcm_from_quaternion(q: Array) -> Array:
    """C(q) (3, 3) of a unit quaternion (4,)."""
    dcm = np.empty((3, 3))
    quaternion_to_dcm(q, dcm)
    return dcm


def dcm_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """C_nb (3, 3) from roll, pitch, yaw in rad."""
    return dcm_from_quaternion(quaternion_from_rpy(roll, pitch, yaw))


def rpy_from_dcm(dcm: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad; yaw in (-pi, pi]; at pitch +-90 deg roll takes the rest."""
    pitch = math.asin(max(-1.0, min(1.0, -float(dcm[2, 0]))))
    return (
        math.atan2(dcm[2, 1], dcm[2, 2]),
        pitch,
        math.atan2(dcm[1, 0], dcm[0, 0]),
    )


@compiled("UniTuple(f8, 3)(f8, f8, f8, f8)")
def rpy_from_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw, rad, of a quaternion."""
    sine = 2.0 * (w * y - x * z)
    return (
        math.atan2(2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
        math.asin(math.copysign(1.0, sine) if abs(sine) > 1.0 else sine),
        math.atan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z),
    )


def rotation_vector_from_dcm(dcm: Array) -> Array:
    """Rotation vector (3,) in rad of a rotation matrix, for angles below pi."""
    w = 0.5 * np.array([dcm[2, 1] - dcm[1, 2], dcm[0, 2] - dcm[2, 0], dcm[1, 0] - dcm[0, 1]])
    s = float(np.linalg.norm(w))
    angle = math.atan2(s, 0.5 * (float(np.trace(dcm)) - 1.0))
    return w * (angle / s if s > 1e-12 else 1.0)


def skew(v: Array) -> Array:
    """Matrix [v x] (3, 3) with [v x] u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def wrap_angle(angle: float) -> float:
    """Angle wrapped to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
