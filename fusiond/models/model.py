r"""Error-state models as lists of blocks.

A block is a named group of states: the errors of the navigation solution, or parameters that the
filter estimates beside it. A parameter block is a first-order Gauss-Markov process

    x' = -x / tau + w,   steady sigma s,   variance over h: s^2 (1 - exp(-2 h / tau))

or, with tau infinite, a random constant. What a block does to the navigation errors is said by its
`columns` (fusiond.navigation.error_model).

or, where a block names its rate, the integral of another state. The papers' models: 000 (15 states,
planar, constant and Markov gyro drift, Markov accelerometer), 001 (10 states, planar), 002 (23 and
17 states with a receiver clock and a SAR's misalignment); the 15 and 21 states for vehicles are
those of Groves, 2nd ed., section 14.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.error_model import (
    CORE_SIZE,
    FORCE_ERROR,
    FORCE_SCALE,
    RATE_ERROR,
    RATE_SCALE,
    WIDTHS,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# What a term of an axis error is (`Model.sensor_terms`); 0 is none.
PLAIN, SCALE = 1, 2

CLOCK_OFFSET, CLOCK_DRIFT = "clock_offset", "clock_drift"
SAR_MISALIGNMENT = "sar_misalignment"
# One sigma (rad) of how a SAR antenna is mounted where nothing else says it: 0.1 deg, about what
# paper 002's accuracy needs and a mechanical alignment keeps.
SAR_MISALIGNMENT_SD = math.radians(0.1)

PARAMETER_COLUMNS = {
    "gyro": RATE_ERROR,
    "accel": FORCE_ERROR,
    "gyro_scale": RATE_SCALE,
    "accel_scale": FORCE_SCALE,
}


@dataclass(frozen=True)
class ImuNoise:
    """IMU error model in SI units, one sigma.

    `rate_noise` rad/s/sqrt(Hz), `force_noise` m/s^2/sqrt(Hz); biases rad/s and m/s^2: `initial` at
    switch-on, `instability` of the Markov part; scale factors without unit; time in s.
    """

    rate_noise: float
    force_noise: float
    rate_bias_initial: float
    force_bias_initial: float
    rate_bias_instability: float
    force_bias_instability: float
    bias_correlation_s: float
    rate_scale: float
    force_scale: float


@dataclass(frozen=True)
class ClockNoise:
    """Receiver clock as ranges (c times its error), one sigma or noise density.

    The defaults are a temperature-compensated crystal oscillator (Groves, 2nd ed., section 9.4.2:
    phase 0.01 m^2/s, frequency 0.04 m^2/s^3) of 1 ppm, its offset unknown to 1 ms. With
    `drift_tau_s` the drift is a first-order Gauss-Markov process of sigma `drift_steady` (paper
    003).
    """

    offset_initial: float = 3e5
    drift_initial: float = 300.0
    offset_white: float = 0.01
    drift_white: float = 0.04
    drift_tau_s: float = math.inf
    drift_steady: float = 0.0


@dataclass(frozen=True)
class Block:
    """A group of states.

    `columns`: 0 to 8 are the navigation errors, 9 to 20 the ways in which a parameter acts on them,
    -1 a parameter that acts on measurements only. `white` is the noise density of each state
    (unit^2 / s), `tau_s` and `steady` (one sigma) those of a Markov process, `initial` one sigma at
    the start where nothing else sets it. `rate` names the block of one state that is the rate of
    each of these.
    """

    name: str
    unit: str
    states: tuple[str, ...]
    columns: tuple[int, ...]
    initial: float = 0.0
    white: float = 0.0
    tau_s: float = math.inf
    steady: float = 0.0
    rate: str = ""


class TooManyStatesError(ValueError):
    """A model of more states than the kernels hold."""


@dataclass(frozen=True)
class Model:
    """A list of blocks, laid out in slots for the kernels.

    Slots 0 to 8 are always the navigation errors (attitude, velocity, position, each n, e, d); a
    slot that no
    block fills is not `active` and stays zero (planar models). Parameters follow in the order of
    their blocks. `size` counts slots; arrays are (size,). `width` is the row width of a covariance
    in the kernels. `sensor_terms` (2, 12) holds slot and kind of two terms of each axis error (rate
    x y z, force x y z), `rate_terms` (2, k) the slots of an offset and of its rate, `noise`
    (3, size) the rows 1 / tau, white density and steady variance, all as the kernels read them.
    """

    name: str
    blocks: tuple[Block, ...]
    hold_height: bool = False
    size: int = field(init=False)
    width: int = field(init=False)
    active: NDArray[np.bool_] = field(init=False)
    column_of: Indices = field(init=False)
    sensor_terms: Indices = field(init=False)
    rate_terms: Indices = field(init=False)
    noise: Array = field(init=False)
    initial: Array = field(init=False)

    def __post_init__(self) -> None:
        parameters = sum(
            len(b.columns) for b in self.blocks if b.columns[0] not in range(CORE_SIZE)
        )
        size = CORE_SIZE + parameters
        width = next((w for w in WIDTHS if w >= size), None)
        if width is None:
            raise TooManyStatesError(f"{self.name} has {size} states, at most {WIDTHS[-1]} fit")
        noise, initial = np.zeros((3, size)), np.zeros(size)
        active = np.zeros(size, dtype=np.bool_)
        column_of = np.full(size, -1, dtype=np.int64)
        for block, slots in self._slots():
            active[slots] = True
            column_of[slots] = block.columns
            noise[:, slots] = [[1.0 / block.tau_s], [block.white], [block.steady**2]]
            initial[slots] = block.initial
        slot, kind = np.zeros(12, dtype=np.int64), np.zeros(12, dtype=np.int64)
        for axis in range(6):
            terms = [(i, PLAIN) for i in np.flatnonzero(column_of == RATE_ERROR + axis)]
            terms += [(i, SCALE) for i in np.flatnonzero(column_of == RATE_SCALE + axis)]
            if len(terms) > 2:
                raise ValueError(
                    f"model {self.name}: the kernels hold two parameters an axis error"
                )
            for i, (slot_of_term, kind_of_term) in enumerate(terms):
                slot[2 * axis + i], kind[2 * axis + i] = slot_of_term, kind_of_term
        rate_terms = [
            (slot_of_offset, self.slots_of(block.rate)[0])
            for block, slots in self._slots()
            if block.rate
            for slot_of_offset in slots
        ]
        for name, value in {
            "size": size,
            "width": width,
            "rate_terms": np.array(rate_terms, dtype=np.int64).reshape(-1, 2).T.copy(),
            "active": active,
            "column_of": column_of,
            "sensor_terms": np.vstack([slot, kind]),
            "noise": noise,
            "initial": initial,
        }.items():
            object.__setattr__(self, name, value)

    def _slots(self) -> list[tuple[Block, list[int]]]:
        slots, following = [], CORE_SIZE
        for block in self.blocks:
            if block.columns[0] in range(CORE_SIZE):
                slots.append((block, list(block.columns)))
            else:
                slots.append((block, list(range(following, following + len(block.columns)))))
                following += len(block.columns)
        return slots

    def slots_of(self, block: str) -> list[int]:
        """The slots of a block; empty if the model has no such block."""
        return self._slots_by_name.get(block, [])

    @cached_property
    def stated(self) -> NDArray[np.bool_]:
        """(9,): whether position, velocity (n, e, d), roll, pitch, yaw are estimated at all, and
        not held."""
        return np.concatenate((self.active[6:9], self.active[3:6], self.active[:3]))

    @cached_property
    def _slots_by_name(self) -> dict[str, list[int]]:
        return {block.name: slots for block, slots in self._slots()}

    def parameters(self, column: int) -> list[int]:
        """Slots of the parameters of one column (constant and Markov gyro drift share one)."""
        return [int(i) for i in np.flatnonzero(self.column_of == column)]


def _navigation_blocks(noise: ImuNoise, planar: bool) -> list[Block]:
    n_e_d, n_e = ("n", "e", "d"), ("n", "e")
    horizontal = n_e if planar else n_e_d
    return [
        Block("attitude", "rad", n_e_d, (0, 1, 2), white=noise.rate_noise**2),
        Block(
            "velocity", "m/s", horizontal, (3, 4, 5)[: len(horizontal)], white=noise.force_noise**2
        ),
        Block("position", "m", horizontal, (6, 7, 8)[: len(horizontal)]),
    ]


def _parameter(
    name: str,
    unit: str,
    kind: str,
    axes: str = "xyz",
    *,
    initial: float,
    white: float = 0.0,
    tau_s: float = math.inf,
    steady: float = 0.0,
) -> Block:
    first = PARAMETER_COLUMNS[kind]
    columns = tuple(first + "xyz".index(a) for a in axes)
    return Block(name, unit, tuple(axes), columns, initial, white, tau_s, steady)


def position_bias(name: str, sd_m: float, tau_s: float, axes: str = "ne") -> Block:
    """A first-order Gauss-Markov error (m) along some axes that an aid's measurements share."""
    columns = (-1,) * len(axes)
    return Block(name, "m", tuple(axes), columns, initial=sd_m, steady=sd_m, tau_s=tau_s)


