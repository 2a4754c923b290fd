r"""Blocks of the error state: named groups of states with their dynamics.

A block is the errors of the navigation solution, or parameters that the filter estimates beside it.
A parameter block is a first-order Gauss-Markov process

    x' = -x / tau + w,   steady sigma s,   variance over h: s^2 (1 - exp(-2 h / tau))

or, with tau infinite, a random constant, or, if a block names its rate, the integral of another
state. `columns` define the effect of a block on the navigation errors
(fusiond.navigation.error_model). Source: Groves, 2nd ed., section 14.2.
"""

from __future__ import annotations

import math

from drivers.immutable import immutable
from fusiond.navigation.error_model import FORCE_ERROR, FORCE_SCALE, RATE_ERROR, RATE_SCALE

CLOCK_OFFSET, CLOCK_DRIFT, CLOCK_RAMP = "clock_offset", "clock_drift", "clock_ramp"
RAMP_M_S2, RAMP_S = 0.2, 1000.0
"""One sigma and correlation time of how a clock's drift runs on while its crystal warms or cools: a
temperature-compensated one is held to 0.5 ppm over 70 K, and by so steep a curve in places that a
tenth of a kelvin a second is half a ppb a second. A receiver on a walk had 0.17 m/s^2 for two
minutes; what is left beside it is the drift's walk."""
CARRIER_ANCHOR, CARRIER_CLOCK = "carrier_anchor", "carrier_clock"
"""Antenna position (ECEF, m) at the epoch from which carriers are counted, and the carriers' clock
since (m): fusiond.aiding.carrier_anchor."""
SAR_MISALIGNMENT = "sar_misalignment"
# One sigma (rad) of how a SAR antenna is mounted where nothing else says it: 0.1 deg, about what
# paper 002's accuracy needs and a mechanical alignment keeps.
SAR_MISALIGNMENT_SD = math.radians(0.1)

PARAMETER_COLUMNS = {
    "gyro": RATE_ERROR,
    "accel": FORCE_ERROR,
    "gyro_scale": RATE_SCALE,
    "accel_scale": FORCE_SCALE,
}


@immutable()
class ImuNoise:
    """IMU error model in SI units, one sigma.

    `rate_noise` rad/s/sqrt(Hz), `force_noise` m/s^2/sqrt(Hz); biases rad/s and m/s^2: `initial` at
    switch-on, `instability` of the Markov part; scale factors without unit; time in s.
    """

    rate_noise: float
    force_noise: float
    rate_bias_initial: float
    force_bias_initial: float
    rate_bias_instability: float
    force_bias_instability: float
    bias_correlation_s: float
    rate_scale: float
    force_scale: float


@immutable()
class ClockNoise:
    """Receiver clock as ranges (c times its error), one sigma or noise density.

    The defaults are a temperature-compensated crystal oscillator (Groves, 2nd ed., section 9.4.2:
    phase 0.01 m^2/s, frequency 0.04 m^2/s^3) of 1 ppm, its offset unknown to 1 ms. With
    `drift_tau_s` the drift is a first-order Gauss-Markov process of sigma `drift_steady` (paper
    003).
    """

    offset_initial: float = 3e5
    drift_initial: float = 300.0
    offset_white: float = 0.01
    drift_white: float = 0.04
    drift_tau_s: float = math.inf
    drift_steady: float = 0.0


@immutable()
class Block:
    """A group of states.

    `columns`: 0 to 8 are the navigation errors, 9 to 20 the ways in which a parameter acts on them,
    -1 a parameter that acts on measurements only. `white` is the noise density of each state
    (unit^2 / s), `tau_s` and `steady` (one sigma) those of a Markov process, `initial` the default
    one sigma at the start. `rate` names the block of one state that is the rate of each state here;
    zero if the model has no such block.
    """

    name: str
    unit: str
    states: tuple[str, ...]
    columns: tuple[int, ...]
    initial: float = 0.0
    white: float = 0.0
    tau_s: float = math.inf
    steady: float = 0.0
    rate: str = ""


