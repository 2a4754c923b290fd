"""The demo: the real daemon, devices on virtual CAN and ptys, a real broker; and what it shows."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
from itertools import takewhile
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest
from rich.console import Console

from fusiond.demo import broker as demo_broker
from fusiond.demo.demo import (
    OUTAGE_START_S,
    Score,
    demo_setup,
    ned_error,
    wrapped,
)
from fusiond.demo.outage_report import outage_report
from fusiond.demo.terminal_view import _MADE_INSIDE, Live, Screen, line
from fusiond.navigation.solution import Mode, Solution
from fusiond.replay.replay_output import ReplayOptions, replay
from fusiond.simulation.papers import REST_S
from tests.patience import PATIENCE_S

KEYS = [
    "duration_s",
    "ticks",
    "overruns",
    "lateness_p99_ms",
    "horizontal_rms_m",
    "yaw_rms_deg",
    "nees",
    "mqtt_published",
    "mqtt_dropped",
    "fused",
    "rejected",
    "fused_by_source",
    "rejected_by_source",
]


@pytest.fixture
def command() -> list[str]:
    return [str(Path(sys.executable).with_name("fusiond")), "demo", "--headless"]


def test_navigates_on_all_sources_and_ctrl_c_ends_with_the_summary(
    command: list[str], tmp_path: Path
) -> None:
    """And what it recorded gives the same bits once more. Its page is there as long as it is."""
    with subprocess.Popen(
        [*command, "--duration", "300", "--record", str(tmp_path), "--dashboard"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        bound = threading.Timer(PATIENCE_S, process.kill)
        bound.start()
        assert process.stderr is not None
        # What the lines say came back through the broker.
        said = list(takewhile(lambda text: "navigating" not in text, process.stderr))
        assert process.poll() is None, said
        assert any("aligning" in text for text in said)
        assert re.fullmatch(r"broker: 127\.0\.0\.1:\d+", said[1].strip())
        page = said[0].removeprefix("dashboard: ").strip()
        with urlopen(page, timeout=PATIENCE_S) as answer:
            assert b"<title>fusiond</title>" in answer.read()
        os.killpg(process.pid, signal.SIGINT)  # as the terminal does: to the broker's process too
        out, err = process.communicate(timeout=PATIENCE_S)
        bound.cancel()
    assert process.returncode == 0, err
    summary = json.loads(out.splitlines()[-1])
    assert list(summary) == KEYS
    assert 0.0 < summary["duration_s"] < 300.0
    assert summary["ticks"] > 0
    assert summary["fused_by_source"]["imu"] > 0
    assert summary["fused_by_source"]["gnss"] > 0
    assert summary["fused"] > 0
    assert 0.0 < summary["horizontal_rms_m"] < 10.0
    assert 0.0 < summary["yaw_rms_deg"] < 10.0
    assert summary["nees"] > 0.0
    assert summary["mqtt_published"] > 0
    assert "Traceback" not in err
    with pytest.raises(URLError):
        urlopen(page, timeout=PATIENCE_S)
    again = replay(list(tmp_path.glob("*.mcap")), ReplayOptions())
    assert again["identical"] is True, again["first_difference"]
    assert again["compared"] == summary["ticks"]
    assert again["problems"] == again["driver_faults"] == []


def test_ends_after_its_duration_and_what_never_navigated_is_null(command: list[str]) -> None:
    """The car rests for longer than that, so there is no heading yet."""
    done = subprocess.run(
        [*command, "--duration", "2"],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert list(summary) == KEYS
    assert summary["duration_s"] >= 2.0
    assert summary["horizontal_rms_m"] is None
    assert summary["yaw_rms_deg"] is None
    assert summary["nees"] is None
    assert "Traceback" not in done.stderr


def test_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_broker.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(demo_broker.DemoError, match=r"install 'amqtt>=0.11'"):
        demo_broker.DemoBroker()


def test_car_rests_moves_and_has_the_configured_sensors(tmp_path: Path) -> None:
    config, scenario = demo_setup().served(1883, tmp_path), demo_setup().scenario
    assert scenario.imu == config.imu
    truth = scenario.truth(30.0)
    speed = np.linalg.norm(truth.at(np.array([REST_S - 0.5, OUTAGE_START_S])).v_ned, axis=1)
    assert speed[0] < 1e-9
    assert speed[1] > config.alignment.course_speed_m_s


def test_score_against_the_truth(tmp_path: Path) -> None:
    """Solutions 3 m north and 4 m east of the truth; P with a correlation of 0.5."""
    vehicle = demo_setup().vehicle(20.0, tmp_path)
    covariance = np.zeros((21, 21))
    covariance[6:8, 6:8] = [[4.0, 3.0], [3.0, 9.0]]
    score = Score()
    for t_s in (12.0, 12.05, 12.1, 13.0):
        truth = vehicle.truth.at(np.array([t_s]))
        position = truth.position[0].copy()
        scale = ned_error(position[None] + 1e-6, truth.position)[0] / 1e-6
        position += [3.0 / scale[0], 4.0 / scale[1], 0.0]
        t_ns = vehicle.start_ns + round(t_s * 1e9)
        solution = Solution(
            t_ns,
            Mode.NAVIGATING,
            "",
            *(float(p) for p in position),
            rpy_rad=(0.0, 0.0, float(truth.rpy[0, 2]) + np.radians(0.5) - 2.0 * np.pi),
        )
        score.add(solution, covariance)
        score.add(solution._replace(mode=Mode.INVALID), covariance)
    result = score.against(vehicle)
    assert result["horizontal_rms_m"] == pytest.approx(5.0, abs=2e-3)
    assert result["yaw_rms_deg"] == pytest.approx(0.5, abs=1e-3)
    expected = np.array([3.0, 4.0]) @ np.linalg.inv(covariance[6:8, 6:8]) @ [3.0, 4.0]
    assert result["nees"] == pytest.approx(expected, rel=1e-3)

    t_s, error_m, sigma_m = score.horizontal(vehicle)
    assert t_s[[0, -1]] == pytest.approx([12.0, 13.0])
    assert error_m == pytest.approx([5.0] * 3, abs=2e-3)
    assert sigma_m == pytest.approx([13.0**0.5] * 3)


def test_story_tells_the_outages_that_were_lived_through() -> None:
    t_s = np.arange(10.05, 60.0, 0.1)
    error_m = np.where((t_s > 18.0) & (t_s < 30.0), 0.5 + (t_s - 18.0) * 0.25, 0.5)
    angles_deg = list(
        outage_report(t_s, error_m, np.full_like(t_s, 1.0), [(2.0, 5.0), (18.0, 30.0)])
    )
    assert angles_deg == [
        "12 s without GNSS: the error grew from 0.50 to 3.49 m at most, and sigma said "
        "1.00 m there",
        "the vehicle was within two sigma for 88 % of the 50 s that it was navigated",
    ]
    none = np.zeros(0)
    assert list(outage_report(none, none, none, [(1.0, 2.0)])) == [
        "No solution: the vehicle had not driven off yet"
    ]


def test_wrapped() -> None:
    assert wrapped(np.array([np.pi + 0.1, -np.pi - 0.1, 6.0 * np.pi])) == pytest.approx(
        [-np.pi + 0.1, np.pi - 0.1, 0.0]
    )


def _live() -> Live:
    live = Live(60.0, 1883, "demo")
    nav = {
        "mode": "navigating",
        "lat_deg": 30.5,
        "lon_deg": 114.3,
        "height_m": 38.0,
        **dict.fromkeys(("v_n_m_s", "v_e_m_s", "v_d_m_s", "roll_deg", "pitch_deg"), 1.0),
        "yaw_deg": 40.0,
        **{f"sd_{name}": 0.5 for name in ("n_m", "e_m", "d_m", "vn_m_s", "ve_m_s", "vd_m_s")},
        **dict.fromkeys(("sd_roll_deg", "sd_pitch_deg", "sd_yaw_deg"), 0.5),
    }
    source = {
        "state": "running",
        "detail": "",
        "fused": 12,
        "rejected": {"gated": 3, "duplicate": 1},
        "latency_s": 0.07,
        "fused_age_s": 1.25,
    }
    health = {
        "sources": {f"source{n}": source for n in range(7)},
        "ticks": 100,
        "overruns": 2,
        "lateness_p50_ms": 0.5,
        "lateness_p99_ms": 1.5,
        "cpu_percent": None,
        "memory_mb": 180.0,
    }
    event = {"t_utc": None, "level": "info", "source": "imu", "code": "x", "text": "y" * 200}
    for topic, message in (("nav", nav), ("health", health), ("status", {"why": "aided"})):
        live.message(topic, json.dumps(message).encode())
    for _ in range(50):
        live.message("event", json.dumps(event).encode())
    live.errors = [0.3, -0.4, 2.0, *[0.1] * 6]
    return live


@pytest.mark.parametrize("size", [(80, 24), (120, 40)])
def test_screen_fits_and_shows_errors_beside_sigma(size: tuple[int, int]) -> None:
    width, height = size
    console = Console(width=width, height=height, force_terminal=True, color_system=None)
    with console.capture() as captured:
        console.print(Screen(_live()))
    lines = captured.get().rstrip("\n").splitlines()
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    assert "NAVIGATING" in text
    assert "38.00 m 0.500 m +2.000 m 4.0" in " ".join(text.split())  # height: 4 sigma off
    assert "3 gated +1" in text
    assert "70 ms" in text
    assert "…" not in "\n".join(row for row in lines if "source" in row)
    assert "mosquitto_sub -p 1883" in text


def test_a_small_terminal_shows_events_and_the_broker() -> None:
    """What the filter makes inside gives way on 24 lines, not on 60."""
    live = _live()
    inside = {**live.health["sources"]["source0"], "detail": _MADE_INSIDE}
    live.health["sources"] |= {f"source{n}": inside for n in range(3, 7)}

    def shown(height: int) -> str:
        console = Console(width=80, height=height, force_terminal=True, color_system=None)
        with console.capture() as captured:
            console.print(Screen(live))
        assert len(captured.get().rstrip("\n").splitlines()) <= height
        return captured.get()

    small = shown(24)
    assert small.count("imu x: yyy") >= 2
    assert "mosquitto_sub -p 1883" in small
    assert "source2" in small
    assert "source3" not in small
    assert "source6" in shown(60)


def test_line() -> None:
    text = line(_live())
    assert "error   0.50 m (sigma 0.71)" in text
    assert "navigating" in text
    assert "yaw +0.10 deg" in text
    live = _live()
    live.errors = [*live.errors[:8], math.nan]  # without an inertial unit
    assert "no heading" in line(live)
    assert "nan" not in line(live)


def test_before_the_first_message() -> None:
    live = Live(60.0, 1883, "demo")
    console = Console(width=80, height=24, force_terminal=True, color_system=None)
    with console.capture() as captured:
        console.print(Screen(live))
    assert "WAITING" in captured.get()
    assert "waiting" in line(live)
