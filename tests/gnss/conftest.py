"""The recorded walk, decoded once for all who ask."""

from __future__ import annotations

import pytest

from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import RawEvent
from tests.places import DATA

WALK = DATA / "walk_0827"


@pytest.fixture(scope="session")
def events() -> list[RawEvent]:
    """What the receiver of the walk sent."""
    if not WALK.is_dir():
        pytest.skip(f"real walk walk_0827 is absent: {WALK} (set FUSIOND_DATA)")
    decoder = RawDecoder("walk")
    return [*decoder.feed((WALK / "gnss.ubx").read_bytes(), 0), *decoder.flush()]
