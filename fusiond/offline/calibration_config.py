"""Configuration of a calibration: which keys change, and the lines of TOML for them.

With C_vb the matrix of `imu.mounting_deg`, m the estimated remaining mounting angles, rho the roll,
and tau the time from the stamps of fixes to their validity:

    C_vb <- C(rho) exp[m x] C_vb          (fusiond.configuration.si_units.sensor_to_body) lever arm
    of an antenna <- C(rho) exp[m x] (l + dl), where dl was observed imu.time_offset_s <-
    time_offset_s - tau,   and, relative to it, all other sources: velocity_delay_s <-
    velocity_delay_s - tau_v + tau,   latency_s <- latency_s + tau_w + tau scale <- scale (1 + k)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.aiding import Aiding, GnssAiding, WheelAiding, lever_sd_m
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    AXLE_LEVER,
    FIX_TIME,
    MOUNTING,
    VELOCITY_TIME,
    WHEEL_LATENCY,
    WHEEL_SCALE,
)
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    rotation_vector_to_quaternion,
    rpy_from_dcm,
)
from fusiond.navigator.calibration import CalibrationState, Parameter
from fusiond.navigator.saved_calibration import CHANGES

Array = NDArray[np.float64]

ROLL = "mounting_roll_deg"
PITCH, YAW = "mounting_pitch_deg", "mounting_yaw_deg"
AXES = "xyz"
KINDS_OF: Mapping[type[Aiding], tuple[str, ...]] = {
    GnssAiding: (FIX_TIME, VELOCITY_TIME, ANTENNA_LEVER),
    WheelAiding: (WHEEL_SCALE, WHEEL_LATENCY),
}
"""Parameters of a source, by class of its section."""


def source_of(config: Config, p: Parameter) -> str:
    """Source of a parameter; empty for one of the vehicle or of the IMU."""
    for name, section in config.aiding.items():
        own = p.kind if name == section.kind else f"{p.kind}_{name}"
        if p.kind in KINDS_OF.get(type(section), ()) and p.block == own:
            return name
    return ""


def calibrated(config: Config, found: Mapping[str, Parameter]) -> Config:
    """Configuration with the observed values and unchanged sigmas."""
    seen = {n: p for n, p in found.items() if p.state is not CalibrationState.NOT_OBSERVED}
    turn = _turn(seen)
    tau_s = _fix_time_s(seen)
    imu = config.imu.model_copy(
        update={
            "mounting_deg": _rpy_deg(
                turn @ dcm_from_rpy(*(angle * DEG for angle in config.imu.mounting_deg))
            ),
            "time_offset_s": config.imu.time_offset_s - tau_s,
        }
    )
    slip = config.constraints.non_holonomic
    forward, right, down = slip.lever_arm_m
    arm = (forward + _axle_m(seen), right, down)
    constraints = config.constraints.model_copy(
        update={"non_holonomic": slip.model_copy(update={"lever_arm_m": arm})}
    )
    aiding = {}
    for name, section in config.aiding.items():
        mine = [p for p in seen.values() if source_of(config, p) == name]
        changed = _of_section(section, mine, turn, tau_s)
        if isinstance(section, GnssAiding) and "lever_arm_m" in changed:
            # The lever arm is now given, but its sigma stays the same.
            changed["lever_arm_sd_m"] = lever_sd_m(section, config.aiding)
        aiding[name] = section.model_copy(update=changed)
    return config.model_copy(update={"imu": imu, "constraints": constraints, "aiding": aiding})


def configured(config: Config, before: Config, p: Parameter) -> tuple[str, float]:
    """Key and value of a parameter in the result of `calibrated`, made of `before`. A parameter
    without a key has an empty key and its own value."""
    imu = config.imu
    if p.kind == MOUNTING:
        axis = (ROLL, PITCH, YAW).index(p.name)
        return f"imu.mounting_deg {('roll', 'pitch', 'yaw')[axis]}", imu.mounting_deg[axis]
    if p.kind == AXLE_LEVER:
        slip = config.constraints.non_holonomic
        return "constraints.non_holonomic.lever_arm_m x", slip.lever_arm_m[0]
    source = source_of(config, p)
    section, at = config.aiding.get(source), f"aiding.{source}"
    if isinstance(section, GnssAiding):
        if p.kind == FIX_TIME and source == _first_receiver(before):
            return "imu.time_offset_s", imu.time_offset_s
        if p.kind == VELOCITY_TIME:
            return f"{at}.velocity_delay_s", section.velocity_delay_s
        if p.kind == ANTENNA_LEVER:
            axis = AXES.index(_axis(p))
            return f"{at}.lever_arm_m {AXES[axis]}", section.lever_arm_m[axis]
    if isinstance(section, WheelAiding):
        if p.kind == WHEEL_SCALE:
            return f"{at}.scale", section.scale
        return f"{at}.latency_s", section.latency_s
    return "", p.value


def fragment(
    config: Config, now: Config, found: Mapping[str, Parameter], sentences: Iterable[str]
) -> str:
    """TOML of the keys in which `now` differs from `config`.

    Observed parameters have smaller sigmas; `sentences` become comments."""
    seen = [p for p in found.values() if p.state is not CalibrationState.NOT_OBSERVED]
    lines = [f"# {text}" for text in sentences]
    lines += _table("imu", _changed(config.imu, now.imu, ("mounting_deg", "time_offset_s")))
    slip = now.constraints.non_holonomic
    keys = _changed(config.constraints.non_holonomic, slip, ("lever_arm_m",))
    keys |= _sigma("mounting_sd_deg", seen, (MOUNTING,), slip.mounting_sd_deg)
    keys |= _sigma("lever_arm_sd_m", seen, (AXLE_LEVER,), slip.lever_arm_sd_m)
    lines += _table("constraints.non_holonomic", keys)
    for name, section in now.aiding.items():
        mine = [p for p in seen if source_of(now, p) == name]
        keys = {}
        if isinstance(section, GnssAiding):
            keys = _changed(config.aiding[name], section, ("lever_arm_m", "velocity_delay_s"))
            times = (FIX_TIME, VELOCITY_TIME)
            keys |= _sigma("time_offset_sd_s", mine, times, section.time_offset_sd_s)
            if any(p.kind == ANTENNA_LEVER for p in mine):
                # One sigma for all three axes, also those not observed.
                axes = [p for p in found.values() if source_of(now, p) == name]
                before = lever_sd_m(section, now.aiding)
                sd = _sigma("lever_arm_sd_m", axes, (ANTENNA_LEVER,), before)
                keys |= sd or {"lever_arm_sd_m": before}
        if isinstance(section, WheelAiding):
            keys = _changed(config.aiding[name], section, ("scale", "latency_s"))
            keys |= _sigma("scale_sd", mine, (WHEEL_SCALE,), section.scale_sd)
            keys |= _sigma("latency_sd_s", mine, (WHEEL_LATENCY,), section.latency_sd_s)
        lines += _table(f"aiding.{name}", keys)
    return "\n".join(lines) + "\n"


def _axis(p: Parameter) -> str:
    """Axis of a lever arm's parameter, whose name ends in `x_m`."""
    return p.name.removesuffix("_m")[-1]


