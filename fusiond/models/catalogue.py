"""The shipped models as lists of blocks.

The papers' models: 000 (15 states, planar, constant and Markov gyro drift, Markov accelerometer),
001 (10 states, planar), 002 (23 and 17 states with a receiver clock and a SAR's misalignment), 003
(20 states, constant and Markov gyro drift, Markov accelerometer, receiver clock); the 15 and 21
states for vehicles are those of Groves, 2nd ed., section 14.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fusiond.models.blocks import (
    SAR_MISALIGNMENT,
    SAR_MISALIGNMENT_SD,
    Block,
    ImuNoise,
    clock_blocks,
    misalignment,
    navigation_blocks,
    parameter,
)
from fusiond.models.model import Model
from fusiond.models.unmodelled_bias_noise import with_force_biases_as_noise
from fusiond.navigation.error_model import FORCE_ERROR


def make_model(name: str, noise: ImuNoise, *extra: Block) -> Model:
    """Shipped model by name, with an IMU's noise and further blocks.

    A further block takes the place of the model's own of the same name. KeyError for a name that
    is not one of MODELS.
    """
    blocks = MODELS[name](noise)
    given = {block.name: block for block in extra}
    own = [given.pop(block.name, block) for block in blocks]
    states = {column for block in own for column in block.columns}
    held = {FORCE_ERROR, FORCE_ERROR + 1} <= states  # a tilt's, north and east
    bias = 0.0 if held else math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    return Model(name, (*own, *given.values()), name.startswith("planar"), bias)


def _gyro_bias(noise: ImuNoise) -> Block:
    return parameter("gyro_bias", "rad/s", "gyro", initial=noise.rate_bias_initial)


def _gyro_markov(noise: ImuNoise, initial: float) -> Block:
    steady, tau = noise.rate_bias_instability, noise.bias_correlation_s
    return parameter("gyro_markov", "rad/s", "gyro", initial=initial, steady=steady, tau_s=tau)


def _walking_biases(noise: ImuNoise) -> list[Block]:
    """Bias of an axis as one state: turn-on bias and its Markov part. A random walk grows as the
    Markov process while t << tau (variance 2 s^2 t / tau), and faster later, so its sigma is never
    too small."""
    rate, force, tau = (
        noise.rate_bias_instability,
        noise.force_bias_instability,
        noise.bias_correlation_s,
    )
    return [
        parameter(
            "gyro_bias",
            "rad/s",
            "gyro",
            initial=math.hypot(noise.rate_bias_initial, rate),
            white=2.0 * rate**2 / tau,
        ),
        parameter(
            "accel_bias",
            "m/s^2",
            "accel",
            initial=math.hypot(noise.force_bias_initial, force),
            white=2.0 * force**2 / tau,
        ),
    ]


def _planar10(noise: ImuNoise) -> list[Block]:
    # One Markov state an axis stands for all of the gyro's drift; accelerometer biases, of which
    # paper 001 has none, are noise.
    drift = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    navigation = navigation_blocks(with_force_biases_as_noise(noise), planar=True)
    return [*navigation, _gyro_markov(noise, drift)]


def _planar15(noise: ImuNoise) -> list[Block]:
    accel_markov = parameter(
        "accel_markov",
        "m/s^2",
        "accel",
        "xy",
        initial=math.hypot(noise.force_bias_initial, noise.force_bias_instability),
        steady=noise.force_bias_instability,
        tau_s=noise.bias_correlation_s,
    )
    return [
        *navigation_blocks(noise, planar=True),
        _gyro_bias(noise),
        _gyro_markov(noise, noise.rate_bias_instability),
        accel_markov,
    ]


def _ins15(noise: ImuNoise) -> list[Block]:
    return [*navigation_blocks(noise, planar=False), *_walking_biases(noise)]


def _ins21(noise: ImuNoise) -> list[Block]:
    scales = [
        parameter("gyro_scale", "1", "gyro_scale", initial=noise.rate_scale),
        parameter("accel_scale", "1", "accel_scale", initial=noise.force_scale),
    ]
    return [*_ins15(noise), *scales]


def _ins17(noise: ImuNoise) -> list[Block]:
    # Accelerometer biases are noise (paper 002), gyro constants part of the Markov states.
    return [
        *navigation_blocks(with_force_biases_as_noise(noise), planar=False),
        _gyro_markov(noise, math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)),
        *clock_blocks(),
        misalignment(SAR_MISALIGNMENT, SAR_MISALIGNMENT_SD),
    ]


def _ins20(noise: ImuNoise) -> list[Block]:
    # One Markov state an axis for all of the accelerometer's bias: of its whole variance, and of
    # the walk of its Markov part, 2 s^2 / tau. A constant that came back to zero in an hour would
    # walk by a hundred times what a MEMS unit's bias does.
    markov = noise.force_bias_instability
    force = math.hypot(noise.force_bias_initial, markov)
    accel_markov = parameter(
        "accel_markov",
        "m/s^2",
        "accel",
        initial=force,
        steady=force,
        tau_s=noise.bias_correlation_s * (force / markov) ** 2,
    )
    return [
        *navigation_blocks(noise, planar=False),
        _gyro_bias(noise),
        _gyro_markov(noise, noise.rate_bias_instability),
        accel_markov,
        *clock_blocks(),
    ]


def _ins23(noise: ImuNoise) -> list[Block]:
    return [
        *navigation_blocks(noise, planar=False),
        _gyro_bias(noise),
        _gyro_markov(noise, noise.rate_bias_instability),
        _walking_biases(noise)[1],
        *clock_blocks(),
        misalignment(SAR_MISALIGNMENT, SAR_MISALIGNMENT_SD),
    ]


MODELS: dict[str, Callable[[ImuNoise], list[Block]]] = {
    "ins15": _ins15,
    "ins21": _ins21,
    "ins17": _ins17,
    "ins20": _ins20,
    "ins23": _ins23,
    "planar10": _planar10,
    "planar15": _planar15,
}
"""The shipped models: 10 states as paper 001, 15 as paper 000, 17 and 23 as paper 002, 20 as paper
003; the 15 and 21 states for vehicles."""
