r"""Monte Carlo runs of tight BeiDou/INS coupling (paper 003): simulation and filters.

A drive of 500 s under the BeiDou-3 sky of a week's instant that is drawn for each run. The
simulated receiver (`fusiond.simulation.gnss.raw`) observes B1I pseudoranges and rates once a
second, with receiver clock, atmosphere, multipath, orbit errors and its own noise. From the same
IMU, observations and start every row of a case makes its own solution:

`tight_ekf`, `tight_ukf`   the daemon's raw measurement in its filters `kalman` and `unscented`
`tight_scaled`  `tight_ekf` with `sigma_scale = 2`: twice the sigma of every range and rate
`loose`      `kalman`, aided by position and velocity of the receiver's fix as the daemon takes
             them, with states for the error that fixes share (`bias_sd_m` as the raw measurement
             has)
`loose_white`  the same without those states, as is the daemon's default
`coasting`   `tight_ekf` without any observation in the stretch
`receiver`   least squares of each epoch alone (`fusiond.gnss.single_point`)

In `canyon2` to `canyon4` 2, 3 or 4 satellites are left from `STRETCH_S[0]` to `STRETCH_S[1]`: those
that the houses along the street hide least, with twice the multipath of the open.

    NEES = e^T P^-1 e,   e (3,) position error n, e, d (m), P (3, 3) as stated: 3 degrees of
    freedom for every row, the receiver's too; of the filters also e (9,) with attitude and velocity

The filter has what the daemon has by default: variances of `fusiond.gnss.ranges`, a displacement
shared by the ranges, a clock drift that walks randomly. The simulated drift is the paper's
first-order Markov process.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import MonotonicStamp, PositionFix
from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import GnssAiding, RawAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from fusiond.gnss.nominal_constellation import slots
from fusiond.gnss.orbit import WEEK_S
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigator.intake import Intake
from fusiond.simulation.gnss.masks import canyon
from fusiond.simulation.gnss.raw import START, GnssRaw, GnssRawOptions
from fusiond.studies.daemon_fed_filter import (
    DURATION_S,
    RATE_HZ,
    DaemonFedFilter,
    drive_samples,
    drive_truth,
)
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

Array = NDArray[np.float64]

IMU = Imu(rate_hz=RATE_HZ, gyro_scale_ppm=1e-6, accel_scale_ppm=1e-6)
"""IMU of a car, as in `config/vehicle.toml`: MEMS, 10 deg/h and 0.1 mg, 0.3 deg/sqrt(h), 0.1
m/s/sqrt(h). Without errors of scale, which the model `ins15` does not have. Paper 003 prints no
figures."""
LEVER = (0.4, -0.3, -1.2)
STRETCH_S = (200.0, 400.0)
"""Open sky before the stretch, long enough to estimate the IMU's biases, and after it for the
recovery."""
COUNTED_S = 30.0
"""Time from which errors count: the vehicle moves off after 20 s, and its velocity has found the
heading by then."""
CASES: dict[str, int | None] = {"open": None, "canyon2": 2, "canyon3": 3, "canyon4": 4}
START_SD = (10.0, 15.0, 0.2, 0.2, 2.0)
"""One sigma of the start: horizontal position and height (m) of a first fix, velocity (m/s), tilt
and heading (deg) of levelling and a compass."""
RAW = RawAiding(systems=("C",), lever_arm_m=LEVER)
LOOSE = GnssAiding(lever_arm_m=LEVER, bias_sd_m=RAW.bias_sd_m, bias_down_sd_m=RAW.bias_down_sd_m)
ORBIT_ERRORS_M = (0.6, 0.3, 0.0)
"""Errors of orbits and clocks: those published of BeiDou-3 (fusiond.gnss.signal_choice) for the
cases; half of them and none, to explain the NEES."""
OPTIONS = GnssRawOptions(
    rate_hz=1.0,
    signals=(("C", "2I"),),
    lever_arm_m=LEVER,
    signal_in_space_sd_m=ORBIT_ERRORS_M[0],
    clock_drift_constant_sd_m_s=0.0,
    clock_drift_sd_m_s=RAW.clock_drift_m_s_sqrt_s * math.sqrt(0.5 * 300.0),
    clock_drift_correlation_s=300.0,
    clock_noise_m_sqrt_s=RAW.clock_phase_m_sqrt_s,
)
"""Options of the simulation. Orbit and clock errors match the filter's assumption. The receiver
clock's drift is paper 003's first-order Markov process, for which it prints no figures: q = 2
sigma^2 / tau is the density of the daemon's default random walk (a temperature-compensated
crystal), so that for less than 300 s the filter's clock is the simulated one. All else is the
simulator's default."""
MOST_PDOP = 25.0
"""Largest PDOP of a valid fix, as in receivers' output masks; chosen for this study."""
ROWS = ("tight_ekf", "tight_ukf", "tight_scaled", "loose", "loose_white", "receiver", "coasting")
COMPARED = ("tight_ekf", "loose", "loose_white", "receiver")
"""Rows of the smaller orbit errors."""


