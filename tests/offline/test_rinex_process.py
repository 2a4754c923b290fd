"""A station's RINEX files, as published, through `fusiond process`: it stands where it is."""

from __future__ import annotations

import gzip
import math
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import read_imu, read_solution
from fusiond.gnss.ecef import to_geodetic
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.offline.measurement_files import READERS
from fusiond.offline.receiver_logs import rinex_text
from tests.drivers.raw.test_rinex import BEIDOU, NOW, header, nav4, observed
from tests.gnss.test_station import NAVIGATION, OBSERVATIONS, PLACE, STATION

pytestmark = pytest.mark.skipif(
    not STATION.is_dir(), reason=f"station_esbc is absent: {STATION} (set FUSIOND_DATA)"
)
CONFIG = """
[imu]
axes = ["+x", "+y", "+z"]
rate_hz = 10.0
sensor_class = "tactical"
[aiding.raw]
lever_arm_m = [0.0, 0.0, 0.0]
[alignment]
heading = ["config"]
heading_deg = 0.0
heading_sd_deg = 1.0
[mqtt]
enabled = false
"""
FROM_S, SECONDS = 345_590.0, 900.0
POSIX_S = 315_964_800 + 2111 * 604_800 - 18


def standing(path: Path, begin_s: float) -> Path:
    """Ten samples a second of an IMU that faces north, without error."""
    lat, _, height = to_geodetic(*PLACE)
    t = begin_s + np.arange(0.0, SECONDS, 0.1)
    rate = (EARTH_RATE_RAD_S * math.cos(lat), 0.0, -EARTH_RATE_RAD_S * math.sin(lat))
    row = np.array([*rate, 0.0, 0.0, -float(gravity(lat, height))])
    noise = np.random.default_rng(3).normal(size=(len(t), 6)) * ([1e-5] * 3 + [1e-3] * 3)
    names = "t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
    np.savetxt(path, np.column_stack([t, row + noise]), "%.9f", ",", header=names, comments="")
    return path


def run(tmp_path: Path, imu: Path, *measurements: Path) -> tuple[int, str]:
    (tmp_path / "c.toml").write_text(CONFIG)
    command = ["process", str(tmp_path / "c.toml"), "--imu", str(imu)]
    for measurement in measurements:
        command += ["--aid", f"raw={measurement}"]
    done = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "out.csv")])
    return done.exit_code, done.output


@pytest.mark.parametrize("begin_s", [FROM_S, POSIX_S + FROM_S], ids=["of the week", "posix"])
def test_a_station_stands_where_it_is(tmp_path: Path, begin_s: float) -> None:
    imu = standing(tmp_path / "imu.csv", begin_s)
    code, output = run(tmp_path, imu, OBSERVATIONS, NAVIGATION)
    assert code == 0, output
    assert "no time in common" not in output
    solution = read_solution(tmp_path / "out.csv")
    lat, lon, height = to_geodetic(*PLACE)
    off = np.array(
        [
            (solution.lat_rad[-1] - lat) * 6.37e6,
            (solution.lon_rad[-1] - lon) * 6.37e6 * math.cos(lat),
            solution.height_m[-1] - height,
        ]
    )
    assert np.linalg.norm(off) < 3.0, off
    assert (np.abs(off) < 3.0 * solution.sd_position[-1]).all(), (off, solution.sd_position[-1])


KINDS = ("C1C", "L1C", "D1C", "S1C", "C2W", "L2W", "D2W", "S2W")
"""Of RINEX 3; in RINEX 2 these are C1, L1, D1, S1, P2, L2, D2, S2."""


def observations_2(text: str) -> str:
    """GPS of an observation file as RINEX 2.11 has it."""
    head, _, body = text.partition("END OF HEADER\n")
    listed: list[str] = []
    system = ""
    for line in head.splitlines():
        if line[60:].startswith("SYS / # / OBS TYPES"):
            system = line[0] if line[0] != " " else system
            listed += line[6:60].split() if system == "G" else []
    columns = [listed.index(kind) for kind in KINDS]
    types = "".join(f"    {kind}" for kind in ("C1", "L1", "D1", "S1", "P2", "L2", "D2", "S2"))
    found = [
        f"{2.11:9.2f}{'':11}{'OBSERVATION DATA':20}{'G (GPS)':20}RINEX VERSION / TYPE",
        f"{8:6}{types:54}# / TYPES OF OBSERV",
        f"{'':60}END OF HEADER",
    ]
    for epoch in body.split(">")[1:]:
        first, *rows = epoch.splitlines()
        gps = [row for row in rows if row[:1] == "G"]
        for at in range(0, len(gps), 12):
            names = "".join(row[:3] for row in gps[at : at + 12])
            y, mo, d, h, mi, sec = first[:28].split()
            date = f" {y[2:]} {int(mo):2} {int(d):2} {int(h):2} {int(mi):2}{float(sec):11.7f}"
            found.append((f"{date}  0{len(gps):3}" if at == 0 else " " * 32) + names)
        for row in gps:
            values = [row[3 + 16 * k : 19 + 16 * k].ljust(16) for k in columns]
            found += ["".join(values[:5]).rstrip(), "".join(values[5:]).rstrip()]
    return "\n".join([*found, ""])


