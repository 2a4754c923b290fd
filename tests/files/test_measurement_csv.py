"""Readers of measurement files: columns in any order, empty cells, and rows that cannot be true."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.files.csv_tables import FEWEST_ZEROS, TableError, file_report, rejection_counts
from fusiond.files.fixed_decimal import newlines, parse_rows
from fusiond.files.measurement_csv import (
    read_attitude,
    read_gnss,
    read_imu,
    read_rdss,
    read_solution,
    read_truth,
    read_wheel,
)

IMU = "t_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"


def write(folder: Path, *lines: str, end: str = "\n") -> Path:
    path = folder / "table.csv"
    path.write_bytes((end.join(lines) + end).encode())
    return path


def imu_row(t: float) -> str:
    return f"{t:.3f},0.01,0.02,0.03,0.1,0.2,-9.8"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_imu_values(tmp_path: Path, end: str) -> None:
    table = read_imu(write(tmp_path, IMU, imu_row(0.0), imu_row(0.01), end=end))
    np.testing.assert_array_equal(table.t_s, [0.0, 0.01])
    np.testing.assert_array_equal(table.gyro, [[0.01, 0.02, 0.03]] * 2)
    np.testing.assert_array_equal(table.accel, [[0.1, 0.2, -9.8]] * 2)
    assert table.rejected == []


def test_column_order_byte_order_mark_and_unknown_columns(tmp_path: Path) -> None:
    header = "\ufeffnote, " + ",".join(reversed(IMU.split(",")))
    table = read_imu(write(tmp_path, header, "warm,-9.8,0.2,0.1,0.03,0.02,0.01,5"))
    assert table.rejected == []
    assert table.t_s[0] == 5.0
    np.testing.assert_array_equal(table.gyro, [[0.01, 0.02, 0.03]])
    np.testing.assert_array_equal(table.accel, [[0.1, 0.2, -9.8]])


def test_last_line_without_newline_and_header_alone(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    path.write_text(f"{IMU}\n{imu_row(0.0)}\n{imu_row(1.0)}")
    assert len(read_imu(path).t_s) == 2
    path.write_text(IMU + "\n")
    empty = read_imu(path)
    assert empty.gyro.shape == (0, 3)
    assert empty.rejected == []


@pytest.mark.parametrize(
    ("row", "reason", "word"),
    [
        ("0.02,nan,0,0,0,0,-9.8", "not_finite", "gyro_x_rad_s"),
        ("0.02,0,0,0,0,0,-inf", "not_finite", "accel_z_m_s2"),
        ("0.02,0,0,,0,0,-9.8", "missing", "gyro_z_rad_s"),
        ("0.02,0,oops,0,0,0,-9.8", "unreadable", "'oops'"),
        ("0.02,0,0,1_0,0,0,-9.8", "unreadable", "'1_0'"),
        ("0.02,0,0,0,0,0", "columns", "6 cells"),
        ("0.02,0,0,0,0,0,-9.8,0.03,0,0,0,0,0,-9.8", "columns", "14 cells"),
        ("0.02,100.1,0,0,0,0,-9.8", "out_of_range", "-100 to 100"),
        ("0.02,0,0,0,0,-1000.1,-9.8", "out_of_range", "accel_y_m_s2"),
        ("0.01,0,0,0,0,0,-9.8", "time_repeated", "0.010000"),
        ("0.005,0,0,0,0,0,-9.8", "time_backwards", "after 0.010000"),
        ("900,0,0,0,0,0,-9.8", "time_ahead", "900"),
        ("1e300,0,0,0,0,0,-9.8", "out_of_range", "t_s"),
    ],
)
def test_impossible_imu_row_costs_only_itself(
    tmp_path: Path, row: str, reason: str, word: str
) -> None:
    path = write(tmp_path, IMU, imu_row(0), imu_row(0.01), row, imu_row(0.03), imu_row(0.04))
    table = read_imu(path)
    np.testing.assert_array_equal(table.t_s, [0.0, 0.01, 0.03, 0.04])
    (rejection,) = table.rejected
    assert (rejection.line, rejection.reason) == (4, reason)
    assert word in rejection.detail


def test_lines_count_from_the_file_although_blank_lines_are_no_rows(tmp_path: Path) -> None:
    path = write(tmp_path, IMU, imu_row(0), "", imu_row(0.01), "", "x,0,0,0,0,0,0", imu_row(0.02))
    table = read_imu(path)
    assert len(table.t_s) == 3
    assert [(r.line, r.reason) for r in table.rejected] == [(6, "unreadable")]


def test_a_reason_has_a_count_and_rejections_stand_in_file_order(tmp_path: Path) -> None:
    rows = [
        imu_row(0.0),
        imu_row(0.0),
        "1,999,0,0,0,0,0",
        imu_row(2.0),
        imu_row(2.0),
        "y,0,0,0,0,0,0",
    ]
    table = read_imu(write(tmp_path, IMU, *rows))
    assert [r.line for r in table.rejected] == [3, 4, 6, 7]
    report = file_report(len(table.t_s), table.rejected, first=1)
    assert report["rows"] == 2
    assert report["rejected"] == rejection_counts(table.rejected)
    assert report["first_rejected"] == ["line 3: time_repeated: t_s = 0.000000 after 0.000000"]
    assert rejection_counts(table.rejected) == {
        "time_repeated": 2,
        "out_of_range": 1,
        "unreadable": 1,
    }


@given(st.lists(st.integers(0, 30), min_size=1, max_size=40))
def test_time_of_kept_rows_increases_and_no_row_is_lost(
    tmp_path_factory: pytest.TempPathFactory, stamps: list[int]
) -> None:
    path = write(tmp_path_factory.mktemp("order"), IMU, *(imu_row(t) for t in stamps))
    table = read_imu(path)
    assert len(table.t_s) + len(table.rejected) == len(stamps)
    assert bool((np.diff(table.t_s) > 0).all())
    longest = [1] * len(stamps)  # the textbook's quadratic recursion as oracle
    for i, t in enumerate(stamps):
        longest[i] += max((longest[k] for k in range(i) if stamps[k] < t), default=0)
    assert len(table.t_s) == max(longest)


def test_a_file_that_is_no_table(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="No such file"):
        read_imu(tmp_path / "absent.csv")
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(TableError, match="empty"):
        read_imu(tmp_path / "empty.csv")
    with pytest.raises(TableError, match="lacks accel_z_m_s2"):
        read_imu(write(tmp_path, IMU.rpartition(",")[0], "0,0,0,0,0,0"))
    with pytest.raises(TableError, match="'t_s' occurs twice"):
        read_imu(write(tmp_path, IMU + ",t_s", imu_row(0) + ",0"))
    (tmp_path / "binary.csv").write_bytes(b"\x81\xfe\x00\x81," + IMU.encode() + b"\n")
    with pytest.raises(TableError, match="not a text file"):
        read_imu(tmp_path / "binary.csv")


GNSS = (
    "t_s,t_arrival_s,lat_deg,lon_deg,height_m,quality,satellites,sd_n_m,sd_e_m,sd_d_m,"
    "v_n_m_s,v_e_m_s,v_d_m_s,sd_vn_m_s,sd_ve_m_s,sd_vd_m_s"
)


def test_gnss_values_in_radians_and_empty_cells_are_unknown(tmp_path: Path) -> None:
    rows = ["1,1.2,40,-105,1600,4,20,0.1,0.2,0.3,1,2,3,0.4,0.5,0.6", "2,,41,-106,,,,,,,,,,,,"]
    table = read_gnss(write(tmp_path, GNSS, *rows))
    assert table.rejected == []
    np.testing.assert_allclose(table.lat_rad, np.radians([40.0, 41.0]), rtol=1e-15)
    np.testing.assert_allclose(table.lon_rad, np.radians([-105.0, -106.0]), rtol=1e-15)
    np.testing.assert_array_equal(table.sd_position, [[0.1, 0.2, 0.3], [np.nan] * 3])
    np.testing.assert_array_equal(table.v, [[1, 2, 3], [np.nan] * 3])
    np.testing.assert_array_equal(table.sd_v, [[0.4, 0.5, 0.6], [np.nan] * 3])
    np.testing.assert_array_equal(table.t_arrival_s, [1.2, np.nan])
    np.testing.assert_array_equal(table.height_m, [1600, np.nan])


def test_gnss_velocity_columns_may_be_absent(tmp_path: Path) -> None:
    table = read_gnss(write(tmp_path, "t_s,lat_deg,lon_deg,height_m,quality", "1,40,-105,0,1"))
    assert np.isnan(table.v).all()
    assert table.v.shape == (1, 3)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("2,2.1,90.1,-105,1600,4,20,1,1,1,,,,,,", "out_of_range"),
        ("2,2.1,40,180.5,1600,4,20,1,1,1,,,,,,", "out_of_range"),
        ("2,2.1,40,-105,1600,4,20,0,1,1,,,,,,", "sd_not_positive"),
        ("2,2.1,40,-105,1600,4,20,1,-1,1,,,,,,", "sd_not_positive"),
        ("2,2.1,40,-105,1600,4,20,1,1,1,0,0,0,1,0,1", "sd_not_positive"),
        ("2,2.1,40,-105,1600,0,0,1,1,1,,,,,,", "no_fix"),
        ("2,1.9,40,-105,1600,4,20,1,1,1,,,,,,", "arrival_before_validity"),
        ("2,2.1,,-105,1600,4,20,1,1,1,,,,,,", "missing"),
        ("2,2.1,40,-105,1600,4,20,1,1,nan,,,,,,", "not_finite"),
    ],
)
def test_impossible_gnss_row(tmp_path: Path, row: str, reason: str) -> None:
    good = "1,1.1,40,-105,1600,4,20,1,1,1,,,,,,"
    table = read_gnss(write(tmp_path, GNSS, good, row))
    assert len(table.t_s) == 1
    assert [(r.line, r.reason) for r in table.rejected] == [(3, reason)]


def test_rdss(tmp_path: Path) -> None:
    header = "t_s,t_arrival_s,lat_deg,lon_deg,height_m,precision_class_m,multi_value"
    table = read_rdss(
        write(
            tmp_path,
            header,
            "1,2.5,30,114,20,20,0",
            "2,1.5,30,114,20,20,0",
            "3,,30,114,20,20,0",
            "4,5,30,114,20,100,1",
            "5,6,30,114,20,0,0",
        )
    )
    np.testing.assert_array_equal(table.t_arrival_s, [2.5, 5.0])
    np.testing.assert_array_equal(table.precision_class_m, [20.0, 100.0])
    np.testing.assert_array_equal(table.multi_value, [False, True])
    assert [(r.line, r.reason) for r in table.rejected] == [
        (3, "arrival_before_validity"),
        (4, "missing"),
        (6, "sd_not_positive"),
    ]


def test_attitude_needs_a_sigma_for_each_angle_given(tmp_path: Path) -> None:
    header = "t_s,roll_deg,pitch_deg,yaw_deg,sd_roll_deg,sd_pitch_deg,sd_yaw_deg"
    table = read_attitude(
        write(tmp_path, header, "1,,,90,,,2", "2,1,2,3,1,1,", "3,,,,1,1,1", "4,1,91,3,1,1,1")
    )
    np.testing.assert_allclose(table.rpy, [[np.nan, np.nan, np.pi / 2]])
    np.testing.assert_allclose(table.sd_rpy, [[np.nan, np.nan, np.radians(2)]])
    assert [(r.line, r.reason) for r in table.rejected] == [
        (3, "missing"),
        (4, "missing"),
        (5, "out_of_range"),
    ]
    assert "sd_yaw_deg" in table.rejected[0].detail


def test_a_sigma_that_is_zero_in_every_row_is_none(tmp_path: Path) -> None:
    """Who has none writes 0; the fixes are used as if the columns were not there."""
    header = "t_s,lat_deg,lon_deg,height_m,sd_n_m,sd_e_m,sd_d_m,sd_vn_m_s"
    rows = [f"{i},40,-105,1600,0,0.000,0,{0.1 * i + 0.1}" for i in range(FEWEST_ZEROS)]
    table = read_gnss(write(tmp_path, header, *rows))
    assert len(table.t_s) == FEWEST_ZEROS
    assert np.isnan(table.sd_position).all()
    assert table.sd_v[0, 0] == pytest.approx(0.1)
    assert [str(r) for r in table.rejected] == [
        "sd_all_zero: sd_n_m, sd_e_m, sd_d_m are 0 in every row: taken as not given"
    ]
    assert file_report(FEWEST_ZEROS, table.rejected)["rejected"] == {}
    # One row that knows its sigma, and a 0 is a row that cannot be true.
    one = read_gnss(write(tmp_path, header, *rows, "99,40,-105,1600,1,1,1,1"))
    assert rejection_counts(one.rejected) == {"sd_not_positive": FEWEST_ZEROS}
    # Too few to tell, and a class that must be there.
    few = read_gnss(write(tmp_path, header, *rows[1:]))
    assert rejection_counts(few.rejected) == {"sd_not_positive": FEWEST_ZEROS - 1}
    rdss = "t_s,t_arrival_s,lat_deg,lon_deg,height_m,precision_class_m"
    table_rdss = read_rdss(write(tmp_path, rdss, *(f"{i},{i},40,9,5,0" for i in range(20))))
    assert rejection_counts(table_rdss.rejected) == {"sd_not_positive": 20}


def test_wheel(tmp_path: Path) -> None:
    table = read_wheel(write(tmp_path, "t_s,speed_m_s,sd_m_s", "1,-2.5,0.1", "2,3,", "3,4,0"))
    np.testing.assert_array_equal(table.speed_m_s, [-2.5, 3.0])
    np.testing.assert_array_equal(table.sd_m_s, [0.1, np.nan])
    assert [(r.line, r.reason) for r in table.rejected] == [(4, "sd_not_positive")]
    coarse = "t_s,speed_m_s,step_m_s,unsigned"
    table = read_wheel(write(tmp_path, coarse, "1,2,0.5,1", "2,3,0,1", "3,4,,2", "4,5,,"))
    np.testing.assert_array_equal(table.step_m_s, [0.5, np.nan])
    np.testing.assert_array_equal(table.unsigned, [1.0, np.nan])
    assert [r.reason for r in table.rejected] == ["sd_not_positive", "out_of_range"]


def test_truth_needs_its_position_and_a_solution_does_not(tmp_path: Path) -> None:
    path = write(
        tmp_path, "t_s,lat_deg,lon_deg,height_m,status", "1,,,,aligning", "2,40,9,5,navigating"
    )
    truth, solution = read_truth(path), read_solution(path)
    assert [(r.line, r.reason) for r in truth.rejected] == [(2, "missing")]
    assert truth.status == []
    assert solution.status == ["aligning", "navigating"]
    np.testing.assert_array_equal(solution.height_m, [np.nan, 5.0])


# --------------------------------------------------------------------------- the compiled reader

DECIMALS = st.from_regex(r"-?[0-9]{1,16}(\.[0-9]{0,16})?", fullmatch=True)


def parse(text: str, columns: int, rows: int) -> list[list[float]] | None:
    values = np.full((columns, rows), np.nan)
    data = np.frombuffer(text.encode(), dtype=np.uint8).copy()
    return values.T.tolist() if parse_rows(data, 0, values) else None


@given(
    st.lists(st.tuples(DECIMALS, DECIMALS), min_size=1, max_size=4), st.sampled_from(["\n", "\r\n"])
)
def test_plain_decimals_are_read_to_the_last_bit_or_left_to_others(
    table: list[tuple[str, str]], newline: str
) -> None:
    read = parse(newline.join(",".join(row) for row in table), 2, len(table))
    largest = max(int(cell.replace(".", "").replace("-", "")) for row in table for cell in row)
    if read is None:
        assert largest > 2**53
    else:
        assert read == [[float(cell) for cell in row] for row in table]


@pytest.mark.parametrize(
    "text",
    [
        *("1e3", "", "-", ".", "1.2.3", " 1", "1 ", "+1", "nan", "inf", "1_0", "1,2"),
        *("1\n\n", "1\n2", "x", "0." + "1" * 23, "9007199254740993", "1\r", "\u0663"),
    ],
)
def test_what_is_no_plain_decimal_is_left_to_others(text: str) -> None:
    expected = [[1.0]] if text == "1\r" else None
    assert parse(text, 1, 1) == expected


@pytest.mark.parametrize(
    "cell", ["5", "-5.", "12.5", ".1234", "-0.1234567", "1.12345678", "00.123456789"]
)
def test_nothing_is_read_beyond_the_end(cell: str) -> None:
    # The memory goes on with more digits: what looks at eight bytes at once must not take them.
    for text in (cell, f"{cell}\n", f"1,{cell}"):
        held = np.full(len(text) + 16, ord("7"), dtype=np.uint8)
        held[: len(text)] = np.frombuffer(text.encode(), dtype=np.uint8)
        values = np.full((1 + text.count(","), 1), np.nan)
        assert parse_rows(held[: len(text)], 0, values)
        assert values[-1, 0] == float(cell)


@pytest.mark.parametrize("after", [",", "\n", ".", "e", "/", ":", "-", "\x80", "\xff"])
@pytest.mark.parametrize("digits", range(1, 14))
def test_eight_digits_at_once_are_digits(digits: int, after: str) -> None:
    cell = "3." + "1415926535897"[:digits]
    text = f"{cell}{after}99999999\n".encode("latin-1")
    values = np.full((2 if after == "," else 1, 2 if after == "\n" else 1), np.nan)
    read = parse_rows(np.frombuffer(text, dtype=np.uint8).copy(), 0, values)
    assert read == (after in ",\n")
    if read:
        assert values.ravel().tolist() == [float(cell), 99999999.0]


@pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 16, 61])
def test_newlines_are_counted(length: int) -> None:
    rng = np.random.default_rng(length)
    for text in rng.choice(np.frombuffer(b"\n\x0b\t\x8a1", dtype=np.uint8), (50, length)):
        assert newlines(text) == text.tobytes().count(b"\n")


def test_a_pipe_is_read_as_a_file_is(tmp_path: Path) -> None:
    path, pipe = write(tmp_path, IMU, "0,0,0,0,0,0,9.8", "1,0,0,0,0,0,9.8"), tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor() as pool:
        writing = pool.submit(pipe.write_bytes, path.read_bytes())
        table = read_imu(pipe)
        writing.result()
    np.testing.assert_array_equal(table.t_s, [0.0, 1.0])