def clock_blocks(
    offsets: tuple[str, ...] = ("receiver",), noise: ClockNoise | None = None
) -> list[Block]:
    """A receiver clock as ranges: one offset (m) for each name, and their common drift (m/s)."""
    n = noise or ClockNoise()
    return [
        Block(
            CLOCK_OFFSET,
            "m",
            offsets,
            (-1,) * len(offsets),
            initial=n.offset_initial,
            white=n.offset_white,
            rate=CLOCK_DRIFT,
        ),
        Block(
            CLOCK_DRIFT,
            "m/s",
            ("drift",),
            (-1,),
            initial=n.drift_initial,
            white=n.drift_white,
            tau_s=n.drift_tau_s,
            steady=n.drift_steady,
        ),
    ]


def misalignment(name: str, sd_rad: float, tau_s: float = math.inf) -> Block:
    """Small angles x, y, z (rad) of a sensor's mounting, one sigma each; Markov where tau ends."""
    steady = 0.0 if math.isinf(tau_s) else sd_rad
    return Block(
        name, "rad", ("x", "y", "z"), (-1, -1, -1), initial=sd_rad, steady=steady, tau_s=tau_s
    )


def make_model(name: str, noise: ImuNoise, *extra: Block) -> Model:
    """One of the shipped models, with an IMU's noise and further blocks.

    A further block takes the place of the model's own of the same name. KeyError for a name that
    is not one of MODELS.
    """
    blocks = MODELS[name](noise)
    given = {block.name: block for block in extra}
    own = [given.pop(block.name, block) for block in blocks]
    return Model(name, (*own, *given.values()), hold_height=name.startswith("planar"))


