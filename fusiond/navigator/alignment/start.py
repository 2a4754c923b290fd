"""First state of the filter: navigation state, parameters and covariance from the alignment."""

from __future__ import annotations

import math
from dataclasses import field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.initialisation_candidates import (
    Candidate,
    HeadingCandidate,
    PositionCandidate,
    VelocityCandidate,
)
from fusiond.aiding.position import markov_sd_of
from fusiond.models.model import Model
from fusiond.navigation.alignment import levelling_jacobian
from fusiond.navigation.earth import (
    EARTH_RATE_RAD_S,
    gravity,
    meridian_radius,
    transverse_radius,
)
from fusiond.navigation.error_model import (
    COLUMN_END,
    DR,
    DV,
    FORCE_ERROR,
    FORCE_SCALE,
    PHI,
    RATE_ERROR,
)
from fusiond.navigation.rotation import quaternion_from_rpy, rpy_from_dcm, skew
from fusiond.navigator.imu_grade import AS_ITS_CLASS

Array = NDArray[np.float64]

# One sigma of tilt (rad) of a vehicle that stands with its engine on.
LEVEL_SD_RAD = math.radians(0.1)
# A vehicle at rest settles by so much in this time (s): it looks like a rate bias.
BIAS_SETTLING_S = 60.0
# One sigma of tilt (rad) that no level found in motion claims to beat: scale factors and axes out
# of square while the vehicle brakes and turns (1 % of 3 m/s^2).
MOTION_LEVEL_SD_RAD = math.radians(0.2)
# One sigma of velocity (m/s) that no start claims to beat.
LEAST_VELOCITY_SD = 0.05
# One sigma of a road's slope: main roads are built to 3 to 6 %, streets in hills to 12 %.
SLOPE_SD = 0.06

# What `how` ends with where the vehicle was taken to drive backward.
BACKWARD = ", backward"
# What the origin of a heading that was carried over a gap ends with.
RESTARTED = ", restarted over "

# One sigma of a height (m) that nothing has told: roads lead from the Dead Sea (-430 m) to Umling
# La (5,900 m), and the geoid is within 107 m of the ellipsoid; uniform within 6 km of 0.
UNKNOWN_HEIGHT_SD_M = 6000.0 / math.sqrt(3.0)


class Place(NamedTuple):
    """Position (rad, rad, m) with its fix, one sigma (m) horizontally and of its height; an unknown
    height is 0."""

    fix: PositionCandidate | None
    where: Array
    sd: float
    sd_height: float


def as_geodetic(metres: Array, lat: float) -> Array:
    """Convert a short vector north, east, down (3,) in m to latitude, longitude (rad) and height
    (m)."""
    n, e, d = metres
    return np.array([n / meridian_radius(lat), e / (transverse_radius(lat) * math.cos(lat)), -d])


def velocity_of(candidate: VelocityCandidate) -> tuple[Array, Array]:
    """Velocity NED (3,) and one sigma (3,). NMEA has no vertical velocity: it is then 0, with a
    sigma of the speed times a road's slope."""
    if len(candidate.v_ned) == 3:
        return np.array(candidate.v_ned), np.full(3, max(candidate.sd))
    sd = max(candidate.sd)
    climb = math.hypot(sd, SLOPE_SD * math.hypot(*candidate.v_ned))
    return np.array([*candidate.v_ned, 0.0]), np.array([sd, sd, climb])


class Levelled(NamedTuple):
    """Attitude C_nb (3, 3) at the instant of levelling, and its sigma (rad).

    The sigma is that of roll and pitch errors gained since, beside the force errors at
    levelling."""

    dcm: Array
    sd: float = LEVEL_SD_RAD


class Fitted(NamedTuple):
    """Force and rate biases (6,) of a level found in motion.

    Also the time offset (s) of the velocities used, and the joint covariance (10, 10), the attitude
    first."""

    biases: Array
    delay_s: float
    covariance: Array


class Moves(NamedTuple):
    """Measured velocity with the body's rate (3,) and acceleration (3,) NED at its instant."""

    candidate: VelocityCandidate
    rate: Array
    acceleration: Array


