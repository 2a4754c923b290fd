"""What is counted of an ordinary fix: all that it passes through, and no more with each change."""

from __future__ import annotations

from functools import cache

from fusiond.bench.fix_call_trace import FixPath, ordinary_fix

FUNCTIONS, MODULES = 40, 12
"""What is asked."""


@cache
def way() -> FixPath:
    return ordinary_fix()


def test_the_way_goes_from_the_door_to_the_solution() -> None:
    """A position and its velocity are both folded in, and the solution is read."""
    calls = way().calls
    assert calls["fusiond.navigator.navigator", "Navigator.add"] == 1
    assert calls["fusiond.navigator.navigator", "Navigator.solution"] == 1
    assert calls["fusiond.estimators.base", "Estimator.run"] == 1
    assert not any(
        module.startswith(("fusiond.bench", "fusiond.simulation")) for module, _ in calls
    )


def test_the_way_does_not_grow() -> None:
    assert way().functions <= FUNCTIONS
    assert way().modules <= MODULES
