"""Pages of a drive that was recorded, of solution files, of two runs, of files that are broken."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusiond.files.measurement_csv import read_truth
from fusiond.files.solution_csv import STATUS, SolutionWriter
from fusiond.offline.compare import compare
from fusiond.recording.reader import Log
from fusiond.report.local_plane import metres_from, origin_of
from fusiond.report.report import report
from fusiond.report.run import Run
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S
from tests.recording.driven import Drive
from tests.report.pages import (
    EPOCH_NS,
    fusiond,
    item,
    items,
    numbers,
    read_page,
    series,
    solution,
    written,
)


@dataclass
class Recorded:
    log: Path
    truth: Path
    page: Path
    run: Run
    document: dict[str, Any]
    health: dict[str, Any]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The demo's car for 26 s, 14 s of them navigating, and its page with the truth."""
    folder = tmp_path_factory.mktemp("drive")
    drive = Drive(folder, 30.0)
    drive.run(26.0)
    (log,) = drive.close()
    states = drive.vehicle.truth.at(np.arange(0.0, 28.0, 0.1))
    path = folder / "truth.csv"
    n = len(states.t_s)
    with SolutionWriter(path) as file:
        file.rows(
            states.t_s + drive.vehicle.utc_start_ns * 1e-9,
            *states.position.T,
            states.v_ned,
            states.rpy,
            np.full((n, 9), np.nan),
            np.full(n, STATUS.index("navigating"), dtype=np.int64),
        )
    page = folder / "report.html"
    (run,) = report([log], page, path)
    health = [m.json() for m in Log([log]).messages("/health")]
    return Recorded(log, path, page, run, read_page(page), health[-1])


# --------------------------------------------------------------------------- a log


def test_a_page_has_every_section_and_a_sentence_under_every_plot(recorded: Recorded) -> None:
    titles = [s["title"] for s in recorded.document["sections"]]
    assert titles == [
        "Summary",
        "Track",
        "Position, velocity, attitude",
        "Errors against the truth",
        "Innovations",
        "Biases and calibration",
        "Verdicts",
        "Delays",
        "Satellites",
        "Inertial unit",
        "Computer",
    ]
    drawn = [i for t in titles for i in items(recorded.document, t) if i["kind"] != "sentence"]
    plots = [i for i in drawn if i["kind"] in ("plot", "track")]
    assert len(plots) > 20
    assert all(i["good"].startswith("Good: ") for i in plots)
    assert not recorded.document["runs"][0]["problems"]


def test_the_page_asks_for_nothing(recorded: Recorded) -> None:
    text = recorded.page.read_text()
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'" in text
    program = re.sub(r'type="application/json">.*?</script>', "></script>", text, flags=re.DOTALL)
    asks = r"<link|<img|<iframe|<script[^>]*src|@import|url\(|fetch\(|XMLHttp|import\(|WebSocket"
    assert not re.findall(asks, program)
    assert set(re.findall(r"https?://[^\s\"')]*", program)) == {"https://github.com/leeoniya/uPlot"}


def test_the_states_are_those_of_the_log(recorded: Recorded) -> None:
    s = recorded.run.solution
    origin = origin_of(s)
    assert origin is not None
    north = metres_from(origin, s)[:, 0]
    plot = item(recorded.document, "Position, velocity, attitude", "Position from")
    drawn = series(plot, "north")
    assert np.nanmax(drawn) == pytest.approx(np.nanmax(north), abs=1e-3)
    assert numbers(plot["x"])[-1] == pytest.approx(s.t_s[-1] - s.t_s[0], abs=1e-3)
    track = items(recorded.document, "Track")[0]
    assert len(numbers(track["north"])) == np.isfinite(s.lat_rad).sum()
    assert numbers(track["north"])[-1] == pytest.approx(north[-1], abs=1e-3)
    modes = recorded.document["runs"][0]["modes"]
    assert [mode for *_, mode in modes] == ["waiting", "aligning", "navigating"]
    codes = [code for *_, code, _ in recorded.document["runs"][0]["events"]]
    assert "aligned" in codes