@immutable()
class Start:
    """A filter's start: instant, nav (10,), parameters (n,), P (n, n), and how it was found.

    `turns`: the heading is so uncertain that the filter updates in the coordinates of
    `fusiond.estimators.invariant`. `contradicted`: positions before the start disagreed with
    velocities of the same receiver. `used`: measurements of its own instant that the start
    contains, which must not be fused again. `confirmed`: false for a heading that neither a
    measurement nor the path has shown, as one configured, of a compass, or backward.
    """

    t_ns: int
    nav: Array
    xi: Array
    covariance: Array
    how: str
    turns: bool = False
    contradicted: bool = False
    used: tuple[Candidate, ...] = ()
    confirmed: bool = True
    grades: Array = field(default_factory=lambda: AS_ITS_CLASS)
    """Of the unit (13,), with which its errors' priors count: fusiond.navigator.imu_grade."""

    @property
    def origin(self) -> str:
        """Origin of the heading before a gap."""
        return self.how.partition(RESTARTED)[0]

    @property
    def backward(self) -> bool:
        """True if the vehicle was taken to drive backward."""
        return self.origin.endswith(BACKWARD)


def build_start(
    model: Model,
    t_ns: int,
    place: Place,
    dcm: Array,
    sd_yaw: float,
    velocity: Array,
    sd_velocity: Array,
    how: str,
    *,
    bias: tuple[Array, float] | None = None,
    levelled: Levelled | None = None,
    fitted: Fitted | None = None,
    compassed: bool = False,
    unexplained: Array | None = None,
    moves: Moves | None = None,
    heading: HeadingCandidate | None = None,
    grades: Array = AS_ITS_CLASS,
) -> Start:
    """Start at `place` with attitude `dcm` (C_nb) and `velocity` (3,) NED, one sigma (3,).

    `bias`: rate bias (3,) seen at rest and its sigma. `levelled`: roll and pitch come from gravity
    at rest; `compassed`: yaw from the Earth's rate. Both correlate attitude with sensor errors in
    the axes of that time; after a bend the sensors have other axes than the tilt. `fitted`:
    attitude and biases from motion; `sd_yaw` is then a lower bound. `unexplained`: rates (3,) of a
    quiet vehicle beyond the data sheet, which may be biases. `moves`: the measured velocity,
    `heading`: the measured yaw, `grades` (13,): those of the unit.
    """
    fix, where, sd_position, sd_height = place
    (lat, _, height), nav = where.tolist(), _first_state(model, place, dcm, velocity)
    p = _prior(model, grades)
    tilt_sd = MOTION_LEVEL_SD_RAD if levelled is None else levelled.sd
    p[0, 0] = p[1, 1] = tilt_sd**2
    p[2, 2] = sd_yaw**2
    p[3:6, 3:6] = np.diag(np.maximum(sd_velocity, LEAST_VELOCITY_SD) ** 2)
    p[6:9, 6:9] = np.diag([sd_position**2, sd_position**2, sd_height**2])
    xi, by = np.zeros(model.size), np.eye(model.size)
    if bias is not None:
        _start_biases(model, p, xi, by, dcm if levelled is None else levelled.dcm, lat, *bias)
    for axis, rate in enumerate([] if unexplained is None else unexplained.tolist()):
        slot = model.parameters(9 + axis)[0]
        p[slot, slot] += rate**2
    if fitted is not None:
        time = model.slots_of(moves.candidate.time) if moves is not None else []
        _take_fitted(model, p, xi, fitted, -gravity(lat, height) * dcm[2], time)
    if levelled is not None:
        _correlate(model, p, levelled.dcm, lat, height, compassed)
    if heading is not None and heading.shared:
        _by_heading(model, p, heading)
    if fix is not None:
        _by_fix(model, by, fix, dcm, velocity)
    if moves is not None:
        _by_velocity(model, by, moves, dcm)
    made_of = fix, moves.candidate if moves is not None else None, heading
    used = tuple(candidate for candidate in made_of if candidate is not None)
    confirmed = not how.endswith(BACKWARD)
    if moves is not None and fitted is None:
        _by_course(p, moves.candidate)
    covariance = by @ p @ by.T
    return Start(t_ns, nav, xi, covariance, how, used=used, confirmed=confirmed, grades=grades)


