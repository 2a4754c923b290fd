"""A recorded drive, looked at and run again: the same bits, or another filter."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.files.measurement_csv import read_gnss, read_imu, read_rdss, read_solution
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.commands import Inject, RequestFix
from fusiond.recording.channels import INPUT, STATE
from fusiond.recording.edit import recover, trim, write_log
from fusiond.recording.info import info
from fusiond.recording.reader import Log, LogError
from fusiond.recording.records import Kind
from fusiond.recording.track_export import WRITERS, Point
from fusiond.replay.replay import Replay
from fusiond.replay.replay_config import replay_config
from fusiond.replay.replay_output import ReplayOptions, replay
from tests.clock.host_time import S
from tests.recording.driven import Drive
from tests.replay.track_judges import gpsbabel_points, gpx_points

LENGTH_S = 18.0
ZSTD = bytes.fromhex("28b52ffd")
"""How a compressed chunk begins (RFC 8878, 3.1.1)."""
SLEW_S, STEP_S, REQUEST_S, INJECT_S, UNPLUG_S = 6.0, 9.0, 10.0, 12.0, 13.5
PLUG_S, STALL_S = 15.0, 16.0


@dataclass(frozen=True)
class Recorded:
    """The files of a drive, and what the daemon had at each tick."""

    paths: Sequence[Path]
    solutions: Sequence[Solution]
    digests: Sequence[bytes]
    folder: Path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """18 s with a step of the system clock, which chrony slews, an operator's request, injected
    noise, a receiver that is unplugged, and ticks that are skipped because the host stood still."""
    folder = tmp_path_factory.mktemp("logs")
    drive = Drive(folder, LENGTH_S + 6.0, split_min=13.0 / 60.0)
    drive.run(SLEW_S)
    drive.host.slew(83_333)
    drive.run(STEP_S)
    drive.host.system_error = 2 * S
    drive.run(REQUEST_S)
    drive.command(RequestFix(id="1"))
    drive.run(INJECT_S)
    drive.command(Inject(id="2", source="gnss", fault="noise", size=0.5, duration_s=1.0))
    drive.run(UNPLUG_S)
    drive.host.slew(0)
    drive.until_file(2)
    drive.take("gnss", "close", "unplugged")
    drive.unplugged.add("gnss")
    drive.run(PLUG_S)
    drive.take("gnss", "open")
    drive.unplugged.clear()
    drive.run(STALL_S)
    drive.host.mono += S // 4
    drive.run(LENGTH_S)
    return Recorded(drive.close(), drive.solutions, drive.digests, folder)


def _run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    return result.exit_code, result.output


# --------------------------------------------------------------------------- the same bits


def test_every_tick_ends_in_the_same_bits(recorded: Recorded) -> None:
    assert recorded.solutions[-1].mode is Mode.NAVIGATING
    assert len(recorded.paths) == 2
    log = Log(recorded.paths)
    run = Replay(log, replay_config(log.about, recorded.folder))
    solutions = [tick.solution for tick in run.ticks()]
    assert run.exact
    assert run.comparison.first is None
    assert run.comparison.compared == len(recorded.digests)
    assert [repr(s) for s in solutions] == [repr(s) for s in recorded.solutions]
    assert log.problems == []


def test_another_filter_gets_the_same_input(recorded: Recorded, tmp_path: Path) -> None:
    code, text = _run(
        *("replay", *recorded.paths, "--set", "aiding.gnss.lever_arm_m=[0.0, 0.0, -2.0]"),
        *("--out", tmp_path, "--json", "-"),
    )
    assert code == 0, text
    summary = json.loads(text[text.index("{\n") :])
    assert summary["identical"] is None
    assert summary["ticks"] == len(recorded.solutions)
    assert summary["outcomes"]["gnss"]["fused"] > 20
    again = read_solution(tmp_path / "solution.csv")
    assert len(again.t_s) == len(recorded.solutions)
    before = recorded.solutions[-1]
    assert abs(again.height_m[-1] - before.height_m) > 0.3
    with (tmp_path / "events.csv").open() as file:
        codes = [row["code"] for row in csv.DictReader(file)]
    assert {"aligned", "injected", "injection_ended", "system_clock_stepped"} <= set(codes)


def test_the_first_tick_that_differs_is_named(recorded: Recorded, tmp_path: Path) -> None:
    """A bit of a GNSS sentence is turned over in the log: at its tick it shows."""
    whole = tmp_path / "whole.mcap"
    trim(recorded.paths, 0.0, 14.0, whole)
    log = Log([whole])
    ticks = 0
    for record in log.records():
        ticks += record.kind is Kind.TICK
        if record.kind is Kind.READ and b"GGA" in record.payload and ticks > 600:
            break
    altered = tmp_path / "altered.mcap"
    _rewrite(whole, altered, record.payload, bytes([*record.payload[:-1], 0x24]))
    found = replay([altered], ReplayOptions())
    assert found["identical"] is False
    assert ticks < found["first_difference"]["tick"] <= ticks + 30
    assert found["first_difference"]["what"] == "the solution or the filter's state"
    assert _run("replay", altered)[0] == 1


def _rewrite(path: Path, out: Path, old: bytes, new: bytes) -> None:
    log = Log([path])
    write_log(
        out, log.about, {}, (m._replace(data=m.data.replace(old, new)) for m in log.messages())
    )


def test_a_log_with_lost_input_says_so(recorded: Recorded, tmp_path: Path) -> None:
    short, out = tmp_path / "short.mcap", tmp_path / "holed.mcap"
    trim(recorded.paths, 0.0, 4.0, short)
    log = Log([short])
    write_log(out, log.about, {}, (m for m in log.messages() if m.sequence not in (100, 101)))
    found = replay([out], ReplayOptions())
    assert found["identical"] is False
    assert "inputs are missing in the log" in found["first_difference"]["what"]
    assert found["problems"] == ["2 messages of input are missing after message 99"]


# --------------------------------------------------------------------------- cut, join, mend


def test_a_cut_goes_on_from_a_state_before_it(recorded: Recorded, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    assert trim(recorded.paths, 16.5, 17.5, cut).begins == "a state of the log"
    log = Log([cut])
    run = Replay(log, replay_config(log.about, tmp_path))
    solutions = {tick.solution.t_ns: tick.solution for tick in run.ticks()}
    assert (run.exact, run.began) == (False, "a state on the way")
    same = [(solutions[s.t_ns], s) for s in recorded.solutions if s.t_ns in solutions]
    assert len(same) > 50
    again, before = same[-1]
    assert again.mode in (Mode.NAVIGATING, Mode.COASTING)
    # Two filters on the same input from states a few ms apart: below what either is sure of.
    assert abs(again.lat_rad - before.lat_rad) * 6.36e6 < before.sd_ned_m[0]
    assert log.problems == []


def test_a_cut_from_the_start_is_compared_like_the_whole(
    recorded: Recorded, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    trim(recorded.paths, 0.0, 3.0, cut)
    found = replay([cut], ReplayOptions())
    assert found["identical"] is True
    assert 140 < found["compared"] < 160


def _inputs_of_whole_chunks(path: Path, size: int) -> int:
    """Messages of input in the chunks that end within `size`, as the format's own package counts
    them: where a chunk ends is a matter of the host's time."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        indexes = summary.chunk_indexes
        ends = [c.chunk_start_offset + c.chunk_length for c in indexes]
        whole = [c for c, end in zip(indexes, ends, strict=True) if end <= size]
        assert whole
        file.seek(0)
        chunks = [c for c in StreamReader(file, emit_chunks=True).records if isinstance(c, Chunk)]
    inputs = {number for number, c in summary.channels.items() if c.topic == INPUT}
    messages = [m for c in chunks[: len(whole)] for m in breakup_chunk(c) if isinstance(m, Message)]
    return sum(message.channel_id in inputs for message in messages)


