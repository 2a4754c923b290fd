"""Faults of the matrix by name: change, duration and phases.

Phase `aligning` is at rest, before the first heading; `navigating` on a straight at 20 m/s with all
measurements; `coasting` in an outage of all fixes: faults of IMU and wheels begin in the middle of
it, faults of fixes with the first fix after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from fusiond.configuration.aiding import WheelAiding
from fusiond.configuration.schema import Config, SpareImu
from fusiond.simulation.trajectories import Leg, Path, follow
from fusiond.studies.faults import imu_faults as imu
from fusiond.studies.faults import measurement_faults as measurement
from fusiond.studies.faults.sensor_data import (
    BEND_S,
    DURATION_S,
    GNSS,
    REST_S,
    SECOND,
    Alter,
    Drive,
)

PhaseName = Literal["aligning", "navigating", "coasting"]
Configure = Callable[[Config], Config]


@dataclass(frozen=True, slots=True)
class Phase:
    """Phase of a drive: begin of faults of IMU, wheels and fixes, and outage (start, end), in s."""

    imu_s: float
    fix_s: float
    outage_s: tuple[float, float] | None = None


PHASES: dict[PhaseName, Phase] = {
    "aligning": Phase(5.0, 5.0),
    "navigating": Phase(80.0, 80.0),
    "coasting": Phase(82.0, 100.0, (60.0, 100.0)),
}
ALL: tuple[PhaseName, ...] = ("aligning", "navigating", "coasting")
UNDER_WAY: tuple[PhaseName, ...] = ("navigating", "coasting")
TO_THE_END = DURATION_S
TOWN = Drive()


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault: `alter` changes the recording for `length_s` from the phase's start, or from
    `begin_s`.

    `configure` changes the navigator's configuration, not the vehicle. A row with neither has no
    fault: its drive itself may be mistaken for one.
    """

    alter: Alter | None = None
    length_s: float = TO_THE_END
    of_imu: bool = False
    phases: tuple[PhaseName, ...] = ALL
    begin_s: float | None = None
    configure: Configure | None = None
    drive: Drive = TOWN
    turned_rad: float = 0.0
    """Rotation of the IMU's forward axis; the recorded attitude is compared in the rotated axes."""

    def begins_s(self, phase: PhaseName) -> float:
        """Start, s of the drive."""
        if self.begin_s is not None:
            return self.begin_s
        return PHASES[phase].imu_s if self.of_imu else PHASES[phase].fix_s


# --------------------------------------------------------------------------- drives


_OFF = (Leg(REST_S), Leg(8, speed_m_s=14.0), Leg(12), Leg(8, turn_deg=90.0))


def _creeping(speed_m_s: float, duration_s: float) -> Path:
    """Drive at town speed, from 80 s on at a crawl."""
    legs = (*_OFF, Leg(17), Leg(20, speed_m_s=speed_m_s), Leg(duration_s))
    return follow(legs, duration_s, course_deg=40.0)


def _turning(rate_deg_s: float, duration_s: float) -> Path:
    """Drive at town speed, a stop at 80 s, and from 90 s a turn on the spot for a minute."""
    legs = (
        *_OFF,
        Leg(27),
        Leg(10, speed_m_s=0.0),
        Leg(10),
        Leg(60, turn_deg=60.0 * rate_deg_s),
        Leg(10),
        Leg(10, speed_m_s=10.0),
        Leg(duration_s),
    )
    return follow(legs, duration_s, course_deg=40.0)


def _reversing(duration_s: float) -> Path:
    """Drive backwards at 5 m/s, then forwards."""
    legs = (Leg(REST_S), Leg(6, speed_m_s=-5.0), Leg(20), Leg(6, speed_m_s=0.0), *_OFF[1:])
    return follow((*legs, Leg(duration_s)), duration_s, course_deg=40.0)


def _smooth(duration_s: float) -> Path:
    """Drive straight after a bend at a constant 20 m/s."""
    legs = (*_OFF, Leg(8, speed_m_s=20.0), Leg(duration_s))
    return follow(legs, duration_s, course_deg=40.0)


# --------------------------------------------------------------------------- configurations


def _axes(x: str, y: str, z: str, config: Config) -> Config:
    section = type(config.imu).model_validate({**config.imu.model_dump(), "axes": (x, y, z)})
    return config.model_copy(update={"imu": section})


