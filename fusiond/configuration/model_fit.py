r"""Fit of the model to the inertial sensor's errors.

An error without a state is noise to the model, which keeps sigma honest but larger: an
accelerometer's bias (`fusiond.models.unmodelled_bias_noise`), scale factors while the vehicle turns
and speeds up (`fusiond.navigation.crosstalk_noise`). The measure is a minute without measurements,
t = 60 s, one sigma of the displacement; of scale factors a quarter turn, one sigma of the heading:

    an accelerometer bias b       b t^2 / 2
    what the model assumes         sqrt(N^2 t^3 / 3 + g^2 n^2 t^5 / 20)
    a gyro's scale factor s       s pi / 2
    what the model assumes         n sqrt(t)

N and n are the densities of velocity and attitude in the model, which represent such a bias. Every
shipped model has gyro states. Only a ratio above `MATTERS` is reported.

Source: Groves, 2nd ed., sections 4.4.2 and 5.7 (short-term straight-line error propagation).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG, MILLI_G, imu_noise
from fusiond.models.catalogue import make_model
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import FORCE_ERROR

MINUTE_S = 60.0
MATTERS = 2.0
"""Ratio of errors from which the lesser one matters: at half the other's size it raises their sum
by an eighth."""


def after_a_minute(force_noise: float, rate_noise: float) -> float:
    """Position sigma (m) after a minute, from white noise of force (m/s^2/sqrt(Hz)) and rate."""
    t, g = MINUTE_S, STANDARD_GRAVITY_M_S2
    return math.sqrt(force_noise**2 * t**3 / 3.0 + (g * rate_noise) ** 2 * t**5 / 20.0)


def model_doubts(config: Config) -> Iterator[str]:
    """Sentences on a model that treats the accelerometer's bias, or scale factors, as noise."""
    name, noise = config.estimator.model, imu_noise(config.imu)
    model = make_model(name, noise)
    velocity = math.sqrt(next(b.white for b in model.blocks if b.name == "velocity"))
    attitude = math.sqrt(next(b.white for b in model.blocks if b.name == "attitude"))
    known_m = after_a_minute(velocity, attitude)
    planar, g = model.hold_height, STANDARD_GRAVITY_M_S2
    kind = config.imu.sensor_class
    of = "[imu]" if kind is None else f"sensor class {kind!r}"
    states = "planar15" if planar else "ins23"
    instead = f"choose {states!r} or 'ins21'"

    force = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    moved_m = 0.5 * force * MINUTE_S**2
    lacks = not all(model.parameters(FORCE_ERROR + axis) for axis in range(2 if planar else 3))
    if lacks and velocity > MATTERS * noise.force_noise:
        yield (
            f"estimator.model = {name!r} has no accelerometer bias, and {of} has one of "
            f"{force / MILLI_G:.3g} mg, one sigma, which is noise to it: sigma grows by "
            f"{_metres(known_m)} in a minute without measurements, where the bias does "
            f"{_metres(moved_m)}, and the level is off by {math.atan(force / g) / DEG:.2g} deg; "
            f"{instead}"
        )
    turned, drifts = 0.5 * math.pi * noise.rate_scale, noise.rate_noise * math.sqrt(MINUTE_S)
    if not model.scale_factors and turned > MATTERS * drifts:
        yield (
            f"estimator.model = {name!r} has no scale factors, and {of} has "
            f"{noise.rate_scale * 1e6:,.0f} ppm of the gyros, one sigma, which are noise to it: "
            f"sigma of the heading grows by {turned / DEG:.2g} deg in a quarter turn, where a "
            f"minute of the gyros' own noise makes {drifts / DEG:.2g} deg of it; choose 'ins21'"
        )


def _metres(value: float) -> str:
    return f"{value:,.0f} m" if value >= 10.0 else f"{value:.2g} m"