@pytest.mark.parametrize("kept", [0.5, 0.9, 0.999])
def test_a_file_that_was_cut_off_gives_all_but_its_last_chunk(
    recorded: Recorded, tmp_path: Path, kept: float
) -> None:
    whole = recorded.paths[0].read_bytes()
    cut_off = tmp_path / "cut_off.mcap"
    cut_off.write_bytes(whole[: int(len(whole) * kept)])
    log = Log([cut_off])
    found = sum(1 for _ in log.records())
    inputs = sum(1 for _ in log.messages(INPUT))
    assert inputs == _inputs_of_whole_chunks(recorded.paths[0], cut_off.stat().st_size)
    assert found >= inputs
    assert "cut off" in log.problems[0]
    mended = tmp_path / "mended.mcap"
    assert recover(cut_off, mended).problems
    log = Log([mended])
    assert sum(1 for _ in log.records()) == found
    assert log.problems == []


def test_the_parts_join_to_one(recorded: Recorded, tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    assert _run("log", "merge", *reversed(recorded.paths), "--out", whole)[0] == 0
    assert list(Log([whole]).messages()) == list(Log(recorded.paths).messages())


def test_a_damaged_chunk_costs_itself(recorded: Recorded, tmp_path: Path) -> None:
    whole = bytearray(recorded.paths[0].read_bytes())
    within = whole.index(ZSTD, len(whole) // 2) + 40  # the data of a chunk, not its index
    whole[within] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(whole)
    log = Log([damaged])
    assert sum(1 for m in log.messages(INPUT)) > 300
    assert "a damaged chunk is left out" in log.problems[0]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no MCAP file"),
        (b"t_s,lat_deg\n1,2\n", "no MCAP file"),
        (b"\x89MCAP0\r\n", "no MCAP file"),
        (b"\x89MCAP0\r\n" + bytes(200), "no MCAP file"),
    ],
)
def test_a_file_that_is_no_log_is_refused_by_name(tmp_path: Path, data: bytes, why: str) -> None:
    path = tmp_path / "foreign.mcap"
    path.write_bytes(data)
    for command in ("info", "merge"):
        out = ("--out", tmp_path / "out.mcap") if command == "merge" else ()
        code, text = _run("log", command, path, *out)
        assert (code, str(path) in text, why in text) == (65, True, True)
    assert not (tmp_path / "out.mcap").exists()


