"""Star tracker and SAR end to end: simulated sensors, files, CAN bus, and the daemon that fuses."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from fusiond.aiding.attitude import STAR_BLOCK
from fusiond.aiding.landmark_bearing import SAR_BLOCK
from fusiond.configuration import load as loading
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import ARCSEC
from fusiond.files.measurement_csv import read_attitude, read_bearing
from fusiond.live import sources as serving
from fusiond.live.daemon import Daemon
from fusiond.offline.process import process
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.files import simulate
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.star_tracker_radar import (
    SarOptions,
    SarRadar,
    StarTracker,
    StarTrackerOptions,
)
from tests.live.daemon_bench import running
from tests.patience import until
from tests.places import REPOSITORY

FLIGHT = SCENARIOS["flight-sar"]
AIRCRAFT = tomllib.loads((REPOSITORY / "config" / "flight_sar.toml").read_text())


def aircraft(**sections: object) -> Config:
    """The shipped configuration; for files it needs no devices."""
    return Config.model_validate({**AIRCRAFT, "sources": {}, **sections})


@pytest.fixture
def entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drivers that pyproject.toml names, installed or not yet."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    group = project["entry-points"]["fusiond.drivers"]
    points = {n: EntryPoint(n, value, "fusiond.drivers") for n, value in group.items()}
    for module in (loading, serving):
        monkeypatch.setattr(module, "driver_entry_points", lambda: points)


# --------------------------------------------------------------------------- simulated sensors


def test_simulated_sensors_have_the_errors_that_they_state() -> None:
    truth = FLIGHT.truth(1000.0)
    star = StarTracker(truth, StarTrackerOptions(), np.random.default_rng(1))
    noise = (
        star.rpy
        - StarTracker(
            truth, StarTrackerOptions(sd_arcsec=(0.0, 0.0, 0.0)), np.random.default_rng(1)
        ).rpy
    )
    assert noise.std(axis=0) / ARCSEC == pytest.approx([200.0] * 3, rel=0.1)
    assert np.ptp(star.misalignment, axis=0) == pytest.approx([0.0] * 3)
    drifting = StarTrackerOptions(misalignment_sd_arcsec=50.0, misalignment_correlation_s=5.0)
    wander = StarTracker(truth, drifting, np.random.default_rng(1)).misalignment
    assert wander.std(axis=0) / ARCSEC == pytest.approx([50.0] * 3, rel=0.25)

    exact = SarOptions(FLIGHT.sar.targets_deg_m, sd_arcsec=(0.0, 0.0), misalignment_sd_arcsec=0.0)
    sar = SarRadar(truth, exact, np.random.default_rng(2))
    assert 300 < len(sar.t_s) <= 1000
    assert set(sar.target) <= set(exact.targets_deg_m)
    assert len(set(sar.target)) > 3
    assert SarRadar(truth, SarOptions(), np.random.default_rng(2)).rows.shape == (0, 9)


def test_files_of_a_flight(tmp_path: Path) -> None:
    written = simulate(FLIGHT, tmp_path, seed=3, duration_s=60.0)
    attitude, bearing = (
        read_attitude(written.files["attitude"]),
        read_bearing(written.files["bearing"]),
    )
    assert not attitude.rejected
    assert not bearing.rejected
    assert len(attitude.t_s) == 60
    assert np.degrees(attitude.sd_rpy) == pytest.approx(np.full((60, 3), 200.0 / 3600.0), rel=1e-5)
    assert attitude.t_arrival_s - attitude.t_s == pytest.approx(np.full(60, 0.1))
    again = simulate(FLIGHT, tmp_path / "again", seed=3, duration_s=60.0)
    plain = simulate(SCENARIOS["flight"], tmp_path / "plain", seed=3, duration_s=60.0)
    for name in ("attitude", "bearing"):
        assert written.files[name].read_bytes() == again.files[name].read_bytes()
        assert name not in plain.files
    # The other devices have their own random streams.
    assert written.files["gnss"].read_bytes() == plain.files["gnss"].read_bytes()


def test_bearings_that_cannot_be_true_are_rejected(tmp_path: Path) -> None:
    header = "t_s,azimuth_deg,elevation_deg,sd_azimuth_deg,sd_elevation_deg"
    header += ",target_lat_deg,target_lon_deg,target_height_m"
    rows = (
        "1,10,-5,0.1,0.2,30,114,50",
        "2,10,-5,,,30,114,50",
        "3,10,-5,0.1,,30,114,50",
        "4,10,-95,0.1,0.1,30,114,50",
        "5,10,-5,0.1,0,30,114,50",
        "6,10,-5,0.1,0.1,,114,50",
    )
    path = tmp_path / "bearing.csv"
    path.write_text("\n".join((header, *rows)) + "\n")
    table = read_bearing(path)
    np.testing.assert_allclose(table.angles, np.radians([[10.0, -5.0]] * 2))
    np.testing.assert_allclose(table.sd, np.radians([[0.1, 0.2], [math.nan] * 2]))
    np.testing.assert_allclose(table.point, [[*np.radians([30.0, 114.0]), 50.0]] * 2)
    assert [(r.line, r.reason) for r in table.rejected] == [
        (4, "missing"),
        (5, "out_of_range"),
        (6, "sd_not_positive"),
        (7, "missing"),
    ]


# --------------------------------------------------------------------------- files and daemon


def test_process_fuses_both(tmp_path: Path) -> None:
    written = simulate(FLIGHT, tmp_path, seed=3, duration_s=420.0).files
    measurements = [("gnss", written["gnss"]), ("attitude", written["attitude"])]
    measurements.append(("bearing", written["bearing"]))
    report = process(aircraft(), written["imu"], measurements)
    assert report["aligned"] == "gyrocompass"
    star, sar = report["sources"]["star_tracker"], report["sources"]["sar"]
    assert star["fused"] > 280
    assert sar["fused"] > 100
    assert star.get("gated", 0) + sar.get("gated", 0) <= 1


async def test_the_daemon_fuses_both_off_the_bus(tmp_path: Path, entry_points: None) -> None:
    """IMU, star tracker and radar on one virtual CAN bus, by the shipped mappings."""
    points = {"1": (30.55, 114.40, 60.0), "2": (30.49, 114.33, 40.0)}
    scenario = replace(
        SCENARIOS["drive"],
        star_tracker=StarTrackerOptions(rate_hz=5.0),
        sar=SarOptions(points, rate_hz=5.0),
    )
    channel = f"aids-{tmp_path.name}"
    bus = {"interface": "virtual", "channel": channel}
    shipped = AIRCRAFT["sources"]
    lines = ['vehicle = "test"', f'state_file = "{tmp_path / "state.json"}"']
    lines += ["[mqtt]", "enabled = false", "[imu]", 'axes = ["+x", "-y", "-z"]']
    lines += ["[alignment]", 'heading = ["config"]', "heading_deg = 40.0"]
    lines += ["[estimator]", 'model = "ins15"']
    for name in ("imu", "star_tracker", "sar"):
        lines.append(f"[sources.{name}]")
        for key, value in {**shipped[name], **bus}.items():
            text = repr(list(value)) if isinstance(value, list) else repr(value)
            lines.append(f"{key} = {text}")
    lines += ["[sources.gnss]", 'driver = "nmea"', f'port = "{tmp_path / "gnss"}"']
    lines += ["[aiding.gnss]", "lever_arm_m = [0.0, 0.0, -1.0]", "[aiding.star_tracker]"]
    lines += ["[aiding.sar.targets_deg_m]", *(f"{k} = {list(v)}" for k, v in points.items())]
    path = tmp_path / "test.toml"
    path.write_text("\n".join(lines) + "\n")
    daemon = Daemon(load_config(path))
    vehicle = SimulatedVehicle(
        scenario,
        seed=4,
        duration_s=60.0,
        can_imu=SIM_IMU.model_copy(update=bus),
        gnss_link=tmp_path / "gnss",
    )

    def fused(name: str) -> int:
        return daemon.sources.health(daemon.clock.now_ns())[name].fused

    async with running(daemon, vehicle):
        await until(lambda: fused("star_tracker") >= 10 and fused("sar") >= 10)
        vehicle.unplug("star_tracker")
        await until(lambda: vehicle.counters["star_tracker_unplugged"] > 2)
        before = fused("sar")
        await until(lambda: fused("sar") > before)
        health = daemon.sources.health(daemon.clock.now_ns())
    for name in ("star_tracker", "sar"):
        assert health[name].rejected.get("gated", 0) == 0, health[name]
        assert health[name].state == "running"
    model = daemon.navigator.model
    sd = np.sqrt(np.diag(daemon.navigator.estimator.covariance)) / ARCSEC
    assert (sd[model.slots_of(STAR_BLOCK)] < 200.0).all()
    assert (sd[model.slots_of(SAR_BLOCK)] < 200.0).all()


def test_the_example_of_the_guide_is_valid(entry_points: None, tmp_path: Path) -> None:
    guide = (REPOSITORY / "docs" / "star-tracker-sar.md").read_text(encoding="utf-8")
    path = tmp_path / "guide.toml"
    path.write_text(guide.split("```toml\n")[1].split("```")[0])
    assert set(load_config(path).sources) == {"star_tracker", "sar"}


def test_a_point_that_the_configuration_lacks_is_named(entry_points: None, tmp_path: Path) -> None:
    """The shipped configuration loads with its drivers; what is missing in it is said."""
    assert load_config(REPOSITORY / "config" / "flight_sar.toml").aiding["sar"].kind == "sar"
    text = (REPOSITORY / "config" / "flight_sar.toml").read_text()
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(text.replace("1 = [30.3931,", "1 = [130.3931,"))
    with pytest.raises(loading.ConfigError, match=r"aiding\.sar\.targets_deg_m\.1\[0\] = 130"):
        load_config(wrong)
