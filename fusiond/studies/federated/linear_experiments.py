r"""Experiments 1 to 3 of paper 004 as linear problems, as far as the paper defines them.

1  x a random walk, measured with noise: does the filter follow it?
2  x constant, measured with noise: does the filter converge? Its sigma is s / sqrt(k).
3  position and velocity, two sensors of the position, a Kalman filter each, and their fusion:

    x_k = F x_k-1 + w,   F = [[1, T], [0, 1]],   cov(w) = q [[T^3/3, T^2/2], [T^2/2, T]]
    z_i = [1, 0] x + v_i,   var(v_i) = s_i^2

The two filters of experiment 3 share w, so their errors are correlated:

    P_12 <- (I - K_1 H) (F P_12 F^T + Q) (I - K_2 H)^T

The formula for uncorrelated estimates is then optimistic, the one for correlated estimates right,
and a federated filter (Q / beta in each local filter) needs no cross-covariance. The centralised
filter takes both sensors. NEES has 2 degrees of freedom.

Source: paper 004, sections 2 and 3; the numbers are ours, the paper prints none.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.federated.fusion import fuse_correlated, fuse_uncorrelated
from fusiond.studies.monte_carlo import nees_interval

Array = NDArray[np.float64]

STEPS = 200
WALK_SD, NOISE_SD = 1.0, 5.0
SENSORS_SD = (5.0, 8.0)
PERIOD_S, ACCELERATION = 1.0, 0.25
"""Density q (m^2/s^3): a random walk of velocity by 0.5 m/s in a second."""
SETTLED = 50
"""Number of steps before figures count."""
H = np.array([[1.0, 0.0]])
F = np.array([[1.0, PERIOD_S], [0.0, 1.0]])
Q = ACCELERATION * np.array([[PERIOD_S**3 / 3.0, PERIOD_S**2 / 2.0], [PERIOD_S**2 / 2.0, PERIOD_S]])
START_P = np.diag([100.0, 25.0])


class _Local(NamedTuple):
    """Estimates (runs, 2), covariance and the last I - K H (2, 2)."""

    x: Array
    p: Array
    left: Array


def _scalar(truth: Array, noise: Array, q: float) -> tuple[Array, Array]:
    """Estimates (runs, steps) of a scalar with walk variance q, and their sigma (steps,)."""
    x, p = np.zeros_like(noise[:, 0]), 1e6
    estimates, sigmas = np.empty_like(noise), np.empty(noise.shape[1])
    for k in range(noise.shape[1]):
        p += q
        gain = p / (p + NOISE_SD**2)
        x = x + gain * (truth[:, k] + noise[:, k] - x)
        p *= 1.0 - gain
        estimates[:, k], sigmas[k] = x, math.sqrt(p)
    return estimates, sigmas


def random_truth(runs: int, seed: int) -> dict[str, Any]:
    """Experiment 1: RMS of measurement and estimate (m), and the filter's own sigma."""
    rng = np.random.default_rng([seed, 1])
    truth = np.cumsum(rng.standard_normal((runs, STEPS)) * WALK_SD, axis=1)
    noise = rng.standard_normal((runs, STEPS)) * NOISE_SD
    estimates, sigmas = _scalar(truth, noise, WALK_SD**2)
    error = (estimates - truth)[:, SETTLED:]
    return {
        "measured_rms_m": float(np.sqrt(np.mean(noise[:, SETTLED:] ** 2))),
        "filtered_rms_m": float(np.sqrt(np.mean(error**2))),
        "filter_sigma_m": float(sigmas[-1]),
        "steps": STEPS,
        "series": {
            "truth": truth[0].tolist(),
            "measured": (truth + noise)[0].tolist(),
            "filtered": estimates[0].tolist(),
        },
    }


def constant_truth(runs: int, seed: int) -> dict[str, Any]:
    """Experiment 2: RMS (m) after 1, 10, 100 steps and s / sqrt(k)."""
    rng = np.random.default_rng([seed, 2])
    truth = np.repeat(rng.standard_normal((runs, 1)) * 100.0, STEPS, axis=1)
    noise = rng.standard_normal((runs, STEPS)) * NOISE_SD
    estimates, _ = _scalar(truth, noise, 0.0)
    rms = np.sqrt(np.mean((estimates - truth) ** 2, axis=0))
    after = (1, 10, 100)
    return {
        "after_steps": list(after),
        "rms_m": [float(rms[k - 1]) for k in after],
        "theory_m": [NOISE_SD / math.sqrt(k) for k in after],
        "series": {
            "truth": truth[0].tolist(),
            "measured": (truth + noise)[0].tolist(),
            "filtered": estimates[0].tolist(),
        },
    }


