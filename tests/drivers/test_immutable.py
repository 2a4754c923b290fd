"""Classes of values are what `dataclass` makes, less what makes them slow."""

from __future__ import annotations

import math
import pickle
from dataclasses import asdict, field, fields, replace

import pytest

from drivers.immutable import immutable


@immutable()
class Way:
    """From a place to another."""

    name: str
    length_m: float = 1.0
    kept: list[int] = field(default_factory=list, repr=False)


@immutable()
class Road(Way):
    """With lanes."""

    lanes: int = 2


@immutable()
class Mark:
    """Of one value."""

    value: float


@immutable(eq=False)
class Thing:
    """Equal to none."""

    value: float


@immutable()
class Named:
    """Shown and compared its own way."""

    value: float

    def __repr__(self) -> str:
        return "named"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Named)

    def __hash__(self) -> int:
        return 7


def test_two_are_equal_by_class_and_values() -> None:
    assert Way("a") == Way("a", 1.0)
    assert Way("a") != Way("b")
    assert Way("a") != Way("a", kept=[1])
    assert Road("a") != Way("a")
    assert Road("a", lanes=3) != Road("a")
    unknown = math.nan
    assert Mark(unknown) == Mark(unknown)  # of a dataclass, too: the values are the same object


def test_one_without_equality_is_equal_to_itself_alone() -> None:
    one = Thing(1.0)
    assert one == one  # noqa: PLR0124
    assert one != Thing(1.0)
    assert len({one, Thing(1.0)}) == 2


def test_hash_goes_by_values() -> None:
    assert len({Mark(1.0), Mark(1.0), Mark(2.0)}) == 2
    with pytest.raises(TypeError, match="unhashable"):
        hash(Way("a"))


def test_what_is_shown_can_be_read() -> None:
    assert repr(Road("a", 2.5)) == "Road(name='a', length_m=2.5, lanes=2)"


def test_what_a_class_defines_stays() -> None:
    assert Named(1.0) == Named(2.0)
    assert (repr(Named(1.0)), hash(Named(1.0))) == ("named", 7)


def test_it_is_a_dataclass_with_slots() -> None:
    road = Road("a", 2.0, [1], 4)
    assert [each.name for each in fields(road)] == ["name", "length_m", "kept", "lanes"]
    assert asdict(replace(road, lanes=1)) == {
        "name": "a",
        "length_m": 2.0,
        "kept": [1],
        "lanes": 1,
    }
    assert pickle.loads(pickle.dumps(road)) == road
    assert not hasattr(road, "__dict__")
