"""The IMU buffer: what is refused is named and counted, what is kept is contiguous and exact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import sensor_to_body
from fusiond.navigation.imu_buffer import MARGIN, MAX_FORCE_M_S2, MAX_RATE_RAD_S, ImuBuffer
from tests import runs

Array = NDArray[np.float64]

STEP = 10_000_000
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -9.8])


def _buffer(keep_s: float = 10.0) -> ImuBuffer:
    return ImuBuffer(100.0, keep_s, np.eye(3), 0.0, 0.5)


def _rows(*times: int) -> tuple[NDArray[np.int64], Array]:
    return np.array(times, dtype=np.int64), np.tile(STILL, (len(times), 1))


@pytest.mark.parametrize(
    ("column", "value", "name"),
    [
        (0, math.nan, "not_finite"),
        (5, math.nan, "not_finite"),
        (2, math.inf, "not_finite"),
        (3, -math.inf, "not_finite"),
        (1, MAX_RATE_RAD_S * 1.01, "out_of_range"),
        (4, -MAX_FORCE_M_S2 * 1.01, "out_of_range"),
    ],
)
def test_a_sample_that_cannot_be_true_is_refused_by_name(
    column: int, value: float, name: str
) -> None:
    buffer = _buffer()
    times, samples = _rows(STEP, 2 * STEP, 3 * STEP)
    samples[1, column] = value
    assert buffer.append(times, samples) == 2
    assert +buffer.counters == {name: 1}
    assert buffer.times[: buffer.end].tolist() == [STEP, 3 * STEP]
    assert np.isfinite(buffer.samples[: buffer.end]).all()


def test_stamps_that_stand_still_or_run_backward() -> None:
    buffer = _buffer()
    assert buffer.append(*_rows(1 * STEP, 2 * STEP, 2 * STEP, 1 * STEP, 3 * STEP)) == 3
    assert buffer.append(*_rows(3 * STEP)) == 0
    assert buffer.append(*_rows(2 * STEP, 4 * STEP)) == 1
    assert +buffer.counters == {"duplicate_stamp": 2, "backward_stamp": 2}
    assert buffer.times[: buffer.end].tolist() == [STEP, 2 * STEP, 3 * STEP, 4 * STEP]


def test_a_gap_is_counted_and_taken() -> None:
    buffer = _buffer()
    assert buffer.append(*_rows(STEP, 2 * STEP, 2 * STEP + 500_000_000)) == 3
    assert not +buffer.counters
    assert buffer.append(*_rows(2 * STEP + 500_000_000 + 500_000_001)) == 1
    assert +buffer.counters == {"gap": 1}


def test_empty_and_only_bad_chunks() -> None:
    buffer = _buffer()
    assert buffer.append(np.zeros(0, dtype=np.int64), np.zeros((0, 6))) == 0
    times, samples = _rows(STEP)
    assert buffer.append(times, samples * math.nan) == 0
    assert buffer.latest_ns == 0
    assert buffer.append(times, samples) == 1


def test_axes_and_time_offset() -> None:
    imu = Imu(axes=("-y", "+x", "+z"), mounting_deg=(0.0, 0.0, 90.0), time_offset_s=-0.02)
    buffer = ImuBuffer(100.0, 10.0, sensor_to_body(imu), imu.time_offset_s, 0.5)
    sample = np.array([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0]])
    buffer.append(np.array([100_000_000]), sample)
    # Nominal axes: forward -y, right +x, down +z; that frame is turned by 90 deg against the body.
    assert buffer.samples[0] == pytest.approx([-0.1, -0.2, 0.3, -1.0, -2.0, 3.0])
    assert buffer.latest_ns == 80_000_000


@settings(max_examples=40)
@given(
    st.lists(st.integers(1, 700) | st.just(2600), min_size=1, max_size=30),
    st.booleans(),
    st.data(),
)
def test_what_is_held_is_what_came(chunks: list[int], needed: bool, data: st.DataObject) -> None:
    """Any chunking: rows are the newest samples in order, `keep_s` of them at least, and no
    sample is dropped that the timeline needs, nor the two before it that its slopes use."""
    buffer = ImuBuffer(1.0, 5.0, np.eye(3), 0.0, 0.5)  # room for 1012: moved often at 100 Hz
    total = sum(chunks)
    times = STEP * np.arange(1, total + 1)
    samples = np.column_stack([np.arange(total) * 1e-3 % 50.0] * 6)
    done = 0
    for count in chunks:
        assert buffer.append(times[done : done + count], samples[done : done + count]) == count
        done += count
        assert buffer.next_sample == done
        rows = slice(buffer.start, done)
        assert np.array_equal(buffer.times[: buffer.end], times[rows])
        assert np.array_equal(buffer.samples[: buffer.end], samples[rows])
        assert buffer.start == 0 or buffer.oldest_ns < times[done - 1] - 5 * runs.SECOND
        if buffer.needed is not None:
            assert buffer.start <= max(0, buffer.needed - MARGIN)
        if needed and buffer.end:
            lowest = buffer.needed or min(done, buffer.start + MARGIN)
            buffer.needed = data.draw(st.integers(lowest, done))
    if not needed:
        assert len(buffer.times) < 3500


def test_faster_than_configured() -> None:
    """1 kHz where 100 Hz was configured: keeps all that is asked for, and memory settles."""
    buffer = _buffer(10.0)
    for first in range(0, 100_000, 50):
        times = 1_000_000 * np.arange(first + 1, first + 51)
        buffer.append(times, np.tile(STILL, (50, 1)))
        buffer.needed = max(0, buffer.next_sample - 10_000)
    assert buffer.latest_ns - buffer.oldest_ns >= 10 * runs.SECOND
    assert len(buffer.times) < 25_000
