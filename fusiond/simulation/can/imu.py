"""Simulated IMU on a CAN bus, described by the options of the driver that reads it."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.can.python_can_import import can
from fusiond.simulation.can.encoder import CanEncoder

SIM_IMU = CanImuOptions(
    interface="virtual",
    channel="fusiond-sim",
    dbc="fusiond_sim_imu",
    gyro=("SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"),
    accel=("SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"),
    counter=("SIM_TIME.TIME_COUNTER", "SIM_GYRO.GYRO_COUNTER", "SIM_ACCEL.ACCEL_COUNTER"),
    device_time="SIM_TIME.TIME",
)
"""The simulation's own IMU: `config/dbc/fusiond_sim_imu.dbc`, 2 deg/h and 20 ug a step."""


class CanImu:
    """Encoder of samples; no bus and no clock. Raises `PermanentDriverError` for wrong options."""

    def __init__(self, options: CanImuOptions = SIM_IMU) -> None:
        self._encoder = CanEncoder(CanImuDecoder("imu", options), options.source_address)

    def frames(
        self, number: int, t_ns: int, gyro: Sequence[float], accel: Sequence[float]
    ) -> list[can.Message]:
        """Frames of sample `number`, valid at `t_ns` of the device's clock; rad/s and m/s^2."""
        return self._encoder.frames(number, t_ns, (*gyro, *accel))
