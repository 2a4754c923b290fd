"""`fusiond simulate --live`: devices that another process finds and reads as real ones."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.configuration.doubts import doubts
from fusiond.configuration.load import load_config
from fusiond.files.csv_tables import MissingPackageError
from fusiond.simulation import live
from tests.places import REPOSITORY

# In a network of its own, where the bus over UDP reaches nobody else.
CODE = """
import json, subprocess, sys, time
from pathlib import Path
from tests.live.rig import network_of_its_own
network_of_its_own()
folder = Path(sys.argv[1])
fusiond = str(Path(sys.executable).with_name("fusiond"))
car = subprocess.Popen(
    [fusiond, "simulate", "drive", "--live", str(folder), "--duration", "600"],
    stdout=subprocess.PIPE, text=True,
)
said = car.stdout.readline() + car.stdout.readline()
while not (folder / "gnss").exists():
    time.sleep(0.05)
doctor = subprocess.run(
    [fusiond, "doctor", str(folder / "vehicle.toml"), "--seconds", "4"],
    capture_output=True, text=True,
)
car.terminate()
said += car.stdout.read()
print(json.dumps([said, car.wait(), doctor.stdout + doctor.stderr]))
"""


def test_a_daemon_s_doctor_finds_the_devices(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(tmp_path / "car")],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said, status, doctor = json.loads(done.stdout)
    config = tmp_path / "car" / "vehicle.toml"
    assert f"fusiond run {config}" in said
    assert "imu_frames" in said  # the counters, at the end
    assert status == 0
    for words in ("imu: can_imu", "ImuSample: ", "gnss: nmea", "rdss: rdss"):
        assert words in doctor
    # Nothing but the broker, which nobody has started here.
    assert "\n1 finding" in doctor
    assert "Connection refused" in doctor
    assert not (tmp_path / "car" / "gnss").exists()


def test_its_configuration_leaves_no_doubt(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text(live.configuration(tmp_path, "socketcan", "vcan0"))
    config = load_config(path)
    assert doubts(config) == []
    assert config.constraints.non_holonomic.lever_arm_m == live.REAR_AXLE_M


def test_a_bus_over_udp_that_is_not_to_be_had_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "VCAN", "none0")
    assert live.bus_here()[0] == "udp_multicast"
    monkeypatch.setattr(live, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"none0 is not up .* install .*msgpack"):
        live.bus_here()


def test_it_is_one_or_the_other(tmp_path: Path) -> None:
    folder = str(tmp_path)
    for arguments in (
        ["drive"],
        ["drive", "--live", folder, "--out", folder],
        ["flight", "--live", folder],
    ):
        assert CliRunner().invoke(app, ["simulate", *arguments]).exit_code == 2