def navigation_2(text: str) -> str:
    """GPS of a navigation file as RINEX 2.11 has it."""
    found = [
        f"{2.11:9.2f}{'':11}{'N: GPS NAV DATA':40}RINEX VERSION / TYPE",
        f"{'':60}END OF HEADER",
    ]
    gps = False
    for line in text.partition("END OF HEADER\n")[2].splitlines():
        if line[:1] != " ":
            gps = line[:1] == "G"
            y, mo, d, h, mi, sec = (int(x) for x in line[4:23].split())
            date = f"{int(line[1:3]):2} {y % 100:02} {mo:2} {d:2} {h:2} {mi:2}{sec:5.1f}"
            line = f" {date}{line[23:]}"  # noqa: PLW2901
        found += [line[1:]] if gps else []
    return "\n".join([*found, ""])


def test_rinex_2_of_the_same_station(tmp_path: Path) -> None:
    """GPS alone, converted: the station stands where it is."""
    unpacked = rinex_text(OBSERVATIONS, gzip.decompress(OBSERVATIONS.read_bytes()))
    assert unpacked is not None
    (tmp_path / "esbc1770.20o").write_text(observations_2(unpacked[0]))
    sent = gzip.decompress(NAVIGATION.read_bytes()).decode()
    (tmp_path / "esbc1770.20n.gz").write_bytes(gzip.compress(navigation_2(sent).encode()))
    imu = standing(tmp_path / "imu.csv", POSIX_S + FROM_S)
    code, output = run(tmp_path, imu, tmp_path / "esbc1770.20o", tmp_path / "esbc1770.20n.gz")
    assert code == 0, output
    solution = read_solution(tmp_path / "out.csv")
    lat, lon, height = to_geodetic(*PLACE)
    off = np.array(
        [
            (solution.lat_rad[-1] - lat) * 6.37e6,
            (solution.lon_rad[-1] - lon) * 6.37e6 * math.cos(lat),
            solution.height_m[-1] - height,
        ]
    )
    assert np.linalg.norm(off) < 5.0, off
    assert (np.abs(off) < 3.0 * solution.sd_position[-1]).all(), (off, solution.sd_position[-1])


@pytest.mark.parametrize("share", [0.04, 0.5, 0.97])
def test_a_cut_hatanaka_file_is_used_up_to_the_cut(tmp_path: Path, share: float) -> None:
    """As a station that lost its power leaves it; what a lost line damages, too."""
    whole = gzip.decompress(OBSERVATIONS.read_bytes())
    head = whole.index(b"END OF HEADER") + 14
    at = head + round(share * (len(whole) - head))
    imu = read_imu(standing(tmp_path / "imu.csv", FROM_S))
    rows, _ = READERS["raw"](OBSERVATIONS, imu, "raw")
    for data in (whole[:at], whole[:at] + whole[at + 200 :]):
        cut = tmp_path / "cut.crx"
        cut.write_bytes(data)
        found, lost = READERS["raw"](cut, imu, "raw")
        assert len(rows) * share - 12 < len(found) <= len(rows) * share + 12
        for one, other in zip(found[:-1], rows, strict=False):
            assert one.measurement == other.measurement
        (note,) = [each for each in lost if each.reason == "file_cut"]
        assert "up to the damage" in note.detail


