r"""Attitude (roll, pitch, yaw), also of a star tracker, and heading.

Attitude: the rotation from measured to computed attitude is -phi, in navigation axes:

    z = rotation vector of C^ C_y^T = -phi + v,   cov(v) = J diag(sd^2) J^T

J's columns are the axes about which roll, pitch and yaw turn: C e_x, [-sin yaw, cos yaw, 0], e_z.
Its noise is whitened, so that the rows are uncorrelated.

A star tracker has a misalignment: its axes are the body's turned by the small rotation vector m
(rad, body axes), so it measures the attitude C exp[m x]. With m^ the estimate and d = m - m^,

    z = rotation vector of C^ exp[m^ x] C_y^T = -phi - C d + v

m is a block of the model, if it has one, else zero. Attitude and misalignment add in z: other
measurements must distinguish them (position and velocity over accelerations, a bearing). A star
tracker really measures against the stars; its attitude against north-east-down, which papers 001
and others take ("SST attitude minus INS"), needs time and position. The effect of a position error,
dr / R, is 0.03 arcsec a metre and is neglected.

A timing error of sigma s_t turns the body by w s_t, w the rate against north-east-down, which adds
the squares of its roll, pitch and yaw to the variances. Heading alone:

    z = yaw^ - yaw,   d yaw = -[tan(pitch) cos yaw, tan(pitch) sin yaw, 1] phi

Source: Groves, 2nd ed., section 16.1; Euler kinematics, eq. 2.57; paper 001 (star tracker).
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.base import (
    AidingMeasurement,
    Innovation,
    NotApplicable,
    State,
    Vector3,
    misaligned_axes,
)
from fusiond.aiding.heading_history import HeadingHistory, Oriented
from fusiond.aiding.initialisation_candidates import HeadingCandidate
from fusiond.aiding.wheel_and_heading import CourseMeasurement
from fusiond.navigation.rotation import (
    dcm_from_rpy,
    rotation_vector_from_dcm,
    rpy_from_dcm,
    wrap_angle,
)

# Beyond this pitch (rad) heading is not a usable angle: its sigma grows as 1 / cos(pitch).
STEEPEST_PITCH_RAD = math.radians(80.0)
# One sigma (rad) for an angle that was not measured: half a turn.
UNKNOWN_SD_RAD = math.pi
STAR_BLOCK = "star_misalignment"


@immutable()
class AttitudeMeasurement(AidingMeasurement):
    """Roll, pitch, yaw (rad, NED to body) with `sd`; NaN is not measured.

    `block` names the model's block of the sensor's misalignment; a model without it has none.
    """

    rpy: Vector3
    sd: Vector3
    sd_time_s: float = 0.0
    block: str = ""

    @property
    def orientation(self) -> Oriented | None:
        """All three angles; None if it measures fewer, or at a steep pitch."""
        known = all(math.isfinite(x) for x in (*self.rpy, *self.sd))
        if not known or abs(self.rpy[1]) > STEEPEST_PITCH_RAD:
            return None
        return Oriented(self.t_ns, self.rpy, self.sd, self.block)

    def without_attitude(self, way: HeadingHistory) -> CourseMeasurement | None:
        if not way.known or self.block or math.isnan(self.rpy[2]):
            return None
        own = self.source, self.t_ns, self.gate, self.rpy[2], self.sd[2], way.slips_m_s
        return CourseMeasurement(*own, robust=self.robust)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        dcm, slots = misaligned_axes(state, self.block)
        computed = rpy_from_dcm(dcm)
        given = [not math.isnan(a) for a in self.rpy]
        rpy = [y if g else c for y, c, g in zip(self.rpy, computed, given, strict=True)]
        sd = [s if g else UNKNOWN_SD_RAD for s, g in zip(self.sd, given, strict=True)]
        measured = dcm_from_rpy(*rpy)
        z = rotation_vector_from_dcm(dcm @ measured.T)
        yaw = rpy[2]
        axes = np.column_stack(
            [measured[:, 0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        )
        try:
            whiten = np.linalg.inv(axes)
        except np.linalg.LinAlgError:
            return NotApplicable("too_steep")
        h = np.zeros((3, state.model.size))
        h[:, 0:3] = -whiten
        if slots:
            h[:, slots] = -whiten @ dcm
        turned = whiten @ (state.dcm @ state.rate_b) * self.sd_time_s
        return Innovation(whiten @ z, h, np.square(sd) + np.square(turned))

    def candidates(self) -> tuple[HeadingCandidate, ...]:
        """The yaw, unless the sensor is mounted askew: the start would have the misalignment, and
        the filter would then find the two to agree."""
        if self.block or math.isnan(self.rpy[2]):
            return ()
        return (HeadingCandidate(self.t_ns, self.rpy[2], self.sd[2]),)


@immutable()
class HeadingMeasurement(AidingMeasurement):
    """True heading (rad) of the body's forward axis with `sd_rad`."""

    period: ClassVar[float] = 2.0 * math.pi

    yaw_rad: float
    sd_rad: float

    def without_attitude(self, way: HeadingHistory) -> CourseMeasurement | None:
        own = self.source, self.t_ns, self.gate, self.yaw_rad, self.sd_rad, way.slips_m_s
        return CourseMeasurement(*own, robust=self.robust) if way.known else None

    def innovation(self, state: State) -> Innovation | NotApplicable:
        _, pitch, yaw = rpy_from_dcm(state.dcm)
        if abs(pitch) > STEEPEST_PITCH_RAD:
            return NotApplicable("too_steep")
        tangent = math.tan(pitch)
        h = np.zeros((1, state.model.size))
        h[0, 0:3] = -tangent * math.cos(yaw), -tangent * math.sin(yaw), -1.0
        z = np.array([wrap_angle(yaw - self.yaw_rad)])
        return Innovation(z, h, np.array([self.sd_rad**2]))

    def candidates(self) -> tuple[HeadingCandidate, ...]:
        return (HeadingCandidate(self.t_ns, self.yaw_rad, self.sd_rad),)
