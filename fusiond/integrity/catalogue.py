"""Catalogue of fault hypotheses: one for each kind of fault, with its signature.

Each hypothesis states its size in the published unit, the prior of that size and its rate, with
sources; its signature in the motion or the measurements (fusiond.estimators.fault_bank); and the
measurements that it affects.

Rates are engineering estimates for devices on vehicles in streets, for which no standard has
counts, and therefore equal for all kinds: one an hour. A device that is late by half a second or
more from an instant on, a wheel whose scale changes, or ground that turns below a vehicle at rest:
one in a thousand hours. Spoofing of position and velocity together one in ten thousand. A tenfold
rate equals a chi-square of 4.6, which moves no decision by an epoch. Sizes are one sigma of a
normal prior, which bounds an estimate; it distinguishes only kinds of a known size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from drivers.immutable import immutable
from fusiond.estimators.fault_bank import (
    ANY,
    BOUNDED,
    CARRIED,
    CLASS,
    DELAY,
    DEVICE,
    FOLLOWED,
    KIND_INTS,
    KIND_NUMBERS,
    LAG,
    LOCATES,
    LOG_RATE,
    MEAN,
    MOVES_TOO,
    POSITION,
    POSITION_RAMP,
    PRIOR,
    ROWS,
    SHIFTED,
    SIGNATURE,
    SIZE,
    SLOTS,
    SPEED,
    STATES,
    TURNED,
    VELOCITY,
    VELOCITY_RAMP,
    FaultTable,
    fault_table,
)
from fusiond.integrity.series_states import LASTS_S
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import FIX_TIME, MOUNTING, VELOCITY_TIME
from fusiond.navigation.error_model import FORCE_ERROR, RATE_ERROR

DEG = math.degrees(1.0)
BODY = ("x", "y", "z")
SENSOR, PLACE, MOTION, TIME, OWN, OVER = range(6)
"""Classes of kinds; kinds of one class need no decision between them before an action."""
RECEIVER_PER_H, DELAYED_PER_H, SPOOFED_PER_H, SENSOR_PER_H = 1.0, 1e-3, 1e-4, 1.0
TURNS_PER_H = 0.01
"""Rate at which a unit turns in its mount, an hour: seldom in a vehicle's life. A rate of one an
hour would add 0.2 deg of tilt for good to a unit that knows its tilt to 0.05 deg."""
POSITION_SD_M = (20.0, 20.0, 20.0)
METRES_SD_M = (2.0, 2.0, 3.0)
"""The lower end of the same sizes: a reflection that arrives with the direct signal, or other
satellites than before. Of code receivers no test tells it before the filter has followed it, so
that it opens what is published and accuses nobody (`Kind.opens`)."""
TOGETHER = "all receivers"
"""Device name of a kind that concerns all GNSS receivers; a terminal of RDSS has its own line, and
no GNSS spoofer carries it off."""
LAGGED_S = 0.5
"""One sigma of an unknown lag."""
FOLLOWED_SPREAD = 0.3
"""One sigma of the followed share of a fault; it differs from noise at about three sigma."""
LAGS_S, LAG_SPREAD = (0.5, 1.0, 2.0, 4.0), 0.3
"""Delays, each of which represents its neighbours within a relative sigma. Shorter delays belong to
the state for the offset in time."""


@immutable()
class Kind:
    """Fault hypothesis with `size` parameters of prior `sd` (SI), published times `per_unit` in
    `unit`; its rate is `per_hour`. `slots` of a step of states, `lag_s` of a delay. Of its `device`
    or `devices` it affects the series that `locates` and `moves` select, or all."""

    name: str
    text: str
    unit: str
    signature: int
    of: int
    sd: tuple[float, ...]
    per_hour: float
    per_unit: float = 1.0
    device: str = ""
    slots: tuple[int, ...] = ()
    lag_s: float = 0.0
    mean: float = 0.0
    bounded: bool = False
    axes: tuple[str, ...] = ("north", "east", "down")
    locates: bool = True
    moves: bool = True
    devices: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of parameters of the fault."""
        return len(self.sd)

    @property
    def corrected(self) -> bool:
        """True if the filter corrects the fault, which is one of its states."""
        return self.signature in (STATES, TURNED, SHIFTED, FOLLOWED)

    @property
    def opens(self) -> bool:
        """True if the fault only widens the published covariance: three numbers of a known size."""
        return self.bounded and self.size == 3

    def spoils(self, device: str, locates: bool, moves: bool) -> bool:
        """True if the fault invalidates a series of such a device."""
        if self.corrected or device not in (self.devices or (self.device,)):
            return False
        return self.of == OWN or (self.locates and locates) or (self.moves and moves)


