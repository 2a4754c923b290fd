r"""Heading from the course over ground: moving off from a standstill, or on the move.

The receiver measures the antenna, the heading is the body's. With the body's rate w, the antenna at
l and the point that does not slide at s, a vehicle of forward speed V (negative: backward) has

    C^T v_antenna = V x + w x (l - s),   yaw = course of the antenna - atan2 of that

Moving off from rest, the IMU senses the velocity and its direction in the body:

    C^T v_antenna = int f dt + w x l

This needs no assumption about slip, but a rest before: sensed and measured speed must agree in
size. If they do not, the quiet window was no rest, and the start is one on the move, in which
changes of velocity distinguish forward from backward (fusiond.navigator.alignment.motion_fit).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.initialisation_candidates import VelocityCandidate
from fusiond.models.blocks import ImuNoise
from fusiond.navigation.alignment import level
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import (
    dcm_from_rpy,
    rpy_from_dcm,
    wrap_angle,
)
from fusiond.navigator.alignment import motion_fit, sensed_motion
from fusiond.navigator.alignment.evidence import TOGETHER_NS, Fix, Standstill
from fusiond.navigator.alignment.heading_source_data import Basis
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.rate_bias_at_rest import rest_bias
from fusiond.navigator.alignment.start import (
    BACKWARD,
    BIAS_SETTLING_S,
    LEVEL_SD_RAD,
    Fitted,
    Levelled,
    Moves,
    Place,
    Start,
    build_start,
    velocity_of,
)
from fusiond.navigator.imu_worse_than_class import evidence_against, worse_classes
from fusiond.navigator.mode_reasons import reason

Array = NDArray[np.float64]

# Sigmas beyond which felt and measured speed do not agree: chance makes 1 in 16,000.
AGREEMENT_SIGMAS = 4.0
# Course and felt direction must agree this well (rad), forward or backward, or the vehicle slid
# or the integration is poor: the next fix decides.
COURSE_AGREEMENT_RAD = math.radians(45.0)
# One sigma (m) of where the point that does not slide is: as measured with a tape; and not said at
# all, when the IMU itself is taken for it (half a wheelbase).
MEASURED_LEVER_SD_M, UNKNOWN_LEVER_SD_M = 0.3, 1.5
# No start claims a better heading (rad): scale factors and misalignments of the IMU.
LEAST_YAW_SD_RAD = math.radians(1.0)
# A start on the move is taken over this long at most, and no shorter.
MOTION_NS = (800_000_000, 20_000_000_000)
# Velocities that miss the best fit by this part of the speed from which a course counts, RMS, are
# none: 20 deg of a course. Late by 0.8 s they miss by a thirtieth.
MISSED = 1.0 / 3.0
# Log likelihood ratio at which forward and backward are told apart: one start in 10,000 is wrong.
DECIDED = math.log(1e4)
# A vehicle that is not seen to accelerate for so long (s) is taken to drive forward: above the
# speed that one reverses at, where only forward remains, and below it, where nobody reverses for a
# minute without braking.
FORWARD_AFTER_S = (5.0, 60.0)
# Reversing has settled once the speed (m/s) has not grown by more in two seconds.
SETTLED_M_S, SETTLED_NS = 0.5, 2_000_000_000


class Along(NamedTuple):
    """Direction of the antenna's velocity in the body (rad) and its sigma."""

    angle: float
    sd: float


def from_course(by: Basis, imu: ImuBuffer, place: Place) -> Start | None:
    """Heading from the course over ground, forward or backward as sensed by the IMU."""
    known = by.known
    # A fix of before the first sample is one of a gap: nothing was felt since.
    sensed = [f for f in known.fixes if imu.oldest_ns <= f.velocity.t_ns <= imu.latest_ns]
    latest = sensed[-1] if sensed else None
    if latest is None or latest.velocity.t_ns == known.tried_ns:
        return None  # the same data say the same
    speed = math.hypot(*latest.velocity.v_ned[:2])
    if speed < by.options.course_speed_m_s:
        known.why = reason("no_heading_course", speed=by.options.course_speed_m_s)
        return None
    known.tried_ns = latest.velocity.t_ns
    last = {f.source: f for f in sensed if latest.velocity.t_ns - f.velocity.t_ns <= TOGETHER_NS}
    confirmed = [fix for fix in last.values() if known.position_confirms(fix)]
    if not confirmed:
        known.why = reason("confirming_course")
        return None
    latest, s = confirmed[-1], known.standstill
    here = known.place_of(latest.position, latest.velocity)
    if (
        s is not None
        and s.seconds >= 1.0
        and imu.oldest_ns <= s.end_ns < latest.velocity.t_ns
        and known.rested(s)
    ):
        found = _moved_off(by, imu, s, latest.velocity, here)
        if found is not None:
            return found if isinstance(found, Start) else None
    found = _on_the_move(by, imu, latest, here, imu.oldest_ns)
    contradicted_ns = known.contradicted_ns.get(latest.source)
    if found is None or contradicted_ns is None:
        return found
    # They fit, on the whole. But of those that the positions contradicted some were wrong, and a
    # jump of the velocity by 6 m/s among twenty is a force bias of 1 m/s^2 and a tilt of 5 deg.
    return _on_the_move(by, imu, latest, here, contradicted_ns + 1)


