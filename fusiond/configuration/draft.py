"""Draft of a configuration as text with comments, for a person to complete."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fusiond.configuration.schema import Axes
from fusiond.configuration.sensor_class import SensorClass
from fusiond.configuration.vehicle_class import VehicleClass

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DraftSource:
    """A `[sources.NAME]`: driver, options, and text on the place where it was found."""

    name: str
    driver: str
    options: Mapping[str, Any]
    found: str = ""
    aiding: str | None = None
    """Kind of its `[aiding]` section, where the driver does not determine it."""


@dataclass(frozen=True, slots=True)
class Draft:
    """Draft of a configuration for a new vehicle."""

    vehicle: str = "vehicle"
    vehicle_class: VehicleClass = "road"
    sensor_class: SensorClass = "mems"
    axes: Axes = ("+x", "+y", "+z")
    axes_known: str = ""
    """Sentence on the origin of the axes."""
    rate_hz: float = 100.0
    lever_arms_m: Mapping[str, Vector] = field(default_factory=dict)
    axle_m: Vector | None = None
    broker: tuple[str, int] = ("localhost", 1883)
    sources: Sequence[DraftSource] = ()


_NO_IMU = """\
# No IMU was found. Uncomment this and adapt it; docs/can-imu.md has blocks for other units:
# [sources.imu]
# driver = "can_imu"
# channel = "can0"
# dbc = "xsens_mti600"
# gyro = ["RATE_OF_TURN.GYRO_X", "RATE_OF_TURN.GYRO_Y", "RATE_OF_TURN.GYRO_Z"]
# accel = ["ACCELERATION.ACCEL_X", "ACCELERATION.ACCEL_Y", "ACCELERATION.ACCEL_Z"]
# device_time = "SAMPLE_TIME.TIME"
"""
_AIDING_KIND = {
    **dict.fromkeys(("nmea", "can_gnss", "bestpos", "sbf", "ubx"), "gnss"),
    "gnss": "raw",
    "rdss": "rdss",
}


def toml(draft: Draft) -> str:
    """The file's text; every key that is not there has its default."""
    return "\n".join(_lines(draft)) + "\n"


def _lines(d: Draft) -> Iterator[str]:
    yield "# Made by `fusiond config init`. Every key: docs/configuration.md; `fusiond check` and"
    yield "# `fusiond doctor` say what is wrong with it."
    yield ""
    yield f"vehicle = {_value(d.vehicle)}"
    yield "# road, rail, marine or aircraft: what no measurement may exceed."
    yield f"vehicle_class = {_value(d.vehicle_class)}"
    yield ""
    yield "[imu]"
    yield "# Sensor axes along forward, right, down."
    if d.axes_known:
        yield f"# {d.axes_known}"
    yield f"axes = {_value(d.axes)}"
    yield f"rate_hz = {_value(d.rate_hz)}"
    yield "# consumer, mems or tactical; the figures of its data sheet are better:"
    yield "# gyro_noise_deg_sqrt_h, accel_noise_m_s_sqrt_h, gyro_bias_instability_deg_h, ..."
    yield f"sensor_class = {_value(d.sensor_class)}"
    if not any(source.driver == "can_imu" for source in d.sources):
        yield ""
        yield _NO_IMU.rstrip("\n")
    for source in d.sources:
        yield from _source(d, source)
    if d.vehicle_class in ("road", "rail"):
        yield ""
        yield "[constraints.non_holonomic]"
        yield "# Wheels that do not slide sideways; false for what has none."
        yield "enabled = true"
        if d.axle_m is not None:
            yield "# From the IMU to the middle of the rear axle: forward, right, down."
            yield f"lever_arm_m = {_value(d.axle_m)}"
        else:
            yield "# From the IMU to the middle of the rear axle: forward, right, down. Measure it."
            yield "# lever_arm_m = [-1.0, 0.0, 0.5]"
    yield ""
    yield "[mqtt]"
    yield f"host = {_value(d.broker[0])}"
    yield f"port = {_value(d.broker[1])}"
    yield "# With a user: username here, the password in FUSIOND_MQTT_PASSWORD or a password_file."


def _source(d: Draft, source: DraftSource) -> Iterator[str]:
    yield ""
    yield f"[sources.{source.name}]"
    if source.found:
        yield f"# Found: {source.found}"
    yield f"driver = {_value(source.driver)}"
    for key, value in source.options.items():
        yield f"{key} = {_value(value)}"
    kind = source.aiding or _AIDING_KIND.get(source.driver)
    if kind is None:
        return
    yield ""
    yield f"[aiding.{source.name}]"
    if kind != source.name:
        yield f"kind = {_value(kind)}"
    if source.driver == "compass":
        yield "# Noise of one reading; what the vehicle's iron makes of it: docs/compass.md."
        yield "sd_deg = 1.0"
        return
    if source.driver == "gnss":
        yield "# Satellite by satellite: fewer than four help, too. Of what else the line has,"
        yield '# driver = "nmea" and kind = "gnss" take the receiver\'s own fixes.'
    arm = d.lever_arms_m.get(kind if kind == "rdss" else "gnss")
    yield "# From the IMU to the antenna: forward, right, down. Measure it to a few centimetres."
    if arm is not None:
        yield f"lever_arm_m = {_value(arm)}"
        return
    if kind == "gnss":
        yield "# Without it the filter looks for it, and says how poorly it is known."
    else:
        yield "# Without it the antenna is taken to be at the IMU."
    yield "# lever_arm_m = [0.0, 0.0, -1.0]"


def _value(value: Any) -> str:
    """Format a value for TOML: text, numbers, truth values and lists are as in JSON."""
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)
