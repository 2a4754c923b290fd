r"""Velocity in the vehicle's axes: no-slip constraint and wheel speed, with their parameters.

At a point l of the vehicle (rear axle, wheel), with the body's rate w, body axes turned into the
vehicle's by the mounting m:

    u = exp[m x] (C^T v + w x l),     l = l_0 + (l_x, 0, 0)

    no slip:      0 = u_right - c s,   0 = u_down
    wheel speed:  y = (1 + k) (u_forward - a_forward tau) + c s_w - q sign(y) p

m (pitch, yaw), the lever's rest l_x, the side drift s (tyres, a road's crown, wind: it lasts for
seconds), the wheel's drift s_w (slip, quantised steps), scale k, latency tau and the rounding p, as
a share of a step q, are estimated if the model has their blocks
(fusiond.models.vehicle_parameter_blocks). c is the learned factor of a configured drift
(fusiond.navigator.aiding_drift_sigma_estimation). With z = h(x^) - y, navigation errors computed
minus true, parameters true minus estimated, and e_i the axis's unit vector:

    z = e_i exp[m x] (C^T dv - C^T [v x] phi - [l x] e - [w x] dl) + e_i [u x] dm + c ds + v
    z = the same (1 + k) - (u_forward - a_forward tau) dk + (1 + k) (a_forward dtau
        - tau e_i exp[m x] (e - C^T [g x] phi)) - c ds_w + q sign(y) dp + v               (wheel)

a_forward = f + C^T g is smoothed, e is the error of its force
(fusiond.aiding.smoothed_imu_jacobian): single samples of a vibrating sensor would bias the
latency towards zero.

Source: Dissanayake et al., The aiding of a low-cost strapdown IMU using vehicle constraints, IEEE
T-RA 17 (2001), eq. 8; Groves, 2nd ed., sections 15.4.1 and 16.3 (scale and mounting of odometers).
"""

from __future__ import annotations

import math
from functools import lru_cache
from operator import attrgetter
from struct import Struct
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.base import (
    NO_SLIP,
    SPEED,
    AidingMeasurement,
    Innovation,
    NotApplicable,
    Packed,
    State,
    Vector3,
)
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import STEADY, SpeedCandidate
from fusiond.aiding.smoothed_imu_jacobian import add_of_force, turning
from fusiond.aiding.wheel_and_heading import SIGN_SIGMAS, GroundSpeed
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import AXLE_LEVER, MOUNTING, SIDE_DRIFT
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements, rotation_vector_to_quaternion
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    Q0,
    STEP_RATE_B,
    STEP_SMOOTH_N,
    VN,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FORWARD, RIGHT = 0, 1
# Where the kernel finds the slot of each parameter; -1 for one that the model has not.
PITCH, YAW, LEVER, DRIFT, SCALE, LATENCY = range(6)
_UNKNOWN = np.zeros((0, 0))
_NO_SLIP_BODY, _SPEED_BODY = Struct("<7d6q"), Struct("<7d9q")


@lru_cache(maxsize=64)
def _blocks(drift: str, scale: str, latency: str) -> tuple[tuple[str, int], ...]:
    """Blocks of the parameters in order, each with its number of states."""
    return (MOUNTING, 2), (AXLE_LEVER, 1), (drift, 1), (scale, 1), (latency, 1)


def _slots(model: Model, drift: str, scale: str = "", latency: str = "") -> Indices:
    """Slots (6,) of the parameters, by names of the blocks of drift, scale and latency."""
    return model.slots_or_missing(*_blocks(drift, scale, latency))