def sensor_kinds(model: Model) -> list[Kind]:
    """Faults of the inertial unit, as steps of the model's states for it."""
    rates = [model.parameters(RATE_ERROR + axis) for axis in range(3)]
    forces = [model.parameters(FORCE_ERROR + axis) for axis in range(3)]
    found = []
    if all(rates):
        # A damaged or loose gyro: a degree a second, a hundred times the bias of a data sheet.
        found.append(
            Kind(
                *("gyro", "the gyros have stepped", "deg/s", STATES, SENSOR),
                *((1.0 / DEG,) * 3, SENSOR_PER_H, DEG),
                slots=tuple(slots[0] for slots in rates),
                axes=BODY,
            )
        )
    if all(forces):
        found.append(
            Kind(
                *("accelerometer", "the accelerometers have stepped", "m/s^2", STATES, SENSOR),
                *((0.5,) * 3, SENSOR_PER_H),
                slots=tuple(slots[0] for slots in forces),
                axes=BODY,
            )
        )
    # A unit that slips in its mount does so by degrees, and sits otherwise on the vehicle then.
    sits = model.slots_of(MOUNTING) or [-1, -1]
    attitude = Kind(
        *("mount", "the inertial unit has turned", "deg", TURNED, SENSOR),
        *((10.0 / DEG,) * 3, TURNS_PER_H, DEG),
        slots=(-1, *sits),
        axes=BODY,
    )
    return [*found, attitude]


def position_kinds(device: str) -> list[Kind]:
    """Faults of positions: an offset or a drift. Sizes: a reflection in a street displaces by
    metres to tens of metres (Groves, 2nd ed., section 9.4.4); a spoofer moves a receiver's solution
    at a metre a second."""
    of = partial(Kind, device=device, moves=False)
    return [
        of(
            *("position", f"{device} position is off", "m", POSITION, PLACE),
            *(POSITION_SD_M, RECEIVER_PER_H),
        ),
        of(
            *("position", f"{device} position is off", "m", POSITION, PLACE),
            *(METRES_SD_M, RECEIVER_PER_H),
            bounded=True,
        ),
        of(
            *("position_drift", f"{device} position runs away", "m/s", POSITION_RAMP, PLACE),
            *((1.0, 1.0, 1.0), RECEIVER_PER_H),
        ),
    ]


def velocity_kinds(device: str) -> list[Kind]:
    """Faults of velocities: an offset or a drift."""
    of = partial(Kind, device=device, locates=False)
    return [
        of(
            *("velocity", f"{device} velocity is off", "m/s", VELOCITY, MOTION),
            *((2.0, 2.0, 2.0), RECEIVER_PER_H),
        ),
        of(
            *("velocity_drift", f"{device} velocity runs away", "m/s^2", VELOCITY_RAMP, MOTION),
            *((0.5, 0.5, 0.5), RECEIVER_PER_H),
        ),
    ]


def carried_kinds(device: str) -> list[Kind]:
    """Spoofing: positions move away at the velocity that is added to the velocities."""
    of = Kind(
        *("carried_off", f"{device} is carried off", "m/s", CARRIED, TIME),
        *((1.0, 1.0, 1.0), SPOOFED_PER_H),
        device=device,
    )
    return [of]


def delay_kinds(device: str) -> list[Kind]:
    """Delay of a device, or of its velocities alone, near each listed lag. The size is a share of
    the lag."""
    return [
        Kind(
            *(name, text, "s", DELAY, of),
            *((LAG_SPREAD,), DELAYED_PER_H, lag_s),
            device=device,
            lag_s=lag_s,
            mean=1.0,
            bounded=True,
            axes=("",),
            locates=locates,
        )
        for name, text, of, locates in (
            ("delay", f"{device} is late", TIME, True),
            ("velocity_delay", f"{device} velocity is late", MOTION, False),
        )
        for lag_s in LAGS_S
    ]


def time_kinds(device: str, model: Model) -> list[Kind]:
    """Step of a device's offset in time, through its states: a line's latency is known to a tenth
    of a second."""
    slots = [slots[0] for name in _times(device) if (slots := model.slots_of(name))]
    if not slots:
        return []
    step = Kind(
        *("time_offset", f"{device} stamps have stepped", "s", STATES, TIME),
        # As rare as any delay: once an hour it is 13 cm along the way behind a minute's outage.
        *((max(float(model.initial[slot]) for slot in slots),), DELAYED_PER_H),
        device=device,
        slots=tuple(slots),
        bounded=True,
        axes=("",),
    )
    # From the start on, so that the filter itself lags: as long as a line may delay a fix.
    shifted = Kind(
        *("late", f"{device} is late, and the solution with it,", "s", SHIFTED, TIME),
        *((LAGGED_S,), RECEIVER_PER_H),
        device=device,
        slots=tuple(slots),
        bounded=True,
        axes=("",),
    )
    return [step, shifted]


