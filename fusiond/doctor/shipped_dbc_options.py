"""Devices with a shipped DBC file, each with its source options.

The same as the blocks of `docs/can-imu.md` and `docs/can-gnss.md`, which describe the settings of
the device and the uncertain points.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class KnownDevice(NamedTuple):
    """Device on a CAN bus: its name, its driver, and the driver's options without the bus."""

    title: str
    driver: str
    options: dict[str, Any]


KNOWN_DEVICES: tuple[KnownDevice, ...] = (
    KnownDevice(
        "SBG Ellipse",
        "can_imu",
        {
            "dbc": "sbg_ellipse",
            "gyro": ["IMU_GYRO.GYRO_X", "IMU_GYRO.GYRO_Y", "IMU_GYRO.GYRO_Z"],
            "accel": ["IMU_ACCEL.ACCEL_X", "IMU_ACCEL.ACCEL_Y", "IMU_ACCEL.ACCEL_Z"],
            "device_time": "IMU_INFO.TIME_STAMP",
        },
    ),
    KnownDevice(
        "Xsens MTi-600",
        "can_imu",
        {
            "dbc": "xsens_mti600",
            "gyro": ["RATE_OF_TURN.GYRO_X", "RATE_OF_TURN.GYRO_Y", "RATE_OF_TURN.GYRO_Z"],
            "accel": ["ACCELERATION.ACCEL_X", "ACCELERATION.ACCEL_Y", "ACCELERATION.ACCEL_Z"],
            "counter": "GROUP_COUNTER.COUNTER",
            "device_time": "SAMPLE_TIME.TIME",
        },
    ),
    KnownDevice(
        "Bosch MM7.10",
        "can_imu",
        {
            "dbc": "bosch_mm7_10",
            "gyro": ["-TX2.ROLL_RATE", "TX3.PITCH_RATE", "TX1.YAW_RATE"],
            "accel": ["TX2.AX", "TX1.AY", "TX3.AZ"],
            "counter": ["TX1.COUNTER", "TX2.COUNTER", "TX3.COUNTER"],
        },
    ),
    KnownDevice(
        "Bosch MM5.10",
        "can_imu",
        {
            "dbc": "bosch_mm5_10",
            "gyro": ["-TX2.ROLL_RATE", 0.0, "TX1.YAW_RATE"],
            "accel": ["TX2.AX", "TX1.AY", 9.80665],
        },
    ),
    KnownDevice(
        "Racelogic IMU04",
        "can_imu",
        {
            "dbc": "racelogic_imu04",
            "gyro": ["IMU_602.ROLL_RATE", "IMU_602.PITCH_RATE", "IMU_600.YAW_RATE"],
            "accel": ["IMU_600.ACCEL_X", "-IMU_601.ACCEL_Y", "-IMU_603.ACCEL_Z"],
        },
    ),
    KnownDevice(
        "Aceinna OpenIMU300RI",
        "can_imu",
        {
            "dbc": "aceinna_openimu300ri",
            "gyro": ["ARI.RATE_X", "ARI.RATE_Y", "ARI.RATE_Z"],
            "accel": ["ACCS.ACCEL_X", "ACCS.ACCEL_Y", "ACCS.ACCEL_Z"],
            "source_address": 0x80,
        },
    ),
    KnownDevice(
        "fusiond's simulated IMU",
        "can_imu",
        {
            "dbc": "fusiond_sim_imu",
            "gyro": ["SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"],
            "accel": ["SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"],
            "counter": [
                "SIM_TIME.TIME_COUNTER",
                "SIM_GYRO.GYRO_COUNTER",
                "SIM_ACCEL.ACCEL_COUNTER",
            ],
            "device_time": "SIM_TIME.TIME",
        },
    ),
    KnownDevice(
        "CSS Electronics CANmod.gps",
        "can_imu",
        {
            "dbc": "css_canmod_gps",
            "gyro": ["gnss_imu.AngularRateX", "gnss_imu.AngularRateY", "gnss_imu.AngularRateZ"],
            "accel": [
                "gnss_imu.AccelerationX",
                "gnss_imu.AccelerationY",
                "gnss_imu.AccelerationZ",
            ],
        },
    ),
    KnownDevice(
        "CSS Electronics CANmod.gps",
        "can_gnss",
        {
            "dbc": "css_canmod_gps",
            "lat": "gnss_pos.Latitude",
            "lon": "gnss_pos.Longitude",
            "horizontal_accuracy": "gnss_pos.PositionAccuracy",
            "position_valid": "gnss_pos.PositionValid",
            "height": "gnss_altitude.Altitude",
            "height_valid": "gnss_altitude.AltitudeValid",
            "speed": "gnss_speed.Speed",
            "course": "gnss_attitude.Heading",
            "speed_accuracy": "gnss_speed.SpeedAccuracy",
            "velocity_valid": ["gnss_speed.SpeedValid", "gnss_attitude.AttitudeValid"],
            "utc": "gnss_time.Epoch",
            "utc_valid": ["gnss_time.TimeValid", "gnss_time.TimeConfirmed"],
            "satellites": "gnss_status.Satellites",
        },
    ),
)
