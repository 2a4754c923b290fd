r"""Cost of a step in studies `reduced-order` and `ins-gnss-sar`, as CPU time.

`step`: the filter's own recursion, as paper 002 times it: the covariance propagated once, then the
epoch's ranges, rates (of four satellites or of all in view) and two angles gated, folded in and fed
back. These are the live filter's kernels, called from compiled code: no INS, no geometry, no
Python, and no judgement of single ranges (`fusiond.estimators.update_with_exclusion`), which the
paper's filter does not have.

`live second`: a second of the running filter (`KalmanEstimator`): 100 IMU samples through the
strapdown equations and the covariance, rows computed from satellites and radar point, every range
judged, update. What does not depend on the number of states is most of it.
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

from fusiond.aiding.base import State
from fusiond.estimators.covariance_propagation import covariance_for, mirror, work_size
from fusiond.estimators.update import fuse
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import COEFFICIENTS, WIDTHS, coefficients
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.studies.reduced_order import flight
from fusiond.studies.reduced_order.runs import started_filter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

IMU_RATE_HZ = 100.0
"""IMU rate (Hz) for which the system is built."""
LIVE_S = 30
RECURSIONS = 1000
"""Timed at once: some milliseconds, long against the resolution of the clock."""
ROUNDS = 45


class Cost(NamedTuple):
    """CPU seconds of a recursion and of a live second."""

    step_s: float
    live_second_s: float


@cache
def _recursions_for(width: int) -> Callable[..., None]:
    """`recursions` for covariances of `width` rows."""
    propagate_covariance = covariance_for(width)

    @compiled(
        "void(i8, f8[:, ::1], f8[::1], f8[::1], f8, b1[::1], i8[::1], i8[::1], f8[::1], f8[::1],"
        "f8[:, ::1], f8[::1], f8[::1], f8[::1])",
        variant=width,
        allocates=True,
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
        rows: Array,
        r: Array,
        nav: Array,
        xi: Array,
    ) -> None:
        """Repeat `count` times: propagate `cov` over h seconds, then update by `rows` (m, n) with
        variances `r` (m,)."""
        z, y, dx = np.zeros(r.shape[0]), np.zeros(r.shape[0]), np.zeros(xi.shape[0])
        g = np.empty((r.shape[0], width))
        flat = cov.reshape(width * width)
        terms = (active, sensor_terms, rate_terms, noise, 1.0, work)
        for _ in range(count):
            propagate_covariance(flat, step, c, h, *terms)
            mirror(flat, width, xi.shape[0])
            fuse(nav, xi, cov, dx, z, rows, r, math.inf, False, y, g)

    return recursions


def _recursion(of: Model, all_in_view: bool = False) -> Callable[[], float]:
    """Function that measures the CPU time of one recursion of a model."""
    nav = flight.true_nav(flight.truth(float(LIVE_S)))[1]
    scene = flight.scenes(float(LIVE_S), all_in_view)[0]
    state = State(nav, np.zeros(of.size), np.zeros(STEP_SIZE), of)
    _, rows, r = flight.rows(flight.measurements(scene, np.zeros(scene.rows)), state)
    step, c = level_step(nav), np.zeros(COEFFICIENTS)
    h = 1.0 / IMU_RATE_HZ
    coefficients(nav, step, h, c)
    kernel, width = _recursions_for(of.width), of.width
    p = np.zeros((width, width))
    p[: of.size, : of.size] = np.diag(flight.initial_sd(of) ** 2)

    def timed() -> float:
        cov, work, xi = p.copy(), np.zeros(work_size(width)), np.zeros(of.size)
        start = time.process_time_ns()
        kernel(
            *(RECURSIONS, cov, step, c, h),
            *(of.active, of.sensor_terms.ravel(), of.rate_terms.ravel(), of.noise.ravel(), work),
            *(rows, r, nav.copy(), xi),
        )
        return (time.process_time_ns() - start) * 1e-9 / RECURSIONS

    return timed


def level_step(nav: Array) -> Array:
    """Strapdown step (28,) in level flight at a constant velocity, nearly."""
    state = State(nav, np.zeros(0), np.zeros(0), flight.model("ins17"))
    step = np.zeros(STEP_SIZE)
    step[2] = step[8] = -9.8
    step[9:18] = state.dcm.ravel()
    return step


def _live_second(of: Model, all_in_view: bool) -> Callable[[], float]:
    """Function that measures the CPU time of the running filter for a second of flight."""
    path = flight.truth(float(LIVE_S), IMU_RATE_HZ)
    nav = flight.true_nav(path)
    buffer = flight.imu_buffer(np.hstack([path.gyro, path.accel]), IMU_RATE_HZ)
    true = State(nav[1], np.zeros(of.size), np.zeros(STEP_SIZE), of)
    given = [
        flight.measured(scene, true._replace(nav=nav[k + 1]), np.zeros(scene.rows))
        for k, scene in enumerate(flight.scenes(float(LIVE_S), all_in_view))
    ]

    def timed() -> float:
        estimator = started_filter(of, nav[0])
        start = time.process_time_ns()
        for measurements in given:
            estimator.propagate(buffer, measurements[0].t_ns)
            for measurement in measurements:
                estimator.update(measurement)
        return (time.process_time_ns() - start) * 1e-9 / len(given)

    return timed


def costs(
    models: dict[str, Model], rounds: int = ROUNDS, all_in_view: bool = False
) -> dict[str, Cost]:
    """Medians over `rounds` of recursions, then over a third as many of live seconds.

    The filters take turns, so that a changing processor clock affects all of them.
    """
    recursions = {name: _recursion(of, all_in_view) for name, of in models.items()}
    live = {name: _live_second(of, all_in_view) for name, of in models.items()}
    steps, seconds = _in_turn(recursions, rounds), _in_turn(live, -(-rounds // 3))
    return {name: Cost(steps[name], seconds[name]) for name in models}


def step_ratio(rounds: int = ROUNDS) -> float:
    """Time of a step of 17 states over that of 23."""
    models = {"17": flight.model("ins17"), "23": flight.model("ins23")}
    steps = _in_turn({name: _recursion(of) for name, of in models.items()}, rounds)
    return steps["17"] / steps["23"]


def _in_turn(timed: dict[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    spent: dict[str, list[float]] = {name: [] for name in timed}
    gc.collect()
    for _ in range(rounds + 1):
        for name, once in timed.items():
            spent[name].append(once())
    return {name: median(values[1:]) for name, values in spent.items()}  # the first warms caches


# Compiled, or loaded from the cache, when this module is imported.
for _width in WIDTHS[:2]:
    _recursions_for(_width)