def _moved_off(
    by: Basis, imu: ImuBuffer, standstill: Standstill, velocity: VelocityCandidate, place: Place
) -> Start | str | None:
    """Start of a vehicle that has moved off; a reason to wait; or None if the motion sensed since
    the end of rest does not match the velocity, so that there was no rest."""
    lat, _, height = (float(v) for v in place[1])
    g = gravity(lat, height)
    f = sensed_motion.sensed(
        imu, np.array([standstill.end_ns, velocity.t_ns]), standstill.mean_rate
    )
    rested = dcm_from_rpy(*level(standstill.mean_force), 0.0)
    gained = rested @ f.gained[1] + [0.0, 0.0, g * f.of.t_s[1]]
    dcm = rested @ f.turned[1]
    roll, pitch, turned = rpy_from_dcm(dcm)
    rate = f.rates[1]
    antenna = gained + dcm @ np.cross(rate, velocity.lever)
    sensed_m_s, speed = math.hypot(*antenna[:2]), math.hypot(*velocity.v_ned[:2])
    sd_sensed = _sensed_sd(by, g, (velocity.t_ns - standstill.end_ns) * 1e-9, turned, speed)
    acceleration = dcm @ f.of.means[1, 3:] + [0.0, 0.0, g]
    delay_v = math.hypot(*acceleration[:2]) * _sd_delay_s(by, velocity)
    sd_speed = math.hypot(max(velocity.sd[:2]), delay_v)
    if abs(sensed_m_s - speed) > AGREEMENT_SIGMAS * math.hypot(sd_sensed, sd_speed):
        return None
    sensed = wrap_angle(math.atan2(antenna[1], antenna[0]) - turned)
    backward = abs(sensed) > math.pi / 2.0
    by_course = _along(by.options, velocity, rate, backward)
    difference = wrap_angle(sensed - by_course.angle)
    if abs(difference) > COURSE_AGREEMENT_RAD:
        return by.known.doubted(reason("imu_sideways"))
    if backward:
        if not by.known.seen_at_rest(standstill):
            return None  # braking from twice the speed feels the same
        if why := _reversing(by, velocity):
            return why
    sd_sensed_angle = math.hypot(sd_sensed, sd_speed) / speed
    share = by_course.sd**2 / (by_course.sd**2 + sd_sensed_angle**2)
    angle = by_course.angle + share * difference
    sd = by_course.sd * sd_sensed_angle / math.hypot(by_course.sd, sd_sensed_angle)
    yaw = math.atan2(velocity.v_ned[1], velocity.v_ned[0]) - angle
    at_rest = dcm_from_rpy(*level(standstill.mean_force), yaw - turned)
    bias = rest_bias(by.noise, standstill, at_rest, lat)
    return _build(
        by,
        imu,
        velocity,
        place,
        dcm_from_rpy(roll, pitch, yaw),
        max(sd, LEAST_YAW_SD_RAD),
        rate,
        "GNSS course" + (BACKWARD if backward else ""),
        (
            bias,
            Levelled(
                at_rest, _level_sd(by, (velocity.t_ns - standstill.end_ns) * 1e-9, turned, lat)
            ),
            by.known.unit.grades(standstill, *bias, g),
        ),
    )


def _level_sd(by: Basis, seconds: float, turned: float, lat: float) -> float:
    """Sigma (rad) of a level propagated by the gyros since a rest: white noise, error of the rate
    bias at rest, and, about the axes of the rest, the Earth's level rate and misaligned axes."""
    n = by.noise
    aside = 2.0 * abs(math.sin(0.5 * turned))
    return math.sqrt(
        LEVEL_SD_RAD**2
        + n.rate_noise**2 * seconds
        + (LEVEL_SD_RAD / BIAS_SETTLING_S * seconds) ** 2
        + (aside * EARTH_RATE_RAD_S * math.cos(lat) * seconds) ** 2
        + (aside * by.options.misalignment_rad) ** 2
    )