@dataclass(slots=True)
class Trace:
    """A row of a case in one run, at each epoch: position error (n, 3) n, e, d in m, stated
    horizontal sigma (n,) sqrt(P_nn + P_ee) in m, NEES (n,) of the position and, of filters, of all
    nine navigation errors. NaN where there is no solution."""

    error: Array
    sigma: Array
    nees: Array
    nav_nees: Array


@dataclass(slots=True)
class CaseRun:
    """Run of a case: its rows, the number of visible satellites (n,) and the PDOP (n,) of the
    least-squares solution, NaN without one."""

    traces: dict[str, Trace]
    satellites: Array
    pdop: Array


@dataclass(frozen=True, slots=True)
class _Row:
    """Input of a filter row."""

    make: Callable[[Model, float], KalmanEstimator]
    aiding: RawAiding | GnssAiding
    coasts: bool = False


_FILTERS = {
    "tight_ekf": _Row(KalmanEstimator, RAW),
    "tight_ukf": _Row(UnscentedEstimator, RAW),
    "tight_scaled": _Row(KalmanEstimator, RAW.model_copy(update={"sigma_scale": 2.0})),
    "loose": _Row(KalmanEstimator, LOOSE),
    "loose_white": _Row(KalmanEstimator, LOOSE.model_copy(update={"bias_sd_m": 0.0})),
    "coasting": _Row(KalmanEstimator, RAW, coasts=True),
}


def epochs() -> Array:
    """Instants (n,), s."""
    return np.arange(1, int(DURATION_S * OPTIONS.rate_hz) + 1, dtype=np.float64) / OPTIONS.rate_hz


def in_stretch(t_s: Array) -> NDArray[np.bool_]:
    """Mask of instants in the stretch: from its start until before its end, as sky masks apply."""
    return (t_s >= STRETCH_S[0]) & (t_s < STRETCH_S[1])


@lru_cache(maxsize=1)
def _true_states() -> tuple[Array, Array]:
    """Navigation states (n + 1, 10) at 0 and each epoch, and the antenna's ECEF position (n + 1,
    3)."""
    t_s = np.r_[0.0, epochs()]
    antenna = drive_truth().at(t_s, LEVER)
    place = np.array([to_ecef(*map(float, p)) for p in antenna.position])
    return true_nav(drive_truth(), t_s), place


def observe(
    case: str, seed: int, number: int, orbit_error_m: float = ORBIT_ERRORS_M[0]
) -> tuple[GnssRaw, list[RawGnssEpoch]]:
    """Simulated observations of a run of a case; the errors are the same in every case."""
    rng = np.random.default_rng([seed, number, 1])
    satellites, (first_s, last_s) = CASES[case], STRETCH_S
    masks = () if satellites is None else (canyon(satellites, first_s, last_s - first_s),)
    start = START[0], START[1] + rng.uniform(0.0, WEEK_S - DURATION_S)
    options = replace(OPTIONS, masks=masks, signal_in_space_sd_m=orbit_error_m)
    simulated = GnssRaw(drive_truth(), options, rng, start)
    return simulated, [simulated.epoch(k) for k in range(len(simulated))]


class Receiver:
    """Receiver's own solution: each epoch alone, rejected if its residual test fails or its
    geometry is too poor. `pdop` is of the last epoch, NaN without a solution."""

    def __init__(self, simulated: GnssRaw) -> None:
        store = EphemerisStore()
        for message in broadcast(simulated):
            store.add(message)
        mask = math.radians(RAW.elevation_mask_deg)
        self._model = RangeModel(store, RangeOptions(RAW.systems, mask, RAW.cno_mask_db_hz))
        self._guess: Array | None = None
        self.pdop = math.nan

    def solve(self, epoch: RawGnssEpoch) -> SinglePoint | None:
        """Position and velocity of an epoch, or None."""
        found = single_point(self._model, epoch, self._guess)
        self.pdop = math.nan if isinstance(found, str) else found.dops.pdop
        if isinstance(found, str) or not found.consistent or self.pdop > MOST_PDOP:
            return None
        self._guess = found.position
        return found


def broadcast(simulated: GnssRaw) -> list[Ephemeris | Klobuchar]:
    """Messages stored by a receiver after some time of reception: every ephemeris and the
    ionosphere. They stay valid for longer than a run."""
    everything = {(slot.system, slot.prn) for slot in slots(simulated.options.systems)}
    return [*simulated.broadcast(0.0, everything), *simulated.ionosphere]


def fix(found: SinglePoint, t_ns: int) -> PositionFix:
    """Position fix of the receiver's solution, with the sigmas of its epoch."""
    lat, lon, height = to_geodetic(*(float(v) for v in found.position))
    axes = ned_axes(lat, lon)
    velocity = sd_velocity = None
    if found.velocity is not None and found.velocity_covariance is not None:
        velocity = _vector(axes.T @ found.velocity)
        sd_velocity = _vector(np.sqrt(np.diag(axes.T @ found.velocity_covariance @ axes)))
    return PositionFix(
        "gnss",
        t_ns,
        MonotonicStamp(t_ns),
        lat,
        lon,
        height,
        satellites=len(found.rows.satellites),
        sd_ned_m=_vector(np.sqrt(np.diag(axes.T @ found.covariance @ axes))),
        v_ned_m_s=velocity,
        sd_v_ned_m_s=sd_velocity,
    )


