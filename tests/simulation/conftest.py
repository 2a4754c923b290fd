"""The drive that the simulated devices sit on."""

from __future__ import annotations

import pytest

from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import drive
from tests.runs import ORIGIN


@pytest.fixture(scope="session")
def truth() -> Truth:
    """Five minutes at 50 Hz; nobody writes into it."""
    return Truth(drive(300.0), ORIGIN, 50.0, 300.0)
