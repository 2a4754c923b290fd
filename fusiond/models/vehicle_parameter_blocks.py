"""Blocks of unmeasured parameters of a vehicle: placement and delays of sensors.

Each is a constant, or nearly one, that driving shows; an unobserved one keeps its prior. The
measurements define their effect (fusiond.aiding.body_velocity, position, velocity).
"""

from __future__ import annotations

from fusiond.models.blocks import Block

MOUNTING = "mounting"
AXLE_LEVER = "axle_lever"
SIDE_DRIFT = "side_drift"
WHEEL_DRIFT = "wheel_drift"
WHEEL_SCALE = "wheel_scale"
WHEEL_LATENCY = "wheel_latency"
WHEEL_ROUNDING = "wheel_rounding"
FIX_TIME = "gnss_time"
FIX_MARKOV = "gnss_wander"
VELOCITY_TIME = "gnss_velocity_time"
CLOCK_SKEW = "gnss_clock_skew"
ANTENNA_LEVER = "antenna_lever"
BAROMETER_OFFSET = "barometer_offset"
BAROMETER_SCALE = "barometer_scale"
BAROMETER_AIRFLOW = "barometer_airflow"

# Random walk (s per root second) of a time offset: a serial line's load moves it by milliseconds in
# minutes, and two crystals part by as much.
TIME_WALK_S_SQRT_S = 1e-3
# The same beside a state of the rate: a crystal that warms by 10 K in five minutes gets 20 ppm off
# its rate, and its time 3 ms off that rate's line.
RATED_TIME_WALK_S_SQRT_S = 2e-4
# One sigma of how much faster one of two clocks runs: crystals are within 50 ppm of each other,
# ceramic resonators within 0.5 %, and NTP slews a host's clock by 500 ppm. The unit of drive_0708
# and its receiver part by 250 ppm.
CLOCK_SKEW_SD = 2e-4


def mounting_block(sd_rad: float) -> Block:
    """Pitch and yaw (rad) of the IMU's nominal axes against the vehicle's. Its roll changes nothing
    that wheels or axle feel."""
    return _constant(MOUNTING, "rad", ("pitch", "yaw"), sd_rad)


def axle_lever_block(sd_m: float) -> Block:
    """Forward offset (m) of the point that does not slide sideways, from the configured one."""
    return _constant(AXLE_LEVER, "m", ("x",), sd_m)


def drift_block(name: str, sd_m_s: float, lasts_s: float) -> Block:
    """Velocity error (m/s) that lasts for seconds: sideways by tyres, a road's crown and wind; of a
    wheel by slip and quantised steps."""
    return Block(name, "m/s", ("v",), (-1,), initial=sd_m_s, steady=sd_m_s, tau_s=lasts_s)


def wheel_scale_block(name: str, sd: float) -> Block:
    """Relative error of a wheel's speed: a tyre's radius, worn or under pressure."""
    return _constant(name, "1", ("scale",), sd)


def wheel_rounding_block(name: str, sd: float) -> Block:
    """Rounding error of a wheel's speed relative to the assumed rounding, as a share of a step: no
    standard defines the rounding of km/h."""
    return _constant(name, "1", ("share",), sd)


def time_offset_block(name: str, sd_s: float, skew: str = "") -> Block:
    """Delay (s) of validity after its stamp; `skew` names the block of its rate."""
    walk = RATED_TIME_WALK_S_SQRT_S if skew else TIME_WALK_S_SQRT_S
    return Block(name, "s", ("t",), (-1,), initial=sd_s, white=walk**2, rate=skew)


def clock_skew_block(name: str) -> Block:
    """Growth (s/s) of a device's offset in time: its clock and the inertial unit's have different
    rates."""
    return _constant(name, "1", ("rate",), CLOCK_SKEW_SD)


def fix_markov_block(name: str, lasts_s: float) -> Block:
    """Error that fixes share for a while, of sigma one; each measurement scales it in metres
    (fusiond.aiding.fix_error_correlation)."""
    return Block(name, "1", ("n", "e", "d"), (-1,) * 3, initial=1.0, steady=1.0, tau_s=lasts_s)


def antenna_lever_block(name: str, sd_m: float) -> Block:
    """Residual of the lever arm (m) from the IMU to an antenna, body axes."""
    return _constant(name, "m", ("x", "y", "z"), sd_m)


def barometer_offset_block(name: str, sd_m: float, walk_m_sqrt_s: float) -> Block:
    """Offset (m) of a barometer's height, at the sea and at rest: the weather, and the geoid above
    the ellipsoid."""
    return Block(name, "m", ("m",), (-1,), initial=sd_m, white=walk_m_sqrt_s**2)


def barometer_scale_block(name: str, sd: float) -> Block:
    """Relative error of a barometer's heights: air colder or warmer than the standard."""
    return _constant(name, "1", ("scale",), sd)


def barometer_airflow_block(name: str, sd: float) -> Block:
    """Share of the dynamic pressure missing at a barometer on a moving vehicle."""
    return _constant(name, "1", ("share",), sd)


def _constant(name: str, unit: str, states: tuple[str, ...], sd: float) -> Block:
    return Block(name, unit, states, (-1,) * len(states), initial=sd)
