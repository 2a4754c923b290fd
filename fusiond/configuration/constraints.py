"""Sections `[constraints.*]`: measurements from the vehicle's motion, without a sensor."""

from __future__ import annotations

from pydantic import Field, NonNegativeFloat, PositiveFloat

from fusiond.configuration.aiding import Section, Vector


class ZeroVelocity(Section):
    """Stationary detector: zero velocity and zero rate while the sensor is quiet."""

    enabled: bool = True
    window_s: PositiveFloat = 1.0
    """Length of a window of samples, on a fixed time grid."""
    gyro_sd_deg_s: PositiveFloat = 0.5
    """Rest needs a smaller standard deviation on every axis; set twice the value with the engine
    on."""
    accel_sd_m_s2: PositiveFloat = 0.15
    """Threshold of specific force, like that of rates."""
    max_rate_deg_s: PositiveFloat = 2.0
    """Rest needs a smaller mean rate, three sigma of the gyro's bias allowed."""
    max_speed_m_s: PositiveFloat = 0.5
    """Rest needs a smaller computed speed."""
    velocity_sd_m_s: PositiveFloat = 0.05
    """One sigma of the velocity at rest."""
    rate_sd_deg_s: PositiveFloat = 0.1
    """Largest rate of a standing vehicle."""
    interval_s: PositiveFloat = 0.5


class NonHolonomic(Section):
    """A wheeled vehicle does not slide sideways nor jump: v_right = v_down = 0 at a point; see
    `docs/vehicle.md`."""

    enabled: bool = False
    sd_m_s: PositiveFloat = 0.2
    """One sigma of the sideways velocity, independent in each interval."""
    sd_down_m_s: PositiveFloat = 0.5
    """One sigma of the downward velocity: heave and pitch of the suspension, which last for
    seconds."""
    drift_sd_m_s: NonNegativeFloat = 0.1
    """One sigma of a lasting sideways velocity (slip angle, a road's crown), a state; 0: none."""
    drift_s: PositiveFloat = 5.0
    """Correlation time of that error."""
    mounting_sd_deg: NonNegativeFloat = 5.0
    """One sigma of the error of `imu.mounting_deg` in pitch and yaw; the filter estimates it. 0:
    exact."""
    min_speed_m_s: NonNegativeFloat = 2.0
    interval_s: PositiveFloat = 0.1
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """From the IMU to the point that does not slide (the rear axle)."""
    lever_arm_sd_m: NonNegativeFloat = 1.0
    """One sigma of the error of its forward part; the filter estimates it. 0: exact."""


class Constraints(Section):
    zero_velocity: ZeroVelocity = Field(default_factory=ZeroVelocity.unsaid)
    non_holonomic: NonHolonomic = Field(default_factory=NonHolonomic.unsaid)
