r"""Error-state models as lists of blocks.

A block is a named group of states: the errors of the navigation solution, or parameters that the
filter estimates beside it. A parameter block is a first-order Gauss-Markov process

    x' = -x / tau + w,   steady sigma s,   variance over h: s^2 (1 - exp(-2 h / tau))

or, with tau infinite, a random constant. What a block does to the navigation errors is said by its
`columns` (fusiond.navigation.error_model).

Blocks of the papers' models: 000 (15 states, planar, constant and Markov gyro drift, Markov
accelerometer); the 15 and 21 states for vehicles are those of Groves, 2nd ed., section 14.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.error_model import (
    CORE_SIZE,
    FORCE_ERROR,
    FORCE_SCALE,
    RATE_ERROR,
    RATE_SCALE,
    STRIDE,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# What a term of an axis error is (`Model.sensor_terms`); 0 is none.
PLAIN, SCALE = 1, 2

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
class Block:
    """A group of states.

    `columns`: 0 to 8 are the navigation errors, 9 to 20 the ways in which a parameter acts on them,
    -1 a parameter that acts on measurements only. `white` is the noise density of each state
    (unit^2 / s), `tau_s` and `steady` (one sigma) those of a Markov process, `initial` one sigma at
    the start where nothing else sets it.
    """

    name: str
    unit: str
    states: tuple[str, ...]
    columns: tuple[int, ...]
    initial: float = 0.0
    white: float = 0.0
    tau_s: float = math.inf
    steady: float = 0.0


@dataclass(frozen=True)
class Model:
    """A list of blocks, laid out in slots for the kernels.

    Slots 0 to 8 are always the navigation errors (attitude, velocity, position, each n, e, d); a
    slot that no
    block fills is not `active` and stays zero (planar models). Parameters follow in the order of
    their blocks. `size` counts slots; arrays are (size,). `sensor_terms`
    (2, 12) holds slot and kind of two terms of each axis error (rate x y z, force x y z), `noise`
    (3, size) the rows 1 / tau, white density and steady variance, all as the kernels read them.
    """

    name: str
    blocks: tuple[Block, ...]
    hold_height: bool = False
    size: int = field(init=False)
    active: NDArray[np.bool_] = field(init=False)
    column_of: Indices = field(init=False)
    sensor_terms: Indices = field(init=False)
    noise: Array = field(init=False)
    initial: Array = field(init=False)

    def __post_init__(self) -> None:
        parameters = sum(
            len(b.columns) for b in self.blocks if b.columns[0] not in range(CORE_SIZE)
        )
        size = CORE_SIZE + parameters
        if size > STRIDE:
            raise ValueError(f"model {self.name}: {size} states, the kernels hold {STRIDE}")
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
        for name, value in {
            "size": size,
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
        return next((slots for b, slots in self._slots() if b.name == block), [])

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


def _parameter(name: str, unit: str, kind: str, axes: str = "xyz", **noise: float) -> Block:
    first = PARAMETER_COLUMNS[kind]
    columns = tuple(first + "xyz".index(a) for a in axes)
    return Block(name, unit, tuple(axes), columns, **noise)


def position_bias(name: str, sd_m: float, tau_s: float) -> Block:
    """A first-order Gauss-Markov error north and east (m) that an aid's fixes share."""
    return Block(name, "m", ("n", "e"), (-1, -1), initial=sd_m, steady=sd_m, tau_s=tau_s)


def make_model(name: str, noise: ImuNoise, *extra: Block) -> Model:
    """One of the shipped models, with an IMU's noise and further blocks.

    KeyError for a name that is not one.
    """
    tau = noise.bias_correlation_s
    if name == "planar15":
        blocks = [
            *_navigation_blocks(noise, planar=True),
            _parameter("gyro_bias", "rad/s", "gyro", initial=noise.rate_bias_initial),
            _parameter(
                "gyro_markov",
                "rad/s",
                "gyro",
                initial=noise.rate_bias_instability,
                steady=noise.rate_bias_instability,
                tau_s=tau,
            ),
            _parameter(
                "accel_markov",
                "m/s^2",
                "accel",
                "xy",
                initial=math.hypot(noise.force_bias_initial, noise.force_bias_instability),
                steady=noise.force_bias_instability,
                tau_s=tau,
            ),
        ]
        return Model(name, (*blocks, *extra), hold_height=True)

    # One state for turn-on bias and its Markov part: a random walk that grows as the Markov process
    # does while t << tau (variance 2 s^2 t / tau), and faster, so never too sure, later.
    biases = [
        _parameter(
            "gyro_bias",
            "rad/s",
            "gyro",
            initial=math.hypot(noise.rate_bias_initial, noise.rate_bias_instability),
            white=2.0 * noise.rate_bias_instability**2 / tau,
        ),
        _parameter(
            "accel_bias",
            "m/s^2",
            "accel",
            initial=math.hypot(noise.force_bias_initial, noise.force_bias_instability),
            white=2.0 * noise.force_bias_instability**2 / tau,
        ),
    ]
    scales = [
        _parameter("gyro_scale", "1", "gyro_scale", initial=noise.rate_scale),
        _parameter("accel_scale", "1", "accel_scale", initial=noise.force_scale),
    ]
    models = {"ins15": biases, "ins21": biases + scales}
    return Model(name, (*_navigation_blocks(noise, planar=False), *models[name], *extra))
