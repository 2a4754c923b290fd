"""Gauss-Newton kernels for the attitude fit of fusiond.navigator.alignment.motion_fit, which
defines the problem.

A guess (19,) holds the attitude C_nb at the last fix by rows, biases of force and rate, the
velocities' offset in time in its sigmas, the velocity at the first fix; a step (13,) moves it by a
rotation vector and by the rest. `asked` (15,): one sigma of the priors of the first ten of these,
heading (rad) at the last fix, gravity, one sigma (s) of the offset, variances of the white noise of
a velocity gained, by t and by t^3.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.alignment import judge_sensed
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.preintegration import integrate_sensed
from fusiond.navigation.rotation import turn_to_dcm

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BIASES, DELAY, FIRST, GUESS_SIZE = 9, 15, 16, 19
PRIORS, YAW, GRAVITY, DELAY_S, BY_T, ASKED_SIZE = 10, 10, 11, 12, 13, 15
SOUGHT = 13
# Steps of Gauss-Newton at most, and the one, in sigmas, that ends them; how often one is halved,
# and the one that ends them where no part of it is any better, for the valley is bent.
ITERATIONS, CONVERGED, HALVINGS, STALLED = 16, 0.1, 6, 1.0
# The integrals are made anew where the biases found would turn or tilt the axes by more (rad) than
# those that they were made with: half its square is left out, a cm/s of what gravity gains in 20 s,
# and what the slopes by the rate bias have of the force bias (a twelfth for 5 deg).
BENT_RAD = 0.01


@compiled("void(f8[::1], f8[::1], f8[::1])", allocates=True)
def moved(guess: Array, step: Array, there: Array) -> None:
    """Write the guess `there` (19,) that differs from another by a step (13,)."""
    turn = np.empty((3, 3))
    turn_to_dcm(step[0], step[1], step[2], turn)
    for i in range(3):
        for j in range(3):
            there[3 * i + j] = 0.0
            for n in range(3):
                there[3 * i + j] += turn[i, n] * guess[3 * n + j]
    for i in range(SOUGHT - 3):
        there[BIASES + i] = guess[BIASES + i] + step[3 + i]


@compiled(
    "void(f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[:, ::1])",
    allocates=True,
)
def judge_guess(
    t_s: Array,
    means: Array,
    gained: Array,
    turned: Array,
    slopes: Array,
    sensed_biases: Array,
    velocity: Array,
    sd: Array,
    levers: Array,
    asked: Array,
    guess: Array,
    z: Array,
    rows: Array,
) -> None:
    """Write a guess's residuals (3 k + 10,) and their derivatives (3 k + 10, 13), in sigmas.

    The slopes are by the steps of the guess; the rest as of `judge_sensed`."""
    k = t_s.shape[0]
    biases, first = guess[BIASES:DELAY], guess[FIRST:]
    # C_0, since which the axes have turned to C_T.
    turn, since, dcm, dcm_turns = (
        np.empty((3, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
    )
    phi = np.zeros(3)
    for i in range(3):
        for j in range(3):
            phi[i] += slopes[k - 1, i, j] * (biases[3 + j] - sensed_biases[3 + j])
    turn_to_dcm(phi[0], phi[1], phi[2], turn)
    for i in range(3):
        for j in range(3):
            for n in range(3):
                since[i, j] += turn[i, n] * turned[k - 1, n, j]
    for i in range(3):
        for j in range(3):
            for n in range(3):
                dcm[i, j] += guess[3 * i + n] * since[j, n]
    for i in range(3):
        for j in range(3):
            for n in range(3):
                dcm_turns[i, j] += dcm[i, n] * slopes[k - 1, n, j]
    rows[:] = 0.0
    judge_sensed(
        t_s,
        means,
        gained,
        turned,
        slopes,
        sensed_biases,
        velocity,
        sd,
        levers,
        dcm,
        first,
        biases,
        dcm_turns,
        asked[BY_T],
        asked[BY_T + 1],
        asked[GRAVITY],
        guess[DELAY],
        asked[DELAY_S],
        z[: 3 * k].reshape((k, 3)),
        rows[: 3 * k].reshape((k, 3, SOUGHT)),
    )
    yaw_residual = asked[YAW] - math.atan2(guess[3], guess[0])
    yaw_residual = (yaw_residual + math.pi) % (2.0 * math.pi) - math.pi
    z[3 * k], z[3 * k + 1], z[3 * k + 2] = guess[5], -guess[2], yaw_residual
    for i in range(3, PRIORS):
        z[3 * k + i] = -guess[BIASES - 3 + i]
    for i in range(PRIORS):
        z[3 * k + i] /= asked[i]
        rows[3 * k + i, i] = 1.0 / asked[i]


@compiled("b1(f8[:, ::1], f8[::1], f8[::1])", allocates=True)
def least_squares(rows: Array, z: Array, step: Array) -> bool:
    """Write the least-squares solution (13,) of rows (m, 13) @ step = z, by the Cholesky factor of
    the scaled normal equations; True if there is one."""
    n = SOUGHT
    normal, scale = np.zeros((n, n)), np.empty(n)
    step[:] = 0.0
    for k in range(rows.shape[0]):
        for i in range(n):
            a = rows[k, i]
            if a != 0.0:
                step[i] += a * z[k]
                for j in range(i + 1):
                    normal[i, j] += a * rows[k, j]
    for i in range(n):
        if not normal[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(normal[i, i])
        step[i] *= scale[i]
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j] * scale[i] * scale[j]
            for m in range(j):
                total -= normal[i, m] * normal[j, m]
            if i > j:
                normal[i, j] = total / normal[j, j]
            elif total > 0.0:
                normal[i, i] = math.sqrt(total)
            else:
                return False
        for m in range(i):
            step[i] -= normal[i, m] * step[m]
        step[i] /= normal[i, i]
    for i in range(n - 1, -1, -1):
        for m in range(i + 1, n):
            step[i] -= normal[m, i] * step[m]
        step[i] /= normal[i, i]
    for i in range(n):
        step[i] *= scale[i]
    return True


@compiled("b1(f8[::1], f8[::1], f8)")
def _bent(biases: Array, sensed: Array, seconds: float) -> bool:
    """True if the integrals must be computed again for changed biases (6,)."""
    force, rate = 0.0, 0.0
    for j in range(3):
        force = max(force, abs(biases[j] - sensed[j]))
        rate = max(rate, abs(biases[3 + j] - sensed[3 + j]))
    bent: bool = max(rate * seconds, force / STANDARD_GRAVITY_M_S2) > BENT_RAD
    return bent


@compiled(
    "b1(i8[::1], f8[:, ::1], i8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1],"
    " f8[:, :, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1],"
    " f8[:, ::1])",
    allocates=True,
)
def descend(
    times: Indices,
    samples: Array,
    counts: Indices,
    t_s: Array,
    means: Array,
    gained: Array,
    turned: Array,
    slopes: Array,
    sensed_biases: Array,
    velocity: Array,
    sd: Array,
    levers: Array,
    asked: Array,
    guess: Array,
    z: Array,
    rows: Array,
) -> bool:
    """Move a `guess` (19,) to the best fit and write its residuals; True if converged. A step that
    makes the fit worse is halved.

    Of the stretch times (m + 1,) ns, samples (m, 6) and counts (k,), as of `integrate_sensed`; the
    rest as of `judge_guess`."""
    gained, turned, slopes = gained.copy(), turned.copy(), slopes.copy()
    made = sensed_biases.copy()
    gained_there, turned_there, slopes_there = gained.copy(), turned.copy(), slopes.copy()
    made_there, there = made.copy(), guess.copy()
    left, by_steps, step = z.copy(), rows.copy(), np.empty(SOUGHT)
    seconds = t_s[t_s.shape[0] - 1]
    if _bent(guess[BIASES:DELAY], made, seconds):
        for j in range(made.shape[0]):
            made[j] = guess[BIASES + j]
        integrate_sensed(times, samples, made, counts, gained, turned, slopes)
    judge_guess(
        t_s, means, gained, turned, slopes, made, velocity, sd, levers, asked, guess, z, rows
    )
    for _ in range(ITERATIONS):
        if not least_squares(rows, z, step):
            return False
        size, cost = 0.0, 0.0
        for k in range(rows.shape[0]):
            by_step = 0.0
            for j in range(SOUGHT):
                by_step += rows[k, j] * step[j]
            size += by_step * by_step
            cost += z[k] * z[k]
        size = math.sqrt(size)
        converged, taken = size < CONVERGED, False
        for _ in range(HALVINGS):
            moved(guess, step, there)
            rebuilt = _bent(there[BIASES:DELAY], made, seconds)
            if rebuilt:
                a, b, c, taken_off = gained_there, turned_there, slopes_there, made_there
                for j in range(made.shape[0]):
                    taken_off[j] = there[BIASES + j]
                integrate_sensed(times, samples, taken_off, counts, a, b, c)
            else:
                a, b, c, taken_off = gained, turned, slopes, made
            judge_guess(
                t_s,
                means,
                a,
                b,
                c,
                taken_off,
                velocity,
                sd,
                levers,
                asked,
                there,
                left,
                by_steps,
            )
            less = 0.0
            for k in range(left.shape[0]):
                less += left[k] * left[k]
            if converged or less < cost:
                guess[:], z[:], rows[:], taken = there, left, by_steps, True
                if rebuilt:
                    gained, gained_there = gained_there, gained
                    turned, turned_there = turned_there, turned
                    slopes, slopes_there = slopes_there, slopes
                    made, made_there = made_there, made
                break
            for j in range(SOUGHT):
                step[j] *= 0.5
        if not taken:
            stalled: bool = size < STALLED
            return stalled
        if converged:
            return True
    return False
