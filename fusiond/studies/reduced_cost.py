r"""What a step costs in study `reduced-order`, as CPU time.

`step`: the filter's own recursion, as paper 002 times it: the covariance propagated once, then the
epoch's four ranges, four rates and two angles folded in. These are the live filter's kernels, with
its judgement of every range, called from compiled code: no INS, no geometry, no Python.

`live second`: a second of the running filter (`KalmanEstimator`): 100 IMU samples through the
strapdown equations and the covariance, rows computed from satellites and radar point, update.
What does not depend on the number of states is most of it.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from functools import cache
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, State
from fusiond.estimators.covariance import covariance_for, work_size
from fusiond.estimators.model import Model
from fusiond.estimators.screening import screened_update
from fusiond.estimators.update import fuse
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import COEFFICIENTS, WIDTHS, coefficients
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.studies import reduced_flight as flight
from fusiond.studies.reduced_runs import started

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

IMU_RATE_HZ = 100.0
"""The live rate that the system is built for."""
LIVE_S = 30
RECURSIONS = 1000
"""Timed at once: some milliseconds, long against the resolution of the clock."""
ROUNDS = 15

_covariance_narrow, _covariance_middle = (covariance_for(w) for w in WIDTHS[:2])


class Cost(NamedTuple):
    """CPU seconds of a recursion and of a live second."""

    step_s: float
    live_second_s: float


@cache
def _recursions_for(width: int) -> Callable[..., None]:
    """`recursions` for covariances of `width` rows, one of the first two of WIDTHS."""
    narrow = width == WIDTHS[0]

    @compiled(
        "void(i8, f8[:, ::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[:, ::1], f8[:, ::1],"
        "f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
    )
    def recursions(
        count: int,
        cov: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
        ranges: Array,
        range_r: Array,
        angles: Array,
        angle_r: Array,
        cov_out: Array,
        nav: Array,
        xi: Array,
    ) -> None:
        """`count` times: `cov` over h seconds, rows `ranges` (8, n) and `angles` (2, n)."""
        range_z, angle_z = np.zeros(ranges.shape[0]), np.zeros(angles.shape[0])
        range_y, angle_y = np.zeros(ranges.shape[0]), np.zeros(angles.shape[0])
        codes = np.zeros(ranges.shape[0], dtype=np.int64)
        dx, dx_out = np.zeros(xi.shape[0]), np.zeros(xi.shape[0])
        for _ in range(count):
            if narrow:
                _covariance_narrow(
                    cov, step, c, h, active, sensor_terms, rate_terms, noise, 1.0, work
                )
            else:
                _covariance_middle(
                    cov, step, c, h, active, sensor_terms, rate_terms, noise, 1.0, work
                )
            codes[:] = 0
            screened_update(
                cov, dx, range_z, ranges, range_r, math.inf, codes, range_y, cov_out, dx_out
            )
            cov[:] = cov_out
            fuse(nav, xi, cov, dx, angle_z, angles, angle_r, math.inf, False, angle_y)

    return recursions


def _recursion(of: Model) -> Callable[[], float]:
    """A function that times the recursion of a model: CPU seconds of one."""
    nav = flight.true_nav(flight.truth(float(LIVE_S)))[1]
    scene = flight.scenes(float(LIVE_S))[0]
    state = State(nav, np.zeros(of.size), np.zeros(STEP_SIZE), of)
    found = [aid.innovation(state) for aid in flight.aids(scene, np.zeros(flight.ROWS))]
    ranges, angles = (f for f in found if isinstance(f, Innovation))
    step, c = level_step(nav), np.zeros(COEFFICIENTS)
    h = 1.0 / IMU_RATE_HZ
    coefficients(nav, step, h, c)
    kernel, width = _recursions_for(of.width), of.width
    p = np.zeros((width, width))
    p[: of.size, : of.size] = np.diag(flight.initial_sd(of) ** 2)

    def timed() -> float:
        cov, work, out = p.copy(), np.zeros(work_size(width)), np.zeros((width, width))
        xi = np.zeros(of.size)
        start = time.process_time_ns()
        kernel(
            *(RECURSIONS, cov, step, c, h),
            *(of.active, of.sensor_terms, of.rate_terms, of.noise, work),
            *(ranges.h, ranges.r, angles.h, angles.r, out, nav.copy(), xi),
        )
        return (time.process_time_ns() - start) * 1e-9 / RECURSIONS

    return timed


def level_step(nav: Array) -> Array:
    """What a strapdown step (18,) leaves in level flight at a constant velocity, nearly."""
    state = State(nav, np.zeros(0), np.zeros(0), flight.model("ins17"))
    step = np.zeros(STEP_SIZE)
    step[2] = step[8] = -9.8
    step[9:] = state.dcm.ravel()
    return step


def _live_second(of: Model) -> Callable[[], float]:
    """A function that times the running filter: CPU seconds of a second of flight."""
    path = flight.truth(float(LIVE_S), IMU_RATE_HZ)
    nav = flight.true_nav(path)
    buffer = flight.imu_buffer(np.hstack([path.gyro, path.accel]), IMU_RATE_HZ)
    true = State(nav[1], np.zeros(of.size), np.zeros(STEP_SIZE), of)
    given = [
        flight.measured(scene, true._replace(nav=nav[k + 1]), np.zeros(flight.ROWS))
        for k, scene in enumerate(flight.scenes(float(LIVE_S)))
    ]

    def timed() -> float:
        estimator = started(of, nav[0])
        start = time.process_time_ns()
        for aids in given:
            estimator.propagate(buffer, aids[0].t_ns)
            for aid in aids:
                estimator.update(aid)
        return (time.process_time_ns() - start) * 1e-9 / len(given)

    return timed


def costs(models: dict[str, Model], rounds: int = ROUNDS) -> dict[str, Cost]:
    """Medians over `rounds`; the filters take turns, so that a processor which changes its clock
    changes it for all."""
    timed = {name: (_recursion(of), _live_second(of)) for name, of in models.items()}
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    gc.collect()
    for _ in range(rounds + 1):
        for name, (step, second) in timed.items():
            spent[name].append((step(), second()))
    # The first round warms caches.
    return {
        name: Cost(median(a for a, _ in values[1:]), median(b for _, b in values[1:]))
        for name, values in spent.items()
    }


def step_ratio(rounds: int = ROUNDS) -> float:
    """Time of a step of 17 states over that of 23."""
    found = costs({"17": flight.model("ins17"), "23": flight.model("ins23")}, rounds)
    return found["17"].step_s / found["23"].step_s


# Compiled, or loaded from the cache, when this module is imported.
for _width in WIDTHS[:2]:
    _recursions_for(_width)