def test_errors_are_those_of_compare(recorded: Recorded) -> None:
    truth = read_truth(recorded.truth)
    s = recorded.run.solution
    utc = replace(s, t_s=s.t_s + recorded.run.truth_offset_s)
    expected = compare(utc, truth)
    table = item(recorded.document, "Errors against the truth", f"{expected['epochs']} epochs")
    horizontal = expected["horizontal_rms_m"]
    assert horizontal is not None
    assert 0.05 < horizontal < 5.0
    assert table["rows"][0][:2] == ["horizontal", f"{horizontal:.4f}"]
    coverage = item(recorded.document, "Errors against the truth", "Coverage")
    share = expected["horizontal_inside_2_sigma"]
    assert share is not None
    assert coverage["rows"][1] == ["inside 2 sigma horizontally", f"{100 * share:.1f} %", "86.5 %"]


def test_each_measurement_is_counted_once(recorded: Recorded) -> None:
    """A late fix rewinds the filter, which meets later measurements again: the log holds them
    twice."""
    found = recorded.run.log
    assert found is not None
    gnss = found.innovations["gnss"]
    assert np.count_nonzero(gnss.fused) == pytest.approx(
        recorded.health["sources"]["gnss"]["fused"], abs=10
    )
    assert len(set(gnss.t_s)) == len(gnss.t_s)
    plot = item(recorded.document, "Innovations", "NIS a degree of freedom, gnss")
    assert np.isfinite(series(plot, "accepted")).sum() == np.count_nonzero(gnss.fused)
    assert plot["good"].startswith("Good: around 1")
    raw = item(recorded.document, "Innovations", "Innovation, gnss: estimate minus measurement")
    assert raw["unit"] == "m"
    for k, axis in enumerate(("north", "east", "down")):
        shown = series(raw, axis)
        assert np.isfinite(shown).sum() == np.count_nonzero(gnss.fused)
        assert np.nanmax(np.abs(shown - gnss.raw[:, k])) < 1e-3
    constraint = item(recorded.document, "Innovations", "NIS a degree of freedom, non_holonomic")
    assert "no verdict" in constraint["good"]
    outcomes = item(recorded.document, "Summary", "What became")
    row = dict(zip(outcomes["head"], outcomes["rows"][1], strict=True))
    assert row["source"] == "gnss"
    assert int(row["fused"]) == recorded.health["sources"]["gnss"]["fused"]


def test_delays_and_lateness_are_those_of_the_drive(recorded: Recorded) -> None:
    rdss = recorded.run.log.innovations["rdss"]  # type: ignore[union-attr]
    fused = rdss.delay_s[rdss.fused]
    assert len(fused) >= 1
    assert np.all((fused > 0.5) & (fused < 5.0))  # the simulated terminal's request cycle
    late = item(recorded.document, "Computer", "Lateness of the ticks")
    assert np.nanmedian(series(late, "after its deadline")) == pytest.approx(0.3, abs=0.2)


def test_the_inertial_unit_is_looked_at(recorded: Recorded) -> None:
    look = recorded.run.log.imu  # type: ignore[union-attr]
    assert look is not None
    assert look.source == "imu"
    assert np.nanmedian(look.stamped_ms) == pytest.approx(10.0, abs=0.01)
    assert look.frequency_hz[-1] == pytest.approx(50.0)
    # The demo's unit: 0.3 deg/sqrt(h), one-sided sqrt(2) times as much, far from the motion.
    noise = 0.3 / 60.0 * np.sqrt(2.0)
    high = look.gyro[look.frequency_hz > 25.0]
    assert float(np.sqrt(np.mean(high**2))) == pytest.approx(noise, rel=0.1)


