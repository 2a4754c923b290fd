r"""Set-up of paper 003: state vector (`ins20`), clock model, path, filter.

It prints: 500 s; from the origin to 200 m west and 40 m up (figure 1); states phi, dv, dr, gyro
constant and Markov drift, accelerometer Markov bias, clock offset and first-order Markov drift;
pseudorange and rate of the visible BeiDou satellites; unscented filter; errors of position and
velocity before and after filtering (figure 4, without legible values). The paper prints neither
noise figures nor the shape of the path. Taken here: it winds 40 deg to both sides of west in
between rests of 20 s; an inertial unit of the 1 deg/h class as in `config/tactical.toml`, its 1 mg
of accelerometer bias all Markov; the sky, receiver and clock of the study's case `open`.

Rows: `ins_alone` is what the inertial unit makes of the start, which is "before filtering" in
attitude; `receiver` each epoch's least squares, which is that in position and velocity; `tight_ukf`
the paper's filter; `tight_ekf` the same extended; `walk` as that with the random walk of a clock's
drift that is the daemon's default.

Figures are over runs and epochs from `COUNTED_S` on: root mean square of position and velocity,
horizontal and vertical, and of tilt and heading; NEES of all nine a degree. `gains`: the row before
over `tight_ukf`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from fusiond.gnss.orbit import WEEK_S
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigator.intake import Intake
from fusiond.simulation.gnss.raw import START, GnssRaw
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Path, Profile
from fusiond.studies.bds_tight.runs import COUNTED_S, OPTIONS, START_SD, Receiver, broadcast, epochs
from fusiond.studies.daemon_fed_filter import DURATION_S, ORIGIN_DEG_M, RATE_HZ, DaemonFedFilter
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error

Array = NDArray[np.float64]

WEST_M, UP_M = 200.0, 40.0
REST_S, RAMP_S, TURN_S, WINDING_DEG = 20.0, 20.0, 40.0, 40.0
SPEED_M_S, CLIMB_DEG = 0.525688, 10.05798
"""Speed and climb of a path that ends 200.0 m west and 40.0 m up, 3.4 m north."""
IMU = Imu(
    rate_hz=RATE_HZ,
    gyro_noise_deg_sqrt_h=0.05,
    accel_noise_m_s_sqrt_h=0.02,
    gyro_bias_initial_deg_h=1.0,
    gyro_bias_instability_deg_h=1.0,
    accel_bias_initial_mg=1e-9,
    accel_bias_instability_mg=1.0,
    gyro_scale_ppm=1e-6,
    accel_scale_ppm=1e-6,
)
TAU_S = OPTIONS.clock_drift_correlation_s
WALK = RawAiding(systems=("C",))
MARKOV = WALK.model_copy(update={"clock_drift_tau_s": TAU_S})
CLOCK = replace(OPTIONS, lever_arm_m=(0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class _Row:
    make: Callable[[Model, float], KalmanEstimator]
    aiding: RawAiding
    aided: bool = True


FILTERS = {
    "ins_alone": _Row(KalmanEstimator, MARKOV, aided=False),
    "tight_ukf": _Row(UnscentedEstimator, MARKOV),
    "tight_ekf": _Row(KalmanEstimator, MARKOV),
    "walk": _Row(KalmanEstimator, WALK),
}
BEFORE = {
    "position": "receiver",
    "height": "receiver",
    "velocity": "receiver",
    "climb": "receiver",
    "tilt": "ins_alone",
    "heading": "ins_alone",
}
"""Labels of each quantity "before filtering"."""
COLUMNS = {
    "position m": "position",
    "height m": "height",
    "velocity m/s": "velocity",
    "climb m/s": "climb",
    "tilt deg": "tilt",
    "heading deg": "heading",
    "NEES a degree": "nees_per_dof",
}


def true_path() -> Path:
    """Winding path from the origin to 200 m west and 40 m up."""
    end = DURATION_S - REST_S - RAMP_S
    begin = REST_S + RAMP_S
    turns = np.arange(begin, end, TURN_S)
    sides = [0.0, *(WINDING_DEG * (1.0 if k % 2 else -1.0) for k in range(1, len(turns))), 0.0]
    course = [(270.0 + side) * DEG for side in sides]
    climb = CLIMB_DEG * DEG
    return Path(
        Profile([REST_S, begin, end, end + RAMP_S], [0.0, SPEED_M_S, SPEED_M_S, 0.0]),
        Profile([*turns.tolist(), end], course),
        Profile([REST_S, begin, end, end + RAMP_S], [0.0, climb, climb, 0.0]),
    )


@lru_cache(maxsize=1)
def truth() -> Truth:
    """Truth of that path, sampled at the IMU's rate."""
    lat, lon, height = ORIGIN_DEG_M
    return Truth(true_path(), (lat * DEG, lon * DEG, height), RATE_HZ, DURATION_S)


