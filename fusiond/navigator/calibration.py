"""Calibration parameters: mounting, lever arms, offsets in time, scales, as the filter knows them
now.

A parameter is published in the units of the configuration (deg, m, s, a ratio), as the difference
from its configured value, with one sigma and one of three states:

    not observed   sigma is still that of the configuration: the motion has not shown it
    observed       better known than configured, and still moving or still wide
    settled        a fifth of the configured sigma or less, and the value has stayed for a minute

An estimate of sigma s from a prior of sigma p holds the share (s / p)^2 of the prior's mean: at a
fifth 4 %, so a settled value is the drive's and not the owner's. If s is above 0.9 p, the drive has
given less than a quarter of the prior's information.

The estimates of a constant are a martingale: between two instants they move by an amount of
variance P_1 - P_2, the information gained. A mounting angle that moves by `TURNED_SIGMAS` of that
is no constant: the unit has turned in the vehicle, which P of attitude and mounting does not
include. Only the yaw is tested so; a turn about another axis shows at once by gravity.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.models.blocks import Block
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

Array = NDArray[np.float64]

# Before any instant that a clock can say.
NEVER_NS = -(2**62)

CALIBRATED = (
    MOUNTING,
    AXLE_LEVER,
    WHEEL_SCALE,
    WHEEL_LATENCY,
    FIX_TIME,
    VELOCITY_TIME,
    ANTENNA_LEVER,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    BAROMETER_AIRFLOW,
)
"""Blocks that are a calibration; a source's own has its name behind it (`wheel_scale_rear`)."""
WANDERING = (WHEEL_LATENCY, FIX_TIME, VELOCITY_TIME, BAROMETER_OFFSET, BAROMETER_SCALE)
"""Parameters that are not constant: clocks drift, and so does the weather."""
UNIT_SUFFIX = {"rad": "_deg", "m": "_m", "s": "_s", "1": ""}

NOT_OBSERVED_SHARE = 0.9
SETTLED_SHARE = 0.2
# A value has stayed if in this time (s) it has moved by less than sigma, and what its own random
# walk allows: a minute of town driving has a bend, a stop and a start in it.
STAYS_S = 60.0
LOOK_NS = 10_000_000_000
"""The watch looks so often (ns of the filter's time)."""
# A mounting is compared each second with those of five minutes before: what has turned is vouched
# for meanwhile. On three recorded cars (50 minutes) the yaw moved by 2.2 at most of the sigmas that
# it may move by.
TURN_LOOK_NS, TURN_LOOKS = 1_000_000_000, 300
TURNED_SIGMAS = 5.0
# What was configured may be wrong by more than it says, which is no turn: looks count from half of
# its sigma on, where three quarters of it are forgotten.
KNOWN_SHARE = 0.5
# A sigma of what moves the yaw of a mounting that is firm: a slip that lasts for minutes (crown of
# the road, side wind) is some tenths of a degree.
FIRM_RAD = math.radians(0.2)


class CalibrationState(StrEnum):
    """Quality of a parameter."""

    NOT_OBSERVED = "not_observed"
    OBSERVED = "observed"
    SETTLED = "settled"


@immutable()
class Slot:
    """Location of a parameter: its published name, the block's kind (of `CALIBRATED`) and name, its
    slot in the model, published units per SI unit, prior sigma (published units) and random walk
    (published units per root second)."""

    name: str
    kind: str
    block: str
    index: int
    factor: float
    prior_sd: float
    walk: float


@immutable()
class Parameter:
    """Parameter beyond its configured value, in published units: value, one sigma, and the
    configured sigma."""

    name: str
    kind: str
    block: str
    value: float
    sd: float
    prior_sd: float
    state: CalibrationState


def kind_of(block: str) -> str | None:
    """Calibration kind of a block; None for another block."""
    for kind in CALIBRATED:
        if block == kind or block.startswith(f"{kind}_"):
            return kind
    return None


def calibration_slots(model: Model) -> list[Slot]:
    """Calibration parameters of a model, in the order of its blocks."""
    found = []
    for block in model.blocks:
        kind = kind_of(block.name)
        if kind is None:
            continue
        factor = math.degrees(1.0) if block.unit == "rad" else 1.0
        for state, index in zip(block.states, model.slots_of(block.name), strict=True):
            found.append(
                Slot(
                    _published(block, state),
                    kind,
                    block.name,
                    index,
                    factor,
                    factor * block.initial,
                    factor * math.sqrt(block.white),
                )
            )
    return found


def _published(block: Block, state: str) -> str:
    """Published name of a state: `mounting_pitch_deg`, `wheel_scale`."""
    name = f"{block.name}_{state}" if len(block.states) > 1 else block.name
    return name + UNIT_SUFFIX[block.unit]