def _first_receiver(config: Config) -> str:
    """Reference receiver for time: the first one with an offset."""
    for name, section in config.aiding.items():
        if isinstance(section, GnssAiding) and section.time_offset_sd_s:
            return name
    return ""


def _axle_m(seen: Mapping[str, Parameter]) -> float:
    return next((p.value for p in seen.values() if p.kind == AXLE_LEVER), 0.0)


def _fix_time_s(seen: Mapping[str, Parameter]) -> float:
    """tau of the first receiver."""
    return next((p.value for p in seen.values() if p.kind == FIX_TIME), 0.0)


def _turn(seen: Mapping[str, Parameter]) -> Array:
    """C(rho) exp[m x] (3, 3)."""
    roll, pitch, yaw = (
        seen[name].value * DEG if name in seen else 0.0 for name in (ROLL, PITCH, YAW)
    )
    rest = dcm_from_quaternion(np.array(rotation_vector_to_quaternion(0.0, pitch, yaw)))
    return dcm_from_rpy(roll, 0.0, 0.0) @ rest


def _rpy_deg(dcm: Array) -> tuple[float, float, float]:
    roll, pitch, yaw = (round(math.degrees(angle), 3) for angle in rpy_from_dcm(dcm))
    return roll, pitch, yaw


def _of_section(
    section: Aiding, mine: list[Parameter], turn: Array, tau_s: float
) -> dict[str, Any]:
    """Changed keys in a source's section."""
    by_kind = {p.kind: p.value for p in mine}
    if isinstance(section, GnssAiding):
        delay_s = section.velocity_delay_s
        if VELOCITY_TIME in by_kind:
            delay_s = max(0.0, delay_s - by_kind[VELOCITY_TIME] + tau_s)
        changed: dict[str, Any] = {"velocity_delay_s": delay_s}
        rest = {_axis(p): p.value for p in mine if p.kind == ANTENNA_LEVER}
        if rest:
            arm = turn @ (np.array(section.lever_arm_m) + [rest.get(axis, 0.0) for axis in AXES])
            changed["lever_arm_m"] = tuple(round(x, 3) for x in arm.tolist())
        return changed
    if isinstance(section, WheelAiding):
        return {
            "scale": section.scale * (1.0 + by_kind.get(WHEEL_SCALE, 0.0)),
            "latency_s": section.latency_s + by_kind.get(WHEEL_LATENCY, 0.0) + tau_s,
        }
    return {}


def _changed(before: Any, now: Any, keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: getattr(now, key) for key in keys if getattr(now, key) != getattr(before, key)}


def _sigma(
    key: str, seen: list[Parameter], kinds: tuple[str, ...], before: float
) -> dict[str, float]:
    """Sigma of a key: the largest of its parameters', with the possible change until the next
    start."""
    sds = [math.hypot(p.sd, CHANGES[p.kind]) for p in seen if p.kind in kinds and p.name != ROLL]
    return {key: max(sds)} if sds and max(sds) < before else {}


def _table(name: str, keys: Mapping[str, Any]) -> list[str]:
    if not keys:
        return []
    return ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]


def _toml(value: float | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(x) for x in value)}]"
    return f"{round(value, 4) + 0.0}"