def _first_state(model: Model, place: Place, dcm: Array, velocity: Array) -> Array:
    """Navigation state (10,) at a place: the fix minus the lever arm."""
    nav = np.zeros(10)
    nav[:3] = place.where
    nav[3:6] = velocity
    nav[6:] = quaternion_from_rpy(*rpy_from_dcm(dcm))
    if place.fix is not None:
        nav[:3] -= as_geodetic(dcm @ np.array(place.fix.lever), float(place.where[0]))
    if model.hold_height and place.sd_height >= UNKNOWN_HEIGHT_SD_M:
        nav[2] = nav[5] = 0.0  # HELD_UNKNOWN_M tells it from a height
    return nav


def _prior(model: Model, grades: Array) -> Array:
    """Covariance (n, n) of a model's start, for a unit with grades (13,)."""
    p = np.diag(model.initial**2)
    for column in range(RATE_ERROR, COLUMN_END):
        for slot in model.parameters(column):
            p[slot, slot] *= grades[column - RATE_ERROR]
    return p


def _by_heading(model: Model, p: Array, heading: HeadingCandidate) -> None:
    """Correlate the heading error with the device's by an innovation of 0 (fusiond.aiding.compass),
    phi_D = e - d dev; without it further readings would seem to prove dev = 0."""
    shared = [
        (slot, rate)
        for block, rates in heading.shared
        for slot, rate in zip(model.slots_of(block), rates, strict=False)
    ]
    common = sum(p[slot, slot] * rate**2 for slot, rate in shared)
    p[PHI + 2, PHI + 2] += heading.own_sd_rad**2 + common - heading.sd_rad**2
    for slot, rate in shared:
        p[PHI + 2, slot] = p[slot, PHI + 2] = -rate * p[slot, slot]


def _by_fix(model: Model, by: Array, fix: PositionCandidate, dcm: Array, velocity: Array) -> None:
    """Rows of the position in `by` (n, n): an innovation of 0 (fusiond.aiding.position) says

        dr = e + S db + w dc + v dtau + C dl - [C l x] phi,   e the fix's noise

    Without it the next fixes would seem to prove that b, c, tau and dl are 0.
    """
    by[DR : DR + 3, PHI : PHI + 3] = -skew(dcm @ np.array(fix.lever))
    for state, slot in enumerate(model.slots_of_all(fix.bias).tolist()):
        by[DR : DR + 3, slot] = [along[state] for along in fix.bias_share]
    for row, slot in enumerate(model.slots_of(fix.markov)):
        by[DR + row, slot] = markov_sd_of(row, fix.markov_m, fix.sd)
    for slot in model.slots_of(fix.time):
        by[DR : DR + 3, slot] = velocity
    for axis, slot in enumerate(model.slots_of(fix.rest)):
        by[DR : DR + 3, slot] = dcm[:, axis]
    by[~model.active] = 0.0


def _by_velocity(model: Model, by: Array, moves: Moves, dcm: Array) -> None:
    """Rows of the velocity in `by` (n, n) (fusiond.aiding.velocity).

    dv = e + a dtau + C [w x] dl - (C (w x l)) x phi
    """
    across = dcm @ np.cross(moves.rate, moves.candidate.lever)
    by[DV : DV + 3, PHI : PHI + 3] = -skew(across)
    for slot in model.slots_of(moves.candidate.time):
        by[DV : DV + 3, slot] = moves.acceleration
    for axis, slot in enumerate(model.slots_of(moves.candidate.rest)):
        by[DV : DV + 3, slot] = (dcm @ skew(moves.rate))[:, axis]
    by[~model.active] = 0.0