sideways = partial(_axes, "+y", "+x", "-z")
"""True if the unit's forward axis points to the right."""


def _heading_off(config: Config) -> Config:
    """The town drive starts with a heading of 40 deg."""
    update = {"heading": ("config",), "heading_deg": 130.0, "heading_sd_deg": 5.0}
    return config.model_copy(update={"alignment": config.alignment.model_copy(update=update)})


def with_wheels(config: Config) -> Config:
    """Configuration with wheel speeds of the point that does not slide."""
    section = WheelAiding(lever_arm_m=config.constraints.non_holonomic.lever_arm_m)
    return config.model_copy(update={"aiding": {**config.aiding, "wheel": section}})


def with_second(config: Config) -> Config:
    """Configuration with a second receiver like the first."""
    aiding = {**config.aiding, SECOND: config.aiding[GNSS]}
    return config.model_copy(update={"aiding": aiding})


def with_spare(config: Config) -> Config:
    """Configuration with a second inertial unit, rotated by a quarter turn."""
    spare = SpareImu(source="spare", axes=("+y", "+x", "-z"))
    return config.model_copy(update={"imu": config.imu.model_copy(update={"spare": spare})})


_of_imu = partial(Fault, of_imu=True)
_in_bend = partial(_of_imu, imu.silent, phases=("navigating",), begin_s=BEND_S)
_of_wheels = partial(_of_imu, length_s=30.0, phases=UNDER_WAY, drive=Drive(wheels=True))
_with_spare = partial(_of_imu, drive=Drive(spare=True))
_of_two = partial(Fault, drive=Drive(second=True))
_from_start = partial(Fault, phases=("aligning",), begin_s=0.0)
_under_way = partial(Fault, phases=("navigating",))
_of_places = partial(_under_way, length_s=60.0, drive=Drive(places_alone=True))
_carried_off = partial(measurement.spoofed_drift, north_m_s=1.0)