@compiled("f8(f8[::1], i8)", forceinline=True)
def _estimate(xi: Array, slot: int) -> float:
    return xi[slot] if slot >= 0 else 0.0


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], b1, f8, f8, f8, i8[::1], f8, i8, f8[::1],f8[:, ::1])",
    allocates=True,
)
def _rows(
    nav: Array,
    step: Array,
    xi: Array,
    column_of: Indices,
    hold_height: bool,
    l0: float,
    l1: float,
    l2: float,
    slot: Indices,
    drifts: float,
    first: int,
    z: Array,
    h: Array,
) -> None:
    """Write h(x^) of vehicle axes first, first + 1 ... to z (m,), and H (m, n)."""
    h[:] = 0.0
    c = dcm_elements(nav[Q0:])
    turn = np.array(
        rotation_vector_to_quaternion(0.0, _estimate(xi, slot[PITCH]), _estimate(xi, slot[YAW]))
    )
    t = dcm_elements(turn)
    w0, w1, w2 = step[STEP_RATE_B], step[STEP_RATE_B + 1], step[STEP_RATE_B + 2]
    v0, v1, v2 = nav[VN], nav[VN + 1], nav[VN + 2]
    l0 += _estimate(xi, slot[LEVER])
    b0 = c[0] * v0 + c[3] * v1 + c[6] * v2 + w1 * l2 - w2 * l1
    b1 = c[1] * v0 + c[4] * v1 + c[7] * v2 + w2 * l0 - w0 * l2
    b2 = c[2] * v0 + c[5] * v1 + c[8] * v2 + w0 * l1 - w1 * l0
    u = (
        t[0] * b0 + t[1] * b1 + t[2] * b2,
        t[3] * b0 + t[4] * b1 + t[5] * b2,
        t[6] * b0 + t[7] * b1 + t[8] * b2,
    )
    # Acceleration, smoothed, along the vehicle's axes.
    g = gravity(nav[LAT], nav[HEIGHT])
    f0, f1, f2 = step[STEP_SMOOTH_N], step[STEP_SMOOTH_N + 1], step[STEP_SMOOTH_N + 2] + g
    b0 = c[0] * f0 + c[3] * f1 + c[6] * f2
    b1 = c[1] * f0 + c[4] * f1 + c[7] * f2
    b2 = c[2] * f0 + c[5] * f1 + c[8] * f2
    a0 = t[0] * b0 + t[1] * b1 + t[2] * b2
    a1 = t[3] * b0 + t[4] * b1 + t[5] * b2
    a2 = t[6] * b0 + t[7] * b1 + t[8] * b2
    # Rows of -[l x].
    arm = (0.0, l2, -l1, -l2, 0.0, l0, l1, -l0, 0.0)
    for i in range(z.shape[0]):
        axis = first + i
        t0, t1, t2 = t[3 * axis], t[3 * axis + 1], t[3 * axis + 2]
        # Row of exp[m x] C^T.
        a = t0 * c[0] + t1 * c[1] + t2 * c[2]
        b = t0 * c[3] + t1 * c[4] + t2 * c[5]
        e = t0 * c[6] + t1 * c[7] + t2 * c[8]
        z[i] = u[axis]
        h[i, 0] = e * v1 - b * v2
        h[i, 1] = a * v2 - e * v0
        h[i, 2] = b * v0 - a * v1
        h[i, 3], h[i, 4] = a, b
        if not hold_height:
            h[i, 5] = e
        for j in range(CORE_SIZE, column_of.shape[0]):
            kind = column_of[j] - RATE_ERROR
            if 0 <= kind < 3:
                h[i, j] = t0 * arm[kind] + t1 * arm[3 + kind] + t2 * arm[6 + kind]
        delay_s = _estimate(xi, slot[LATENCY]) if axis == FORWARD else 0.0
        if slot[PITCH] >= 0:
            # Row of [u x], of the velocity that long before, and columns of the left Jacobian of
            # exp[m x] to second order.
            u0, u1, u2 = u[0] - delay_s * a0, u[1] - delay_s * a1, u[2] - delay_s * a2
            x = 0.0 if axis == 0 else (u2 if axis == 1 else -u1)
            y = -u2 if axis == 0 else (0.0 if axis == 1 else u0)
            w = u1 if axis == 0 else (-u0 if axis == 1 else 0.0)
            p, q = xi[slot[PITCH]], xi[slot[YAW]]
            h[i, slot[PITCH]] = -0.5 * q * x + (1.0 - q * q / 6.0) * y + p * q / 6.0 * w
            h[i, slot[YAW]] = 0.5 * p * x + p * q / 6.0 * y + (1.0 - p * p / 6.0) * w
        if slot[LEVER] >= 0:
            h[i, slot[LEVER]] = t2 * turning(step, 1) - t1 * turning(step, 2)
        if axis == RIGHT and slot[DRIFT] >= 0:
            z[i] -= drifts * xi[slot[DRIFT]]
            h[i, slot[DRIFT]] = drifts
        if axis == FORWARD:
            z[i] -= delay_s * a0
            h[i, 0] += delay_s * b * g
            h[i, 1] -= delay_s * a * g
            add_of_force(step, column_of, c, -delay_s * t0, -delay_s * t1, -delay_s * t2, h[i])
            if slot[LATENCY] >= 0:
                h[i, slot[LATENCY]] = a0
            gain = 1.0 + _estimate(xi, slot[SCALE])
            for j in range(h.shape[1]):
                h[i, j] *= gain
            if slot[SCALE] >= 0:
                h[i, slot[SCALE]] = -z[i]
            z[i] *= gain
            if slot[DRIFT] >= 0:
                z[i] += drifts * xi[slot[DRIFT]]
                h[i, slot[DRIFT]] = -drifts


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], b1, f8, f8, f8, i8[::1], f8, f8, f8, f8, i8[::1],"
    "f8[::1], f8[::1], f8[:, ::1], f8[::1])",
    allocates=True,
)
def speed_rows(
    nav: Array,
    step: Array,
    xi: Array,
    column_of: Indices,
    hold_height: bool,
    l0: float,
    l1: float,
    l2: float,
    slot: Indices,
    drifts: float,
    speed: float,
    variance: float,
    rounded: float,
    rounding: Indices,
    initial: Array,
    z: Array,
    h: Array,
    r: Array,
) -> None:
    """Write z (1,), H (1, n) and r (1,) of a wheel's `speed` with that variance. `rounding` (0 or
    1,): the slot of the rounding error as a share of the step `rounded` (m/s; 0: none), whose
    variance at the start, of sigma `initial` (n,), is subtracted."""
    _rows(nav, step, xi, column_of, hold_height, l0, l1, l2, slot, drifts, FORWARD, z, h)
    z[0] -= speed
    r[0] = variance
    if rounded != 0.0:
        step_m_s = math.copysign(rounded, speed)
        for share in rounding:
            z[0] -= step_m_s * xi[share]
            h[0, share] = step_m_s
            r[0] -= (step_m_s * initial[share]) ** 2


