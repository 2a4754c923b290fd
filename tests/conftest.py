"""What holds for all tests: how properties are judged, how often garbage is collected, and in which
order files come."""

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


COMPUTING = (
    "commands/test_kernel_cache",
    "studies/test_faults_matrix",
    "studies/test_bds_tight",
    "studies/test_reduced_order",
    "estimators/test_nees_clock",
    "studies/",
    "estimators/test_federated_faults",
    "offline/",
    "commands/",
    "navigator/",
    "estimators/",
    "navigation/test_compiled",
)
"""Files that compute for ten seconds or more come first, the longest at the head, so that all cores
end at about the same time."""
WAITING = (
    "live/test_messages",
    "demo/test_papers",
    "live/test_warm_restart",
    "demo/",
    "doctor/test_forward_axis",
    "live/test_daemon",
    "live/",
    "doctor/",
    "simulation/test_live",
    "outputs/",
    "dashboard/",
)
"""Files whose devices, brokers and cards keep real time leave their core idle: one comes after two
that compute, so that seldom more than one of the processes waits."""


def file_of(item: pytest.Item) -> str:
    return item.path.relative_to(Path(__file__).parent).as_posix()


def place(file: str, among: tuple[str, ...]) -> int:
    return next((k for k, begin in enumerate(among) if file.startswith(begin)), len(among))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files in the order above; the tests of a file keep theirs."""
    files = list(dict.fromkeys(map(file_of, items)))
    waiting = [file for file in files if file.startswith(WAITING)]
    computing = [file for file in files if not file.startswith(WAITING)]
    waiting.sort(key=lambda file: place(file, WAITING))
    computing.sort(key=lambda file: place(file, COMPUTING))
    order: list[str] = []
    while waiting or computing:
        order += [*waiting[:1], *computing[:2]]
        del waiting[:1], computing[:2]
    rank = {file: k for k, file in enumerate(order)}
    items.sort(key=lambda item: rank[file_of(item)])