def test_a_later_format_and_two_recordings_are_refused(recorded: Recorded, tmp_path: Path) -> None:
    log = Log(recorded.paths[:1])
    later, other = tmp_path / "later.mcap", tmp_path / "other.mcap"
    write_log(later, log.about, {"format": "9"}, list(log.messages())[:50])
    with pytest.raises(LogError, match="format 9; this version reads 1"):
        Log([later])
    write_log(other, log.about, {"run": "another"}, list(log.messages())[:50])
    with pytest.raises(LogError, match="parts of 2 recordings"):
        Log([recorded.paths[0], other])


def test_a_missing_part_is_told_and_not_compared(recorded: Recorded) -> None:
    found = replay(recorded.paths[1:], ReplayOptions())
    assert found["identical"] is None
    assert found["started_from"] != "the daemon's start"


# --------------------------------------------------------------------------- what is in it


def test_info_tells_what_came_and_what_was_wrong(recorded: Recorded) -> None:
    found = info(Log(recorded.paths))
    assert found["from_the_daemons_start"] is True
    assert found["ticks"] == len(recorded.solutions)
    assert found["duration_s"] == pytest.approx(LENGTH_S, abs=1.0)
    assert found["sources"]["imu"]["frame"] > 3 * 90 * LENGTH_S
    assert found["sources"]["gnss"]["close"] == 1
    assert found["sources"]["rdss"]["sent"] >= 3
    assert [c["name"] for c in found["commands"]] == ["request_fix", "inject"]
    assert [s["step_s"] for s in found["clock_steps"]] == [2.0]
    assert found["channels"]["/nav"] > 9 * LENGTH_S
    assert found["channels"]["/event"] == found["channels"]["/log"]
    assert {"/health", "/status", "/innovation", "/location", STATE} <= found["channels"].keys()
    assert found["problems"] == []
    code, text = _run("log", "info", *recorded.paths)
    assert code == 0
    assert "request_fix" in text


def test_other_tools_see_position_events_and_innovations(recorded: Recorded) -> None:
    fixes = [m.json() for m in Log(recorded.paths).messages("/location")]
    last = recorded.solutions[-1]
    fix = fixes[-1]
    assert abs(fix["longitude"] - last.lon_rad * 57.29577951308232) < 1e-4
    east, north = fix["position_covariance"][0], fix["position_covariance"][4]
    assert north == pytest.approx(last.sd_ned_m[0] ** 2, rel=0.2)
    assert east == pytest.approx(last.sd_ned_m[1] ** 2, rel=0.2)
    lines = [m.json() for m in Log(recorded.paths).messages("/log")]
    assert any(line["level"] == 3 and "system_clock_stepped" in line["message"] for line in lines)
    ended = [m.json() for m in Log(recorded.paths).messages("/innovation")]
    gnss = [e for e in ended if e["source"] == "gnss" and e["outcome"] == "fused"]
    assert gnss
    assert all(e["degrees"] == len(e["whitened"]) for e in gnss)
    assert {(e["unit"], e["axes"]) for e in gnss} == {("m", "ned")}
    apart = np.array([e["raw"] for e in gnss])
    assert np.all(np.abs(apart) < 20.0)
    # L^-1 is lower triangular: the first row is the innovation north over its own sigma.
    judged = [e for e in gnss if e["whitened"] and abs(e["whitened"][0]) > 1e-3]
    sigma_m = np.array([e["raw"][0] / e["whitened"][0] for e in judged])
    assert len(judged) > 50
    assert np.all((sigma_m > 0.05) & (sigma_m < 10.0))


