"""Calibration on disk: results of one drive for the next start.

It has its own file beside the saved state, because it outlives a drive: the saved state becomes
void as soon as the vehicle moves. Values are relative to the configured ones, so they hold only
while axes, mounting, lever arms and delays keep their configuration.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from fusiond.configuration.aiding import GnssAiding, WheelAiding
from fusiond.configuration.schema import Config
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    AXLE_LEVER,
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    FIX_TIME,
    MOUNTING,
    VELOCITY_TIME,
    WHEEL_LATENCY,
    WHEEL_SCALE,
)
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.calibration import (
    WANDERING,
    CalibrationState,
    Parameter,
    calibration_slots,
)
from fusiond.navigator.saved_noise import SavedNoise
from fusiond.navigator.saved_state import STRICT
from fusiond.navigator.state_file import (
    DamagedStateError,
    RefusedStateError,
    read_state,
    write_state,
)

# One sigma of what may have changed until the next start, in published units.
CHANGES = {
    # A full boot or back seat lets a car's rear down by 3 to 5 cm over a wheel base of 2.7 m: 0.6
    # to 1 deg, in one load of several.
    MOUNTING: 0.5,
    # The point that does not slide moves with load and tyres.
    AXLE_LEVER: 0.05,
    # 0.3 bar or 40 K of a tyre change its rolling radius by 0.2 to 0.4 %.
    WHEEL_SCALE: 0.004,
    # A serial line or a bus gateway that is opened anew queues differently by one or two frames of
    # its 50 or 100 Hz.
    WHEEL_LATENCY: 0.02,
    FIX_TIME: 0.02,
    VELOCITY_TIME: 0.02,
    # An antenna stays where it is screwed.
    ANTENNA_LEVER: 0.01,
    # Other weather (10 hPa) at another place (the geoid), other air (10 K).
    BAROMETER_OFFSET: 100.0,
    BAROMETER_SCALE: 0.04,
    # A window that is open or not.
    BAROMETER_AIRFLOW: 0.05,
}
# A value this many configured sigmas off belongs to no vehicle of that configuration.
MOST_SIGMAS = 6.0

Name = Annotated[str, Field(min_length=1, max_length=128)]
Value = Annotated[float, Field(ge=-1e3, le=1e3)]
Sigma = Annotated[float, Field(gt=0.0, le=1e3)]


@dataclass(frozen=True, slots=True, config=STRICT)
class SavedCalibration:
    """Value and one sigma of each observed parameter by published name, with the observed noise;
    `configuration` is the digest of the configured values. Raises pydantic's `ValidationError`."""

    configuration: Annotated[str, Field(max_length=64)]
    values: Annotated[dict[Name, tuple[Value, Sigma]], Field(max_length=64)]
    noise: SavedNoise | None = None
    version: Literal[1] = 1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of parameters, and of fixes with known errors."""
        return (*self.values, *(self.noise.fixes if self.noise is not None else ()))

    def taken_up(self, start: Start, model: Model) -> Start:
        """Start with these parameters: their saved sigma grown by the possible change, at most the
        configured one."""
        xi, p = start.xi.copy(), start.covariance.copy()
        for s in calibration_slots(model):
            if s.name not in self.values:
                continue
            value, sd = self.values[s.name]
            sd = min(math.hypot(sd, CHANGES[s.kind]), s.prior_sd) / s.factor
            xi[s.index] = value / s.factor
            p[s.index], p[:, s.index] = 0.0, 0.0
            p[s.index, s.index] = sd**2
        return replace(start, xi=xi, covariance=p)

    def refuted(self, parameters: Iterable[Parameter]) -> str | None:
        """Contradiction of a restored calibration: a value beyond four sigma of the possible
        change, by chance one time in 16,000. Time offsets may drift on a long drive. None without
        one."""
        for p in parameters:
            if p.name in self.values and p.kind not in WANDERING:
                value, sd = self.values[p.name]
                sd = min(math.hypot(sd, CHANGES[p.kind]), p.prior_sd)
                if sd < p.prior_sd and abs(p.value - value) > 4.0 * sd:
                    return f"{p.name} was {value:+.3g} and is now {p.value:+.3g}"
        return None


_SAVED = TypeAdapter(SavedCalibration)


def mounting_digest(config: Config) -> str:
    """Digest of twelve hexadecimal digits over the values to which a calibration refers."""
    imu, slip = config.imu, config.constraints.non_holonomic
    about: dict[str, Any] = {
        "axes": imu.axes,
        "mounting_deg": imu.mounting_deg,
        "time_offset_s": imu.time_offset_s,
        "axle": slip.lever_arm_m,
        "serial_latency_s": config.clock.serial_latency_s,
    }
    for name, section in config.aiding.items():
        own: dict[str, Any] = {"kind": section.kind, "lever_arm_m": section.lever_arm_m}
        if isinstance(section, GnssAiding):
            own["velocity_delay_s"] = section.velocity_delay_s
        if isinstance(section, WheelAiding):
            own["scale"], own["latency_s"] = section.scale, section.latency_s
        about[f"aiding.{name}"] = own
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]


def saved_calibration(
    parameters: Iterable[Parameter], digest: str, noise: SavedNoise | None = None
) -> SavedCalibration | None:
    """Observed part of a calibration, to be saved; None if nothing was observed."""
    values = {
        p.name: (p.value, p.sd) for p in parameters if p.state is not CalibrationState.NOT_OBSERVED
    }
    return SavedCalibration(digest, values, noise) if values or noise is not None else None


def save_calibration(path: Path, saved: SavedCalibration) -> None:
    """Write atomically. OSError passes."""
    write_state(path, _SAVED.dump_json(saved), durable=True)


def load_calibration(path: Path, model: Model, digest: str) -> SavedCalibration | None:
    """Saved calibration; None without a valid one.

    Raises `DamagedStateError` for an invalid file, `RefusedStateError` for one of another mounting.
    """
    saved = read_state(path, _SAVED)
    if saved is None:
        return None
    if saved.configuration != digest:
        raise RefusedStateError("axes, mounting, lever arms or delays have changed since")
    for s in calibration_slots(model):
        value, _ = saved.values.get(s.name, (0.0, 1.0))
        if abs(value) > MOST_SIGMAS * s.prior_sd:
            raise DamagedStateError(f"{s.name}: {value:g} is {MOST_SIGMAS:g} sigmas off or more")
    return saved