@dataclass(slots=True)
class Trace:
    """Trace of a row of one run, by epoch: errors (n, 9) phi, dv, dr north, east, down (NaN without
    a solution), and their NEES (n,), NaN for rows that are not filters."""

    error: Array
    nees: Array


def simulate(seed: int, number: int) -> dict[str, Trace]:
    """Run `number`: all rows with the same IMU, observations and start."""
    rng = np.random.default_rng([seed, number, 3])
    out = imu_output(IMU, truth().gyro, truth().accel, rng)
    samples, unit = np.hstack([out.gyro, out.accel]), rng.standard_normal(9)
    start = START[0], START[1] + rng.uniform(0.0, WEEK_S - DURATION_S)
    simulated = GnssRaw(truth(), CLOCK, rng, start)
    observed = [simulated.epoch(k) for k in range(len(simulated))]
    t_s = epochs()
    nav = true_nav(truth(), np.r_[0.0, t_s])
    traces = {"receiver": Trace(np.full((len(t_s), 9), np.nan), np.full(len(t_s), np.nan))}
    receiver = Receiver(simulated)
    for k, epoch in enumerate(observed):
        found = receiver.solve(epoch)
        if found is None:
            continue
        place = np.array(to_ecef(*(float(x) for x in nav[k + 1, :3])))
        lat, lon, _ = to_geodetic(*(float(v) for v in place))
        axes = ned_axes(lat, lon)
        traces["receiver"].error[k, 6:] = axes.T @ (found.position - place)
        if found.velocity is not None:
            traces["receiver"].error[k, 3:6] = axes.T @ found.velocity - nav[k + 1, 3:6]
    for name, row in FILTERS.items():
        intake = Intake({"raw": row.aiding})
        model = make_model("ins20", imu_noise(IMU), *intake.extra_blocks())
        horizontal, height, velocity, tilt, heading = START_SD
        sd = model.initial.copy()
        sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[horizontal] * 2, height]
        started = with_error(nav[0], unit * sd[:9])
        live = DaemonFedFilter(row.make(model, IMU.gap_s), IMU.gap_s, samples, started, sd)
        raw = intake.receivers["raw"]
        for message in broadcast(simulated):
            raw.learn(message)
        trace = Trace(np.empty((len(t_s), 9)), np.empty(len(t_s)))
        for k, t in enumerate(t_s):
            live.advance(t)
            measurements: list[AidingMeasurement] = (
                [raw.measurement(observed[k], round(t * 1e9))] if row.aided else []
            )
            live.advance(t, measurements)
            x, p = nav_error(live.estimator.nav, nav[k + 1]), live.estimator.covariance[:9, :9]
            scale = np.sqrt(np.diag(p))
            trace.error[k] = x
            trace.nees[k] = x / scale @ np.linalg.solve(p / np.outer(scale, scale), x / scale)
        traces[name] = trace
    return traces