class CalibrationWatch:
    """Watch of the calibration in a filter of `model`; `on_event(code, text)` receives `calibrated`
    for each settled parameter, and for the last.

    `misalignment_rad` is one sigma of the IMU axes' deviation from square, the least sigma of any
    mounting angle.
    """

    def __init__(
        self, model: Model, on_event: Callable[[str, str], None], misalignment_rad: float = 0.0
    ) -> None:
        self._slots = calibration_slots(model)
        self._least_sd = np.array([misalignment_rad * (s.kind == MOUNTING) for s in self._slots])
        self._indices = np.array([s.index for s in self._slots], dtype=np.int64)
        self._prior = np.array([s.prior_sd / s.factor for s in self._slots])
        yaws = (k for k, s in enumerate(self._slots) if s.kind == MOUNTING and "yaw" in s.name)
        self._yaws = tuple(yaws)
        self._event = on_event
        self._reported: set[str] = set()
        self.restart()

    def restart(self) -> None:
        """Restart with the filter."""
        self._cell = self._turn_cell = -1
        self.due_ns = 0
        """Instant of the filter at which the next look is due."""
        self._past: deque[tuple[int, Array]] = deque()
        self._learned, self._variance = np.zeros((2, len(self._yaws)))
        self._looked_ns = np.full(TURN_LOOKS, NEVER_NS)
        self._was, self._knew = np.zeros((2, TURN_LOOKS, len(self._yaws)))
        self._known = np.zeros((TURN_LOOKS, len(self._yaws)), dtype=np.bool_)
        self._row = 0
        self.turned: str | None = None
        """Set once the IMU has turned in the vehicle: why nothing before counts any more."""
        self.parameters: tuple[Parameter, ...] = ()
        """Parameters at the last look; empty before the filter has run."""

    def corrected(self) -> None:
        """Record a correction of the state for a fault: earlier mounting angles are no longer
        comparable."""
        self._known[:] = False
        self.turned = None

    @property
    def settled(self) -> bool:
        """True if all estimated parameters have settled."""
        return bool(self.parameters) and all(
            p.state is CalibrationState.SETTLED for p in self.parameters
        )

    def look(self, t_ns: int, xi: Array, covariance: Array) -> bool:
        """Look at parameters (n,) and P (n, n) at `t_ns` if due, each `LOOK_NS`; True if so."""
        turn_cell, cell = t_ns // TURN_LOOK_NS, t_ns // LOOK_NS
        if turn_cell == self._turn_cell or not self._slots:
            return False
        self._turn_cell, self.due_ns = turn_cell, (turn_cell + 1) * TURN_LOOK_NS
        now, variance = xi[self._indices].copy(), covariance[self._indices, self._indices]
        self._compare(t_ns, now, variance)
        if cell == self._cell:
            return False
        self._cell = cell
        while len(self._past) > 1 and t_ns - self._past[1][0] >= STAYS_S * 1e9:
            self._past.popleft()
        before = None
        if self._past and t_ns - self._past[0][0] >= STAYS_S * 1e9:
            before = self._past[0][1]
        sd = np.maximum(np.sqrt(variance), self._least_sd)
        self._past.append((t_ns, now))
        self.parameters = tuple(
            _parameter(s, float(now[i]), float(sd[i]), None if before is None else before[i])
            for i, s in enumerate(self._slots)
        )
        self._report()
        return True

    def _compare(self, t_ns: int, now: Array, variance: Array) -> None:
        """Detect a mounting yaw that has moved beyond the information gained since a look."""
        if not self._yaws:
            return
        yaws = list(self._yaws)
        yaw, known = now[yaws], variance[yaws]
        if self._row:
            self._learned = self._learned + np.maximum(self._variance - known, 0.0)
        self._variance = known
        moved = yaw - self._was
        may = np.sqrt(np.maximum(self._learned - self._knew, 0.0) + FIRM_RAD**2)
        sigmas = np.abs(moved) / may
        recent = t_ns - self._looked_ns <= TURN_LOOKS * TURN_LOOK_NS
        sigmas[~(self._known & recent[:, None])] = 0.0
        worst = np.unravel_index(int(np.argmax(sigmas)), sigmas.shape)
        if sigmas[worst] > TURNED_SIGMAS:
            by = f"{math.degrees(moved[worst]):+.1f} deg, {sigmas[worst]:.0f} sigma"
            self.turned = f"the IMU has turned in the vehicle: its yaw has moved by {by}"
        row = self._row % TURN_LOOKS
        self._looked_ns[row], self._was[row], self._knew[row] = t_ns, yaw, self._learned
        self._known[row] = np.sqrt(known) <= KNOWN_SHARE * self._prior[yaws]
        self._row += 1

    def _report(self) -> None:
        for p in self.parameters:
            if p.state is CalibrationState.SETTLED and p.name not in self._reported:
                self._reported.add(p.name)
                rest = "all settled" if self.settled else "others still settling"
                self._event("calibrated", f"{_label(p)}, one sigma {p.sd:.2g}; {rest}")


_UNITS = ("deg", "m", "ms", "ppm", "percent", "s")


def _label(p: Parameter) -> str:
    """A parameter in words: `mounting_pitch_deg` 0.01 is "Mounting pitch 0.01 deg"."""
    *words, unit = p.name.split("_")
    if unit not in _UNITS:
        words, unit = [*words, unit], ""
    return f"{' '.join(words).capitalize()} {p.value:.2g} {unit}".rstrip()


def _parameter(s: Slot, value: float, sd: float, before: float | None) -> Parameter:
    """Parameter from SI values, `before` a minute ago; None while the filter is younger."""
    value, sd = value * s.factor, sd * s.factor
    state = CalibrationState.OBSERVED
    if sd > NOT_OBSERVED_SHARE * s.prior_sd:
        state = CalibrationState.NOT_OBSERVED
    elif sd <= SETTLED_SHARE * s.prior_sd and before is not None:
        moved = abs(value - before * s.factor)
        if moved <= math.hypot(sd, s.walk * math.sqrt(STAYS_S)):
            state = CalibrationState.SETTLED
    return Parameter(s.name, s.kind, s.block, value, sd, s.prior_sd, state)
