"""A drive with GNSS that fails for a while, late RDSS fixes, a wheel and no slip, as one tape.

Errors of the measurements are drawn from the filter's own model: whatever a measurement says of
itself at the true state, with the true parameters, is taken off its innovation, and noise of its
own sigma added. So the parameters of every block may be drawn from their priors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.body_velocity import NonHolonomicConstraint, WheelSpeedMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rdss_position import BIAS_BLOCK, HeldFeedback, RdssPositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.smoothing.backward import Smoothed, Smoother
from fusiond.estimators.smoothing.node import Nodes
from fusiond.estimators.smoothing.node_recorder import NEVER, TapedKalman, nodes_of
from fusiond.models import vehicle_parameter_blocks as vehicle
from fusiond.models.blocks import Block, position_bias
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE
from fusiond.navigator.timeline import Timeline
from fusiond.simulation.imu_truth import Truth
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
SECONDS, OUTAGE_S, RDSS_DELAY_S = 90.0, (35.0, 62.0), 1.5
GATE = 1.0 - 1e-9
SD, SD_V, LEVER, WHEEL, AXLE = (
    (1.5, 1.5, 3.0),
    (0.05, 0.05, 0.1),
    (0.4, -0.3, -1.2),
    (-1.0, 0.7, 0.5),
    (-1.2, 0.0, 0.4),
)
UNKNOWN: tuple[Block, ...] = (
    vehicle.time_offset_block(vehicle.FIX_TIME, 0.1),
    vehicle.time_offset_block(vehicle.VELOCITY_TIME, 0.1),
    vehicle.mounting_block(np.radians(2.0)),
    vehicle.axle_lever_block(0.5),
    vehicle.drift_block(vehicle.SIDE_DRIFT, 0.1, 5.0),
    vehicle.drift_block(vehicle.WHEEL_DRIFT, 0.1, 1.0),
    vehicle.wheel_scale_block(vehicle.WHEEL_SCALE, 0.02),
    position_bias(BIAS_BLOCK, 15.0, 600.0),
)
"""What an owner cannot measure; without it the measurements have white errors alone."""


class Late(NamedTuple):
    """A measurement and when it comes."""

    arrival_s: float
    measurement: AidingMeasurement


class Drawn:
    """A measurement with drawn errors: `offset` (m,) comes off its innovation."""

    def __init__(self, measurement: AidingMeasurement, offset: Array) -> None:
        self._measurement, self._offset = measurement, offset

    def __getattr__(self, name: str) -> Any:
        return getattr(self._measurement, name)

    def at(self, nav: Array) -> Drawn:
        return self

    def candidates(self) -> tuple[()]:
        """Its nominal values are no measurements that anything may be told from."""
        return ()

    def innovation(self, state: State) -> Innovation | NotApplicable:
        rows = self._measurement.innovation(state)
        if isinstance(rows, NotApplicable):
            return rows
        return Innovation(rows.z - self._offset, rows.h, rows.r)


@lru_cache(maxsize=1)
def truth() -> Truth:
    return runs.town_truth(SECONDS, IMU.rate_hz)


@lru_cache(maxsize=2)
def model(unknown: bool) -> Model:
    """ins21, with the vehicle's states if `unknown`."""
    return make_model("ins21", imu_noise(IMU), *(UNKNOWN if unknown else ()))


@lru_cache(maxsize=4)
def nominal_measurements(holding: bool = False) -> tuple[Late, ...]:
    """All that is measured, by nominal values: what a measurement says apart from its place matters
    to its Jacobian alone."""
    lat, lon, height = runs.ORIGIN
    found: list[Late] = []
    for t in np.arange(0.303, SECONDS - 1.0, 1.0):
        if OUTAGE_S[0] <= t < OUTAGE_S[1]:
            continue
        t_ns = round(t * 1e9)
        fix = PositionMeasurement(
            *("gnss", t_ns, GATE, lat, lon, height, SD, LEVER),
            time=vehicle.FIX_TIME,
        )
        v = VelocityMeasurement(
            *(
                "gnss_velocity",
                t_ns,
                GATE,
                (0.0, 0.0, 0.0),
                SD_V,
                LEVER,
                vehicle.VELOCITY_TIME,
            )
        )
        found += [Late(t, fix), Late(t, v)]
    for t in np.arange(3.111, SECONDS - 1.0, 5.0):
        place = ("rdss", round(t * 1e9), GATE, lat, lon, (400.0, 60.0, 300.0), (0.0, 0.0, 0.0))
        found.append(Late(t + RDSS_DELAY_S, RdssPositionMeasurement(*place, holds=holding)))
    for t in np.arange(0.652, SECONDS - 1.0, 0.5):
        names = vehicle.WHEEL_DRIFT, vehicle.WHEEL_SCALE, ""
        wheel = WheelSpeedMeasurement(
            "wheel", round(t * 1e9), GATE, 0.0, 0.1, WHEEL, True, 0.0, *names
        )
        found.append(Late(t, wheel))
    for t in np.arange(1.0, SECONDS - 1.0, 1.0):
        found.append(
            Late(t, NonHolonomicConstraint("slip", round(t * 1e9), GATE, 0.1, 0.2, 2.0, AXLE))
        )
    return tuple(sorted(found, key=lambda late: late.arrival_s))


