"""Export of a log as a rosbag2: `sensor_msgs/NavSatFix` of the solution, `Imu` of the sensor.
Storage is MCAP. It needs the package rosbags (extra `ros`), and no ROS.

Frames are ROS's own (REP 103): covariance east, north, up; the sensor's rates and forces turned
from forward, right, down to forward, left, up. A sensor's message has no orientation, which -1 in
its covariance states.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from drivers.measurements import ImuSample, Measurement
from drivers.raw.messages import RawGnssEpoch
from fusiond.clock.results import Instant
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import sensor_to_body
from fusiond.files.csv_tables import MissingPackageError
from fusiond.files.install_extra import install_command
from fusiond.recording.channels import LOCATION
from fusiond.recording.reader import Log
from fusiond.replay.measurement_csv_export import replay_measurements

_TO_ROS = np.array([1.0, -1.0, -1.0])


def write_rosbag(recording: Log, config: Config, folder: Path) -> dict[str, int]:
    """Write a bag into `folder`, which must not exist, and return the number of messages by topic.
    Raises `MissingPackageError`, OSError."""
    if importlib.util.find_spec("rosbags") is None:
        raise MissingPackageError(f"rosbag2 needs the package rosbags: {install_command('ros')}")
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - an extra
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        made = _Messages(store)
        fixes = bag.add_connection("/fix", made.fix_type, typestore=store)
        samples = bag.add_connection("/imu", made.imu_type, typestore=store)
        counts = {"/fix": 0, "/imu": 0}
        for message in recording.messages(LOCATION):
            fix = made.fix(message.json())
            bag.write(fixes, message.t_log_ns, store.serialize_cdr(fix, made.fix_type))
            counts["/fix"] += 1
        to_ros = _TO_ROS[:, None] * sensor_to_body(config.imu)
        epoch_ns = recording.about.epoch_ns

        def add(m: Measurement | RawGnssEpoch, instant: Instant) -> None:
            if isinstance(m, ImuSample):
                t_ns = instant.t_valid_ns + epoch_ns
                imu = made.imu(t_ns, to_ros @ m.gyro_rad_s, to_ros @ m.accel_m_s2)
                bag.write(samples, t_ns, store.serialize_cdr(imu, made.imu_type))
                counts["/imu"] += 1

        replay_measurements(recording, config, add)
    return counts


class _Messages:
    """Converter of messages to the ROS types of a store."""

    fix_type = "sensor_msgs/msg/NavSatFix"
    imu_type = "sensor_msgs/msg/Imu"

    def __init__(self, store: Any) -> None:
        self._types = store.types

    def _header(self, t_ns: int, frame: str) -> Any:
        sec, nanosec = divmod(t_ns, 1_000_000_000)
        time = self._types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def fix(self, location: dict[str, Any]) -> Any:
        """Convert a `foxglove.LocationFix` into a NavSatFix, which has the same fields."""
        stamp = location["timestamp"]
        status = self._types["sensor_msgs/msg/NavSatStatus"]
        return self._types[self.fix_type](
            header=self._header(stamp["sec"] * 1_000_000_000 + stamp["nsec"], "body"),
            status=status(status=status.STATUS_FIX, service=status.SERVICE_COMPASS),
            latitude=location["latitude"],
            longitude=location["longitude"],
            altitude=location["altitude"],
            position_covariance=np.array(location["position_covariance"]),
            position_covariance_type=location["position_covariance_type"],
        )

    def imu(self, t_ns: int, rate: Any, force: Any) -> Any:
        """Make an Imu message of rates (rad/s) and specific forces (m/s^2), (3,) in ROS's axes."""
        vector = self._types["geometry_msgs/msg/Vector3"]
        quaternion = self._types["geometry_msgs/msg/Quaternion"]
        unknown = np.zeros(9)
        unknown[0] = -1.0  # sensor_msgs/Imu: this part of the message is not given
        return self._types[self.imu_type](
            header=self._header(t_ns, "imu"),
            orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=unknown,
            angular_velocity=vector(*rate.tolist()),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*force.tolist()),
            linear_acceleration_covariance=np.zeros(9),
        )