def test_biases_come_with_sigma(recorded: Recorded) -> None:
    biases = recorded.run.log.biases  # type: ignore[union-attr]
    assert list(biases) == [f"{what} {axis}" for what in ("gyro", "accel") for axis in "xyz"]
    assert biases["gyro x"].unit == "deg/h"
    assert all(np.all(b.sd > 0.0) for b in biases.values())
    assert items(recorded.document, "Biases and calibration")


def test_faults_and_service_over_time(tmp_path: Path) -> None:
    """Told from 3 s to 5 s and again from 7 s on: two faults; out for three messages of ten."""
    messages: list[tuple[str, float, bytes]] = []
    fault = EXAMPLES["status"].model_dump(mode="json")["faults"][0]
    for k in range(10):
        told = 3 <= k <= 5 or k >= 7
        faults = [{**fault, "since_s": k - 2.0, "size": 0.1 * k}] if told else []
        service = "out" if 3 <= k <= 5 else "nominal"
        health = {"sources": {"gnss": {"service": service}, "imu": {"service": None}}}
        messages += [
            ("/status", float(k), json.dumps({"faults": faults}).encode()),
            ("/health", k + 0.1, json.dumps(health).encode()),
        ]
    nav = {"lat_deg": 31.0, "lon_deg": 121.0, "height_m": 10.0, "mode": "navigating"}
    messages += [("/nav", 10.0, json.dumps(nav).encode())]
    (run,) = report([written(tmp_path / "a.mcap", messages)], tmp_path / "a.html")
    assert run.log is not None
    first, second = run.log.faults
    assert (first.source, first.kind, first.axis) == ("gnss", "velocity", "north")
    started_s, last_s = (t_s - EPOCH_NS * 1e-9 for t_s in (first.started_s, first.last_s))
    assert (started_s, last_s) == pytest.approx((2.0, 5.0), abs=1e-3)
    assert (first.size, second.size) == pytest.approx((0.5, 0.9))
    document = read_page(tmp_path / "a.html")
    rows = item(document, "Summary", "Faults")["rows"]
    assert [row[0] for row in rows] == ["gnss", "gnss"]
    assert rows[0][5:] == ["0.5 m/s", "0.081", "31.2", "left out"]
    service = item(document, "Summary", "Service")
    assert service["rows"] == [["gnss", "70.0 %", "0.0 %", "30.0 %", "0.0 %"]]


def test_satellites_verdicts_and_calibration_over_time(tmp_path: Path) -> None:
    messages: list[tuple[str, float, bytes]] = []
    for k in range(5):
        sky = {"used": ["C21"] * (6 + k), "refused": {"C05": "low", "C06": "low"}, "pdop": 2.0 + k}
        health = {"sources": {"gnss": {"sky": sky}}, "cpu_percent": 10.0 * k, "memory_mb": 80.0}
        judged = {
            "verdict": "optimistic",
            "nis_average": 1.0 + k,
            "rho": [0.1 * k],
            "rho_high": 0.2,
        }
        bounds = {"nis_low": 0.8, "nis_high": 1.2}
        scale = {"value": 0.01, "sd": 0.1 / (k + 1), "prior_sd": 0.1, "state": "observed"}
        messages += [
            ("/health", 1.0 + k, json.dumps(health).encode()),
            ("/consistency", 1.1 + k, json.dumps({"sources": {"gnss": judged | bounds}}).encode()),
            ("/calibration", 1.2 + k, json.dumps({"parameters": {"wheel_scale": scale}}).encode()),
        ]
    report([written(tmp_path / "a.mcap", messages)], tmp_path / "a.html")
    document = read_page(tmp_path / "a.html")
    assert series(item(document, "Satellites", "Satellites"), "used").tolist() == [6, 7, 8, 9, 10]
    assert series(item(document, "Satellites", "PDOP"), "PDOP").tolist() == [2, 3, 4, 5, 6]
    assert item(document, "Satellites", "Why refused")["rows"] == [["low", "10"]]
    end = item(document, "Verdicts", "At the end")
    assert end["rows"] == [["gnss", "optimistic", "5.000", "0.400"]]
    assert end["wrong"] == [0]
    nis = item(document, "Verdicts", "NIS average")
    assert series(nis, "95 % to") == pytest.approx([1.2] * 5)
    scale_plot = item(document, "Biases and calibration", "wheel_scale")
    assert scale_plot["unit"] == "ratio"
    assert series(scale_plot, "+2 sigma")[-1] == pytest.approx(0.05)
    assert series(item(document, "Computer", "CPU"), "CPU").tolist() == [0, 10, 20, 30, 40]


