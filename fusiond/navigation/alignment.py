r"""Alignment: attitude from gravity, from the Earth's rate, and from motion.

At rest the specific force is -g along down and the rate is the Earth's:

    roll = atan2(-f_y, -f_z)      pitch = atan2(f_x, sqrt(f_y^2 + f_z^2))
    yaw:  C w = [W cos(lat), 0, -W sin(lat)]

Sensor errors become attitude errors, fully correlated with them:

    phi_N = (C a)_E / g     phi_E = -(C a)_N / g
    phi_D = ((C e)_E + phi_N w_D) / w_N                 after gyrocompassing

Source: Groves, 2nd ed., section 5.6; Titterton and Weston, 2nd ed., section 10.3; signs by the
error model (fusiond.navigation.error_model), checked in the tests.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.rotation import dcm_from_rpy

Array = NDArray[np.float64]


def level(mean_force: Array) -> tuple[float, float]:
    """Roll and pitch (rad) from the mean specific force (3,) of a body at rest."""
    x, y, z = (float(v) for v in mean_force)
    return math.atan2(-y, -z), math.atan2(x, math.hypot(y, z))


def gyrocompass(mean_rate: Array, roll: float, pitch: float) -> float:
    """Yaw (rad) of a body at rest from its mean rate (3,) and its level."""
    levelled = dcm_from_rpy(roll, pitch, 0.0) @ mean_rate
    return math.atan2(-float(levelled[1]), float(levelled[0]))


def gyrocompass_sd(lat: float, rate_bias: float, rate_noise: float, seconds: float) -> float:
    """One sigma of gyrocompassed heading (rad): east rate error over the Earth's north rate."""
    north_rate = EARTH_RATE_RAD_S * math.cos(lat)
    return math.hypot(rate_bias, rate_noise / math.sqrt(seconds)) / north_rate


def levelling_jacobian(dcm: Array, lat: float, height: float) -> Array:
    """d phi / d(force error) (3, 3) of an attitude that was levelled at C_nb = `dcm`."""
    g = gravity(lat, height)
    return np.vstack([dcm[1] / g, -dcm[0] / g, np.zeros(3)])


@compiled(
    "void(f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8, f8, f8, f8, f8,"
    " f8[:, ::1], f8[:, :, ::1])",
    allocates=True,
)
def judge_sensed(
    t_s: Array,
    means: Array,
    gained: Array,
    turned: Array,
    slopes: Array,
    sensed_biases: Array,
    velocity: Array,
    sd: Array,
    levers: Array,
    dcm: Array,
    first: Array,
    biases: Array,
    dcm_turns: Array,
    force_variance: float,
    rate_variance: float,
    g: float,
    delay: float,
    sd_delay_s: float,
    left: Array,
    rows: Array,
) -> None:
    """Write residuals of a guess for k velocities, in sigmas (k, 3), and their derivatives (k, 3,
    13).

    The slopes are by phi, biases (6,) of force and rate, offset in time and first velocity
    (`fusiond.navigator.alignment.motion_fit`).

    Of a stretch of samples: seconds (k,), rate and force (k, 6) as sensed at the fixes; the
    integrals over it (fusiond.navigation.preintegration), with the biases that were taken off; of
    the fixes velocity, sigma and lever (k, 3). Of the guess: C_0 (3, 3), the velocity (3,) at the
    first fix, biases, C_0 D (3, 3) of the last fix, the offset `delay` in its sigmas, `sd_delay_s`.
    A velocity gained has the white noise of `force_variance` t + `rate_variance` t^3 beside its
    own.
    """
    more = biases - sensed_biases
    there, acceleration, arm, body = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    turn, weight = np.empty((3, 3)), np.empty(3)
    for k in range(t_s.shape[0]):
        t, lever = t_s[k], levers[k]
        x, y, z = means[k, 0] - biases[3], means[k, 1] - biases[4], means[k, 2] - biases[5]
        arm[0] = y * lever[2] - z * lever[1]
        arm[1] = z * lever[0] - x * lever[2]
        arm[2] = x * lever[1] - y * lever[0]
        for i in range(3):
            body[i] = gained[k, i]
            for j in range(6):
                body[i] += slopes[k, i, j] * more[j]
            for j in range(3):
                body[i] += turned[k, i, j] * arm[j]
                turn[i, j] = 0.0
                for n in range(3):
                    turn[i, j] += dcm[i, n] * turned[k, n, j]
        white = force_variance * t + rate_variance * t * t * t
        for i in range(3):
            down = g if i == 2 else 0.0
            there[i], acceleration[i] = 0.0, down
            for j in range(3):
                there[i] += dcm[i, j] * body[j]
                acceleration[i] += turn[i, j] * (means[k, 3 + j] - biases[j])
            weight[i] = 1.0 / np.sqrt(sd[k, i] * sd[k, i] + white)
            said = first[i] + down * t + there[i] + delay * sd_delay_s * acceleration[i]
            left[k, i] = (velocity[k, i] - said) * weight[i]
        for i in range(3):
            row, one, two = rows[k, i], (i + 1) % 3, (i + 2) % 3
            # exp(phi) u moves by phi x u; a lever's velocity by a rate less b_w is -[l]x of it.
            row[i], row[one], row[two] = 0.0, there[two], -there[one]
            for j in range(6):
                row[3 + j] = 0.0
                for n in range(3):
                    row[3 + j] += dcm[i, n] * slopes[k, n, j]
            for j in range(3):
                ahead, behind = (j + 1) % 3, (j + 2) % 3
                row[6 + j] -= there[two] * dcm_turns[one, j] - there[one] * dcm_turns[two, j]
                row[6 + j] += turn[i, ahead] * lever[behind] - turn[i, behind] * lever[ahead]
            row[9] = sd_delay_s * acceleration[i]
            row[10], row[11], row[12] = 0.0, 0.0, 0.0
            row[10 + i] = 1.0
            for j in range(13):
                row[j] *= weight[i]
