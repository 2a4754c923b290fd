r"""Attitude (roll, pitch, yaw) and heading.

Attitude: the rotation from measured to computed attitude is -phi, in navigation axes:

    z = rotation vector of C^ C_y^T = -phi + v,   cov(v) = J diag(sd^2) J^T

J's columns are the axes about which roll, pitch and yaw turn: C e_x, [-sin yaw, cos yaw, 0], e_z.
Its noise is whitened, so that the rows are uncorrelated. Heading alone:

    z = yaw^ - yaw,   d yaw = -[tan(pitch) cos yaw, tan(pitch) sin yaw, 1] phi

Source: Groves, 2nd ed., section 16.1; Euler kinematics, eq. 2.57.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
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


@dataclass(frozen=True, slots=True)
class AttitudeAid(Aid):
    """Roll, pitch, yaw (rad, NED to body) with `sd`; NaN is not measured."""

    rpy: Vector3
    sd: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        computed = rpy_from_dcm(state.dcm)
        given = [not math.isnan(a) for a in self.rpy]
        rpy = [y if g else c for y, c, g in zip(self.rpy, computed, given, strict=True)]
        sd = [s if g else UNKNOWN_SD_RAD for s, g in zip(self.sd, given, strict=True)]
        measured = dcm_from_rpy(*rpy)
        z = rotation_vector_from_dcm(state.dcm @ measured.T)
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
        return Innovation(whiten @ z, h, np.square(sd))


@dataclass(frozen=True, slots=True)
class HeadingAid(Aid):
    """True heading (rad) of the body's forward axis with `sd_rad`."""

    yaw_rad: float
    sd_rad: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        _, pitch, yaw = rpy_from_dcm(state.dcm)
        if abs(pitch) > STEEPEST_PITCH_RAD:
            return NotApplicable("too_steep")
        tangent = math.tan(pitch)
        h = np.zeros((1, state.model.size))
        h[0, 0:3] = -tangent * math.cos(yaw), -tangent * math.sin(yaw), -1.0
        z = np.array([wrap_angle(yaw - self.yaw_rad)])
        return Innovation(z, h, np.array([self.sd_rad**2]))
