"""The command line as a person calls it: output, exit codes, no traceback.

Each exit code comes from a process of its own once; the other mistakes are made in this process,
where all is loaded: `main` adds nothing to the app but the exit code of Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from tests.patience import PATIENCE_S
from tests.places import REPOSITORY

FUSIOND = Path(sys.executable).with_name("fusiond")
VEHICLE = REPOSITORY / "config" / "vehicle.toml"
HEADER = "t_s,lat_deg,lon_deg,height_m,sd_n_m,sd_e_m,sd_d_m,status"


def fusiond(*args: str | Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [FUSIOND, *args],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        cwd=REPOSITORY,
    )
    assert "Traceback" not in done.stderr
    return done


def in_this_process(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """The same where navigation is loaded already: 1 to 3 s of CPU less than a process of its own.

    That these commands work as processes, too, is shown by `test_kernel_cache`."""
    done = CliRunner().invoke(app, list(map(str, args)))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return subprocess.CompletedProcess(args, done.exit_code, done.stdout, done.stderr)


Call = Callable[..., subprocess.CompletedProcess[str]]


def test_version_and_help() -> None:
    assert fusiond("--version").stdout == f"fusiond {version('fusiond')}\n"
    text = fusiond("--help").stdout
    live = ("run", "demo", "check", "doctor")
    for command in (*live, "process", "calibrate", "simulate", "compare", "bench"):
        assert command in text


def test_help_imports_nothing_heavy() -> None:
    code = "import sys, fusiond.commands.app; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert not {"numpy", "numba", "pydantic", "can", "fusiond.configuration.schema"} & set(
        done.stdout.split()
    )


def test_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    done = in_this_process("check", "config/vehicle.toml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "config/vehicle.toml: ok, vehicle vehicle",
        "  imu: driver can_imu",
        "  gnss: driver nmea, used as gnss",
        "  rdss: driver rdss, used as rdss",
    ]


@pytest.mark.parametrize(
    ("call", "command"),
    [(fusiond, "run"), (in_this_process, "check"), (in_this_process, "doctor")],
)
def test_configuration_mistake_exits_78(tmp_path: Path, call: Call, command: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text("[imu]\nrate_hz = -5\n")
    done = call(command, path)
    assert (done.returncode, done.stdout) == (78, "")
    assert done.stderr == f"{path}: imu.rate_hz = -5: expected a number above 0\n"


def test_missing_configuration_exits_78(tmp_path: Path) -> None:
    done = fusiond("run", tmp_path / "none.toml")
    assert done.returncode == 78
    assert "none.toml: No such file or directory" in done.stderr


@pytest.mark.parametrize(
    ("option", "word"),
    [
        ("--aid=gnns=a.csv", "gnss, rdss, attitude, bearing, wheel"),
        ("--aid=gnss", "KIND=FILE"),
        ("--outage=5", "START:LENGTH"),
        ("--outage=5:0", "LENGTH above 0"),
        ("--outage=nan:5", "START:LENGTH"),
    ],
)
def test_wrong_command_line_exits_2(option: str, word: str) -> None:
    command = "process", REPOSITORY / "config" / "drive_0708.toml", "--imu", "imu.csv", option
    done = in_this_process(*command)
    assert done.returncode == 2
    assert word in done.stderr


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    return path


def test_compare_prints_text_and_writes_json(tmp_path: Path) -> None:
    solution = write(
        tmp_path / "solution.csv",
        "0,,,,,,,aligning",
        "1,40,-105,10,1,1,1,navigating",
        "2,40,-105,13,1,1,0,navigating",
        "3,40,-105,13,1,1,1,navigating",
        "3.5,40,-105,13,1,1,1,navigating",
    )
    truth = write(tmp_path / "truth.csv", "1,40,-105,10,,,,", "3.5,40,-105,10,,,,")
    report = tmp_path / "report.json"
    done = fusiond("compare", solution, truth, "--json", report)
    assert done.returncode == 0
    assert "line 4: sd_not_positive: sd_d_m = 0" in done.stderr
    assert "2 epochs, 1.000 to 3.500 s; 0 not covered by the solution" in done.stdout
    assert "\x1b" not in done.stdout
    figures = json.loads(report.read_text())
    assert figures["down_max_m"] == pytest.approx(3.0)
    assert figures["yaw_rms_deg"] is None
    piped = in_this_process("compare", solution, truth, "--json", "-", "--after", "2")
    assert json.loads(piped.stdout)["epochs"] == 1


def test_compare_with_unusable_files_exits_65(tmp_path: Path) -> None:
    solution = write(tmp_path / "solution.csv", "1,40,-105,10,1,1,1,navigating")
    truth = write(tmp_path / "truth.csv", "9,40,-105,10,,,,")
    done = fusiond("compare", solution, truth)
    assert done.returncode == 65
    assert "no common epoch" in done.stderr
    done = in_this_process("compare", solution, tmp_path / "none.csv")
    assert done.returncode == 65
    assert "none.csv: No such file or directory" in done.stderr


def test_output_that_cannot_be_written_exits_74(tmp_path: Path) -> None:
    solution = write(tmp_path / "solution.csv", "1,40,-105,10,1,1,1,navigating")
    done = fusiond("compare", solution, solution, "--json", tmp_path / "no" / "report.json")
    assert done.returncode == 74
    assert "report.json: No such file or directory" in done.stderr


def test_simulate_writes_what_the_readers_read(tmp_path: Path) -> None:
    done = in_this_process(
        "simulate", "static", "--out", tmp_path / "sim", "--seed", "3", "--duration", "5"
    )
    assert done.returncode == 0, done.stderr
    truth = tmp_path / "sim" / "truth.csv"
    rows = len(truth.read_text().splitlines()) - 1
    assert rows > 1
    assert f"{truth}: {rows} rows" in done.stdout.splitlines()
    same = in_this_process("compare", truth, truth, "--json", "-")
    assert json.loads(same.stdout)["horizontal_max_m"] == pytest.approx(0.0, abs=1e-6)
    assert fusiond("simulate", "boat", "--out", tmp_path).returncode == 2


@pytest.mark.parametrize("raw_format", ["ubx", "rtcm3"])
def test_a_simulated_raw_stream_is_processed(tmp_path: Path, raw_format: str) -> None:
    """Tightly coupled from the bytes of the simulated receiver, through 20 s with three satellites,
    without any other measurement."""
    done = in_this_process(
        *("simulate", "drive", "--out", tmp_path, "--seed", "2", "--duration", "150"),
        *("--gnss-raw", raw_format, "--gnss-mask", "canyon3:110:20"),
    )
    assert done.returncode == 0, done.stderr
    config = tmp_path / "vehicle.toml"
    config.write_text(
        'vehicle = "simulated"\n[imu]\naxes = ["+x", "-y", "-z"]\n'
        "[aiding.raw]\nlever_arm_m = [0.0, 0.0, -1.0]\n"
    )
    out, raw = tmp_path / "nav.csv", tmp_path / f"gnss.{raw_format}"
    done = in_this_process(
        "process", config, "--imu", tmp_path / "imu.csv", "--aid", f"raw={raw}", "--out", out
    )
    assert done.returncode == 0, done.stderr
    judged = in_this_process("compare", out, tmp_path / "truth.csv", "--after", "20", "--json", "-")
    report = json.loads(judged.stdout)
    assert report["horizontal_rms_m"] < 2.0


def test_a_mask_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    bad = in_this_process("simulate", "drive", "--out", tmp_path, "--gnss-mask", "cave:1:2")
    assert bad.returncode == 2
    assert "no mask 'cave'" in bad.stderr


def test_process_names_what_it_rejected(tmp_path: Path) -> None:
    assert (
        in_this_process("simulate", "static", "--out", tmp_path, "--duration", "20").returncode == 0
    )
    imu, gnss = tmp_path / "imu.csv", tmp_path / "gnss.csv"
    lines = imu.read_text().splitlines()
    lines[10] = lines[9]
    lines[500] = lines[500].rpartition(",")[0] + ",nan"
    imu.write_text("\n".join(lines) + "\n")
    measurement, out = f"gnss={gnss}", tmp_path / "solution.csv"
    done = in_this_process("process", VEHICLE, "--imu", imu, "--aid", measurement, "--out", out)
    assert done.returncode == 65
    assert done.stderr.startswith("fusiond: No solution: No heading")
    assert f"imu: {len(lines) - 1} rows, 2 rejected" in done.stdout.splitlines()
    assert "  line 11: time_repeated: " in done.stdout
    assert "  line 501: not_finite: accel_z_m_s2 = nan" in done.stdout
    assert out.read_text().startswith("t_s,lat_deg,")
    piped = in_this_process("process", VEHICLE, "--imu", imu, "--aid", measurement, "--json", "-")
    assert json.loads(piped.stdout)["files"]["imu"]["rejected"] == {
        "time_repeated": 1,
        "not_finite": 1,
    }
    assert "line 11" in piped.stderr
    absent = in_this_process("process", VEHICLE, "--imu", tmp_path / "none.csv")
    assert (absent.returncode, absent.stdout) == (65, "")
    assert "none.csv: No such file or directory" in absent.stderr


def test_interrupt_exits_130(tmp_path: Path) -> None:
    fifo = tmp_path / "truth.csv"
    os.mkfifo(fifo)
    # A suite that runs in the background ignores SIGINT, and hands that on.
    command = ["env", "--default-signal=INT", FUSIOND, "compare", fifo, fifo]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY)
    writer = os.open(fifo, os.O_WRONLY)  # returns once the command waits for the file
    try:
        process.send_signal(signal.SIGINT)
        _, text = process.communicate(timeout=PATIENCE_S)
    finally:
        os.close(writer)
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert "Traceback" not in text


def test_exit_functions_run_after_a_broken_output() -> None:
    """A command ends the process by itself: after what is registered for that, and by its code."""
    code = (
        "import atexit, sys\n"
        "from fusiond.commands import app\n"
        "sys.argv[1:] = {arguments}\n"
        "atexit.register(lambda: (print('the end'), {closing}))\n"
        "app.main()\n"
    )
    for closing in ("None", "sys.stdout.close()"):
        for arguments, expected in ((["--version"], 0), (["no such command"], 2)):
            text = code.format(arguments=arguments, closing=closing)
            done = subprocess.run(
                [sys.executable, "-c", text],
                check=False,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
            )
            assert done.returncode == expected, done.stderr
            assert done.stdout.endswith("the end\n")
            assert "Traceback" not in done.stderr
