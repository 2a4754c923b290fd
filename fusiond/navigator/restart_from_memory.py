r"""Start from the state of a daemon killed moments ago: an IMU gap instead of an alignment.

Over the gap T, from the snapshot's instant to the first IMU sample (exact, as both are of one
monotonic clock), turn rate w and acceleration a of the vehicle are two Markov processes after
Singer: known at the snapshot, forgotten with the time constant tau, rms TURN and PUSH.

    psi = w tau (1 - e),  dv = a tau (1 - e),  e = exp(-T / tau)      expected motion
    P   <- Phi P Phi^T + Q
    Phi :  phi, dv turned by psi,  dr += T dv,  clock offset += T rate,  Markov states decay
    Q   :  turn    theta of heading, and of velocity and path with it,
                   dv = theta (v_e, -v_n),  dr = int(theta) (v_e, -v_n)
           push    dv, dr = int(dv)  on each axis
           tilt    of the road at either end, at most
           parameters: their own noise over T

The unknown part of a process x of rms 1 gives y = int(x) and z = int(y) the covariance S, x = T/tau

    S_yy = tau^2 (2 x - 3 + 4 e - e^2)
    S_yz = tau^3 (1 - 2 x + x^2 - 2 e + 2 x e + e^2)
    S_zz = tau^4 (1 + 2 x - 2 x^2 + 2 x^3 / 3 - 4 x e - e^2)

so that (theta, int(theta)) ~ N(0, TURN^2 S) and (dv, dr) ~ N(0, PUSH^2 S). The path does not follow
from the velocity at its end: with dr = T dv / 2 a receiver's first velocities gave the place to 9
cm, and 23 % of restarts were 3 to 15 sigma off two seconds later.

P is the covariance of the errors (computed minus true, fusiond.navigation.error_model; there phi_d
= +theta for a vehicle that turned right unseen). A prior of white force and rate, as
fusiond.estimators.propagation has for a silent IMU, is worse: after 1 s in a bend it is 4.8 sigma
off in heading (90 deg in 6 s), this one less than 3.

The start is on trial until the first position measurement has passed its gate; one that fails ends
it.

Source: Singer, Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets, IEEE
Trans. AES-6 (1970), eq. 4 to 11: covariance of the integrals of such a process.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from fusiond.estimators.base import Estimator
from fusiond.models.model import Model
from fusiond.navigation.error_model import CORE_SIZE, DR, DV, PHI
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion, quaternion_from_rpy, rpy_from_dcm
from fusiond.navigator.alignment.start import RESTARTED, SLOPE_SD, Start, as_geodetic
from fusiond.navigator.saved_state import STRICT, Height, Latitude, Longitude
from fusiond.navigator.state_file import DamagedStateError, RefusedStateError

Array = NDArray[np.float64]

# A junction is turned in about six seconds, a stop takes as long: half of it later the vehicle does
# something else.
MANOEUVRE_S = 3.0
# Three sigma are a turn of 90 deg in under three seconds and a braking of half a g.
TURN_RAD_S = 0.2
PUSH_M_S2 = 1.5
# The longest gap (s) that is crossed: the heading's sigma is 35 deg by then. The filter is linear
# in the heading's error and would not hold for more; the course of the next fix tells it better.
LONGEST_GAP_S = 5.0
# Below this part of MANOEUVRE_S the leading terms of S are right to 1 %, and rounding of the
# differences, 1e-16 of terms near 1, would not be.
SHORT = 0.01
# Turn and push at the snapshot are means over this long: a shaken sensor says little in a sample.
MEAN_NS = 250_000_000
# Below this (m/s) a velocity has no direction.
SLOW_M_S = 0.5
# A suspended computer stops CLOCK_MONOTONIC; the two clocks read apart differ by microseconds.
SUSPENDED_NS = 100_000_000
# Rounding of a covariance on its way through a filter: what its least eigenvalue, scaled to unit
# diagonal, may lie below zero.
ROUNDING = 1e-9

Speed = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Turn = Annotated[float, Field(ge=-3.0, le=3.0)]
Push = Annotated[float, Field(ge=-20.0, le=20.0)]
Component = Annotated[float, Field(ge=-1.0001, le=1.0001)]
Nanoseconds = Annotated[int, Field(ge=0, lt=2**63)]


@dataclass(frozen=True, slots=True, config=STRICT)
class WarmState:
    """A navigation state: instant, nav (10,), parameters (n,), P (n, n) as its lower triangle.

    `t_ns` is CLOCK_MONOTONIC_RAW of the boot `boot_id`, `asleep_ns` the suspended time of that
    boot; `config` the digest of the configuration, `how` the heading's origin, `confirmed` true if
    a measurement has confirmed the heading. `turn_rad_s` is the rate of the heading, `push_m_s2`
    the acceleration along the way.
    """

    boot_id: Annotated[str, Field(min_length=1, max_length=64)]
    config: Annotated[str, Field(max_length=128)]
    t_ns: Nanoseconds
    asleep_ns: Nanoseconds
    how: Annotated[str, Field(max_length=200)]
    place: tuple[Latitude, Longitude, Height]
    velocity: tuple[Speed, Speed, Speed]
    attitude: tuple[Component, Component, Component, Component]
    turn_rad_s: Turn
    push_m_s2: Push
    xi: Annotated[tuple[float, ...], Field(max_length=64)]
    covariance: Annotated[tuple[float, ...], Field(max_length=64 * 65 // 2)]
    confirmed: bool = True
    version: Literal[1] = 1


class WarmStart:
    """Start from `state` for a filter of `model`, and its trial.

    Raises `DamagedStateError` for an invalid state.
    """

    def __init__(self, state: WarmState, model: Model) -> None:
        self._state, self._model = state, model
        self._covariance = _checked(state, model)
        self.on_trial = False
        """True after a warm start without confirmation by a position measurement."""
        self.refused_by: str | None = None
        """Source of the position measurement that contradicted the state."""

    def start(self, t_ns: int) -> Start:
        """Start at `t_ns` (monotonic ns), the first IMU sample. Raises `RefusedStateError`."""
        gap_s = (t_ns - self._state.t_ns) * 1e-9
        if not 0.0 <= gap_s <= LONGEST_GAP_S:
            raise RefusedStateError(
                f"{gap_s:.1f} s between it and the first IMU sample (limit {LONGEST_GAP_S:.0f} s)"
            )
        self.on_trial = True
        return _after_gap(self._state, self._model, self._covariance, t_ns, gap_s)

    def judge(self, source: str, outcome: str) -> None:
        """Judge the start by an applied position measurement of `source`: the first fused or gated
        one decides."""
        if self.on_trial and outcome in ("fused", "gated"):
            self.on_trial = False
            if outcome == "gated":
                self.refused_by = source


def warm_state(
    estimator: Estimator,
    imu: ImuBuffer,
    how: str,
    config: str,
    boot_id: str,
    asleep_ns: int,
    *,
    confirmed: bool,
) -> WarmState:
    """State of the estimator and last IMU data. Raises pydantic's `ValidationError` if no vehicle
    can have that."""
    turn, push = _manoeuvre(estimator, imu)
    nav = estimator.nav.tolist()
    longitude = (nav[1] + math.pi) % (2.0 * math.pi) - math.pi
    rows = np.tril_indices(estimator.model.size)
    return WarmState(
        boot_id=boot_id,
        config=config,
        t_ns=estimator.t_ns,
        asleep_ns=asleep_ns,
        how=how,
        place=(nav[0], longitude, nav[2]),
        velocity=(nav[3], nav[4], nav[5]),
        attitude=(nav[6], nav[7], nav[8], nav[9]),
        turn_rad_s=turn,
        push_m_s2=push,
        xi=tuple(estimator.xi.tolist()),
        covariance=tuple(estimator.covariance[rows].tolist()),
        confirmed=confirmed,
    )


def same_run(state: WarmState, config: str, boot_id: str, asleep_ns: int) -> None:
    """Check that a state belongs to this boot and configuration. Raises `RefusedStateError`."""
    if state.boot_id != boot_id:
        raise RefusedStateError("the computer was restarted since")
    if abs(state.asleep_ns - asleep_ns) > SUSPENDED_NS:
        raise RefusedStateError("the computer has slept since")
    if state.config != config:
        raise RefusedStateError("it is of another configuration")


def _checked(state: WarmState, model: Model) -> Array:
    """P (n, n) of the state."""
    size = model.size
    if len(state.xi) != size or len(state.covariance) != size * (size + 1) // 2:
        raise DamagedStateError(f"{len(state.xi)} parameters: the model has {size}")
    if abs(math.hypot(*state.attitude) - 1.0) > 1e-6:
        raise DamagedStateError("attitude: not a unit quaternion")
    p = np.zeros((size, size))
    p[np.tril_indices(size)] = state.covariance
    p += np.tril(p, -1).T
    variance = np.diag(p)
    core = variance[:CORE_SIZE][model.active[:CORE_SIZE]]
    if (core <= 0.0).any() or (variance < 0.0).any():
        raise DamagedStateError("covariance: a variance that is not positive")
    held = variance > 0.0
    scale = 1.0 / np.sqrt(variance[held])
    correlation = p[np.ix_(held, held)] * scale * scale[:, None]
    if p[~held].any() or np.linalg.eigvalsh(correlation)[0] < -ROUNDING:
        raise DamagedStateError("covariance: not positive")
    return p


def _manoeuvre(estimator: Estimator, imu: ImuBuffer) -> tuple[float, float]:
    """Rate of the heading (rad/s) and longitudinal acceleration (m/s^2), means of `MEAN_NS`."""
    rows = slice(imu.index_after(estimator.t_ns - MEAN_NS), imu.index_after(estimator.t_ns))
    if rows.start == rows.stop:
        return 0.0, 0.0
    dcm = dcm_from_quaternion(estimator.nav[6:])
    sensed = imu.samples[rows].mean(axis=0) - estimator.sensor_errors[:6]
    v = estimator.nav[3:5]
    speed = float(np.hypot(*v))
    push = float((dcm @ sensed[3:])[:2] @ v) / speed if speed > SLOW_M_S else 0.0
    return float((dcm @ sensed[:3])[2]), push


def _gone_on(turn: float, push: float, t_s: float) -> tuple[float, float]:
    """Most likely change of heading (rad) and speed (m/s) after `t_s`."""
    whole = MANOEUVRE_S * (1.0 - math.exp(-t_s / MANOEUVRE_S))
    return turn * whole, push * whole


def _after_gap(state: WarmState, model: Model, p: Array, t_ns: int, gap_s: float) -> Start:
    v, moved, psi = _moved(state, gap_s)
    nav = np.array([*state.place, *v, *state.attitude])
    nav[:3] += as_geodetic(moved, state.place[0])
    dcm = dcm_from_quaternion(nav[6:] / np.linalg.norm(nav[6:]))
    nav[6:] = quaternion_from_rpy(*rpy_from_dcm(_turned(psi) @ dcm))
    decay = np.ones(model.size)
    decay[CORE_SIZE:] = np.exp(-gap_s * model.noise[0, CORE_SIZE:])
    phi = np.diag(decay)
    phi[PHI : PHI + 3, PHI : PHI + 3] = phi[DV : DV + 3, DV : DV + 3] = _turned(psi)
    phi[DR : DR + 3, DV : DV + 3] = gap_s * _turned(0.5 * psi)
    phi[model.rate_terms[0], model.rate_terms[1]] = gap_s
    p = phi @ p @ phi.T
    own = slice(CORE_SIZE, None)
    p[own, own] += np.diag((model.noise[1] * gap_s + model.noise[2] * (1.0 - decay**2))[own])
    p[:CORE_SIZE, :CORE_SIZE] += _unseen(v, gap_s)
    xi = np.array(state.xi)
    xi[own] = (phi @ xi)[own]
    how = f"{state.how}{RESTARTED}{gap_s:.1f} s"
    return Start(t_ns, nav, xi, p, how, confirmed=state.confirmed)


def _moved(state: WarmState, gap_s: float) -> tuple[Array, Array, float]:
    """Velocity (3,) after the gap, displacement (3,) in m, and turn (rad)."""
    v = np.array(state.velocity)
    speed = float(np.hypot(*v[:2]))
    if speed <= SLOW_M_S:
        return v, v * gap_s, 0.0
    steps = 20
    after, moved, psi = v, np.zeros(3), 0.0
    for k in range(1, steps + 1):
        psi, faster = _gone_on(state.turn_rad_s, state.push_m_s2, gap_s * k / steps)
        before = after
        # A vehicle that brakes comes to rest; it does not go on backward.
        after = _turned(psi) @ v * max(0.0, 1.0 + faster / speed)
        moved += 0.5 * (before + after) * gap_s / steps
    return after, moved, psi


def _turned(psi: float) -> Array:
    """Rotation (3, 3) of a vector in north, east, down by `psi` to the right."""
    c, s = math.cos(psi), math.sin(psi)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _unknown(t_s: float) -> tuple[float, float, float]:
    """S_yy, S_yz and S_zz of the module's docstring after `t_s`."""
    tau, x = MANOEUVRE_S, t_s / MANOEUVRE_S
    if x < SHORT:
        return 2.0 * t_s**3 / (3.0 * tau), t_s**4 / (4.0 * tau), t_s**5 / (10.0 * tau)
    e = math.exp(-x)
    yy = tau**2 * (2.0 * x - 3.0 + 4.0 * e - e**2)
    yz = tau**3 * (1.0 - 2.0 * x + x**2 - 2.0 * e + 2.0 * x * e + e**2)
    zz = tau**4 * (1.0 + 2.0 * x - 2.0 * x**2 + 2.0 * x**3 / 3.0 - 4.0 * x * e - e**2)
    return yy, yz, zz


def _unseen(v: Array, gap_s: float) -> Array:
    """Covariance (9, 9) of attitude, velocity and position that the gap adds."""
    yy, yz, zz = _unknown(gap_s)
    across = np.array([v[1], -v[0]])
    turn = np.zeros((CORE_SIZE, 2))  # by theta and by its integral
    turn[PHI + 2, 0] = 1.0
    turn[DV : DV + 2, 0] = turn[DR : DR + 2, 1] = across
    unseen: Array = TURN_RAD_S**2 * turn @ np.array([[yy, yz], [yz, zz]]) @ turn.T
    for axis in range(3):
        dv, dr = DV + axis, DR + axis
        unseen[dv, dv] += PUSH_M_S2**2 * yy
        unseen[dv, dr] += PUSH_M_S2**2 * yz
        unseen[dr, dv] += PUSH_M_S2**2 * yz
        unseen[dr, dr] += PUSH_M_S2**2 * zz
    tilt = min(TURN_RAD_S * math.sqrt(yy), math.sqrt(2.0) * SLOPE_SD)
    unseen[PHI, PHI] = unseen[PHI + 1, PHI + 1] = tilt**2
    return unseen