def _gyro_bias(noise: ImuNoise) -> Block:
    return _parameter("gyro_bias", "rad/s", "gyro", initial=noise.rate_bias_initial)


def _gyro_markov(noise: ImuNoise, initial: float) -> Block:
    steady, tau = noise.rate_bias_instability, noise.bias_correlation_s
    return _parameter("gyro_markov", "rad/s", "gyro", initial=initial, steady=steady, tau_s=tau)


def _walking_biases(noise: ImuNoise) -> list[Block]:
    """One state an axis for turn-on bias and its Markov part: a random walk that grows as the
    Markov process does while t << tau (variance 2 s^2 t / tau), and faster, so never too sure,
    later."""
    rate, force, tau = (
        noise.rate_bias_instability,
        noise.force_bias_instability,
        noise.bias_correlation_s,
    )
    return [
        _parameter(
            "gyro_bias",
            "rad/s",
            "gyro",
            initial=math.hypot(noise.rate_bias_initial, rate),
            white=2.0 * rate**2 / tau,
        ),
        _parameter(
            "accel_bias",
            "m/s^2",
            "accel",
            initial=math.hypot(noise.force_bias_initial, force),
            white=2.0 * force**2 / tau,
        ),
    ]


def _planar10(noise: ImuNoise) -> list[Block]:
    # One Markov state an axis stands for all of the gyro's drift.
    drift = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    return [*_navigation_blocks(noise, planar=True), _gyro_markov(noise, drift)]


def _planar15(noise: ImuNoise) -> list[Block]:
    accel_markov = _parameter(
        "accel_markov",
        "m/s^2",
        "accel",
        "xy",
        initial=math.hypot(noise.force_bias_initial, noise.force_bias_instability),
        steady=noise.force_bias_instability,
        tau_s=noise.bias_correlation_s,
    )
    return [
        *_navigation_blocks(noise, planar=True),
        _gyro_bias(noise),
        _gyro_markov(noise, noise.rate_bias_instability),
        accel_markov,
    ]


def _ins15(noise: ImuNoise) -> list[Block]:
    return [*_navigation_blocks(noise, planar=False), *_walking_biases(noise)]


def _ins21(noise: ImuNoise) -> list[Block]:
    scales = [
        _parameter("gyro_scale", "1", "gyro_scale", initial=noise.rate_scale),
        _parameter("accel_scale", "1", "accel_scale", initial=noise.force_scale),
    ]
    return [*_ins15(noise), *scales]


def _ins17(noise: ImuNoise) -> list[Block]:
    return [
        *_navigation_blocks(noise, planar=False),
        _gyro_markov(noise, math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)),
        *clock_blocks(),
        misalignment(SAR_MISALIGNMENT, SAR_MISALIGNMENT_SD),
    ]


def _ins23(noise: ImuNoise) -> list[Block]:
    return [
        *_navigation_blocks(noise, planar=False),
        _gyro_bias(noise),
        _gyro_markov(noise, noise.rate_bias_instability),
        _walking_biases(noise)[1],
        *clock_blocks(),
        misalignment(SAR_MISALIGNMENT, SAR_MISALIGNMENT_SD),
    ]


MODELS: dict[str, Callable[[ImuNoise], list[Block]]] = {
    "ins15": _ins15,
    "ins21": _ins21,
    "ins17": _ins17,
    "ins23": _ins23,
    "planar10": _planar10,
    "planar15": _planar15,
}
"""The shipped models: 10 states as paper 001, 15 as paper 000, 17 and 23 as paper 002; the 15 and
21 states for vehicles."""
