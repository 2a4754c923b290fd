r"""Process noise that replaces biases without states in the model.

A bias without a state is a force error in body axes, b = b_0 + b_m: a constant of sigma s_0 and a
first-order Gauss-Markov process of sigma s and correlation time tau. White noise that adds the same
variance to a velocity over an interval T has the density

    q(T) = var(integral of b over T) / T
         = s_0^2 T + 2 s^2 tau (1 - (tau / T) (1 - exp(-T / tau)))

which is (s_0^2 + s^2) T while T << tau, and 2 s^2 tau of the Markov part once T >> tau. So no
density is right for every T. T is the time for which the filter uses a velocity to estimate the
tilt. A level bias appears as a tilt b / g, and an old velocity is evidence on the present tilt only
while the gyro maintains the tilt:

    n^2 T + 2 s_g^2 / (3 tau) T^3 = (s_0^2 + s^2) / g^2

n^2 density of the gyro's noise, s_g sigma of its drift, which is a state and changes by the
variance 2 s_g^2 t / tau in a time t << tau. With that T the steady sigma of the tilt equals the
effect of the bias: the filter of one tilt with measurement noise q / g^2 and n^2 on the tilt states
sqrt(n^2 q) / g, and (b / g)^2 = n^2 T, q = b^2 T give just b / g. A drift that outweighs the noise
makes it up to 1.33 b / g (Riccati equation of both, in the tests).

A shorter T treats one bias as many independent ones and states a tilt sigma far too small (with T =
1 s in the flight of paper 002 a quarter); a longer one discards information of the accelerometer.

Source: paper 002 leaves the accelerometer's biases out "as white noise" and prints no density;
derived here, held by covariance analysis and live flights (docs/observability.md).
"""

from __future__ import annotations

import math
from dataclasses import replace

from fusiond.models.blocks import ImuNoise
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2


def tilt_memory_s(noise: ImuNoise) -> float:
    """T of the module's text, in s: 0 of an accelerometer without bias."""
    bias = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    linear = noise.rate_noise**2
    cubic = 2.0 * noise.rate_bias_instability**2 / (3.0 * noise.bias_correlation_s)
    tilt = (bias / STANDARD_GRAVITY_M_S2) ** 2
    # The one real root of cubic T^3 + linear T = tilt, by hyperbolic sines.
    root = math.sqrt(linear / (3.0 * cubic))
    return 2.0 * root * math.sinh(math.asinh(1.5 * tilt / (linear * root)) / 3.0)


def density_of(initial: float, steady: float, tau_s: float, interval_s: float) -> float:
    """Density q(T) of the module's text, for sigmas `initial` of the constant and `steady` of the
    Markov part; their unit squared times seconds."""
    if interval_s == 0.0:
        return 0.0
    x = interval_s / tau_s
    # 2 tau (1 - (1 - exp(-x)) / x); by its series where the difference would be rounding.
    markov = interval_s * (1.0 - x / 3.0) if x < 1e-4 else 2.0 * tau_s * (1.0 + math.expm1(-x) / x)
    return initial**2 * interval_s + steady**2 * markov


def with_force_biases_as_noise(noise: ImuNoise) -> ImuNoise:
    """The IMU's noise for a model without states for accelerometer biases."""
    added = density_of(
        noise.force_bias_initial,
        noise.force_bias_instability,
        noise.bias_correlation_s,
        tilt_memory_s(noise),
    )
    return replace(noise, force_noise=math.sqrt(noise.force_noise**2 + added))
