"""A model of the error state: a list of blocks, laid out in slots for the kernels."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import Block
from fusiond.models.vehicle_parameter_blocks import FIX_TIME
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
    force_left_out: float = 0.0
    """One sigma (m/s^2) of an accelerometer bias without a state: levelling by gravity is wrong by
    it."""
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
            if self.slots_of(block.rate)
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

    def slots_of_all(self, blocks: tuple[str, ...]) -> Indices:
        """Slots of blocks in sequence (k,), as kernels take them; read-only."""
        return self.indices[blocks]

    @cached_property
    def indices(self) -> _Indices:
        """Slots by name or names of blocks, cached since measurements need them at each instant."""
        return _Indices(self)

    @cached_property
    def listed(self) -> dict[tuple[str | tuple[str, ...], ...], tuple[int, ...]]:
        """Slots by names of blocks, as a packed row holds them, from `list_slots`."""
        return {}

    def list_slots(
        self, names: tuple[str | tuple[str, ...], ...], most: tuple[int, ...]
    ) -> tuple[int, ...]:
        """Number and slots of each list of blocks, at most `most`, padded with zeros."""
        found: list[int] = []
        for blocks, count in zip(names, most, strict=True):
            slots = self.indices[blocks].tolist()[:count]
            found += [len(slots), *slots, *([0] * (count - len(slots)))]
        self.listed[names] = tuple(found)
        return self.listed[names]

    def slots_of_each(self, *lists: tuple[str, ...]) -> tuple[Indices, ...]:
        """`slots_of_all` of several lists of blocks, needed at each measurement."""
        found = self._each.get(lists)
        if found is None:
            found = self._each[lists] = tuple(self.slots_of_all(blocks) for blocks in lists)
        return found

    def slots_or_missing(self, *blocks: tuple[str, int]) -> Indices:
        """Slots of blocks (name, states) in sequence (k,), as kernels take them; -1 for a state
        that the model lacks."""
        found = self._or_missing.get(blocks)
        if found is None:
            slots = [slot for name, n in blocks for slot in self.slots_of(name) or [-1] * n]
            found = self._or_missing[blocks] = np.array(slots, dtype=np.int64)
        return found

    @cached_property
    def _or_missing(self) -> dict[tuple[tuple[str, int], ...], Indices]:
        return {}

    @cached_property
    def _each(self) -> dict[tuple[tuple[str, ...], ...], tuple[Indices, ...]]:
        return {}

    @cached_property
    def packed(self) -> Array:
        """Arrays `noise`, `sensor_terms`, `rate_terms` and `active` in sequence as doubles, for
        kernels."""
        active = np.zeros(-(-self.size // 8) * 8, dtype=np.bool_)
        active[: self.size] = self.active
        parts = (self.noise, self.sensor_terms, self.rate_terms, active)
        return np.concatenate([part.ravel().view(np.float64) for part in parts])

    @cached_property
    def stated(self) -> NDArray[np.bool_]:
        """Flags (9,): position, velocity (n, e, d), roll, pitch, yaw are estimated, not held."""
        return np.concatenate((self.active[6:9], self.active[3:6], self.active[:3]))

    @cached_property
    def unstated(self) -> tuple[int, ...]:
        """Value where `stated` is not given."""
        return tuple(np.flatnonzero(~self.stated).tolist())

    @cached_property
    def _slots_by_name(self) -> dict[str, list[int]]:
        return {block.name: slots for block, slots in self._slots()}

    @cached_property
    def time_slot(self) -> int:
        """Slot of the first receiver's offset in time, which applies to a published solution; -1
        without one."""
        for block in self.blocks:
            if block.name.startswith(FIX_TIME):
                return self.slots_of(block.name)[0]
        return -1

    @cached_property
    def sensor_errors(self) -> bool:
        """True if the model has states for the errors of every gyro and accelerometer."""
        return all(self.parameters(axis) for axis in range(RATE_ERROR, FORCE_ERROR + 3))

    @cached_property
    def scale_factors(self) -> bool:
        """True if it has states for the scale factor of each gyro and each accelerometer."""
        return all(self.parameters(axis) for axis in range(RATE_SCALE, FORCE_SCALE + 3))

    def parameters(self, column: int) -> list[int]:
        """Slots of the parameters of one column (constant and Markov gyro drift share one)."""
        return self._slots_by_column.get(column, [])

    @cached_property
    def _slots_by_column(self) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for slot, column in enumerate(self.column_of.tolist()):
            found.setdefault(column, []).append(slot)
        return found


class _Indices(dict[str | tuple[str, ...], Indices]):
    """Slots of a model by names of blocks, computed on first use."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self._model = model

    def __missing__(self, names: str | tuple[str, ...]) -> Indices:
        blocks = (names,) if isinstance(names, str) else names
        slots = [slot for block in blocks for slot in self._model.slots_of(block)]
        found = self[names] = np.array(slots, dtype=np.int64)
        return found
