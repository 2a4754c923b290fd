"""A file of NMEA is read as the daemon reads the line, by the options of its source."""

from __future__ import annotations

import gzip
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.measurements import Heading, MagneticHeading, MonotonicStamp, PositionFix
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import TableError
from fusiond.offline.measurement_files import Arrival
from fusiond.offline.process import process
from fusiond.offline.run_input import Recorded, read_recorded
from tests.offline.nmea_lines import sentence

BEGIN = datetime(2026, 3, 24, 7, 33, tzinfo=UTC)
BEGIN_S = int(BEGIN.timestamp())
SECONDS = 20


def gga(k: int) -> bytes:
    at = f"07330{k}.00" if k < 10 else f"0733{k}.00"
    return sentence(f"GNGGA,{at},4712.0000,N,00812.0000,E,1,14,0.9,403.0,M,47.0,M,,")


def rmc(k: int) -> bytes:
    at = f"07330{k}.00" if k < 10 else f"0733{k}.00"
    return sentence(f"GNRMC,{at},A,4712.0000,N,00812.0000,E,0.0,,240326,,,A,V")


def read(tmp_path: Path, lines: list[bytes], toml: str = "") -> tuple[Recorded, list[Arrival]]:
    """Through `read_recorded`, beside samples in POSIX seconds."""
    imu = tmp_path / "imu.csv"
    rows = [f"{BEGIN_S + 0.1 * k:.1f},0,0,0,0,0,-9.8" for k in range(10 * SECONDS)]
    header = "t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
    imu.write_text("\n".join((header, *rows)))
    path = tmp_path / "receiver.nmea"
    path.write_bytes(b"".join(lines))
    config = tmp_path / "vehicle.toml"
    config.write_text(toml)
    found = read_recorded(load_config(config), imu, [("nmea", path)], (), None, None)
    return found, found.arrivals


def of(arrivals: list[Arrival], kind: type) -> list[Any]:
    return [row.measurement for row in arrivals if isinstance(row.measurement, kind)]


@pytest.mark.parametrize("packed", ["gz", "cut", "utf-16"])
def test_a_file_that_is_packed(packed: str, tmp_path: Path) -> None:
    plain = b"".join(gga(k) + rmc(k) for k in range(SECONDS))
    data = plain.decode().encode("utf-16") if packed == "utf-16" else gzip.compress(plain)
    found, arrivals = read(tmp_path, [data[:-60] if packed == "cut" else data])
    fixes = len(of(arrivals, PositionFix))
    assert fixes == SECONDS if packed != "cut" else 0 < fixes < SECONDS
    notes = [str(each) for each in found.files["nmea"].rejected if each.reason == "file_cut"]
    assert len(notes) == (packed == "cut")


@pytest.mark.parametrize("told", ["GNTHS,30.00,A", "GNHDT,30.00,T"])
def test_headings_of_two_antennas(told: str, tmp_path: Path) -> None:
    lines = [b"".join((gga(k), rmc(k), sentence(told))) for k in range(SECONDS)]
    _, arrivals = read(tmp_path, lines)
    headings = of(arrivals, Heading)
    assert len(headings) == len(of(arrivals, PositionFix)) == SECONDS
    for k, m in enumerate(headings):
        assert m.source == "gnss"
        assert m.yaw_rad == pytest.approx(math.radians(30.0))
        assert m.stamp == MonotonicStamp((BEGIN_S + k) * 10**9)


def test_the_options_of_the_source_are_those_of_the_daemon(tmp_path: Path) -> None:
    """A baseline that lies across, a simulator, a receiver of another name."""
    toml = """
[sources.roof]
driver = "nmea"
port = "/dev/ttyUSB0"
heading_offset_deg = 90.0
allow_simulator = true
[aiding.roof]
kind = "gnss"
"""
    simulated = [gga(k).replace(b",E,1,14", b",E,8,14") for k in range(SECONDS)]
    mended = [sentence(line[1:].split(b"*")[0].decode()) for line in simulated]
    ths = sentence("GNTHS,30.00,A")
    lines = [b"".join((mended[k], rmc(k), ths)) for k in range(SECONDS)]
    _, arrivals = read(tmp_path, lines, toml)
    assert {m.source for m in of(arrivals, Heading)} == {"roof"}
    assert {round(math.degrees(m.yaw_rad)) for m in of(arrivals, Heading)} == {120}
    assert len(of(arrivals, PositionFix)) == SECONDS
    with pytest.raises(TableError, match="the receiver simulates: allow_simulator would accept it"):
        read(tmp_path, [line for k in range(SECONDS) for line in (mended[k], rmc(k))])