FAULTS: dict[str, Fault] = {
    "none": Fault(),
    # fixes of the receiver
    "step_500m": Fault(measurement.position_step, 20.0),
    "position_0n_0e": Fault(measurement.null_island, 20.0),
    "fix_frozen": Fault(measurement.frozen_fix, 20.0),
    "velocity_reversed": Fault(measurement.velocity_reversed, 20.0),
    "velocity_1s_old": Fault(measurement.velocity_old, 60.0),
    "drift_0.1_m_s": Fault(partial(measurement.drift, north_m_s=0.1), 60.0, phases=UNDER_WAY),
    "drift_0.2_m_s": Fault(partial(measurement.drift, north_m_s=0.2), 60.0, phases=UNDER_WAY),
    "drift_0.5_m_s": Fault(measurement.drift, 60.0),
    # In an outage it is within what the outage leaves open: nobody can tell.
    "step_2m_to_the_end": Fault(
        partial(measurement.position_step, north_m=2.0), phases=("navigating",)
    ),
    "step_10m_to_the_end": Fault(
        partial(measurement.position_step, north_m=10.0), phases=UNDER_WAY
    ),
    "step_500m_to_the_end": Fault(measurement.position_step, phases=UNDER_WAY),
    "velocity_ramp_0.1_m_s2": Fault(measurement.velocity_ramp, 60.0),
    # In an outage a velocity is not known as well as that: nobody can tell.
    "carried_off_0.5_m_s": Fault(measurement.spoofed_drift, 60.0, phases=("navigating",)),
    # Of a receiver without velocities, which would tell.
    "places_drift_0.5_m_s": _of_places(measurement.drift),
    "places_drift_2_m_s": _of_places(partial(measurement.drift, north_m_s=2.0)),
    "fixes_late_0.8s": Fault(measurement.stamped_too_new, phases=UNDER_WAY),
    "fixes_always_late_0.8s": _from_start(measurement.stamped_too_new),
    "false_burst_1khz": Fault(measurement.false_burst, 0.5),
    "sigma_1e-9": Fault(measurement.tiny_sigma, 20.0),
    "sigma_infinite": Fault(measurement.infinite_sigma, 1.0),
    "latitude_nan": Fault(measurement.nan_latitude, 1.0),
    "height_1e300": Fault(measurement.huge_height, 0.4),
    "speed_1e300": Fault(measurement.huge_speed, 0.4),
    "speed_2000_knots": Fault(measurement.impossible_speed, 20.0),
    "fixes_twice": Fault(measurement.repeated, 20.0),
    "fixes_from_future": Fault(measurement.from_future, 20.0),
    "multipath_tunnel_jump": _under_way(measurement.multipath_tunnel_jump, 60.6),
    "first_fixes_at_90s": _from_start(measurement.no_fix_yet, 90.0, drive=Drive(_smooth)),
    # fixes of two receivers
    "one_of_two_drifts_0.5_m_s": _of_two(
        measurement.except_source(measurement.drift, SECOND), 60.0
    ),
    "two_step_500m": _of_two(measurement.position_step, 20.0),
    "two_frozen": _of_two(measurement.frozen_fix, 20.0),
    "two_carried_off_0.5_m_s": _of_two(measurement.spoofed_drift, 60.0, phases=("navigating",)),
    "two_late_0.8s": _of_two(measurement.stamped_too_new, 60.0, phases=("navigating",)),
    # The IMU and the wheels alone can say so.
    "carried_off_1_m_s_wheels": _under_way(_carried_off, 60.0, drive=Drive(wheels=True)),
    "two_carried_off_1_m_s_wheels": _under_way(
        _carried_off, 60.0, drive=Drive(wheels=True, second=True)
    ),
    # RDSS
    "rdss_step_500m": Fault(measurement.rdss_step, 60.0),
    "rdss_latitude_nan": Fault(measurement.rdss_nan, 30.0),
    # wheels
    "wheels_frozen": _of_wheels(measurement.wheels_frozen),
    "wheels_scaled": _of_wheels(measurement.wheels_scaled),
    "wheels_reversed": _of_wheels(measurement.wheels_reversed),
    # samples of the IMU
    "imu_saturated_1s": _of_imu(imu.saturated, 1.0),
    "imu_stuck_15s": _of_imu(imu.stuck, 15.0),
    "imu_zero_15s": _of_imu(imu.all_zero, 15.0),
    "gyro_axis_dead": _of_imu(imu.dead_axis),
    "gyro_bias_1_deg_s": _of_imu(imu.bias_step),
    "mount_turned_30_deg": _of_imu(imu.mount_turned, turned_rad=-imu.TURNED_RAD),
    "imu_nan_1s": _of_imu(imu.not_numbers, 1.0),
    "gyro_spike": _of_imu(imu.gyro_spike, 0.1),
    "gyro_spike_in_range": _of_imu(imu.small_spike, 0.1),
    "imu_silent_5s_bend": _in_bend(5.0),
    "imu_silent_15s_bend": _in_bend(15.0),
    "imu_lost_0.3s_bend": _in_bend(0.3),
    "imu_lost_0.45s_bend": _in_bend(0.45),
    # of the first of two units
    "imu_silent_spare": _with_spare(imu.silent),
    "imu_silent_spare_bend": _with_spare(imu.silent, phases=("navigating",), begin_s=BEND_S),
    "imu_stuck_spare": _with_spare(imu.stuck),
    "gyro_axis_dead_spare": _with_spare(imu.dead_axis, phases=UNDER_WAY),
    # stamps of the IMU
    "imu_stamp_0.7s_ahead": _of_imu(imu.stamp_ahead, 0.1),
    "imu_stamps_reversed": _from_start(imu.stamps_reversed),
    # units, mounting and heading, wrong from the first sample on
    "force_in_g": _from_start(imu.force_in_g),
    "rate_in_deg_s": _from_start(imu.rate_in_deg_s),
    "imu_upside_down": _from_start(configure=partial(_axes, "+x", "+y", "+z")),
    "imu_backwards": _from_start(configure=partial(_axes, "-x", "+y", "-z")),
    "heading_off_by_90_deg": _from_start(configure=_heading_off),
    # drives that look like something else
    "creeping_0.2_m_s": _under_way(drive=Drive(partial(_creeping, 0.2))),
    "creeping_0.45_m_s": _under_way(drive=Drive(partial(_creeping, 0.45))),
    "turning_0.6_deg_s": _under_way(drive=Drive(partial(_turning, 0.6))),
    "turning_1.8_deg_s": _under_way(drive=Drive(partial(_turning, 1.8))),
    "smooth_ride": Fault(phases=("coasting",), drive=Drive(_smooth)),
    "start_in_reverse": Fault(phases=("aligning",), drive=Drive(_reversing)),
}
