"""What several tests of this room share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest


@pytest.fixture
def zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Sets this computer's zone, for as long as the test runs."""

    def of(name: str) -> None:
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield of
    monkeypatch.undo()
    time.tzset()
