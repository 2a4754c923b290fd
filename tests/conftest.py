"""What holds for all tests: how properties are judged, how often garbage is collected, and which
files come first."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import drivers.can.python_can_import  # noqa: F401 - a test's `import can` would bring asammdf

# A busy host is no counterexample: properties judge what comes out, not how long it took.

settings.register_profile("fusiond", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("fusiond")

# As in commands (fusiond.commands.app): a million objects live as long as the tests do, and to look
# through them at CPython's own threshold takes a thirtieth of the suite's time.
gc.set_threshold(50_000)


def pytest_unconfigure() -> None:
    """The interpreter's last collections have nothing to look for either."""
    gc.freeze()


LONG = (
    "studies/test_bds_tight",
    "studies/test_studies",
    "commands/test_kernel_cache",
    "studies/",
    "estimators/test_federated_faults",
    "live/",
    "offline/",
    "commands/",
    "estimators/",
    "navigator/",
    "navigation/test_compiled",
    "demo/",
)
"""Files that take ten seconds or more come first, the longest at the head, so that all cores end at
about the same time."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those of `LONG` first; the tests of a file keep their order."""

    here = Path(__file__).parent

    def place(item: pytest.Item) -> int:
        name = item.path.relative_to(here).as_posix()
        return next((k for k, long in enumerate(LONG) if name.startswith(long)), len(LONG))

    items.sort(key=place)