@lru_cache(maxsize=2)
def _true_states(unknown: bool, holding: bool) -> tuple[tuple[Array, Array], ...]:
    """True navigation state (10,) and last step (27,) at each measurement of `nominal_aids`."""
    without_errors = TapedKalman(model(unknown), IMU.gap_s)
    times = runs.sample_times(truth())
    buffer = runs.filled_buffer(IMU, times, np.hstack([truth().gyro, truth().accel]))
    measurements = nominal_measurements(holding)
    at_s = np.array([late.measurement.t_ns for late in measurements]) * 1e-9
    navs, n = runs.true_nav(truth(), at_s), without_errors.model.size
    start = runs.true_nav(truth(), np.array([0.0]))[0]
    without_errors.initialise(0, 0, start, np.zeros(n), np.zeros((n, n)))
    steps = np.zeros((len(measurements), STEP_SIZE))
    for row in np.argsort(at_s, kind="stable"):
        without_errors.propagate(buffer, measurements[row].measurement.t_ns)
        steps[row] = without_errors.step
    return tuple(zip(navs, steps, strict=True))


def _parameters(m: Model, at_s: Array, rng: np.random.Generator) -> Array:
    """True parameters (k, n) at instants (k,), ascending, each block drawn from its model."""
    rate, white, steady = m.noise
    x, now = m.initial * rng.standard_normal(m.size), 0.0
    found = np.empty((len(at_s), m.size))
    for k, t in enumerate(at_s):
        decay = np.exp(-(t - now) * rate)
        variance = steady * (1.0 - decay**2) + white * (t - now)
        x = decay * x + np.sqrt(variance) * rng.standard_normal(m.size)
        found[k], now = x, t
    return found


@dataclass
class Tape:
    """What a run left: the filter, the nodes of its last pass, and what is smoothed at them."""

    estimator: TapedKalman
    nodes: Nodes
    smoothed: Smoothed

    def at(self, t_s: float) -> tuple[Array, Array, Array]:
        """At the last node before `t_s`: smoothed error (9,), stated covariance (9, 9), and the
        filter's own there."""
        row = int(np.searchsorted(self.nodes.t_ns, round(t_s * 1e9))) - 1
        body, n = self.nodes.bodies[row], self.estimator.model.size
        nav = body[-STEP_SIZE - 1 - NAV_SIZE : -STEP_SIZE - 1]
        true = runs.true_nav(truth(), np.array([self.nodes.t_ns[row] * 1e-9]))[0]
        error = runs.nav_error(nav, true) - self.smoothed.error[row, :9]
        filtered = body[: 9 * n].reshape(9, n)[:, :9]
        return error, self.smoothed.covariance[row, :9, :9], filtered


def run(
    seed: int,
    unknown: bool,
    holding: bool = False,
    in_order: bool = False,
    make: Callable[[Model, float], TapedKalman] = TapedKalman,
) -> Tape:
    """One drive; `in_order`: nothing is late."""
    m, rng = model(unknown), np.random.default_rng([seed, 5])
    late = nominal_measurements(holding)
    order = np.argsort([x.measurement.t_ns for x in late], kind="stable")
    at_s = np.array([late[row].measurement.t_ns for row in order]) * 1e-9
    parameters = dict(zip(order.tolist(), _parameters(m, at_s, rng), strict=True))
    measurements: list[tuple[float, AidingMeasurement]] = []
    for row, (arrival_s, measurement) in enumerate(late):
        nav, step = _true_states(unknown, holding)[row]
        rows = measurement.innovation(State(nav, parameters[row], step, m))
        if isinstance(rows, Innovation):
            noise = np.sqrt(rows.r) * rng.standard_normal(len(rows.r))
            drawn = cast("AidingMeasurement", Drawn(measurement, rows.z + noise))
            measurements.append((measurement.t_ns * 1e-9 if in_order else arrival_s, drawn))
        if measurement.feedback == "hold":
            due = HeldFeedback("rdss_feedback", round(arrival_s * 1e9), GATE)
            measurements.append((arrival_s, due))
    measurements.sort(key=lambda pair: pair[0])
    sd = runs.initial_sd(m, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    start = runs.with_error(
        runs.true_nav(truth(), np.array([0.0]))[0], sd[:9] * rng.standard_normal(9)
    )
    times = runs.sample_times(truth())
    samples = runs.imu_run(IMU, truth(), seed).samples
    estimator = make(m, IMU.gap_s)
    buffer = ImuBuffer(IMU.rate_hz, SECONDS + 10.0, np.eye(3), 0.0, IMU.gap_s)
    timeline = Timeline(estimator, buffer, 15.0, 0.5)
    estimator.initialise(0, 0, start, np.zeros(m.size), np.diag(sd**2))
    timeline.start()
    given = 0
    for second in range(int(SECONDS)):
        rows_now = slice(round(second * IMU.rate_hz), round((second + 1) * IMU.rate_hz))
        buffer.append(times[rows_now], samples[rows_now])
        while given < len(measurements) and measurements[given][0] <= second + 1.0:
            timeline.insert(measurements[given][1])
            given += 1
        timeline.advance()
    outcomes = timeline.counters.outcomes
    unused = ("gated", "isolated", "too_old")
    assert not any(counts[name] for counts in outcomes.values() for name in unused), outcomes
    assert timeline.counters.rewinds or in_order
    newest = estimator.newest
    assert newest is not None
    nodes, _ = nodes_of(newest, None, NEVER)
    return Tape(estimator, nodes, Smoother(m, estimator.published).back(nodes))