# --------------------------------------------------------------------------- broken files


def test_a_log_that_is_cut_off_is_shown_as_far_as_it_goes(
    recorded: Recorded, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recorded.log.read_bytes()[: recorded.log.stat().st_size // 2])
    code, text = fusiond(cut, "--out", tmp_path / "cut.html")
    assert code == 0
    assert "cut off" in text
    document = read_page(tmp_path / "cut.html")
    ((level, problem),) = document["runs"][0]["problems"]
    assert level == "error"
    assert "cut off" in problem
    assert 1.0 < document["span"][1] < recorded.document["span"][1]


def test_a_part_that_is_missing_is_named(recorded: Recorded, tmp_path: Path) -> None:
    nav = json.dumps({"mode": "aligning"}).encode()
    first = written(tmp_path / "a.mcap", [("/nav", 1.0, nav)])
    third = written(tmp_path / "c.mcap", [("/nav", 2.0, nav)], metadata={"part": "2"})
    (run,) = report([first, third], tmp_path / "r.html")
    assert any("missing" in p.text for p in run.problems)


# --------------------------------------------------------------------------- solutions, two runs


def test_a_solution_file_says_what_it_does_not_hold(tmp_path: Path) -> None:
    path = solution(tmp_path / "s.csv", 1000.0)
    code, _ = fusiond(path, "--out", tmp_path / "s.html")
    assert code == 0
    document = read_page(tmp_path / "s.html")
    titles = [s["title"] for s in document["sections"]]
    assert titles == ["Summary", "Track", "Position, velocity, attitude"]
    told = " ".join(i["text"] for i in items(document, "Summary") if i["kind"] == "sentence")
    assert "outcomes, innovations, biases, verdicts, delays, satellites" in told
    run = item(document, "Summary", "Run")
    assert ["distance", "399.0 m"] in run["rows"]
    modes = item(document, "Summary", "Modes")
    assert [row[:2] for row in modes["rows"]] == [["navigating", "87.7 %"], ["coasting", "12.3 %"]]


def test_a_log_beside_a_solution(recorded: Recorded, tmp_path: Path) -> None:
    other = solution(tmp_path / "b.csv", EPOCH_NS * 1e-9)
    report([other], tmp_path / "two.html", beside=[recorded.log])
    document = read_page(tmp_path / "two.html")
    rows = next(s["rows"] for s in document["sections"] if s["title"] == "Computer")
    assert all(row[0] is None and row[1] is not None for row in rows)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's chromium is not installed")
def test_a_browser_draws_every_plot(recorded: Recorded, tmp_path: Path) -> None:
    told = tmp_path / "told.html"
    watch = (
        "<script>addEventListener('load', () => setTimeout(() => { document.title ="
        " `drawn ${document.querySelectorAll('.uplot').length}"
        " track ${document.querySelectorAll('.track canvas').length}`; }, 0));</script>"
    )
    told.write_text(recorded.page.read_text().replace("</body>", watch + "</body>"))
    done = subprocess.run(
        [
            *("chromium", "--headless", "--no-sandbox", "--disable-gpu"),
            *("--disable-background-networking", "--disable-component-update"),
            *(f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000"),
            *("--dump-dom", told.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    titles = [s["title"] for s in recorded.document["sections"]]
    plots = sum(i["kind"] == "plot" for t in titles for i in items(recorded.document, t))
    assert f"<title>drawn {plots} track 1</title>" in done.stdout