@compiled(
    "f8(f8[::1], f8[::1], f8[::1], i8[::1], b1, f8, f8, f8, i8[::1], f8, f8[:, :], f8[::1],"
    "f8[:, ::1])"
)
def direction_of(
    nav: Array,
    step: Array,
    xi: Array,
    column_of: Indices,
    hold_height: bool,
    l0: float,
    l1: float,
    l2: float,
    slot: Indices,
    drifts: float,
    p: Array,
    z: Array,
    h: Array,
) -> float:
    """Sign of the forward velocity of a filter with P (n, n); 0 if within `SIGN_SIGMAS` of zero,
    (0, 0) if unknown. z (1,) and H (1, n) are used up."""
    _rows(nav, step, xi, column_of, hold_height, l0, l1, l2, slot, drifts, FORWARD, z, h)
    variance = 0.0
    for i in range(p.shape[0]):
        if h[0, i] != 0.0:
            for j in range(p.shape[0]):
                variance += h[0, i] * p[i, j] * h[0, j]
    if abs(z[0]) <= SIGN_SIGMAS * math.sqrt(max(variance, 0.0)):
        return 0.0
    return math.copysign(1.0, z[0])


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], b1, f8, f8, f8, i8[::1], f8, f8, f8, f8[::1],"
    "f8[:, ::1], f8[::1])"
)
def no_slip_rows(
    nav: Array,
    step: Array,
    xi: Array,
    column_of: Indices,
    hold_height: bool,
    l0: float,
    l1: float,
    l2: float,
    slot: Indices,
    drifts: float,
    sd: float,
    sd_down: float,
    z: Array,
    h: Array,
    r: Array,
) -> None:
    """Write z (m,), H (m, n) and r (m,) of zero velocity to the right and down."""
    _rows(nav, step, xi, column_of, hold_height, l0, l1, l2, slot, drifts, RIGHT, z, h)
    r[0] = sd * sd
    if r.shape[0] > 1:
        r[1] = sd_down * sd_down