def paper_figures(
    runs: int, seed: int, progress: Callable[[], None] | None = None
) -> dict[str, Any]:
    """Figures of each row, gains, and the course of run 0 for the pictures."""
    results = map_runs(partial(simulate, seed), runs, progress)
    counted = epochs() >= COUNTED_S
    rows = {name: _figures([r[name] for r in results], counted) for name in results[0]}
    t_s = epochs()
    at = truth().at(t_s)
    _, east, down = _metres(at.position).T
    return {
        "model": "ins20",
        "west_m": float(-east[-1]),
        "up_m": float(-down[-1]),
        "drift_tau_s": TAU_S,
        "rows": rows,
        "gains": {
            quantity: rows[before][quantity] / rows["tight_ukf"][quantity]
            for quantity, before in BEFORE.items()
        },
        "series": {
            "t_s": t_s.tolist(),
            "east_m": east.tolist(),
            "up_m": (-down).tolist(),
            "v_enu_m_s": (at.v_ned[:, [1, 0, 2]] * [1.0, 1.0, -1.0]).T.tolist(),
            "rms": {name: _course([r[name] for r in results]) for name in results[0]},
        },
    }


def _metres(position: Array) -> Array:
    start = truth().at(np.zeros(1)).position[0]
    return np.asarray((position - start) * metres_per_unit(float(start[0]), float(start[2])))


def _figures(traces: Sequence[Trace], counted: NDArray[np.bool_]) -> dict[str, Any]:
    error = np.concatenate([t.error[counted] for t in traces])
    nees = np.concatenate([t.nees[counted] for t in traces])
    filtered = bool(np.isfinite(nees).any())
    attitude = error[:, :3] / DEG
    return {
        "position": _rms(error[:, 6:8]),
        "height": _rms(error[:, 8:9]),
        "velocity": _rms(error[:, 3:5]),
        "climb": _rms(error[:, 5:6]),
        "tilt": _rms(attitude[:, :2]) if filtered else None,
        "heading": _rms(attitude[:, 2:3]) if filtered else None,
        "nees_per_dof": float(np.nanmean(nees)) / 9.0 if filtered else None,
    }


def _rms(errors: Array) -> float:
    """RMS length of the finite vectors (n, k)."""
    return math.sqrt(float(np.nanmean(np.square(errors).sum(axis=1))))


def _course(traces: Sequence[Trace]) -> dict[str, list[float | None]]:
    """RMS over the runs of position, velocity and heading at each epoch."""
    error = np.array([t.error for t in traces])
    parts = {"position m": slice(6, 9), "velocity m/s": slice(3, 6), "heading deg": slice(2, 3)}
    out: dict[str, list[float | None]] = {}
    for name, part in parts.items():
        scale = DEG if name.startswith("heading") else 1.0
        size = np.square(error[..., part]).sum(axis=2)
        there = np.isfinite(size)
        total = np.where(there, size, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        values = np.sqrt(total) / scale
        seen = there.any(axis=0)
        out[name] = [float(v) if s else None for v, s in zip(values, seen, strict=True)]
    return out


def draw(panels: Any, series: dict[str, Any]) -> None:
    """Draw figures 1, 2 and 4 of the paper on `panels` (3, 2): path, velocities, errors before and
    after filtering."""
    first, second, *others = panels.ravel()
    first.plot(series["east_m"], series["up_m"])
    first.set_title("figure 1: the way", loc="left")
    first.set_xlabel("east, m")
    first.set_ylabel("up, m")
    for axis, values in zip(("east", "north", "up"), series["v_enu_m_s"], strict=True):
        second.plot(series["t_s"], values, label=axis)
    second.set_title("figure 2: velocity", loc="left")
    second.set_ylabel("velocity, m/s")
    second.legend(fontsize="small")
    for panel, quantity in zip(others, ("position m", "velocity m/s", "heading deg"), strict=False):
        for name in ("ins_alone", "receiver", "tight_ukf"):
            values = np.array(series["rms"][name][quantity], dtype=np.float64)
            panel.plot(series["t_s"], values, label=name.replace("_", " "))
        panel.set_yscale("log")
        what, unit = quantity.split()
        panel.set_title(f"figure 4: RMS of the {what}, before and after fusion", loc="left")
        panel.set_ylabel(f"{what}, {unit}")
        panel.legend(fontsize="small")
    others[-1].set_visible(False)
    for panel in (second, *others):
        panel.set_xlabel("s")
    for panel in panels.ravel():
        panel.grid(alpha=0.3)