def _by_course(p: Array, velocity: VelocityCandidate) -> None:
    """Correlate a heading by the course with the velocity of that course, whose noise e is in both:

        phi_D = -w (z x v) e / |v|^2 + the rest

    w is 1, or the variance of the heading by that of this course alone where more than this course
    made it (the weight of a mean). Without it further velocities would correct the velocity and
    leave the heading."""
    north, east, *_ = velocity.v_ned
    of_course = np.array([east, -north]) / (north * north + east * east)
    shared = of_course * np.square(velocity.sd[:2])
    weight = min(1.0, p[PHI + 2, PHI + 2] / float(of_course @ shared))
    p[PHI + 2, DV : DV + 2] = p[DV : DV + 2, PHI + 2] = weight * shared


def _take_fitted(
    model: Model, p: Array, xi: Array, fitted: Fitted, force: Array, time: list[int]
) -> None:
    """Set biases, and the offset of slots `time` (0 or 1), to the fitted values, with their
    covariance with the attitude; P's attitude covariance is added to it.

    The sensed force bias is b + s f, f (3,) nearly gravity alone. If the model has the scale factor
    s, b is known no better than s f, and cov(b, s) = -f var(s).
    """
    slots, rows = list(range(3)), list(range(3))
    columns = *range(FORCE_ERROR, FORCE_ERROR + 3), *range(RATE_ERROR, RATE_ERROR + 3)
    for row, column in enumerate(columns):
        for slot in model.parameters(column)[:1]:
            slots.append(slot)
            rows.append(3 + row)
            xi[slot] = fitted.biases[row]
            p[slot, slot] = 0.0
    for slot in time:
        slots.append(slot)
        rows.append(9)
        xi[slot], p[slot, slot] = fitted.delay_s, 0.0
    p[np.ix_(slots, slots)] += fitted.covariance[np.ix_(rows, rows)]
    for axis in range(3):
        for slot in model.parameters(FORCE_ERROR + axis)[:1]:
            for scale in model.parameters(FORCE_SCALE + axis):
                shared = -force[axis] * p[scale, scale]
                p[slot, slot] -= force[axis] * shared
                p[slot, scale] = p[scale, slot] = shared


def _start_biases(
    model: Model, p: Array, xi: Array, by: Array, dcm: Array, lat: float, bias: Array, sd: float
) -> None:
    """Set the rate bias at rest, if better known than by the data sheet.

    The sensed rate is that of a vehicle at rest for any attitude `dcm`: the part of the Earth's
    rate that phi turns to other axes is in the bias, db = -C^T (w_ie x phi), rows of `by` (n, n).
    Without them a rest would seem to confirm the heading of the start (fusiond.aiding.standstill).
    """
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    by_attitude = dcm.T @ skew(earth)
    for axis in range(3):
        slot = model.parameters(9 + axis)[0]
        prior = p[slot, slot]
        floor = LEVEL_SD_RAD / BIAS_SETTLING_S
        variance = sd**2 + floor**2
        taken = prior / (prior + variance)
        xi[slot] = bias[axis] * taken
        p[slot, slot] = taken * variance
        by[slot, PHI : PHI + 3] = -taken * by_attitude[axis]


def _correlate(
    model: Model, p: Array, dcm: Array, lat: float, height: float, compassed: bool
) -> None:
    """Add attitude errors caused by sensor errors: J Pss J^T on attitude, J Pss across. A bias
    without a state in the model also tilts the attitude."""
    size = model.size
    jacobian = np.zeros((3, size))
    by_force = levelling_jacobian(dcm, lat, height)
    for axis in range(3):
        for slot in model.parameters(12 + axis):
            jacobian[:, slot] = by_force[:, axis]
    if compassed:
        north, down = EARTH_RATE_RAD_S * math.cos(lat), -EARTH_RATE_RAD_S * math.sin(lat)
        jacobian[2] = jacobian[0] * down / north
        for axis in range(3):
            for slot in model.parameters(9 + axis):
                jacobian[2, slot] += dcm[1, axis] / north
    cross = jacobian @ p
    p[:3, :3] += cross @ jacobian.T
    p[:3, 9:] += cross[:, 9:]
    p[9:, :3] = p[:3, 9:].T
    tilt = model.force_left_out / gravity(lat, height)
    for turned in ([1.0, 0.0, -math.tan(lat) if compassed else 0.0], [0.0, 1.0, 0.0]):
        p[:3, :3] += tilt**2 * np.outer(turned, turned)