def _sensed_sd(by: Basis, g: float, seconds: float, turned: float, speed: float) -> float:
    """Sigma (m/s) of a velocity integrated from rest: white noise of both sensors, level, force
    bias (which the level hides until the vehicle has turned), scale."""
    n = by.noise
    return math.sqrt(
        n.force_noise**2 * seconds
        + (g * n.rate_noise) ** 2 * seconds**3 / 3.0
        + (g * LEVEL_SD_RAD * seconds) ** 2
        + (2.0 * math.sin(0.5 * turned) * n.force_bias_initial * seconds) ** 2
        + (n.force_scale * speed) ** 2
    )


def _along(
    options: AlignmentOptions, velocity: VelocityCandidate, rate: Array, backward: bool
) -> Along:
    """Direction of the antenna's motion in a body that turns and does not slide."""
    no_slip = options.no_slip_m
    known = no_slip is not None
    arm = np.array(velocity.lever) - np.array(no_slip if no_slip is not None else (0.0, 0.0, 0.0))
    speed = math.hypot(*velocity.v_ned[:2])
    across = float(np.cross(rate, arm)[1])
    forward = math.sqrt(max(speed**2 - across**2, 0.0))
    bend = abs(float(rate[2])) * (MEASURED_LEVER_SD_M if known else UNKNOWN_LEVER_SD_M)
    sd = math.hypot(options.course_sd_rad, math.hypot(max(velocity.sd[:2]), bend) / speed)
    return Along(math.atan2(across, -forward if backward else forward), sd)


def _reversing(by: Basis, velocity: VelocityCandidate) -> str:
    """Reason why a backward start must wait; empty without one.

    An IMU mounted backwards senses a vehicle that drives off forward like one that reverses. The
    speed distinguishes them once it has settled or exceeds that of reversing; from then on no start
    is backward.
    """
    speed = math.hypot(*velocity.v_ned[:2])
    if speed > by.options.max_reverse_m_s or "imu_backwards" in by.known.reported:
        return by.known.report("imu_backwards", reason("imu_backwards", speed=speed))
    for fix in by.known.fixes:
        age_ns = velocity.t_ns - fix.velocity.t_ns
        if 0 < age_ns <= SETTLED_NS:
            if speed - math.hypot(*fix.velocity.v_ned[:2]) > SETTLED_M_S:
                return by.known.doubted(reason("reversing"))
            break
    return ""


@immutable()
class Ways:
    """Fits of velocities to sensed motion, one for each direction of travel."""

    sensed: sensed_motion.Sensed
    _past: sensed_motion.Past
    _measured: sensed_motion.Measured
    _latest: VelocityCandidate
    _options: AlignmentOptions
    _noise: ImuNoise
    _g: float
    _sd_delay_s: float

    def fit(self, backward: bool) -> motion_fit.Fit:
        """Best fit of a forward or backward direction of travel."""
        velocity = self._latest
        course = math.atan2(velocity.v_ned[1], velocity.v_ned[0])
        along = _along(self._options, velocity, self.sensed.rates[-1], backward)
        yaw = course - along.angle
        given = self._past, self.sensed, self._measured, self._noise, self._g
        return motion_fit.fit(*given, yaw, along.sd, self._sd_delay_s)


def ways(
    past: sensed_motion.Past,
    m: sensed_motion.Measured,
    latest: VelocityCandidate,
    options: AlignmentOptions,
    noise: ImuNoise,
    g: float,
    sd_delay_s: float = 0.0,
) -> Ways:
    """Fits of velocities in order of time to sensed motion; `latest` is the last. Their delay is
    between 0 and `sd_delay_s`."""
    f = sensed_motion.sensed(past, m.instants, sensed_motion.rate_before_motion(past, m))
    return Ways(f, past, m, latest, options, noise, g, sd_delay_s)