@immutable()
class NonHolonomicConstraint(AidingMeasurement):
    """No sideways (sigma `sd_m_s`) or vertical velocity (`sd_down_m_s`) at `lever`, above
    `min_speed_m_s`; the side drift of the model counts `drift_counts` times."""

    constraint: ClassVar[bool] = True
    no_slip: ClassVar[bool] = True

    sd_m_s: float
    sd_down_m_s: float
    min_speed_m_s: float
    lever: Vector3
    drift_counts: float = 1.0

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.speed < self.min_speed_m_s:
            return NotApplicable("too_slow")
        model, slots = state.model, _slots(state.model, SIDE_DRIFT)
        at = state.nav, state.step, state.xi, model.column_of, model.hold_height
        m = 1 if model.hold_height else 2  # right, down
        rows = state.lent.get(m) or Innovation.unwritten(m, model.size)
        noise = self.drift_counts, self.sd_m_s, self.sd_down_m_s
        no_slip_rows(*at, *self.lever, slots, *noise, *rows)
        return rows

    def packed(self, model: Model) -> Packed | None:
        slots = _slots(model, SIDE_DRIFT).tolist()
        sd = self.sd_m_s, self.sd_down_m_s, self.min_speed_m_s
        body = _NO_SLIP_BODY.pack(*self.lever, *sd, self.drift_counts, *slots)
        return Packed(NO_SLIP, 1 if model.hold_height else 2, body)


@immutable()
class WheelSpeedMeasurement(AidingMeasurement):
    """Forward speed (m/s) with `sd_m_s` at `lever`; `rounding_sd_m_s` is a part of that. `drift`,
    `scale`, `latency` and `rounding` name the blocks of the wheel's own errors; without a block for
    rounding, that of steps of `shared_step_m_s` is included in `sd_m_s`. `drifts`: sigma (m/s) and
    correlation time (s) of the block `drift`, for tests without a filter, with the factor
    `drift_counts`.

    If not `signed`, it is an amount: its sign is that of the filter's forward velocity, if that
    exceeds `SIGN_SIGMAS` of its sigma; otherwise unknown (`direction_unknown`).
    """

    rolls: ClassVar[bool] = True
    shown: ClassVar[attrgetter[Any] | None] = attrgetter("speed_m_s")

    speed_m_s: float
    sd_m_s: float
    lever: Vector3
    signed: bool = True
    rounding_sd_m_s: float = 0.0
    drift: str = ""
    scale: str = ""
    latency: str = ""
    rounding: str = ""
    shared_step_m_s: float = 0.0
    drifts: tuple[float, float] = STEADY
    drift_counts: float = 1.0

    def without_attitude(self, way: HeadingHistory) -> GroundSpeed:
        return GroundSpeed(
            *(self.source, self.t_ns, self.gate, self.speed_m_s, self.sd_m_s, self.signed),
            *(self.drift, self.scale, self.latency, self.rounding, self.shared_step_m_s, way),
            robust=self.robust,
        )

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav, xi, step, model, p, lent = state
        slots = _slots(model, self.drift, self.scale, self.latency)
        speed = self.speed_m_s
        known = model.column_of, model.hold_height, *self.lever, slots, self.drift_counts
        at = nav, step, xi, *known
        rows = lent.get(1) or Innovation.unwritten(1, model.size)
        if not self.signed:
            z, h, _ = rows
            direction = direction_of(*at, _UNKNOWN if p is None else p, z, h)
            if direction == 0.0:
                return NotApplicable("direction_unknown")
            speed = math.copysign(speed, direction)
        rounding = self.shared_step_m_s, model.indices[self.rounding], model.initial
        speed_rows(*at, speed, self.sd_m_s**2, *rounding, *rows)
        return rows

    def packed(self, model: Model) -> Packed | None:
        slots = _slots(model, self.drift, self.scale, self.latency).tolist()
        measured = self.speed_m_s, self.sd_m_s**2, self.shared_step_m_s, self.drift_counts
        names = (self.rounding,)
        rounding = model.listed.get(names) or model.list_slots(names, (1,))
        body = _SPEED_BODY.pack(*self.lever, *measured, bool(self.signed), *slots, *rounding)
        return Packed(SPEED, 1, body)

    def candidates(self) -> tuple[SpeedCandidate, ...]:
        own = self.sd_m_s, self.rounding_sd_m_s, self.drifts
        return (SpeedCandidate(self.t_ns, self.speed_m_s, *own),)
