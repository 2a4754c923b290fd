"""The compiled fixed-decimal formatter against Python's, and solutions written and read back."""

from __future__ import annotations

import io
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fusiond.files.fixed_decimal import MAX_CELL, MAX_DECIMALS, format_rows
from fusiond.files.measurement_csv import read_solution
from fusiond.files.solution_csv import COLUMNS, STATUS, SolutionWriter
from fusiond.navigation.solution import Mode

NO_LABELS = np.zeros((1, 0), dtype=np.uint8)


def formatted(values: list[float], decimals: int) -> list[str]:
    matrix = np.array([values], dtype=np.float64)
    out = np.full(MAX_CELL * len(values) + 1, ord("#"), dtype=np.uint8)
    size = format_rows(
        matrix,
        np.full(len(values), decimals, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        NO_LABELS,
        out,
    )
    text = out[:size].tobytes().decode("ascii")
    assert text.endswith("\n")
    return text[:-1].split(",")


@given(st.floats(-1e17, 1e17), st.integers(0, MAX_DECIMALS))
@example(-0.0, 4)
@example(-1e-9, 4)
@example(0.99999999999, 4)
@example(-9.99999, 4)
@example(0.5, 0)
@example(0.125, 2)
@example(243261.854, 6)
@example(1.7e9 + 1e-6, 6)
@example(-9.999999999999999e17, 9)
@example(5e-324, 9)
def test_as_python_formats_but_for_ties_and_signed_zero(value: float, decimals: int) -> None:
    (cell,) = formatted([value], decimals)
    expected = f"{value:.{decimals}f}"
    if float(expected) == 0.0:
        expected = expected.lstrip("-")
    assert len(cell) == len(expected) or cell.strip("-0.") != expected.strip("-0.")
    unit = Decimal(1).scaleb(-decimals)
    difference = abs(Decimal(cell) - Decimal(expected))
    assert difference in (0, unit)
    if difference:  # only where the value lies on a tie, as far as a double can tell
        tie = abs(abs(Decimal(value)) - abs(Decimal(cell) + Decimal(expected)) / 2)
        assert tie <= Decimal("1e-6") * unit


@given(st.floats(-1e6, 1e6))
def test_metres_read_back_within_half_a_unit(value: float) -> None:
    assert abs(float(formatted([value], 4)[0]) - value) <= 0.5000001e-4 + 1e-10


def test_what_is_no_number() -> None:
    cells = formatted([np.nan, np.inf, -np.inf, 1e18, -1e300, 0.0], 3)
    assert cells == ["", "inf", "-inf", "inf", "-inf", "0.000"]


def test_longest_cell_fits() -> None:
    (cell,) = formatted([-9.999999999999999e17], MAX_DECIMALS)
    assert len(cell) + 1 <= MAX_CELL


@pytest.mark.parametrize("decimals", range(MAX_DECIMALS + 1))
def test_cells_of_any_length_touch_no_more_than_their_part(decimals: int) -> None:
    # One unit below each power of ten, and the power: another digit before the point.
    values = [sign * (10.0**k - below) for k in range(18) for below in (1, 0) for sign in (1, -1)]
    for value in [*values, -9.999999999999999e17]:
        out = np.full(MAX_CELL + 9, ord("#"), dtype=np.uint8)
        table = np.full((1, 1), value), np.array([decimals]), np.zeros(1, dtype=np.int64)
        size = format_rows(*table, NO_LABELS, out[: MAX_CELL + 1])
        expected = f"{value or 0.0:.{decimals}f}\n"
        assert out[:size].tobytes() == expected.encode()
        assert (out[MAX_CELL:] == ord("#")).all()


def rows(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    return {
        "t_s": 1000.0 + 0.01 * np.arange(n),
        "lat_rad": rng.uniform(-1.5, 1.5, n),
        "lon_rad": rng.uniform(-3.1, 3.1, n),
        "height_m": rng.uniform(-100, 9000, n),
        "v_ned_m_s": rng.normal(0, 20, (n, 3)),
        "rpy_rad": rng.uniform(-1.5, 1.5, (n, 3)),
        "sd": rng.uniform(0.001, 5, (n, 9)),
        "status_code": rng.integers(0, len(STATUS), n),
    }


def test_written_solution_reads_back(tmp_path: Path) -> None:
    n = 5000  # more than two chunks
    data = rows(n)
    data["lat_rad"][:3] = np.nan
    path = tmp_path / "solution.csv"
    with SolutionWriter(path) as writer:
        writer.rows(**{k: v[:10] for k, v in data.items()})
        writer.rows(**{k: v[10:] for k, v in data.items()})
    table = read_solution(path)
    assert table.rejected == []
    assert table.status == [STATUS[code] for code in data["status_code"]]
    metre = 1.0 / 6378137.0
    np.testing.assert_allclose(table.t_s, data["t_s"], atol=1e-6)
    np.testing.assert_allclose(table.lat_rad, data["lat_rad"], rtol=0, atol=1e-4 * metre)
    np.testing.assert_allclose(table.lon_rad, data["lon_rad"], rtol=0, atol=1e-4 * metre)
    np.testing.assert_allclose(table.height_m, data["height_m"], rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(table.v, data["v_ned_m_s"], rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(table.rpy, data["rpy_rad"], rtol=0, atol=np.radians(5.1e-6))
    np.testing.assert_allclose(table.sd_position, data["sd"][:, :3], rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(table.sd_v, data["sd"][:, 3:6], rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(table.sd_rpy, data["sd"][:, 6:], rtol=0, atol=np.radians(5.1e-6))


def test_one_line_by_hand() -> None:
    stream = io.BytesIO()
    writer = SolutionWriter(stream)
    writer.rows(
        np.array([12.5]),
        np.radians([40.5]),
        np.radians([-105.25]),
        np.array([-1.0]),
        np.array([[1.0, -0.5, np.nan]]),
        np.radians([[0.5, -1.5, 179.0]]),
        np.array([[1, 2, 3, 0.1, 0.2, 0.3, *np.radians([0.5, 0.25, 2.0])]]),
        np.array([STATUS.index(Mode.NAVIGATING)]),
    )
    writer.close()
    header, line = stream.getvalue().decode().splitlines()
    assert header == ",".join(COLUMNS)
    assert header.startswith("t_s,lat_deg,lon_deg,height_m,v_n_m_s,v_e_m_s,v_d_m_s,roll_deg,")
    assert header.endswith(
        "sd_vn_m_s,sd_ve_m_s,sd_vd_m_s,sd_roll_deg,sd_pitch_deg,sd_yaw_deg,status"
    )
    assert line == (
        "12.500000,40.500000000,-105.250000000,-1.0000,1.0000,-0.5000,,0.50000,-1.50000,179.00000,"
        "1.0000,2.0000,3.0000,0.1000,0.2000,0.3000,0.50000,0.25000,2.00000,navigating"
    )


@pytest.mark.parametrize("code", [-1, len(STATUS)])
def test_unknown_status_code_is_an_empty_cell(code: int) -> None:
    stream = io.BytesIO()
    data = rows(1)
    data["status_code"][:] = code
    with SolutionWriter(stream) as writer:
        writer.rows(**data)
    assert stream.getvalue().decode().splitlines()[1].endswith(",")