def test_what_the_unpacking_skips_is_told(tmp_path: Path) -> None:
    """An epoch line whose first letter is damaged: no Python warning, a line of the account."""
    lines = gzip.decompress(OBSERVATIONS.read_bytes()).split(b"\n")
    head = next(k for k, line in enumerate(lines) if b"END OF HEADER" in line)
    lines[head + 46] = b"x" + lines[head + 46]
    damaged = tmp_path / "damaged.crx"
    damaged.write_bytes(b"\n".join(lines[: head + 200]) + b"\n")
    imu = read_imu(standing(tmp_path / "imu.csv", FROM_S))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, lost = READERS["raw"](damaged, imu, "raw")
    assert found
    assert "skip until an initialized epoch" in {e.reason: e.detail for e in lost}["damaged"]


def test_what_was_sent_comes_when_it_was_sent(tmp_path: Path) -> None:
    """The first of each satellite and message at the start, the others not before their time."""
    imu = read_imu(standing(tmp_path / "imu.csv", FROM_S))
    rows, _ = READERS["raw"](NAVIGATION, imu, "raw")
    start_ns = round(FROM_S * 1e9)
    assert min(row.t_arrival_ns for row in rows) == start_ns
    first, later = 0, 0
    for row in rows:
        toe_ns = round(getattr(row.measurement, "toe_s", 0.0) * 1e9)
        if row.t_arrival_ns == start_ns:
            first += 1
        else:
            later += 1
            assert abs(row.t_arrival_ns - toe_ns) < 4 * 3600 * 10**9
    assert first >= 90
    assert later > 1500


def test_first_lines_that_editors_leave(tmp_path: Path) -> None:
    """A byte order mark and blank lines are passed over; a moved label is named."""
    imu = read_imu(standing(tmp_path / "imu.csv", FROM_S))
    unpacked = rinex_text(OBSERVATIONS, gzip.decompress(OBSERVATIONS.read_bytes()))
    assert unpacked is not None
    text = "\n>".join(unpacked[0].split("\n>")[:4]) + "\n"
    for odd in ("\ufeff" + text, "\r\n" + text, text.replace("\n", "\r\n"), observations_2(text)):
        file = tmp_path / "odd.rnx"
        file.write_text(odd, newline="")
        assert len(READERS["raw"](file, imu, "raw")[0]) == 3
    for odd in (text.replace("  ", "\t"), text.replace("RINEX VERSION", "Rinex Version")):
        file.write_text(odd)
        with pytest.raises(TableError, match="its label elsewhere"):
            READERS["raw"](file, imu, "raw")


def test_reasons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imu = standing(tmp_path / "imu.csv", FROM_S)
    code, output = run(tmp_path, imu, OBSERVATIONS)
    assert code == 65
    assert "no_ephemeris" in output
    code, output = run(tmp_path, imu, NAVIGATION)
    assert (code, "and no observation: give that file as well" in output) == (65, True)
    old = tmp_path / "old.rnx"
    old.write_text(header("1.00"))
    code, output = run(tmp_path, imu, old)
    assert (code, "RINEX 1.00; versions 2 to 4 are read" in output) == (65, True)
    cut = tmp_path / "cut.crx.gz"
    cut.write_bytes(gzip.compress(gzip.decompress(OBSERVATIONS.read_bytes())[:60_000]))
    code, output = run(tmp_path, imu, cut, NAVIGATION)
    assert code in (0, 65)
    assert "Traceback" not in output
    monkeypatch.setitem(sys.modules, "hatanaka", None)
    code, output = run(tmp_path, imu, OBSERVATIONS)
    assert code == 69
    assert "pip install 'hatanaka>=2.8'" in output


def test_b1c_of_a_rinex_file_without_cnav_says_so(tmp_path: Path) -> None:
    """An observation file of B1C alone beside D1's ephemerides: RINEX 4 has CNV1, 3 has not."""
    imu = standing(tmp_path / "imu.csv", FROM_S)
    lines = "".join(f"C{prn:02d}{observed(2.2e7 + 1e5 * prn)}\n" for prn in (19, 20, 23, 32, 37))
    at = NOW.replace("2026 12 01 02 14 47", "2020 06 25 00 {m:02d} 00")
    text = header("3.05", "OBSERVATION DATA", BEIDOU)
    text += "".join(at.format(flag=0, n=5, m=m) + lines for m in range(10))
    only = tmp_path / "b1c.rnx"
    only.write_text(text)
    code, output = run(tmp_path, imu, only, NAVIGATION)
    assert code == 65
    assert "no_group_delay" in output
    empty = tmp_path / "empty.rnx"
    empty.write_text(nav4())
    code, output = run(tmp_path, imu, empty)
    assert (code, "without a record that is read" in output) == (65, True)