def navigation_blocks(noise: ImuNoise, planar: bool) -> list[Block]:
    """Attitude, velocity and position errors; planar ones are horizontal."""
    n_e_d, n_e = ("n", "e", "d"), ("n", "e")
    horizontal = n_e if planar else n_e_d
    return [
        Block("attitude", "rad", n_e_d, (0, 1, 2), white=noise.rate_noise**2),
        Block(
            "velocity", "m/s", horizontal, (3, 4, 5)[: len(horizontal)], white=noise.force_noise**2
        ),
        Block("position", "m", horizontal, (6, 7, 8)[: len(horizontal)]),
    ]


def parameter(
    name: str,
    unit: str,
    kind: str,
    axes: str = "xyz",
    *,
    initial: float,
    white: float = 0.0,
    tau_s: float = math.inf,
    steady: float = 0.0,
) -> Block:
    """States of one error of gyro or accelerometer along some sensor axes: `kind` of
    PARAMETER_COLUMNS."""
    first = PARAMETER_COLUMNS[kind]
    columns = tuple(first + "xyz".index(a) for a in axes)
    return Block(name, unit, tuple(axes), columns, initial, white, tau_s, steady)


def position_bias(name: str, sd_m: float, tau_s: float, axes: str = "ne") -> Block:
    """A first-order Gauss-Markov error (m) along some axes that successive measurements
    share."""
    columns = (-1,) * len(axes)
    return Block(name, "m", tuple(axes), columns, initial=sd_m, steady=sd_m, tau_s=tau_s)


def shared_error(name: str, unit: str, sd: float, tau_s: float) -> Block:
    """State of an error that several measurements share: a first-order Gauss-Markov process or a
    constant."""
    steady = 0.0 if math.isinf(tau_s) else sd
    return Block(name, unit, (name,), (-1,), initial=sd, steady=steady, tau_s=tau_s)


def clock_blocks(
    offsets: tuple[str, ...] = ("receiver",), noise: ClockNoise | None = None
) -> list[Block]:
    """A receiver clock as ranges: one offset (m) for each name, and their common drift (m/s)."""
    n = noise or ClockNoise()
    return [
        Block(
            CLOCK_OFFSET,
            "m",
            offsets,
            (-1,) * len(offsets),
            initial=n.offset_initial,
            white=n.offset_white,
            rate=CLOCK_DRIFT,
        ),
        Block(
            CLOCK_DRIFT,
            "m/s",
            ("drift",),
            (-1,),
            initial=n.drift_initial,
            white=n.drift_white,
            tau_s=n.drift_tau_s,
            steady=n.drift_steady,
        ),
    ]


def clock_ramp() -> Block:
    """Rate of a clock's drift."""
    sd = RAMP_M_S2
    return Block(CLOCK_RAMP, "m/s^2", ("ramp",), (-1,), initial=sd, tau_s=RAMP_S, steady=sd)


def carrier_blocks(noise: ClockNoise) -> list[Block]:
    """Carrier anchor and carrier clock, which drifts with the code clock."""
    columns = (-1, -1, -1)
    return [
        Block(CARRIER_ANCHOR, "m", ("x", "y", "z"), columns, initial=1.0),
        Block(
            *(CARRIER_CLOCK, "m", ("carriers",), (-1,)),
            initial=1.0,
            white=noise.offset_white,
            rate=CLOCK_DRIFT,
        ),
    ]


def misalignment(name: str, sd_rad: float, tau_s: float = math.inf) -> Block:
    """Misalignment angles x, y, z (rad) of a sensor, one sigma each; Markov where tau is finite."""
    steady = 0.0 if math.isinf(tau_s) else sd_rad
    return Block(
        name, "rad", ("x", "y", "z"), (-1, -1, -1), initial=sd_rad, steady=steady, tau_s=tau_s
    )
