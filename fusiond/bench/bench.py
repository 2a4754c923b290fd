"""`fusiond bench`: cost of the filter, as ratios to one numpy covariance product.

    Phi @ P @ Phi.T + Q,   21x21, float64

is timed before and after every single measurement, and each ratio is taken to the mean of those
two, so that a change of the processor's clock in between does not matter. Time is CPU time of the
process (user and system), which excludes other programs. Every figure is the median over the
repetitions. OpenBLAS uses one thread for matrices of this size (interface/gemm.c: up to m n k = 262
144; here 9261).

The IMU runs at 200 Hz, or 100 Hz for `process` and the steps of estimators; the model is `ins21`.

`numpy_product_us`: the product. As ratios to it: `block_step_ratio`, strapdown and covariance over
one of 4000 samples propagated in one call; `single_step_ratio`, a call from Python for one sample;
`rewind_2s_ratio`, a position 2 s old inserted into the timeline and everything run again to the
present, with a position fix five times a second and a checkpoint every 0.5 s;
`process_epoch_ratio`, `fusiond process` by IMU row: 100 Hz IMU, 4 Hz GNSS position and velocity in
order of validity, files read and the solution written at every row; `raw_epoch_40_ratio`, an epoch
of 40 satellites (`fusiond.bench.raw_epoch`); `late_tick_ratio`, the tick in which a fix arrives 10
s late (`fusiond.bench.delayed_fix`); `late_raw_tick_ratio`, the tick in which an RDSS fix arrives
1.5 s late, over raw epochs of 40 satellites (`fusiond.bench.delayed_fix_over_raw_epochs`).

Seconds: `process_start_s`, `fusiond process` before its first row
(`fusiond.bench.process_startup`).

As ratio to the same with the centralised filter: `multiscale_step_ratio`, a second of a multi-scale
filter with M = 2 (IMU at 100 Hz, one position and one velocity); `federated_step_ratio`, a second
of a federated filter with three local filters (IMU at 100 Hz, one position of each of three
sources, fault detection on, mode `no_reset`). `unscented_step_ratio` and
`unscented_propagation_step_ratio`, a second of the unscented filter by default, and with sigma
points in the propagation, too.

Against each other: `reduced_order_step_ratio`, a step of 17 states to one of 23
(`fusiond.studies.reduced_order.cost`).

Counted: `fix_functions` and `fix_modules`, the Python functions of an ordinary fix from arrival
to published sigma, and the modules that they are in (`fusiond.bench.fix_call_trace`);
`wired_fix_functions` and `wired_fix_modules`, those from bytes on a line to the payload of `nav`
(`fusiond.bench.wire_to_payload_call_trace`).
"""

from __future__ import annotations

import gc
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.bench.delayed_fix import delayed_fix
from fusiond.bench.delayed_fix_over_raw_epochs import delayed_raw
from fusiond.bench.fix_call_trace import ordinary_fix
from fusiond.bench.process_startup import start
from fusiond.bench.raw_epoch import raw_epoch
from fusiond.bench.wire_to_payload_call_trace import wired_fix
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multiscale.filter import MultiscaleEstimator
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.assembly import federated
from fusiond.navigator.timeline import Timeline
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import CAR_IMU, SCENARIOS
from fusiond.studies.reduced_order import cost as reduced_cost

REPETITIONS = 15
PROCESS_S = 1560.0
"""The whole of the scenario `drive`: what is done once (opening, aligning) is a few percent."""
STATES = 21
IMU_RATE_HZ = 200.0
STEP_NS = round(1e9 / IMU_RATE_HZ)
BLOCK_STEPS = 4000
SINGLE_STEPS = 1000
PRODUCTS = 300
"""Timed at once: 1 to 3 ms, long against the resolution of the clock, short against a throttle."""
FIX_NS = 200_000_000
DELAY_NS = 2_000_000_000
HISTORY_S = 4.0
STEP_RATE_HZ, STEP_SECONDS = 100, 100
LOCAL_FILTERS = ("first", "second", "third")
LAT, LON, HEIGHT = np.radians(30.5276), np.radians(114.3556), 38.0


