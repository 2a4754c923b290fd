"""Hostile bytes cost each parser a time that goes with their length, and no more."""

from __future__ import annotations

import pytest

from tests.fuzz.hostile import HOSTILE, Hostile, slope

MOST = 1.5
"""Half-way from linear to quadratic: over eight times the length a factor of three either way."""


@pytest.mark.parametrize("each", HOSTILE, ids=lambda each: f"{each.parser}: {each.pattern}")
def test_time_goes_with_length(each: Hostile) -> None:
    # The second look is for a host that was busy: what is quadratic is so twice.
    assert slope(each.times_s(1)) <= MOST or slope(each.times_s(3)) <= MOST
