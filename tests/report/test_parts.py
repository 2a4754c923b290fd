"""The parts of a page: thinning, spectrum, settings, size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.configuration.schema import Config
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.report.input_timing_and_spectrum import spectrum
from fusiond.report.page import page
from fusiond.report.plot_arrays import BUCKETS, thinned
from fusiond.report.report import document
from fusiond.report.run import Innovations, LogParts, Run
from fusiond.report.settings import changed_settings


@settings(max_examples=30)
@given(st.integers(1, 8_000), st.integers(0, 10**6))
def test_thinning_loses_no_extreme_and_invents_nothing(n: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    t_s = np.cumsum(random.uniform(0.01, 0.02, n))
    columns = random.standard_normal((n, 2))
    columns[random.integers(n), 0] = 99.0
    t, thin = thinned(t_s, columns)
    assert len(t) <= max(2 * BUCKETS, 1)
    assert np.all(np.diff(t) >= 0.0)
    assert np.array_equal(thin.max(axis=0), columns.max(axis=0))
    assert np.array_equal(thin.min(axis=0), columns.min(axis=0))
    assert np.all(np.isin(thin, columns))


def test_a_pause_is_a_gap() -> None:
    t_s = np.concatenate([np.arange(0.0, 500.0, 0.1), np.arange(600.0, 1000.0, 0.1)])
    for column in (np.ones((len(t_s), 1)), np.ones((len(t_s), 1))[::9]):
        t, thin = thinned(t_s[:: len(t_s) // len(column)][: len(column)], column)
        (gap,) = np.flatnonzero(np.isnan(thin[:, 0]))
        assert t[gap] == pytest.approx(550.0, abs=1.0)


def test_the_spectrum_of_white_noise_and_a_line() -> None:
    random = np.random.default_rng(5)
    n, step = 40_000, 0.01
    noise = 0.02 * random.standard_normal((n, 1))
    line = 0.5 * np.sin(2.0 * np.pi * 12.0 * step * np.arange(n))[:, None]
    frequency, density = spectrum(noise + line, np.zeros(n), step)
    # One-sided: variance = density^2 times half the sampling rate.
    flat = density[np.abs(frequency - 12.0) > 2.0]
    assert float(np.sqrt(np.mean(flat**2))) == pytest.approx(0.02 / np.sqrt(50.0), rel=0.02)
    assert frequency[np.argmax(density[:, 0])] == pytest.approx(12.0)
    power = np.sum(density[:, 0] ** 2) * (frequency[1] - frequency[0])
    assert power == pytest.approx(0.02**2 + 0.5**2 / 2.0, rel=0.02)


def test_stretches_are_not_joined_in_the_spectrum() -> None:
    """A step from one stretch to the next is no motion."""
    values = np.repeat([[0.0], [5.0]], 1000, axis=0)
    _, density = spectrum(values, np.repeat([0, 1], 1000), 0.01)
    assert float(density.max()) < 1e-9


def test_settings_that_differ_from_the_defaults() -> None:
    config = Config.model_validate(
        {
            "vehicle": "truck",
            "imu": {"sensor_class": "mems", "rate_hz": 200.0},
            "sources": {"fix": {"driver": "nmea", "port": "/dev/ttyS1", "baudrate": 115200}},
            "aiding": {"fix": {"kind": "gnss", "sigma_scale": 2.0}},
            "estimator": {"model": "ins15"},
        }
    )
    found = changed_settings(config.model_dump_json().encode())
    assert found is not None
    told = {d.key: (d.value, d.default) for d in found}
    assert told == {
        "vehicle": ('"truck"', '"vehicle"'),
        "imu.sensor_class": ('"mems"', "null"),
        "imu.rate_hz": ("200.0", "100.0"),
        "sources.fix.driver": ('"nmea"', None),
        "sources.fix.port": ('"/dev/ttyS1"', None),
        "sources.fix.baudrate": ("115200", told["sources.fix.baudrate"][1]),
        "aiding.fix.kind": ('"gnss"', None),
        "aiding.fix.sigma_scale": ("2.0", "1.0"),
        "estimator.model": ('"ins15"', '"ins21"'),
    }
    assert changed_settings(Config().model_dump_json().encode()) == []
    assert changed_settings(None) is None
    assert changed_settings(b"[1]") is None


def test_an_hour_stays_below_5_mb(tmp_path: Path) -> None:
    """A solution at 10 Hz, and two sources at 10 Hz each with innovations of three rows."""
    n = 36_000
    random = np.random.default_rng(1)
    t_s = 1.8e9 + 0.1 * np.arange(n)
    wander = np.cumsum(random.standard_normal((n, 3)), axis=0)
    solution = TrajectoryTable(
        t_s,
        0.5 + 1e-7 * wander[:, 0],
        2.0 + 1e-7 * wander[:, 1],
        wander[:, 2],
        *(random.standard_normal((n, 3)) for _ in range(2)),
        *(np.abs(random.standard_normal((n, 3))) for _ in range(3)),
        status=["navigating"] * n,
        rejected=[],
    )
    parts = LogParts(tick_delay_ms=(np.repeat(t_s, 10), random.standard_normal(10 * n)))
    for source in ("gnss", "gnss_velocity"):
        whitened = random.standard_normal((n, 3))
        nis = np.sum(whitened**2, axis=1)
        outcome = ["fused", "gated"] * (n // 2)
        delay = np.abs(nis)
        parts.innovations[source] = Innovations(t_s, delay, nis, np.full(n, 3.0), whitened, outcome)
    run = Run("hour", solution, posix=True, log=parts)
    text = page("hour", document("hour", [run], solution))
    assert 100_000 < len(text) < 5_000_000