def _predict(x: Array, p: Array, share: float) -> tuple[Array, Array]:
    return x @ F.T, F @ p @ F.T + Q / share


def _update(x: Array, p: Array, z: Array, sd: float) -> _Local:
    gain = p @ H.T / (H @ p @ H.T + sd * sd)
    left = np.eye(2) - gain @ H
    new = left @ p @ left.T + gain @ gain.T * sd * sd
    return _Local(x + (z - x @ H.T) @ gain.T, new, left)


def two_sensors(runs: int, seed: int) -> dict[str, Any]:
    """Experiment 3: RMS of the position, stated sigma and NEES, by kind of fusion."""
    rng = np.random.default_rng([seed, 3])
    root_q, root_p = np.linalg.cholesky(Q), np.linalg.cholesky(START_P)
    truth = rng.standard_normal((runs, 2)) @ root_p.T
    # Full process noise and start in each local filter; half of the information each; one filter.
    alone = [_Local(np.zeros((runs, 2)), START_P.copy(), np.eye(2)) for _ in SENSORS_SD]
    shared = [_Local(np.zeros((runs, 2)), 2.0 * START_P, np.eye(2)) for _ in SENSORS_SD]
    both = _Local(np.zeros((runs, 2)), START_P.copy(), np.eye(2))
    p_12 = START_P.copy()
    names = ("sensor_1", "sensor_2", "uncorrelated", "correlated", "federated", "centralised")
    sums = {name: np.zeros(3) for name in names}
    for k in range(STEPS):
        truth = truth @ F.T + rng.standard_normal((runs, 2)) @ root_q.T
        z = [truth[:, :1] + rng.standard_normal((runs, 1)) * sd for sd in SENSORS_SD]
        alone = [
            _update(*_predict(f.x, f.p, 1.0), z[i], SENSORS_SD[i]) for i, f in enumerate(alone)
        ]
        shared = [
            _update(*_predict(f.x, f.p, 0.5), z[i], SENSORS_SD[i]) for i, f in enumerate(shared)
        ]
        both = _update(*_predict(both.x, both.p, 1.0), z[0], SENSORS_SD[0])
        both = _update(both.x, both.p, z[1], SENSORS_SD[1])
        p_12 = alone[0].left @ (F @ p_12 @ F.T + Q) @ alone[1].left.T
        if k < SETTLED:
            continue
        first, second = alone
        for name, (x, p) in {
            "sensor_1": (first.x, first.p),
            "sensor_2": (second.x, second.p),
            "uncorrelated": _each(first, second, None),
            "correlated": _each(first, second, p_12),
            "federated": _each(shared[0], shared[1], None),
            "centralised": (both.x, both.p),
        }.items():
            error = x - truth
            nees = np.einsum("ri,ij,rj->r", error, np.linalg.inv(p), error)
            sums[name] += [np.mean(error[:, 0] ** 2), p[0, 0], np.mean(nees)]
    counted = STEPS - SETTLED
    return {
        "estimates": {
            name: {
                "rms_m": math.sqrt(s[0] / counted),
                "sigma_m": math.sqrt(s[1] / counted),
                "nees_mean": float(s[2] / counted),
            }
            for name, s in sums.items()
        },
        "nees_dof": 2,
        "nees_interval": nees_interval(runs, 2),
    }


def _each(first: _Local, second: _Local, p_12: Array | None) -> tuple[Array, Array]:
    """Fused estimates (runs, 2) and their covariance; the weights are the same in all runs."""
    if p_12 is None:

        def fuse(a: Array, b: Array) -> tuple[Array, Array]:
            return fuse_uncorrelated(np.array([a, b]), np.array([first.p, second.p]))
    else:

        def fuse(a: Array, b: Array) -> tuple[Array, Array]:
            return fuse_correlated(a, first.p, b, second.p, p_12)

    # Linear in the estimates: the columns of the two weights are what unit estimates give.
    unit, zero = np.eye(2), np.zeros(2)
    w_1 = np.array([fuse(u, zero)[0] for u in unit]).T
    w_2 = np.array([fuse(zero, u)[0] for u in unit]).T
    return first.x @ w_1.T + second.x @ w_2.T, fuse(zero, zero)[1]