def _times(device: str) -> tuple[str, ...]:
    names = (FIX_TIME, VELOCITY_TIME)
    return tuple(name if device == "gnss" else f"{name}_{device}" for name in names)


def speed_kinds(device: str) -> list[Kind]:
    """Faults of a wheel: its scale; minus one is a stuck sensor."""
    of = Kind(
        *("wheel_scale", f"{device} speed is off by", "%", SPEED, OWN),
        *((0.5,), DELAYED_PER_H, 100.0),
        device=device,
        axes=("",),
    )
    return [of]


def row_kinds(
    device: str,
    text: str,
    unit: str,
    sd: tuple[float, ...],
    per_unit: float,
    axes: tuple[str, ...],
    per_hour: float = RECEIVER_PER_H,
) -> list[Kind]:
    """Faults of any other measurement: an offset of each row."""
    of = Kind(
        *("offset", f"{device} {text}", unit, ROWS, OWN),
        *(sd, per_hour, per_unit),
        device=device,
        axes=axes,
    )
    return [of]


def over_kind() -> Kind:
    """End of a source's fault that the solution has followed, with the odds of a fault of a
    minute's mean duration. Its size is the followed share."""
    return Kind(
        *("over", "a source's fault that the solution followed is over:", "%", FOLLOWED, OVER),
        *((FOLLOWED_SPREAD,), 3600.0 / LASTS_S, 100.0),
        mean=1.0,
        bounded=True,
        axes=("",),
    )


def changed_kind(device: str) -> Kind:
    """Jump of a device's positions within their shared error, found outside the bank, which would
    take it for a fault (fusiond.integrity.correlated_fix_jumps)."""
    text = f"{device} position has changed within what its fixes share,"
    of = "position_change", text, "m", FOLLOWED, OVER
    return Kind(*of, (1.0, 1.0, 1.0), RECEIVER_PER_H, device=device)


def kinds_of(model: Model, aiding: Mapping[str, str], slips: bool) -> list[Kind]:
    """Hypotheses of a model and the devices of `aiding` (name to kind of section); with `slips`
    also those of the no-slip constraint."""
    found = sensor_kinds(model)
    for device, kind in aiding.items():
        if kind == "gnss":
            found += [*position_kinds(device), *velocity_kinds(device)]
            found += [*time_kinds(device, model), *delay_kinds(device)]
            found += carried_kinds(device)
        elif kind == "rdss":
            found += position_kinds(device)[:1]
        elif kind == "wheel":
            found += speed_kinds(device)
        elif kind in ("heading", "compass"):
            found += row_kinds(device, "heading is off", "deg", (0.2,), DEG, ("",))
        elif kind == "height":
            found += row_kinds(device, "height is off", "m", (20.0,), 1.0, ("",))
    if slips:
        found += row_kinds("non_holonomic", "the vehicle slips", "m/s", (0.5,), 1.0, ("",))
    receivers = tuple(device for device, kind in aiding.items() if kind == "gnss")
    if len(receivers) > 1:
        # One spoofer carries all off; one line, hub or clock of the host delays all.
        of_all = *carried_kinds(TOGETHER), *delay_kinds(TOGETHER)[: len(LAGS_S)]
        found += [replace(kind, devices=receivers) for kind in of_all]
    found.append(over_kind())
    # At rest nobody can tell a gyro from the ground that turns: a ferry, a turntable.
    of_ground = "zero_rate", "the ground turns", "deg/s", (1.0 / DEG,) * 3, DEG, BODY
    found += row_kinds(*of_ground, per_hour=DELAYED_PER_H)
    return sorted(found, key=lambda kind: -kind.size)  # as a table of them has to be


def table_of(kinds: Sequence[Kind]) -> FaultTable:
    """Table of the hypotheses for the kernels."""
    ints = np.zeros((len(kinds), KIND_INTS), dtype=np.int64)
    numbers = np.ones((len(kinds), KIND_NUMBERS))
    devices = tuple(dict.fromkeys(kind.device for kind in kinds if kind.device))
    for row, kind in enumerate(kinds):
        ints[row, SIGNATURE], ints[row, CLASS] = kind.signature, kind.of
        ints[row, LOCATES], ints[row, MOVES_TOO] = kind.locates, kind.moves
        ints[row, DEVICE] = devices.index(kind.device) if kind.device else -2
        if kind.device == TOGETHER:
            ints[row, DEVICE] = ANY
        ints[row, SIZE] = kind.size
        ints[row, SLOTS : SLOTS + 3] = (*kind.slots, -1, -1, -1)[:3]
        numbers[row, PRIOR : PRIOR + kind.size] = kind.sd
        numbers[row, LOG_RATE] = math.log(kind.per_hour / 3600.0)
        numbers[row, LAG], numbers[row, MEAN] = kind.lag_s, kind.mean
        numbers[row, BOUNDED] = kind.bounded
    return fault_table(ints, numbers, devices)
