"""Measurements from the IMU alone: standstill and no slip."""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.rest_evidence import RestEvidence
from fusiond.aiding.standstill import Rest, ZeroAngularRateUpdate, ZeroVelocityUpdate
from fusiond.configuration.constraints import Constraints, NonHolonomic
from fusiond.configuration.si_units import DEG, quiet_limits
from fusiond.models.blocks import Block, ImuNoise
from fusiond.models.vehicle_parameter_blocks import (
    SIDE_DRIFT,
    axle_lever_block,
    drift_block,
    mounting_block,
)
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.standstill import StandstillDetector, Window, next_cell
from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels

GATE = 0.9999
"""Gate probability, as the measured measurements' default."""

NO_SLIDING = "non_holonomic"


class Sensed(NamedTuple):
    """Ended windows of the detector, and the constraints that hold as measurements."""

    windows: list[Window]
    measurements: list[AidingMeasurement]


def vehicle_blocks(options: NonHolonomic) -> list[Block]:
    """Parameters of a vehicle that does not slide: mounting of the IMU, axle, side drift."""
    if not options.enabled:
        return []
    found = []
    if options.mounting_sd_deg:
        found.append(mounting_block(options.mounting_sd_deg * DEG))
    if options.lever_arm_sd_m:
        found.append(axle_lever_block(options.lever_arm_sd_m))
    if options.drift_sd_m_s:
        found.append(drift_block(SIDE_DRIFT, options.drift_sd_m_s, options.drift_s))
    return found


class ConstraintMaker:
    """Maker of the constraints of `[constraints]` from samples in chunks of any size.

    `noise` is the IMU's; `rest_evidence` receives the measurements; `drifts` scale the configured
    side drift and its white noise.
    """

    def __init__(self, options: Constraints, noise: ImuNoise, drifts: DriftLevels) -> None:
        self._options, self._rate_noise, self._drifts = options, noise.rate_noise, drifts
        self.rest_evidence = RestEvidence()
        self._detector = StandstillDetector(quiet_limits(options.zero_velocity, noise))
        self._last_cell = -1

    def feed(self, imu: ImuBuffer, new: int) -> Sensed:
        """Process the samples from row `new` on."""
        windows = self._detector.feed(imu.times, imu.samples, imu.start, new, imu.end)
        if windows:
            self.rest_evidence.catch_up()
        measurements: list[AidingMeasurement] = []
        if self._options.zero_velocity.enabled:
            for window in windows:
                if window.quiet:
                    measurements += self._standstill(window)
        if self._options.non_holonomic.enabled:
            measurements += self._no_sliding(imu, new)
        return Sensed(windows, measurements)

    def _standstill(self, w: Window) -> list[AidingMeasurement]:
        z = self._options.zero_velocity
        rest = Rest(
            w,
            self.rest_evidence,
            z.max_speed_m_s,
            z.velocity_sd_m_s,
            z.rate_sd_deg_s * DEG,
            self._rate_noise / math.sqrt(z.window_s),
            z.window_s,
        )
        rate = (float(w.mean_rate[0]), float(w.mean_rate[1]), float(w.mean_rate[2]))
        return [
            ZeroVelocityUpdate("zero_velocity", w.end_ns, GATE, z.velocity_sd_m_s, rest),
            ZeroAngularRateUpdate("zero_rate", w.end_ns, GATE, rate, rest.rate_sd_rad_s, rest),
        ]

    def _no_sliding(self, imu: ImuBuffer, new: int) -> list[AidingMeasurement]:
        """Non-holonomic constraints, one at the first sample of each interval."""
        o = self._options.non_holonomic
        width, rows, row = round(o.interval_s * 1e9), [], new
        while (row := next_cell(imu.times, row, imu.end, width, self._last_cell)) >= 0:
            self._last_cell = int(imu.times[row]) // width
            rows.append(row)
        found: list[AidingMeasurement] = []
        for row in rows:
            t_ns, white = int(imu.times[row]), self._drifts.white
            found.append(
                NonHolonomicConstraint(
                    NO_SLIDING,
                    t_ns,
                    GATE,
                    o.sd_m_s * white.counts(NO_SLIDING, t_ns, o.sd_m_s, o.drift_s),
                    o.sd_down_m_s,
                    o.min_speed_m_s,
                    o.lever_arm_m,
                    self._drifts.counts(SIDE_DRIFT, t_ns),
                )
            )
        return found