COMPASS = "[aiding.compass]\ndeclination_deg = 3.0\n"


@pytest.mark.parametrize("rate", [1, 10])
@pytest.mark.parametrize("told", ["HCHDM,30.0,M", "HCHDG,28.0,2.0,E,3.0,E"])
def test_a_compass_in_the_receivers_file(rate: int, told: str, tmp_path: Path) -> None:
    """Its sentences have no time: of the epoch before them, evenly spread, less the latency."""
    lines = [gga(k) + rmc(k) + rate * sentence(told) for k in range(SECONDS)]
    found, arrivals = read(tmp_path, lines, COMPASS)
    headings = of(arrivals, MagneticHeading)
    assert len(headings) == rate * SECONDS
    assert {m.source for m in headings} == {"compass"}
    assert headings[0].yaw_rad == pytest.approx(math.radians(30.0))
    times = np.array([m.stamp.t_ns for m in headings[: rate * (SECONDS - 1)]])
    expected = (BEGIN_S + np.arange(rate * (SECONDS - 1)) / rate - 0.1) * 1e9
    assert np.abs(times - expected).max() < 1000
    # The declination depends on the date, which the receiver says.
    utc = [row.utc_ns for row in arrivals if isinstance(row.measurement, MagneticHeading)]
    assert utc == [m.stamp.t_ns for m in headings]
    assert found.files["nmea"].refused == 0


def test_a_gyrocompass_in_the_receivers_file(tmp_path: Path) -> None:
    """Its HDT has a talker of its own: it is true north, and no antenna's."""
    lines = [gga(k) + rmc(k) + sentence("HEHDT,30.0,T") for k in range(SECONDS)]
    _, arrivals = read(tmp_path, lines, COMPASS)
    assert {m.source for m in of(arrivals, Heading)} == {"compass"}
    assert len(of(arrivals, Heading)) == SECONDS


@pytest.mark.parametrize("told", ["HCHDM,30.0,M", "HEHDT,30.0,T"])
def test_a_compass_that_is_not_configured_is_named(told: str, tmp_path: Path) -> None:
    hdm = sentence(told)
    found, arrivals = read(tmp_path, [gga(k) + rmc(k) + hdm for k in range(SECONDS)])
    assert not of(arrivals, MagneticHeading)
    (rejected,) = found.files["nmea"].rejected
    assert (rejected.reason, rejected.times) == ("compass_not_configured", SECONDS)


def test_a_compass_of_the_configuration_has_its_options(tmp_path: Path) -> None:
    toml = """
[sources.flux]
driver = "compass"
port = "/dev/ttyUSB1"
heading_offset_deg = -30.0
latency_s = 0.5
"""
    hdm = sentence("HCHDM,30.0,M")
    _, arrivals = read(tmp_path, [gga(k) + rmc(k) + hdm for k in range(SECONDS)], toml)
    headings = of(arrivals, MagneticHeading)
    assert {(m.source, m.yaw_rad) for m in headings} == {("flux", 0.0)}
    assert headings[3].stamp.t_ns == (BEGIN_S + 3) * 10**9 - 500_000_000


def test_without_a_receivers_epochs_nothing_has_a_time(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="with a date"):
        read(tmp_path, [sentence("HCHDM,30.0,M")] * 9, COMPASS)
    with pytest.raises(TableError, match="headings of a compass alone, and the configuration has"):
        read(tmp_path, [sentence("HCHDM,30.0,M")] * 9)
    with pytest.raises(TableError, match="no NMEA sentence whose checksum is right"):
        read(tmp_path, [b"$GNGGA,,,*00\r\n", b"binary"])
    with pytest.raises(TableError, match=r"\(GSV\), but none that counts: switch on GGA"):
        read(tmp_path, [sentence("GPGSV,1,1,00")])


def test_headings_of_two_antennas_align_the_vehicle(tmp_path: Path) -> None:
    """At rest, where no course does: by THS of the receiver's own file."""
    ths = sentence("GNTHS,30.00,A")
    read(tmp_path, [gga(k) + rmc(k) + ths for k in range(SECONDS)])
    config = Config.model_validate({"alignment": {"heading": ["dual_antenna"]}})
    found = process(config, tmp_path / "imu.csv", [("nmea", tmp_path / "receiver.nmea")])
    assert found["aligned"] == "dual antenna"
    assert found["sources"]["gnss_heading"]["fused"] > SECONDS // 2
