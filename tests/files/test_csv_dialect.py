"""Tables as spreadsheets of other countries write them give the same numbers."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import ImuTable, read_imu

HEADER = "t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
ROWS = ["0.00,0.001,-0.002,0,0.15,-9.75,1e-3", "0.01,0.001,-.002,0,0.25,-9.80,2E+1"]
PLAIN = "\n".join([HEADER, *ROWS]) + "\n"


def read(path: Path, data: bytes) -> ImuTable:
    path.write_bytes(data)
    return read_imu(path)


def with_comma_decimals(text: str, between: str) -> str:
    return text.replace(",", between).replace(".", ",")


def quoted(text: str, between: str) -> str:
    rows = (row.split(between) for row in text.splitlines())
    return "\n".join(between.join(f'"{cell}"' for cell in row) for row in rows)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", "\t"),
        PLAIN.replace("\n", "\r"),
        with_comma_decimals(PLAIN, ";"),
        with_comma_decimals(PLAIN, "\t"),
        "\ufeff" + with_comma_decimals(PLAIN, ";").replace("\n", "\r\n"),
        quoted(PLAIN, ","),
        quoted(HEADER, ",") + "\n" + "\n".join(ROWS),
        HEADER + "\n" + quoted("\n".join(ROWS), ","),
        "\ufeff" + quoted(with_comma_decimals(PLAIN, ";"), ";"),
    ],
)
@pytest.mark.parametrize("zipped", [False, True])
def test_the_same_numbers(tmp_path: Path, text: str, zipped: bool) -> None:
    data = text.encode()
    plain = read(tmp_path / "plain.csv", PLAIN.encode())
    other = read(tmp_path / "other.csv", gzip.compress(data) if zipped else data)
    assert len(plain.t_s) == 2
    assert other.rejected == []
    for ours, theirs in ((plain.t_s, other.t_s), (plain.gyro, other.gyro)):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(plain.accel, other.accel)


def test_a_refused_row_keeps_its_line(tmp_path: Path) -> None:
    text = with_comma_decimals(PLAIN, ";") + "0,02;;;;;;\n0,03;0;0;0;0;0;eins\n"
    table = read(tmp_path / "imu.csv", text.encode())
    assert [(r.line, r.reason) for r in table.rejected] == [(4, "missing"), (5, "unreadable")]


def test_a_byte_that_is_none_of_utf_8_costs_its_row(tmp_path: Path) -> None:
    """A remark of a Windows in German beside numbers, and a number that a disk has damaged."""
    data = (HEADER + ",Höhe über Grund\n" + ROWS[0] + ",fährt\n" + ROWS[1] + ",\n").encode("cp1252")
    table = read(tmp_path / "imu.csv", data)
    assert len(table.t_s) == 2
    damaged = read(tmp_path / "damaged.csv", data.replace(b"-9.80", b"-9\xff80"))
    assert [(r.line, r.reason) for r in damaged.rejected] == [(3, "unreadable")]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (PLAIN.replace(",", " ").encode(), "blanks between the cells"),
        (b"# by a logger\n" + PLAIN.encode(), "line 1 is a comment"),
        (b"\n" + PLAIN.encode(), "line 1 is empty"),
        (PLAIN.encode("utf-16"), "UTF-16"),
        (b"sep=;\n" + PLAIN.replace(",", ";").encode(), "line 1 is a spreadsheet's 'sep='"),
        (
            PLAIN.replace(",", ";").encode() + b"0,02;0;0;0;0;0;-9,8\n",
            "numbers with a point and numbers with a comma",
        ),
        (gzip.compress(PLAIN.encode(), mtime=0)[:-20], "damaged .gz"),
    ],
    ids=["blanks", "comment", "empty", "utf16", "sep", "mixed", "damaged"],
)
def test_what_is_refused_has_a_name(tmp_path: Path, data: bytes, said: str) -> None:
    with pytest.raises(TableError, match=said):
        read(tmp_path / "imu.csv", data)