def _on_the_move(
    by: Basis, imu: ImuBuffer, latest: Fix, place: Place, since_ns: int
) -> Start | None:
    """Start in motion by the velocities from `since_ns` on."""
    velocity = latest.velocity
    shortest, longest = MOTION_NS
    oldest = max(velocity.t_ns - longest, imu.oldest_ns, since_ns)
    usable = [f.velocity for f in by.known.fixes if oldest <= f.velocity.t_ns <= velocity.t_ns]
    if not usable or velocity.t_ns - usable[0].t_ns < shortest:
        by.known.doubted(reason("collecting"))
        return None
    lat, _, height = (float(v) for v in place[1])
    delay_v = _sd_delay_s(by, velocity)
    m, g = sensed_motion.measured(usable, sensed_motion.MOST_FIXES), gravity(lat, height)
    either = ways(imu, m, usable[-1], by.options, by.noise, g, delay_v)
    forward_fit, backward_fit = either.fit(backward=False), either.fit(backward=True)
    best = min(forward_fit, backward_fit, key=lambda x: x.cost)
    for worse in () if by.known.unit.judged else worse_classes(by.noise):
        beyond = evidence_against(by.noise, worse)
        if best.cost - best.degrees <= beyond:
            break
        other = ways(imu, m, usable[-1], by.options, worse, g, delay_v)
        fits = other.fit(backward=False), other.fit(backward=True)
        better = min(fits, key=lambda x: x.cost)
        if best.cost - better.cost > beyond:
            by.known.unit.noise, either, best = worse, other, better
            forward_fit, backward_fit = fits
    rate = either.sensed.rates[-1]
    # Where even the better fit is poor, the sigmas are too small by as much.
    doubt = max(1.0, best.cost / best.degrees)
    ratio = 0.5 * (backward_fit.cost - forward_fit.cost) / doubt
    missed_m_s = math.sqrt(doubt) * float(np.max(velocity_of(velocity)[1][:2]))
    if missed_m_s > MISSED * by.options.course_speed_m_s:
        by.known.doubted(reason("fixes_disagree"))
        return None
    if not (forward_fit.converged and backward_fit.converged):
        by.known.doubted(reason("no_attitude"))
        return None
    speed = math.hypot(*velocity.v_ned[:2])
    if ratio < -DECIDED:
        if _reversing(by, velocity):
            return None
        at = by, imu, velocity, place, backward_fit.dcm, LEAST_YAW_SD_RAD, rate
        how = "GNSS course, on the move" + BACKWARD
        return _build(*at, how, fitted=_fitted(backward_fit, doubt))
    fast = speed > by.options.max_reverse_m_s
    moving_s = (velocity.t_ns - by.known.moving_since_ns) * 1e-9
    timeout_s = FORWARD_AFTER_S[0 if fast else 1]
    # The prior says forward, but not once an IMU was found to face the other way.
    assumed = moving_s >= timeout_s and ratio > -1.0 and "imu_backwards" not in by.known.reported
    if ratio < DECIDED and not assumed:
        by.known.doubted(reason("direction", seconds=timeout_s))
        return None
    at = by, imu, velocity, place, forward_fit.dcm, LEAST_YAW_SD_RAD, rate
    return _build(*at, "GNSS course, on the move", fitted=_fitted(forward_fit, doubt))


def _sd_delay_s(by: Basis, velocity: VelocityCandidate) -> float:
    """One sigma of the delay of a receiver's velocities; 0 if not estimated."""
    return float(sum(by.model.initial[slot] for slot in by.model.slots_of(velocity.time)))


def _fitted(fit: motion_fit.Fit, doubt: float) -> Fitted:
    return Fitted(fit.biases, fit.delay_s, doubt * fit.covariance)


def _build(
    by: Basis,
    imu: ImuBuffer,
    candidate: VelocityCandidate,
    place: Place,
    dcm: Array,
    sd_yaw: float,
    rate: Array,
    how: str,
    rested: tuple[tuple[Array, float], Levelled, Array] | None = None,
    fitted: Fitted | None = None,
) -> Start:
    """Start with the antenna's velocity in the body; `rested`: bias, level and grades of a
    standstill."""
    bias, levelled, grades = rested or (None, None, by.known.unit.unrested_grades)
    velocity, sd = velocity_of(candidate)
    velocity = velocity - dcm @ np.cross(rate, candidate.lever)
    force = sensed_motion.samples_at(imu, candidate.t_ns)[3:]
    if fitted is not None:
        force = force - fitted.biases[:3]
    acceleration = dcm @ force + [0.0, 0.0, gravity(float(place[1][0]), float(place[1][2]))]
    if fitted is not None:
        velocity = velocity - acceleration * fitted.delay_s
    return build_start(
        by.model,
        candidate.t_ns,
        place,
        dcm,
        sd_yaw,
        velocity,
        sd,
        how,
        bias=bias,
        levelled=levelled,
        fitted=fitted,
        unexplained=by.known.unexplained,
        moves=Moves(candidate, rate, acceleration),
        grades=grades,
    )
