r"""Heading of a compass: magnetic, with the deviation of the vehicle.

    psi_m = psi - D + a + b sin psi + c cos psi + d + v

D is the declination at the vehicle. a (mounting, and the error of the field's model) and b, c (the
vehicle's permanent magnetism, the semicircular deviation) are constants, or nearly; d lasts for
some seconds (bridges, vehicles beside, own currents), a first-order Gauss-Markov process with a
learned factor (fusiond.navigator.aiding_drift_sigma_estimation); v is white. The measurement is
psi_m + D:

    z = psi^ + dev(psi^) - (psi_m + D),   d z = d psi (1 + b cos psi - c sin psi) - d dev

with d dev the error of the deviation by its states, true minus estimated. Soft iron (sin 2 psi) is
mostly a tenth of it and goes into d. Source: Groves, 2nd ed., section 6.1.1; Bowditch, The American
Practical Navigator (2019), chapter 8 (coefficients A to E).
"""

from __future__ import annotations

import math

import numpy as np

from drivers.immutable import immutable
from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.base import Innovation, NotApplicable, State
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import HeadingCandidate
from fusiond.aiding.wheel_and_heading import CourseMeasurement
from fusiond.models.blocks import Block
from fusiond.navigation.rotation import rpy_from_dcm, wrap_angle

DEVIATION, DISTURBANCE = "compass_deviation", "compass_disturbance"


def deviation(name: str, sd_rad: float) -> Block:
    """States a, b and c, each with the same sigma, so that their sum has `sd_rad` at any heading
    and is uncorrelated at opposite ones: var(a + b sin psi + c cos psi) = 2 s^2."""
    each = sd_rad / math.sqrt(2.0)
    return Block(name, "rad", ("a", "b", "c"), (-1, -1, -1), initial=each)


def disturbance(name: str, sd_rad: float, lasts_s: float) -> Block:
    """State d."""
    return Block(name, "rad", ("d",), (-1,), initial=sd_rad, steady=sd_rad, tau_s=lasts_s)


@immutable()
class CompassMeasurement(HeadingMeasurement):
    """Heading of a compass with the declination added (rad), `sd_rad` of its white noise.
    `deviation` and `disturbance` name the model's blocks of further errors, with a total sigma of
    `lasting_sd_rad`; the disturbance is scaled by `disturbed`."""

    deviation: str
    disturbance: str
    lasting_sd_rad: float
    disturbed: float = 1.0

    @property
    def _by(self) -> tuple[float, float, float, float]:
        """Derivatives of the compass reading by the states."""
        return lasting(self.yaw_rad, self.disturbed)

    def without_attitude(self, way: HeadingHistory) -> CourseMeasurement | None:
        own = self.source, self.t_ns, self.gate, self.yaw_rad, self.sd_rad, way.slips_m_s
        blocks = self.deviation, self.disturbance
        return CourseMeasurement(*own, blocks, self._by, robust=self.robust) if way.known else None

    def innovation(self, state: State) -> Innovation | NotApplicable:
        found = HeadingMeasurement.innovation(self, state)  # super() knows no dataclass with slots
        if isinstance(found, NotApplicable):
            return found
        yaw = rpy_from_dcm(state.dcm)[2]
        slots = [*state.model.slots_of(self.deviation), *state.model.slots_of(self.disturbance)]
        by = np.array(lasting(yaw, self.disturbed))
        of = state.xi[slots]
        # What turns the compass turns the iron with it.
        turned = 1.0 + of[1] * math.cos(yaw) - of[2] * math.sin(yaw)
        h = found.h * turned
        h[0, slots] = -by
        return Innovation(np.array([wrap_angle(found.z[0] + float(by @ of))]), h, found.r)

    def candidates(self) -> tuple[HeadingCandidate, ...]:
        """A claim: how wrong it is, the deviation shares."""
        by = self._by
        shared = ((self.deviation, by[:3]), (self.disturbance, by[3:]))
        sd = math.hypot(self.sd_rad, self.lasting_sd_rad)
        return (HeadingCandidate(self.t_ns, self.yaw_rad, sd, "compass", self.sd_rad, shared),)


def lasting(yaw: float, disturbed: float) -> tuple[float, float, float, float]:
    """Error of the compass by a, b, c and d for a vehicle with heading `yaw`."""
    return 1.0, math.sin(yaw), math.cos(yaw), disturbed