def bench(repetitions: int = REPETITIONS, process_s: float = PROCESS_S) -> dict[str, Any]:
    """Run the benchmarks and return their figures, with versions and processor."""
    product = _product()
    figures: dict[str, Any] = {}
    products: list[float] = []

    def ratio(make: Callable[[int], Callable[[], int]], count: int) -> float:
        """Median over runs of the time per unit of work, divided by the time per product."""
        ratios = []
        for number in range(count):
            work = make(number)
            before = product()
            gc.collect()
            start = time.process_time()
            units = work()
            seconds = (time.process_time() - start) / units
            after = product()
            products.extend((before, after))
            ratios.append(seconds / (0.5 * (before + after)))
        return statistics.median(ratios[1:] or ratios)  # the first warms caches

    figures["block_step_ratio"] = ratio(_block, repetitions)
    figures["single_step_ratio"] = ratio(_single, repetitions)
    figures["rewind_2s_ratio"] = ratio(_rewind, repetitions)
    figures["raw_epoch_40_ratio"] = ratio(raw_epoch, repetitions)
    figures["late_tick_ratio"] = ratio(delayed_fix(repetitions), repetitions)
    figures["late_raw_tick_ratio"] = ratio(delayed_raw(repetitions), repetitions)
    figures["multiscale_step_ratio"] = _step_ratio(
        lambda model, gap_s: MultiscaleEstimator(model, gap_s, 2), _one_source(), repetitions
    )
    figures["federated_step_ratio"] = _step_ratio(
        lambda model, gap_s: federated(model, gap_s, LOCAL_FILTERS, FederatedOptions()),
        _three_sources(),
        repetitions,
    )
    figures["unscented_step_ratio"] = _step_ratio(UnscentedEstimator, _one_source(), repetitions)
    figures["unscented_propagation_step_ratio"] = _step_ratio(
        lambda model, gap_s: UnscentedEstimator(model, gap_s, propagation=True),
        _one_source(),
        repetitions,
    )
    with tempfile.TemporaryDirectory(prefix="fusiond-bench-") as folder:
        make = _process(Path(folder), process_s)
        figures["process_epoch_ratio"] = ratio(make, max(2, repetitions // 3))
        timed = start(Path(folder) / "start")
        runs = [timed() for _ in range(max(1, repetitions // 3))]
        figures["process_start_s"] = statistics.median(runs)
    figures["reduced_order_step_ratio"] = reduced_cost.step_ratio(3 * repetitions)
    way = ordinary_fix()
    figures["fix_functions"], figures["fix_modules"] = way.functions, way.modules
    way = wired_fix()
    figures["wired_fix_functions"], figures["wired_fix_modules"] = way.functions, way.modules
    return {
        "numpy_product_us": round(statistics.median(products) * 1e6, 3),
        **{name: round(value, 4) for name, value in figures.items()},
        "repetitions": repetitions,
        "cpu": _cpu(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("fusiond", "numpy", "numba")},
    }


def _product() -> Callable[[], float]:
    """Seconds of one `Phi @ P @ Phi.T + Q`."""
    rng = np.random.default_rng(0)
    phi = np.eye(STATES) + 1e-3 * rng.standard_normal((STATES, STATES))
    p, q = np.eye(STATES), 1e-9 * np.eye(STATES)

    def timed() -> float:
        start = time.process_time()
        for _ in range(PRODUCTS):
            _ = phi @ p @ phi.T + q
        return (time.process_time() - start) / PRODUCTS

    timed()
    return timed


# --------------------------------------------------------------------------- timed work


def _filter(steps: int, rate_hz: float = IMU_RATE_HZ) -> tuple[Model, KalmanEstimator, ImuBuffer]:
    """Filter at rest at time 0 with `steps` noisy samples ahead of it."""
    imu = Imu(rate_hz=rate_hz)
    model = make_model("ins21", imu_noise(imu))
    buffer = ImuBuffer(rate_hz, steps / rate_hz, np.eye(3), 0.0, imu.gap_s)
    rng = np.random.default_rng(1)
    samples = rng.standard_normal((steps, 6)) * np.array([1e-3] * 3 + [1e-2] * 3)
    samples[:, 5] -= gravity(LAT, HEIGHT)
    buffer.append(round(1e9 / rate_hz) * np.arange(1, steps + 1, dtype=np.int64), samples)
    estimator = KalmanEstimator(model, imu.gap_s)
    nav = np.array([LAT, LON, HEIGHT, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    sigma = model.initial.copy()
    sigma[:9] = [0.01] * 2 + [0.05] + [0.1] * 3 + [1.0] * 3
    estimator.initialise(0, 0, nav, np.zeros(model.size), np.diag(sigma**2))
    return model, estimator, buffer


def _block(_: int) -> Callable[[], int]:
    _model, estimator, buffer = _filter(BLOCK_STEPS)

    def work() -> int:
        estimator.propagate(buffer, buffer.latest_ns)
        return BLOCK_STEPS

    return work


def _single(_: int) -> Callable[[], int]:
    _model, estimator, buffer = _filter(SINGLE_STEPS)

    def work() -> int:
        for k in range(1, SINGLE_STEPS + 1):
            estimator.propagate(buffer, k * STEP_NS)
        return SINGLE_STEPS

    return work


def _fix(source: str, t_ns: int) -> PositionMeasurement:
    lever, lat = (0.3, 0.0, -1.0), LAT + 1e-20 * t_ns  # no value repeats
    return PositionMeasurement(source, t_ns, 0.9999, lat, LON, HEIGHT + 1.0, (2.0, 2.0, 4.0), lever)


def _rewind(number: int) -> Callable[[], int]:
    # One sample more each time, so that fixes fall anywhere between two checkpoints.
    steps = round(HISTORY_S * IMU_RATE_HZ) + 7 * number
    _model, estimator, buffer = _filter(steps)
    timeline = Timeline(estimator, buffer, keep_s=15.0, checkpoint_s=0.5)
    timeline.start()
    for t_ns in range(FIX_NS, steps * STEP_NS + 1, FIX_NS):
        timeline.insert(_fix("gnss", t_ns))
    timeline.advance()
    delayed = _fix("rdss", buffer.latest_ns - DELAY_NS)

    def work() -> int:
        timeline.insert(delayed)
        timeline.advance()
        assert timeline.counters.rewinds == 1
        return 1

    return work


def _one_source() -> list[Linearised]:
    """Fixes of one source: a position and a velocity each second."""
    lever, rest, sd = (0.3, 0.0, -1.0), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)
    measurements: list[Linearised] = []
    for second in range(1, STEP_SECONDS + 1):
        t_ns = second * 1_000_000_000
        measurements.append(_fix("gnss", t_ns))
        measurements.append(VelocityMeasurement("gnss_velocity", t_ns, 0.9999, rest, sd, lever))
    return measurements


def _three_sources() -> list[Linearised]:
    """Positions of three sources in turn, one from each source every second."""
    count = len(LOCAL_FILTERS)
    return [
        _fix(LOCAL_FILTERS[k % count], (k + 1) * 1_000_000_000 // count)
        for k in range(count * STEP_SECONDS)
    ]


def _step_ratio(
    make: Callable[[Model, float], Estimator], measurements: list[Linearised], repetitions: int
) -> float:
    """Ratio of an estimator's processor time to the centralised filter's, measured in turns.

    100 IMU samples and the measurements, in order of validity; median over the repetitions.
    """
    model, centralised, buffer = _filter(STEP_SECONDS * STEP_RATE_HZ, STEP_RATE_HZ)
    nav, xi, p = centralised.nav.copy(), centralised.xi.copy(), centralised.covariance.copy()
    ratios = []
    for _ in range(repetitions + 1):
        spent = []
        for estimator in (make(model, Imu().gap_s), KalmanEstimator(model, Imu().gap_s)):
            estimator.initialise(0, 0, nav, xi, p)
            gc.collect()
            before = time.process_time()
            for measurement in measurements:
                estimator.propagate(buffer, measurement.t_ns)
                estimator.update(measurement)
            spent.append(time.process_time() - before)
        ratios.append(spent[0] / spent[1])
    return statistics.median(ratios[1:])


def _process(folder: Path, duration_s: float) -> Callable[[int], Callable[[], int]]:
    drive = SCENARIOS["drive"]
    gnss = replace(drive.gnss, rate_hz=4.0, latency_s=(0.0, 0.0))
    written = simulate(replace(drive, gnss=gnss), folder, duration_s=duration_s)
    config = Config.model_validate(
        {"imu": CAR_IMU, "aiding": {"gnss": {"lever_arm_m": [0, 0, -1]}}}
    )

    def make(_: int) -> Callable[[], int]:
        def work() -> int:
            measurements = [("gnss", written.files["gnss"])]
            process(config, written.files["imu"], measurements, out=folder / "solution.csv")
            return written.rows["imu"]

        return work

    return make


def _cpu() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
