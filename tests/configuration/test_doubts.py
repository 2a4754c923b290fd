"""What `fusiond check` says of a configuration that is valid and cannot work."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from drivers.shipped_files import shipped
from fusiond.commands.app import app
from fusiond.configuration.doubts import GIVES, doubts
from fusiond.configuration.load import _DEFAULT_AIDING, load_config
from tests.places import REPOSITORY

IMU = """driver = "can_imu"
dbc = "xsens_mti600"
gyro = ["RATE_OF_TURN.GYRO_X", "RATE_OF_TURN.GYRO_Y", "RATE_OF_TURN.GYRO_Z"]
accel = ["ACCELERATION.ACCEL_X", "ACCELERATION.ACCEL_Y", "ACCELERATION.ACCEL_Z"]
"""
GNSS = 'driver = "nmea"\nport = "/dev/ttyUSB0"\n'
SOUND = f"[sources.imu]\n{IMU}[sources.gnss]\n{GNSS}"


def found(folder: Path, text: str) -> list[str]:
    path = folder / "vehicle.toml"
    path.write_text(text)
    return doubts(load_config(path))


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / "config").glob("*.toml")), ids=lambda p: p.name
)
def test_examples_leave_no_doubt(path: Path) -> None:
    """But for those whose drives came as files."""
    said = doubts(load_config(path))
    assert [doubt for doubt in said if not doubt.startswith("sources: none")] == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"[sources.gnss]\n{GNSS}", "sources: no IMU"),
        (f"{SOUND}[sources.imu2]\n{IMU}", "sources: imu and imu2 are IMUs"),
        (f"{SOUND}[imu]\nrate_hz = 0.01\n", "imu.rate_hz = 0.01: samples 100 s apart"),
        (
            f"{SOUND}[sources.compass]\n{GNSS}[aiding.compass]\nkind = 'heading'\n",
            "sources.compass.port = '/dev/ttyUSB0': gnss has it already",
        ),
        (
            f"{SOUND}[aiding.gnss]\nkind = 'raw'\n",
            "aiding.gnss.kind = 'raw': driver nmea gives gnss",
        ),
        (
            f"{SOUND}[aiding.imu]\nkind = 'wheel'\n",
            "aiding.imu: driver can_imu gives no measurement",
        ),
        (
            f"{SOUND}[aiding.gnss]\nlever_arm_m = [0.0, 100.0, 0.0]\n",
            "aiding.gnss.lever_arm_m = [0.0, 100.0, 0.0]: 100 m from the IMU",
        ),
        (
            f"{SOUND}[aiding.gnss]\nlever_arm_m = [0.5, 0.0, 1.5]\n",
            "aiding.gnss.lever_arm_m = [0.5, 0.0, 1.5]: the antenna would be 1.5 m below the IMU",
        ),
        (
            f"{SOUND}[constraints.non_holonomic]\nlever_arm_m = [-25.0, 0.0, 0.0]\n",
            "constraints.non_holonomic.lever_arm_m",
        ),
        (f"{SOUND}[mqtt]\ntls = true\nca_file = 'ca.pem'\n", "/ca.pem': No such file"),
        (f"[sources.imu]\n{IMU}", "sources: none gives a position"),
        ("", "sources: none"),
        (
            f"{SOUND}[estimator]\nmodel = 'planar10'\n",
            "'planar10' has no accelerometer bias, and [imu] has one of 10 mg, one sigma, which is "
            "noise to it: sigma grows by 646 m in a minute without measurements, where the bias "
            "does 177 m, and the level is off by 0.57 deg; choose 'planar15' or 'ins21'",
        ),
        (
            f"{SOUND}[imu]\nsensor_class = 'mems'\n[estimator]\nmodel = 'ins17'\n",
            "and sensor class 'mems' has one of 20 mg, one sigma, which is noise to it: sigma "
            "grows by 1,136 m in a minute without measurements, where the bias does 353 m, and the "
            "level is off by 1.1 deg; choose 'ins23' or 'ins21'",
        ),
        (
            f"{SOUND}[outputs.gpsd]\nport = 10110\n[outputs.nmea]\n",
            "outputs.nmea.port = 10110: outputs.gpsd listens there already",
        ),
    ],
)
def test_one_doubt(tmp_path: Path, text: str, said: str) -> None:
    (doubt,) = (d for d in found(tmp_path, text) if "has no scale factors" not in d)
    assert said in doubt


def test_one_line_by_two_names(tmp_path: Path) -> None:
    (tmp_path / "gnss").symlink_to("/dev/ttyUSB0")
    other = GNSS.replace("/dev/ttyUSB0", str(tmp_path / "gnss"))
    (doubt,) = found(tmp_path, f"{SOUND}[sources.other]\n{other}")
    assert "(that is /dev/ttyUSB0 of gnss): gnss has it already" in doubt


def test_addresses_that_two_sources_name(tmp_path: Path) -> None:
    """A UDP port gives its datagrams to one; a server serves both."""
    for address, doubts_found in (("udp://:5000", 1), ("tcp://10.0.0.1:5000", 0)):
        both = SOUND.replace("/dev/ttyUSB0", address)
        other = GNSS.replace("/dev/ttyUSB0", address)
        assert len(found(tmp_path, f"{both}[sources.other]\n{other}")) == doubts_found


def test_no_doubt_about_what_may_well_be(tmp_path: Path) -> None:
    """A ship's lever arm, a measurement for `process` alone, a start from a known place."""
    text = 'vehicle_class = "marine"\n' + SOUND
    assert found(tmp_path, f"{text}[aiding.gnss]\nlever_arm_m = [100.0, 0.0, -20.0]\n") == []
    assert found(tmp_path, f"{SOUND}[aiding.log]\nkind = 'rdss'\n") == []
    known = f"[sources.imu]\n{IMU}[alignment]\nposition_deg_m = [30.5, 114.3, 20.0]\n"
    assert found(tmp_path, known) == []


def test_measurement_kinds_of_drivers_cover_the_defaults() -> None:
    assert {
        driver: section().kind in GIVES[driver] for driver, section in _DEFAULT_AIDING.items()
    } == (dict.fromkeys(_DEFAULT_AIDING, True))


def test_check_prints_them_and_exits_0(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text(f"{SOUND}[imu]\nrate_hz = 0.01\n")
    done = CliRunner().invoke(app, ["check", str(path)])
    assert done.exit_code == 0
    assert "\n  ! imu.rate_hz = 0.01" in done.stdout
    assert "!" not in CliRunner().invoke(app, ["check", str(shipped("vehicle.toml"))]).stdout


def test_a_password_is_not_echoed(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text('[mqtt]\npassword = "hunter2"\n')
    done = CliRunner().invoke(app, ["check", str(path)])
    assert done.exit_code == 78
    assert "mqtt.password: no such key; did you mean 'password_file'?" in done.output
    assert "hunter2" not in done.output
