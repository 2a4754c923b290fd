"""Further faults for recorded drives: other sizes, and several at once."""

from __future__ import annotations

from functools import partial

from drivers.measurements import DelayedFix, PositionFix, WheelSpeed
from fusiond.configuration.si_units import DEG
from fusiond.studies.faults import imu_faults as imu
from fusiond.studies.faults import measurement_faults as measurement
from fusiond.studies.faults.library import FAULTS, UNDER_WAY, Fault, sideways
from fusiond.studies.faults.sensor_data import Alter, Drive, Recording

KM_H = 3.6
"""km/h in a m/s: speeds of one unit, read as the other."""
FORWARD, UP = 3, 5
"""Axes of the accelerometers."""


def _both(first: Alter, second: Alter) -> Alter:
    def alter(r: Recording, begin_s: float, length_s: float) -> Recording:
        return second(first(r, begin_s, length_s), begin_s, length_s)

    return alter


_of_imu = partial(Fault, of_imu=True, phases=UNDER_WAY)
_of_fixes = partial(Fault, phases=UNDER_WAY)
_of_wheels = partial(Fault, of_imu=True, phases=UNDER_WAY, drive=Drive(wheels=True))
_silences = partial(Fault, phases=("navigating",))
_at_once = partial(Fault, phases=("navigating",), drive=Drive(wheels=True))
_slip = partial(measurement.wheels_scaled, factor=1.5)

MORE: dict[str, Fault] = {
    # fixes of the receiver
    "step_3m": _of_fixes(partial(measurement.position_step, north_m=3.0), 20.0),
    "step_10m": _of_fixes(partial(measurement.position_step, north_m=10.0), 20.0),
    "step_50m": _of_fixes(partial(measurement.position_step, north_m=50.0), 20.0),
    "scatter_20m": _of_fixes(partial(measurement.scattered_positions, sd_m=20.0), 30.0),
    "height_50m": _of_fixes(partial(measurement.too_high, up_m=50.0), 20.0),
    "velocity_off_3_m_s": _of_fixes(partial(measurement.velocity_bias, north_m_s=3.0), 20.0),
    "sigma_1mm": _of_fixes(partial(measurement.tiny_sigma, sd_m=1e-3), 30.0),
    "fixes_late_2s": _of_fixes(partial(measurement.stamped_too_new, delay_s=2.0), 30.0),
    # samples of the IMU
    "gyro_bias_0.3_deg_s": _of_imu(partial(imu.bias_step, size=0.3 * DEG)),
    "force_bias_0.5_m_s2": _of_imu(partial(imu.bias_step, size=0.5, axis=FORWARD)),
    "gyro_scale_10%": _of_imu(partial(imu.scaled_axis, axis=imu.YAW_AXIS, factor=1.1)),
    "force_scale_10%": _of_imu(partial(imu.scaled_axis, axis=UP, factor=1.1)),
    "mount_turned_10_deg": _of_imu(
        partial(imu.mount_turned, angle_rad=10.0 * DEG), turned_rad=-10.0 * DEG
    ),
    "imu_noise_x10": _of_imu(partial(imu.noisy, times=10.0), 60.0),
    "imu_lost_0.3s": _of_imu(imu.silent, 0.3),
    "imu_lost_1s": _of_imu(imu.silent, 1.0),
    "imu_lost_3s": _of_imu(imu.silent, 3.0),
    "imu_lost_5s": _of_imu(imu.silent, 5.0),
    "imu_half_rate": _of_imu(imu.half_rate, phases=("aligning", *UNDER_WAY)),
    "imu_sideways": Fault(phases=("aligning",), begin_s=0.0, configure=sideways),
    # stamps of the IMU
    "imu_stamps_0.1s_ahead": _of_imu(partial(imu.stamps_off, off_s=0.1), 15.0),
    "imu_stamps_0.5s_ahead": _of_imu(partial(imu.stamps_off, off_s=0.5), 15.0),
    "imu_stamps_0.1s_behind": _of_imu(partial(imu.stamps_off, off_s=-0.1), 15.0),
    "imu_stamps_0.9s_behind": _of_imu(partial(imu.stamps_off, off_s=-0.9), 15.0),
    "imu_clock_200ppm": _of_imu(partial(imu.clock_fast, ppm=200.0)),
    # wheels
    "wheels_10%_fast": _of_wheels(partial(measurement.wheels_scaled, factor=1.1), 30.0),
    "wheels_locked": _of_wheels(measurement.wheels_locked, 5.0),
    "wheels_slip": _of_wheels(_slip, 3.0),
    "wheels_late_0.5s": _of_wheels(partial(measurement.wheels_delayed, delay_s=0.5)),
    "wheels_in_km_h": _of_wheels(partial(measurement.wheels_scaled, factor=KM_H)),
    "wheels_in_km_h_always": _of_wheels(
        partial(measurement.wheels_scaled, factor=KM_H), phases=("aligning",), begin_s=0.0
    ),
    "wheels_now_and_then": _of_wheels(
        lambda r, begin_s, length_s: measurement.intermittent(r, begin_s, length_s, WheelSpeed),
        60.0,
    ),
    # several at once
    "drift_and_slip": _at_once(_both(partial(measurement.drift, north_m_s=0.5), _slip), 20.0),
    "drift_and_scale": _at_once(
        _both(
            partial(measurement.drift, north_m_s=0.2),
            partial(measurement.wheels_scaled, factor=1.1),
        ),
        60.0,
    ),
    "step_and_locked": _at_once(
        _both(partial(measurement.position_step, north_m=50.0), measurement.wheels_locked), 10.0
    ),
    "step_and_gyro_bias": _silences(
        _both(partial(measurement.position_step, north_m=50.0), imu.bias_step), 20.0
    ),
    "no_fixes": _silences(
        lambda r, begin_s, length_s: measurement.removed(
            r, begin_s, length_s, PositionFix, DelayedFix
        ),
        60.0,
    ),
    "no_wheels": _at_once(
        lambda r, begin_s, length_s: measurement.removed(r, begin_s, length_s, WheelSpeed), 60.0
    ),
    "no_aids": _silences(measurement.removed, 60.0),
    "no_aids_and_gyro_bias": _silences(_both(measurement.removed, imu.bias_step), 30.0),
    "no_aids_and_imu_noise": _silences(
        _both(measurement.removed, partial(imu.noisy, times=10.0)), 30.0
    ),
    "no_fixes_and_slip": _at_once(
        _both(
            lambda r, begin_s, length_s: measurement.removed(r, begin_s, length_s, PositionFix),
            _slip,
        ),
        20.0,
    ),
    "all_silent": _silences(_both(measurement.removed, imu.silent), 5.0),
}

EVERY = {**FAULTS, **MORE}
"""Faults of the matrix and of this module."""
