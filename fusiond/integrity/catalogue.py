"""The catalogue of what may be wrong: a hypothesis a kind, and what such a fault is like.

Each names its size in the unit in which people are told, the prior of that size and how often such
a fault begins, each with its source; by which signature it enters the motion or the measurements
(fusiond.estimators.fault_bank); and which measurements it spoils.

Rates are an engineer's, of devices on vehicles in streets, where no standard counts them, and the
same for all kinds for that reason: one an hour; but a device that is late by half a second or more
from an instant on, a wheel whose scale changes, or ground that turns below a vehicle at rest, is
one in a thousand hours, and one that is carried off, position and velocity together, one in ten
thousand.
Ten times the rate is what a chi-square of 4.6 is: it moves no decision by an epoch. Sizes are one
sigma of a normal prior, which bounds an estimate and tells no kinds apart but those that are known
to be of a size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from fusiond.integrity.service import LASTS_S
from fusiond.models.model import Model
from fusiond.models.vehicle import FIX_TIME, MOUNTING, VELOCITY_TIME
from fusiond.navigation.error_model import FORCE_ERROR, RATE_ERROR

DEG = math.degrees(1.0)
BODY = ("x", "y", "z")
SENSOR, PLACE, MOTION, TIME, OWN, OVER = range(6)
"""Classes: between kinds of one class nobody has to choose before something is done."""
RECEIVER_PER_H, DELAYED_PER_H, SPOOFED_PER_H, SENSOR_PER_H = 1.0, 1e-3, 1e-4, 1.0
TURNS_PER_H = 0.01
"""A unit works loose in its mount now and then in the life of a vehicle, not once an hour: what may
have begun a moment ago is 0.2 deg of tilt for ever then, of a unit that knows it to 0.05."""
POSITION_SD_M = (20.0, 20.0, 20.0)
TOGETHER = "all receivers"
"""The device of a kind that is of all of them."""
LAGGED_S = 0.5
"""One sigma of a lag that nobody knows of."""
FOLLOWED_SPREAD = 0.3
"""One sigma of a share of what a fault has done: it is told from noise at three sigma or so."""
LAGS_S, LAG_SPREAD = (0.5, 1.0, 2.0, 4.0), 0.3
"""Delays, each of which stands for those around it, by so much of it at one sigma: a delay that is
no longer than what the state for it admits is that state's."""


@immutable()
class Kind:
    """One hypothesis: `size` numbers of a prior `sd` (SI), told times `per_unit` in `unit`; it
    begins `per_hour`. `slots` of a step of states, `lag_s` of a delay. Of its `device` it spoils
    what `locates` and what `moves`, or all."""

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

    @property
    def size(self) -> int:
        """Of how many numbers the fault is."""
        return len(self.sd)

    @property
    def corrected(self) -> bool:
        """True if the filter goes on without it: it is one of its states."""
        return self.signature in (STATES, TURNED, SHIFTED, FOLLOWED)

    def spoils(self, device: str, locates: bool, moves: bool) -> bool:
        """True if a series of such a device is no measurement any more."""
        if self.corrected or self.device not in (TOGETHER, device):
            return False
        return self.of == OWN or (self.locates and locates) or (self.moves and moves)


def sensor_kinds(model: Model) -> list[Kind]:
    """Of the inertial unit, as steps of those states that the model has for it."""
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
    """Of positions: off, or running away. Sizes: a reflection in a street is metres to tens of
    metres off (Groves, 2nd ed., section 9.4.4); what pulls a receiver away does so at a metre a
    second."""
    of = partial(Kind, device=device, moves=False)
    return [
        of(
            *("position", f"{device} position is off", "m", POSITION, PLACE),
            *(POSITION_SD_M, RECEIVER_PER_H),
        ),
        of(
            *("position_drift", f"{device} position runs away", "m/s", POSITION_RAMP, PLACE),
            *((1.0, 1.0, 1.0), RECEIVER_PER_H),
        ),
    ]


def velocity_kinds(device: str) -> list[Kind]:
    """Of velocities: off, or running away."""
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
    """Of a device whose positions are carried off at the velocity that it adds: what is spoofed."""
    of = Kind(
        *("carried_off", f"{device} is carried off", "m/s", CARRIED, TIME),
        *((1.0, 1.0, 1.0), SPOOFED_PER_H),
        device=device,
    )
    return [of]


def delay_kinds(device: str) -> list[Kind]:
    """Of a device, or of its velocities alone: late by about so much. The amount is one of the lag:
    its share of it is told."""
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
    """Of a device's offset in time, as a step of the states for it: a line's latency is known to a
    tenth of a second."""
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
    """Of a wheel: its scale, of which minus one is a wheel that stands still."""
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
    """Of any other measurement: each of its rows is off."""
    of = Kind(
        *("offset", f"{device} {text}", unit, ROWS, OWN),
        *(sd, per_hour, per_unit),
        device=device,
        axes=axes,
    )
    return [of]


def over_kind() -> Kind:
    """That a source's fault is over, which the solution has followed until then: as likely as that
    fault, which lasts a minute in the mean. Its size is the share of what was followed."""
    return Kind(
        *("over", "a source's fault that the solution followed is over:", "%", FOLLOWED, OVER),
        *((FOLLOWED_SPREAD,), 3600.0 / LASTS_S, 100.0),
        mean=1.0,
        bounded=True,
        axes=("",),
    )


def changed_kind(device: str) -> Kind:
    """That a device's positions have jumped within what they share: found beside the bank, which
    takes it for a fault of them (fusiond.integrity.shared_error)."""
    text = f"{device} position has changed within what its fixes share,"
    of = "position_change", text, "m", FOLLOWED, OVER
    return Kind(*of, (1.0, 1.0, 1.0), RECEIVER_PER_H, device=device)


def kinds_of(model: Model, aiding: Mapping[str, str], slips: bool) -> list[Kind]:
    """All of a model and the devices of `aiding`, name to kind of section; with a vehicle that does
    not slip where `slips`."""
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
    receivers = [device for device, kind in aiding.items() if kind == "gnss"]
    if len(receivers) > 1:
        found += carried_kinds(TOGETHER)
    found.append(over_kind())
    # At rest nobody can tell a gyro from the ground that turns: a ferry, a turntable.
    of_ground = "zero_rate", "the ground turns", "deg/s", (1.0 / DEG,) * 3, DEG, BODY
    found += row_kinds(*of_ground, per_hour=DELAYED_PER_H)
    return sorted(found, key=lambda kind: -kind.size)  # as a table of them has to be


def table_of(kinds: Sequence[Kind]) -> FaultTable:
    """The same for the kernels."""
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
