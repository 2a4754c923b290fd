"""A barometer measurements the height, by its own table and by the driver off a recorded bus."""

from __future__ import annotations

import csv
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.can.height import CanHeightDecoder
from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import read_barometer, read_imu, read_solution, read_truth
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from fusiond.simulation.barometer import Barometer, barometer_stream
from fusiond.simulation.can.encoder import CanEncoder
from fusiond.simulation.can.imu import CanImu
from fusiond.simulation.can.star_tracker_radar import SIM_BAROMETER
from fusiond.simulation.files import Simulated, simulate
from fusiond.simulation.scenarios import SCENARIOS

SEED, SECONDS = 5, 110.0
OUTAGE = (80.0, 30.0, frozenset({"gnss"}))
START_S = 1_760_000_000.0
VEHICLE = """
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = 100.0
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
bias_sd_m = 0.0
[aiding.barometer]
[alignment]
heading = ["gnss_course"]
[mqtt]
enabled = false
"""
BUS = """
[sources.imu]
driver = "can_imu"
dbc = "fusiond_sim_imu"
gyro = ["SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"]
accel = ["SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"]
[sources.barometer]
driver = "can_height"
dbc = "fusiond_sim_aids"
pressure = "BAROMETER.PRESSURE"
accuracy = "BAROMETER.SIGMA"
latency_s = 0.05
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return simulate(SCENARIOS["drive"], tmp_path_factory.mktemp("drive"), SEED, SECONDS)


def shifted(path: Path, out: Path) -> Path:
    """A table on the bus's times."""
    with path.open() as source, out.open("w", newline="") as target:
        rows = csv.DictReader(source)
        writer = csv.DictWriter(target, rows.fieldnames or ())
        writer.writeheader()
        for row in rows:
            times = {k: f"{float(row[k]) + START_S:.6f}" for k in ("t_s", "t_arrival_s")}
            writer.writerow(row | times)
    return out


def bus(written: Simulated, path: Path) -> Path:
    """What the inertial unit and the barometer of that drive send."""
    imu, air = read_imu(written.files["imu"]), read_barometer(written.files["barometer"])
    frames, height = CanImu(), CanEncoder(CanHeightDecoder("barometer", SIM_BAROMETER))
    sent = []
    for k, (t_s, gyro, accel) in enumerate(zip(imu.t_s, imu.gyro, imu.accel, strict=True)):
        sent += [(t_s, m) for m in frames.frames(k, round(t_s * 1e9), gyro, accel)]
    for k, (t_s, *values) in enumerate(
        zip(air.t_arrival_s, air.pressure_pa, air.sd_m, strict=True)
    ):
        sent += [(t_s, m) for m in height.frames(k, 0, values)]
    with can.Logger(path) as log:
        for t_s, message in sorted(sent, key=lambda row: row[0]):
            message.timestamp, message.channel = START_S + t_s, "can0"
            log(message)
    return path


def test_a_barometer_holds_the_height_by_table_and_by_bus(
    written: Simulated, tmp_path: Path
) -> None:
    truth = read_truth(written.files["truth"])
    true = Barometer(
        SCENARIOS["drive"].truth(SECONDS), SCENARIOS["drive"].barometer, barometer_stream(SEED)
    )
    by_table, by_bus = tmp_path / "table.toml", tmp_path / "bus.toml"
    by_table.write_text(VEHICLE)
    by_bus.write_text(VEHICLE + BUS)
    measurements = [("gnss", written.files["gnss"]), ("barometer", written.files["barometer"])]
    late = [("gnss", shifted(written.files["gnss"], tmp_path / "gnss.csv"))]
    log = bus(written, tmp_path / "bus.blf")
    seen: list[Navigator] = []
    heights = {}
    for name, start_s in (("table", 0.0), ("bus", START_S)):
        window = [(start_s + OUTAGE[0], *OUTAGE[1:])]
        out = tmp_path / f"{name}.csv"
        if name == "bus":
            config = load_config(by_bus)
            found = process(config, None, late, window, out, can_log=log, watch=seen.append)
        else:
            config = load_config(by_table)
            found = process(config, written.files["imu"], measurements, window, out)
        solution = read_solution(out)
        at_s = truth.t_s[(truth.t_s >= OUTAGE[0]) & (truth.t_s < SECONDS - 1.0)]
        rows = [
            np.interp(at_s + start_s, solution.t_s, x)
            for x in (solution.height_m, solution.sd_position[:, 2])
        ]
        error = rows[0] - np.interp(at_s, truth.t_s, truth.height_m)
        heights[name] = (found["sources"], error, rows[1])
    sources, error, sd = heights["table"]
    assert sources["barometer"]["fused"] > 60
    assert (np.abs(error) < 3.0 * sd).all()
    # Thirty seconds without a fix and without wheels: 3 m by the accelerometers alone.
    assert sd[-1] < 2.0
    assert heights["bus"][0]["barometer"] == sources["barometer"]
    assert np.abs(heights["bus"][1] - error).max() < 0.1
    parameters = {p.name: p for p in seen[-1].calibrating.parameters}
    offset = parameters["barometer_offset_m"]
    # At the height of the start: what the scale says there is a part of what is seen.
    level = float(true.offset_m[-1] + true.scale * truth.height_m[-1])
    scale = parameters["barometer_scale"]
    seen_m = offset.value + scale.value * truth.height_m[-1]
    assert abs(seen_m - level) < 3.0 * sd[-1]
    assert abs(offset.value - true.offset_m[-1]) < 3.0 * offset.sd < 0.2 * offset.prior_sd
    assert offset.prior_sd == 100.0
