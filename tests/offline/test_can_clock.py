"""A recorder whose clock is set while it records: the same samples and fixes as without."""

from __future__ import annotations

import json
from pathlib import Path

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.commands.app import app
from fusiond.configuration.load import load_config
from fusiond.offline.can_through_drivers import CanLog, read_can_log
from tests.offline.recorded_bus import BEGIN_S, CONFIG, bus, candump
from tests.places import DATA

SECONDS, AT_S = 60, 31.0
LEAST_REPORTS = 5


def read(tmp_path: Path, lines: list[str], name: str = "bus.log") -> CanLog:
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n")
    return read_can_log(path, load_config(CONFIG))


def fixes(log: CanLog) -> list[PositionFix]:
    return [r.measurement for r in log.arrivals if isinstance(r.measurement, PositionFix)]


def valid_s(log: CanLog) -> np.ndarray:
    """Of the fixes, since the beginning."""
    stamps = [fix.stamp for fix in fixes(log)]
    return np.array([s.t_ns * 1e-9 for s in stamps if isinstance(s, MonotonicStamp)]) - BEGIN_S


def off_s(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest distance to what is expected next to it."""
    return float(np.abs(found[:, None] - expected).min(axis=1).max())


@pytest.fixture(scope="module")
def even(tmp_path_factory: pytest.TempPathFactory) -> CanLog:
    return read(tmp_path_factory.mktemp("even"), candump(bus(SECONDS)))


@pytest.mark.parametrize(
    "by", [86_400.0, -86_400.0, -3600.0, 5.0, -5.0, 0.4, -0.6, 1.7e9 - BEGIN_S]
)
def test_a_clock_that_is_set_once(by: float, even: CanLog, tmp_path: Path) -> None:
    log = read(tmp_path, candump(bus(SECONDS), lambda t_s: by if t_s >= AT_S else 0.0))
    assert len(log.imu.t_s) == len(even.imu.t_s) == 100 * SECONDS
    # Frames are put together by their stamps: an epoch may be lost to the step.
    assert SECONDS - LEAST_REPORTS <= len(fixes(even)) <= len(fixes(log)) + 1
    # Times are those of the clock as it was at the end.
    assert np.abs(log.imu.t_s - by - even.imu.t_s).max() < 5e-3
    assert off_s(valid_s(log) - by, valid_s(even)) < 0.02
    assert max(row.sd_time_s for row in log.arrivals) < 0.1
    (stepped,) = [text for code, text in log.events if code == "system_clock_stepped"]
    assert f"set by {by:+.1f}"[:12] in stepped
    assert "s of the log" in stepped
    assert log.rejected["can"] == []


def test_set_twice(even: CanLog, tmp_path: Path) -> None:
    """No date at first, then a wrong zone."""

    def ahead(t_s: float) -> float:
        return -BEGIN_S if t_s < 20.0 else (7200.0 if t_s < 40.0 else 0.0)

    log = read(tmp_path, candump(bus(SECONDS), ahead))
    assert np.abs(log.imu.t_s - even.imu.t_s).max() < 5e-3
    assert off_s(valid_s(log), valid_s(even)) < 0.02
    assert [code for code, _ in log.events].count("system_clock_stepped") == 2


def test_a_pause_is_no_step(tmp_path: Path) -> None:
    """The bus slept for a minute: the receiver's UTC went on."""
    lines = candump(m for m in bus(150) if not 30.0 <= m.timestamp - BEGIN_S < 95.0)
    log = read(tmp_path, lines)
    assert log.imu.t_s[-1] - log.imu.t_s[0] == pytest.approx(150.0, abs=0.1)
    assert not [code for code, _ in log.events if code == "system_clock_stepped"]
    paused = [text for code, text in log.events if code == "recorder_paused"]
    assert paused == ["no frame for 65 s by the recorder's clock"]


@pytest.mark.parametrize("by", [-3600.0, 3600.0])
def test_without_utc(by: float, tmp_path: Path) -> None:
    """What goes back was set; what leaps may be either, and that is told."""
    lines = candump(bus(SECONDS, utc=False), lambda t_s: by if t_s >= AT_S else 0.0)
    log = read(tmp_path, lines)
    assert len(log.imu.t_s) == 100 * SECONDS
    span = log.imu.t_s[-1] - log.imu.t_s[0]
    assert span == pytest.approx(60.0 if by < 0.0 else 3660.0, abs=0.1)
    codes = dict(log.events)
    assert ("system_clock_stepped" in codes) == (by < 0.0)
    if by > 0.0:
        assert "or its clock was set, of which no device tells UTC" in codes["recorder_paused"]


CASE = DATA.parent / "cases" / "10_clock_set_by_a_day.log.gz"


@pytest.mark.skipif(not CASE.is_file(), reason=f"{CASE} is missing: set FUSIOND_DATA")
def test_a_real_drive_goes_on_over_the_step(tmp_path: Path) -> None:
    """All fixes were `time_unknown` from the step on, and nothing was navigated."""
    report = tmp_path / "report.json"
    arguments = ["process", str(CONFIG), "--can", str(CASE), "--json", str(report)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    found = json.loads(report.read_text())
    assert found["sources"]["gnss"] == {"no_alignment": 11, "start": 1, "fused": 85}
    assert "! the system clock was set by +86400.0" in done.stdout


def test_a_wrong_zone_is_told_by_the_receivers_utc(even: CanLog, tmp_path: Path) -> None:
    log = read(tmp_path, candump(bus(SECONDS), lambda t_s: 7200.0))
    (told,) = [text for code, text in log.events if code == "recorder_clock_off"]
    assert told == "the recorder's clock is off by +7200.0 s from the UTC of gnss"
    assert not [code for code, _ in even.events if code == "recorder_clock_off"]


def test_a_step_while_the_receiver_is_silent(even: CanLog, tmp_path: Path) -> None:
    """In a tunnel: what tells UTC again after it tells the step apart."""

    def outside(m: can.Message) -> bool:
        return m.arbitration_id == 9 or not 25.0 < m.timestamp - BEGIN_S < 40.0

    lines = candump(filter(outside, bus(SECONDS)), lambda t_s: 5.0 if t_s >= AT_S else 0.0)
    log = read(tmp_path, lines)
    assert np.abs(log.imu.t_s - 5.0 - even.imu.t_s).max() < 5e-3
    assert len(fixes(log)) > len(fixes(even)) - 20


@pytest.mark.parametrize("each", [1.0, 7.0, -90.0])
def test_set_several_times_while_the_receiver_is_silent(
    each: float, even: CanLog, tmp_path: Path
) -> None:
    """What tells UTC after the last of them tells all of them apart from pauses."""

    def outside(m: can.Message) -> bool:
        return m.arbitration_id == 9 or not 20.0 < m.timestamp - BEGIN_S < 44.0

    def ahead(t_s: float) -> float:
        return each * sum(t_s >= at_s for at_s in (26.0, 31.0, 36.0, 41.0))

    log = read(tmp_path, candump(filter(outside, bus(SECONDS)), ahead))
    by = 4.0 * each
    assert np.abs(log.imu.t_s - by - even.imu.t_s).max() < 2e-2
    assert off_s(valid_s(log)[-10:] - by, valid_s(even)) < 0.02
    assert [code for code, _ in log.events].count("system_clock_stepped") == 4


@pytest.mark.parametrize("back", [-5.0, 2.0])
def test_set_again_before_five_reports(back: float, even: CanLog, tmp_path: Path) -> None:
    def ahead(t_s: float) -> float:
        return 5.0 * (t_s >= AT_S) + back * (t_s >= AT_S + 3.0)

    log = read(tmp_path, candump(bus(SECONDS), ahead))
    by = 5.0 + back
    assert np.abs(log.imu.t_s - by - even.imu.t_s).max() < 2e-2
    assert off_s(valid_s(log) - by, valid_s(even)) < 0.05


def test_a_pause_among_steps_is_none(even: CanLog, tmp_path: Path) -> None:
    """Of two leaps in a silence the second was a pause, which UTC shows by what is left."""

    def outside(m: can.Message) -> bool:
        since_s = m.timestamp - BEGIN_S
        return (m.arbitration_id == 9 or not 20.0 < since_s < 44.0) and not 35.0 <= since_s < 37.0

    log = read(tmp_path, candump(filter(outside, bus(SECONDS)), lambda t_s: 9.0 * (t_s >= 27.0)))
    span_s = log.imu.t_s[-1] - log.imu.t_s[0]
    assert span_s == pytest.approx(even.imu.t_s[-1] - even.imu.t_s[0], abs=2e-2)
    assert [code for code, _ in log.events].count("system_clock_stepped") == 1


@pytest.mark.parametrize("rate", [0.1, -0.1, 0.02, -0.3])
def test_a_clock_that_is_slewed(rate: float, even: CanLog, tmp_path: Path) -> None:
    """Tick of the system clock turned to its end: half of the fixes were lost."""

    def ahead(t_s: float) -> float:
        return rate * min(max(0.0, t_s - 20.0), 25.0)

    log = read(tmp_path, candump(bus(SECONDS), ahead))
    by = 25.0 * rate
    assert len(log.imu.t_s) == len(even.imu.t_s)
    assert len(fixes(log)) >= len(fixes(even)) - 1
    # Begin and end of a slew are known to what reports jitter by, over its rate.
    assert np.abs(log.imu.t_s - by - even.imu.t_s).max() < 0.03
    assert off_s(valid_s(log) - by, valid_s(even)) < 0.03
    assert max(row.sd_time_s for row in log.arrivals) < 0.1
    (told,) = [text for code, text in log.events if code == "recorder_clock_slewed"]
    ran = float(told.partition("clock ran ")[2].partition("%")[0]) / 100.0
    assert ran == pytest.approx(abs(rate), abs=1e-3)
    assert ("too fast" in told) == (rate > 0.0)
    assert not [code for code, _ in log.events if code == "system_clock_stepped"]


def test_an_even_clock_is_read_once(even: CanLog) -> None:
    assert not [code for code, _ in even.events if code == "recorder_clock_slewed"]


def test_a_slew_and_a_step(even: CanLog, tmp_path: Path) -> None:
    """As a computer that is set by an hour, and then slews what is left of it."""

    def ahead(t_s: float) -> float:
        return -3600.0 * (t_s < 15.0) - 0.08 * (15.0 + 20.0 - min(max(t_s, 15.0), 35.0))

    log = read(tmp_path, candump(bus(SECONDS), ahead))
    assert len(fixes(log)) >= len(fixes(even)) - 2
    assert np.abs(log.imu.t_s - even.imu.t_s).max() < 0.1
    codes = [code for code, _ in log.events]
    assert codes.count("system_clock_stepped") == codes.count("recorder_clock_slewed") == 1
