"""The forward axis of an IMU by driving off, of samples and of frames on a bus."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.configuration.load import load_config
from fusiond.doctor.forward_axis import ForwardAxis, axes_of
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive as path

RATE_HZ = 100.0
REST_S = 12.0
"""The bus is listened to for 3 s first, and standing is two seconds."""
GRAVITY = 9.8
AXES = [
    (forward, down)
    for forward in ("+x", "-x", "+y", "-y", "+z", "-z")
    for down in ("+x", "-x", "+y", "-y", "+z", "-z")
    if forward[1] != down[1]
]


def unit(axis: str) -> NDArray[np.float64]:
    return np.array([float(k == axis[1]) for k in "xyz"]) * (1.0 if axis[0] == "+" else -1.0)


def drive(
    forward: NDArray[np.float64],
    down: NDArray[np.float64],
    parts: list[tuple[float, float, float]],
    seed: int = 1,
) -> Iterator[NDArray[np.float64]]:
    """Samples (6,) of stretches (seconds, acceleration, yaw rate), with noise and a bias."""
    rng = np.random.default_rng(seed)
    bias = np.array([0.002, -0.001, 0.001, 0.05, -0.04, 0.03])
    for seconds, acceleration, yaw_rate in parts:
        motion = np.concatenate([yaw_rate * down, acceleration * forward - GRAVITY * down])
        shaking = 0.3 if acceleration else 0.02
        for _ in range(round(seconds * RATE_HZ)):
            noise = rng.normal(0.0, [0.002] * 3 + [shaking] * 3)
            yield motion + bias + noise


def judged(samples: Iterator[NDArray[np.float64]], down: str) -> ForwardAxis:
    found = ForwardAxis(down)
    for sample in samples:
        found.add(sample, 1.0 / RATE_HZ)
    return found


@pytest.mark.parametrize(("forward", "down"), AXES)
def test_driving_off_shows_the_forward_axis(forward: str, down: str) -> None:
    samples = drive(unit(forward), unit(down), [(2.5, 0.0, 0.0), (4.0, 2.0, 0.0)])
    assert judged(samples, down).axis == forward


def test_braking_after_it_changes_nothing() -> None:
    parts = [(3.0, 0.0, 0.0), (4.0, 2.0, 0.0), (3.0, 0.0, 0.0), (4.0, -2.0, 0.0)]
    assert judged(drive(unit("+x"), unit("-z"), parts), "-z").axis == "+x"


def test_door_that_is_shut_is_no_departure() -> None:
    samples = [
        *drive(unit("+y"), unit("+z"), [(2.0, 0.0, 0.0)]),
        *drive(unit("+y"), unit("+z"), [(0.3, 1.0, 0.0), (0.3, -1.0, 0.0)], seed=2),
        *drive(unit("+y"), unit("+z"), [(3.0, 0.0, 0.0), (4.0, 2.0, 0.0)], seed=3),
    ]
    assert judged(iter(samples), "+z").axis == "+y"


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([(4.0, 0.0, 0.0)], "did not drive off"),
        ([(2.0, 0.0, 0.0), (10.0, 0.4, 0.0)], "slower than 4 m/s after 8 s"),
        ([(2.0, 0.0, 0.0), (4.0, 2.0, 0.3)], "turned before it was fast enough"),
        ([(4.0, 1.0, 0.0)], "never stood still"),
    ],
)
def test_drive_that_shows_nothing_says_why(
    parts: list[tuple[float, float, float]], reason: str
) -> None:
    found = judged(drive(unit("+x"), unit("+z"), parts), "+z")
    assert found.axis is None
    assert reason in found.reason


def test_unit_at_45_deg_is_not_given_an_axis() -> None:
    aside = (unit("+x") + unit("+y")) / np.sqrt(2.0)
    found = judged(drive(aside, unit("+z"), [(2.0, 0.0, 0.0), (4.0, 2.0, 0.0)]), "+z")
    assert found.axis is None
    assert "between two axes" in found.reason


@pytest.mark.parametrize(("forward", "down"), AXES)
def test_third_axis_makes_them_right_handed(forward: str, down: str) -> None:
    axes = axes_of(forward, down)
    assert np.linalg.det(np.array([unit(axis) for axis in axes])) == pytest.approx(1.0)


async def test_init_finds_the_axes_of_a_simulated_car(tmp_path: Path) -> None:
    """Its unit points forward, left, up; the car stands for a while and drives off."""
    bus = str(tmp_path)
    car = SimulatedVehicle(
        replace(SCENARIOS["drive"], path=partial(path, rest_s=REST_S)),
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update={"channel": bus}),
    )
    out = tmp_path / "car.toml"
    running = asyncio.create_task(car.run())
    arguments = ["config", "init", str(out), "--yes", "--drive", "--can", f"virtual:{bus}"]
    arguments += ["--port", str(tmp_path / "none")]
    done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert done.exit_code == 0, done.output
    assert "standing: now drive off straight ahead" in done.stdout
    assert load_config(out).imu.axes == ("+x", "-y", "-z")
    assert "+x is forward, by driving off" in out.read_text()