def _vector(values: Array) -> tuple[float, float, float]:
    n, e, d = values.tolist()
    return n, e, d


# --------------------------------------------------------------------------- one run


def simulate(seed: int, number: int) -> list[dict[str, CaseRun]]:
    """Run `number`: every case with the same IMU, start and errors of the observations; for each of
    `ORBIT_ERRORS_M` the cases."""
    rng = np.random.default_rng([seed, number])
    samples = drive_samples(IMU, rng)
    error = rng.standard_normal(9)
    found: list[dict[str, CaseRun]] = []
    for orbit_error_m in ORBIT_ERRORS_M:
        rows = COMPARED if found else ROWS
        found.append(
            {
                case: _run_case(
                    case, rows, observe(case, seed, number, orbit_error_m), samples, error
                )
                for case in CASES
            }
        )
    return found


def _run_case(
    case: str,
    rows: Sequence[str],
    observations: tuple[GnssRaw, list[RawGnssEpoch]],
    samples: Array,
    unit_error: Array,
) -> CaseRun:
    simulated, observed = observations
    receiver = Receiver(simulated)
    solved, pdop = [], []
    for epoch in observed:
        solved.append(receiver.solve(epoch))
        pdop.append(receiver.pdop)
    traces = {"receiver": _receiver_trace(solved)}
    for name, row in _FILTERS.items():
        if name not in rows or (row.coasts and CASES[case] is None):
            continue
        traces[name] = _filter_trace(row, simulated, observed, solved, samples, unit_error)
    count = np.array([len(epoch.signals) for epoch in observed], dtype=np.float64)
    return CaseRun(traces, count, np.array(pdop))


def _filter_trace(
    row: _Row,
    simulated: GnssRaw,
    observed: Sequence[RawGnssEpoch],
    solved: Sequence[SinglePoint | None],
    samples: Array,
    unit_error: Array,
) -> Trace:
    """Trace of one live filter: its error after each epoch."""
    intake = Intake({row.aiding.kind: row.aiding})
    model = make_model("ins15", imu_noise(IMU), *intake.extra_blocks())
    horizontal, height, velocity, tilt, heading = START_SD
    sd = model.initial.copy()
    sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[horizontal] * 2, height]
    nav = _true_states()[0]
    start = with_error(nav[0], unit_error * sd[:9])
    live = DaemonFedFilter(row.make(model, IMU.gap_s), IMU.gap_s, samples, start, sd)
    estimator = live.estimator
    raw = intake.receivers.get("raw")
    if raw is not None:
        for message in broadcast(simulated):
            raw.learn(message)
    t_s = epochs()
    away = in_stretch(t_s) & row.coasts
    trace = _empty(len(t_s))
    for k, t in enumerate(t_s):
        t_ns = round(t * 1e9)
        live.advance(t)
        measurements: list[AidingMeasurement] = []
        found = solved[k]
        if raw is not None and not away[k]:
            measurements = [raw.measurement(observed[k], t_ns)]
        elif raw is None and found is not None:
            accepted = intake.measurements_of(fix(found, t_ns), t_ns, 0.0)
            measurements = [] if isinstance(accepted, str) else list(accepted)
        live.advance(t, measurements)
        x, p = nav_error(estimator.nav, nav[k + 1]), estimator.covariance[:9, :9]
        trace.error[k] = x[6:]
        trace.sigma[k] = math.sqrt(p[6, 6] + p[7, 7])
        trace.nees[k] = x[6:] @ np.linalg.solve(p[6:, 6:], x[6:])
        trace.nav_nees[k] = x @ np.linalg.solve(p, x)
    return trace


def _receiver_trace(solved: Sequence[SinglePoint | None]) -> Trace:
    place = _true_states()[1]
    trace = _empty(len(solved))
    for k, found in enumerate(solved):
        if found is None:
            continue
        lat, lon, _ = to_geodetic(*(float(v) for v in place[k + 1]))
        axes = ned_axes(lat, lon)
        e, p = axes.T @ (found.position - place[k + 1]), axes.T @ found.covariance @ axes
        trace.error[k] = e
        trace.sigma[k] = math.sqrt(p[0, 0] + p[1, 1])
        trace.nees[k] = e @ np.linalg.solve(p, e)
    return trace


def _empty(n: int) -> Trace:
    return Trace(np.full((n, 3), np.nan), *(np.full(n, np.nan) for _ in range(3)))


def monte_carlo(
    runs: int, seed: int, progress: Callable[[], None] | None = None
) -> list[list[dict[str, CaseRun]]]:
    """Runs in order, on two processes."""
    return map_runs(partial(simulate, seed), runs, progress)