def test_measurements_come_out_as_the_tables_that_process_reads(
    recorded: Recorded, tmp_path: Path
) -> None:
    code, text = _run("log", "export", *recorded.paths, "--to", "csv", "--out", tmp_path / "csv")
    assert code == 0, text
    imu, gnss = read_imu(tmp_path / "csv" / "imu.csv"), read_gnss(tmp_path / "csv" / "gnss.csv")
    rdss = read_rdss(tmp_path / "csv" / "rdss.csv")
    assert imu.rejected == gnss.rejected == rdss.rejected == []
    assert len(imu.t_s) > 90 * LENGTH_S
    assert len(gnss.t_s) > 9 * (LENGTH_S - (PLUG_S - UNPLUG_S)) - 20
    assert len(rdss.t_s) >= 2
    assert (rdss.t_arrival_s - rdss.t_s > 0.3).all()


def test_the_track_opens_elsewhere(recorded: Recorded, tmp_path: Path) -> None:
    for kind in ("gpx", "kml", "geojson"):
        out = tmp_path / f"track.{kind}"
        where = ("--to", kind, "--out", out, "--interval", "0.5")
        code, text = _run("log", "export", *recorded.paths, *where)
        assert code == 0, text
    points = gpx_points(tmp_path / "track.gpx")
    assert 10 < len(points) < 2.5 * LENGTH_S
    last = recorded.solutions[-1]
    assert points[-1].lat_deg == pytest.approx(math.degrees(last.lat_rad), abs=1e-4)
    assert points[-1].lon_deg == pytest.approx(math.degrees(last.lon_rad), abs=1e-4)
    assert points[-1].height_m == pytest.approx(last.height_m, abs=1.0)
    for kind in ("gpx", "kml"):
        understood = gpsbabel_points(tmp_path / f"track.{kind}", kind, tmp_path)
        assert understood in (None, points)
    kml = ElementTree.parse(tmp_path / "track.kml").getroot()
    assert len(kml.findall(".//{http://www.google.com/kml/ext/2.2}coord")) == len(points)
    features = json.loads((tmp_path / "track.geojson").read_text())["features"]
    assert sum(len(f["properties"]["t_ms"]) for f in features) >= len(points)


def test_a_track_over_the_date_line_is_one_that_gpx_knows(tmp_path: Path) -> None:
    """GPX has longitudes below 180 degrees; what is next to it must not be rounded up to it."""
    here = Point("2026-11-22T16:32:55.383Z", 0, -16.5, 179.9999999999, 12.3, "navigating", 0.5)
    out = tmp_path / "fiji.gpx"
    with out.open("w") as file:
        WRITERS["gpx"](file, 'a "car" & <trailer>', [here, here._replace(lon_deg=-179.99)])
    assert [p.lon_deg for p in gpx_points(out)] == [-180.0, -179.99]
    understood = gpsbabel_points(out, "gpx", tmp_path)
    assert understood is None or len(understood) == 2


@pytest.mark.parametrize("kind", list(WRITERS))
def test_a_height_that_is_not_known_is_none_in_a_track(tmp_path: Path, kind: str) -> None:
    known = Point("2026-11-22T16:32:55.383Z", 0, -16.5, 12.0, 12.3, "navigating", 0.5)
    out = tmp_path / f"track.{kind}"
    with out.open("w") as file:
        WRITERS[kind](file, "truck", [known, known._replace(height_m=None)])
    text = out.read_text()
    assert text.count("12.3") == 1
    assert {"gpx": "<ele>", "kml": "0.000</gx:coord>", "geojson": "[12.0, -16.5]"}[kind] in text
    assert text.count("<ele>") == (kind == "gpx")
    if kind == "gpx":
        assert len(gpx_points(out)) == 2


def test_a_bag_for_ros_holds_fixes_and_samples(recorded: Recorded, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - heavy
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    bag = tmp_path / "bag"
    code, text = _run("log", "export", recorded.paths[1], "--to", "rosbag2", "--out", bag)
    assert code == 0, text
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        messages: dict[str, list[Any]] = {}
        for connection, _, raw in reader.messages():
            found = reader.deserialize(raw, connection.msgtype)
            messages.setdefault(connection.topic, []).append(found)
    fix, sample = messages["/fix"][-1], messages["/imu"][-1]
    assert fix.latitude == pytest.approx(recorded.solutions[-1].lat_rad * 57.29577951, abs=1e-5)
    assert sample.linear_acceleration.z == pytest.approx(9.8, abs=1.5)  # up: forces hold it up
