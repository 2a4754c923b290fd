"""`fusiond process` over the real walk: the raw stream alone, tight, against the RTK track.

The track's base has an unstated datum (`tests/gnss/test_walk.py`): all solutions are off it by one
constant vector, so that they are judged about their mean, against a least-squares solution of the
same corrected ranges, and against each other.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.nmea.mixed_framing import Frame, StreamSplitter
from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch, System
from fusiond.commands.app import app
from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import TrajectoryTable, read_gnss, read_solution
from fusiond.gnss.ecef import to_geodetic
from fusiond.gnss.ranges import RangeModel
from fusiond.gnss.single_point import single_point
from fusiond.gnss.store import EphemerisStore
from fusiond.offline.process import process
from tests.places import DATA, REPOSITORY
from tests.runs import metres_per_unit

WALK = DATA / "walk_0827"
CONFIG = REPOSITORY / "config" / "walk_0827.toml"
SETTLED_S = 20.0
RAWX, HEADER, BLOCK = b"\x02\x15", 16, 32

pytestmark = pytest.mark.skipif(
    not WALK.is_dir(), reason=f"real walk walk_0827 is absent: {WALK} (set FUSIOND_DATA)"
)


def _process(
    folder: Path,
    stream: Path = WALK / "gnss.ubx",
    outages: list[tuple[float, float]] | None = None,
    systems: tuple[System, ...] | None = None,
) -> tuple[dict[str, Any], TrajectoryTable]:
    out = folder / "solution.csv"
    measurements = [("raw", stream)]
    result = process(load_config(CONFIG), WALK / "imu.csv", measurements, outages, out, systems)
    return result, read_solution(out)


def _off(t: Any, t_s: Any, lat: Any, lon: Any) -> Any:
    """North and east of the track (n, 2) in m, of positions given at `t_s`, at instants `t`."""
    track = read_gnss(WALK / "gnss.csv")
    north, east, _ = metres_per_unit(float(track.lat_rad[0]), float(track.height_m[0]))
    d_lat = np.interp(t, t_s, lat) - np.interp(t, track.t_s, track.lat_rad)
    d_lon = np.interp(t, t_s, lon) - np.interp(t, track.t_s, track.lon_rad)
    return np.column_stack([d_lat * north, d_lon * east])


def _errors(solution: TrajectoryTable, t: Any) -> Any:
    return _off(t, solution.t_s, solution.lat_rad, solution.lon_rad)


def _instants(solution: TrajectoryTable) -> Any:
    t = read_gnss(WALK / "gnss.csv").t_s
    return t[(t > solution.t_s[0] + SETTLED_S) & (t < solution.t_s[-1])]


def _least_squares() -> tuple[Any, Any, Any]:
    """Times, latitudes and longitudes of epochs solved alone, ephemerides known from the start."""
    decoder = RawDecoder("walk")
    events = [*decoder.feed((WALK / "gnss.ubx").read_bytes(), 0), *decoder.flush()]
    store = EphemerisStore()
    for event in events:
        if isinstance(event, Ephemeris | Klobuchar):
            store.add(event)
    model = RangeModel(store)
    found = []
    for event in events:
        if isinstance(event, RawGnssEpoch):
            solved = single_point(model, event)
            if not isinstance(solved, str):
                x, y, z = (float(v) for v in solved.position)
                found.append((event.tow_s, *to_geodetic(x, y, z)[:2]))
    t, lat, lon = np.array(found).T
    return t, lat, lon


def _rms(errors: Any) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def all_in_view(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], TrajectoryTable]:
    """Result and solution of the whole stream."""
    return _process(tmp_path_factory.mktemp("all_in_view"))


def test_all_systems(all_in_view: tuple[dict[str, Any], TrajectoryTable]) -> None:
    result, solution = all_in_view
    assert result["mode"] == "navigating"
    t = _instants(solution)
    assert len(t) > 350
    errors = _errors(solution, t)
    assert np.hypot(*errors.std(axis=0)) < 0.6
    assert _rms(errors) < 1.1 * _rms(_off(t, *_least_squares()))
    about_mean = errors - errors.mean(axis=0)
    sigma = np.column_stack([np.interp(t, solution.t_s, c) for c in solution.sd_position.T[:2]])
    assert (np.abs(about_mean) < 2.0 * sigma).mean() > 0.95
    verdicts = {name: report["verdict"] for name, report in result["consistency"].items()}
    assert {"raw_G", "raw_E", "raw_C"} <= set(verdicts)
    assert "optimistic" not in verdicts.values()
    # What all ranges share no innovation shows.
    assert "cannot_tell" in verdicts.values()
    assert "pessimistic" not in verdicts.values()


@pytest.mark.parametrize(("systems", "scatter_m"), [("C", 0.6), ("G", 1.0), ("E", 0.6)])
def test_one_system_alone(systems: System, scatter_m: float, tmp_path: Path) -> None:
    out = tmp_path / "solution.csv"
    command = ["process", str(CONFIG), "--imu", str(WALK / "imu.csv"), "--systems", systems]
    command += ["--aid", f"raw={WALK / 'gnss.ubx'}", "--out", str(out)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    solution = read_solution(out)
    errors = _errors(solution, _instants(solution))
    assert np.hypot(*errors.std(axis=0)) < scatter_m


# --------------------------------------------------------------------------- three satellites


def _checksum(body: bytes) -> bytes:
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def _only(stream: bytes, keep: set[tuple[int, int]], start_s: float, length_s: float) -> bytes:
    """The stream with only satellites (gnssId, svId) of `keep` in its observations of a window."""
    out = bytearray()
    for item in StreamSplitter().feed(stream):
        if not isinstance(item, Frame):
            continue
        raw = item.raw
        if raw[2:4] == RAWX:
            payload = bytearray(raw[6:-2])
            (tow_s,) = struct.unpack_from("<d", payload)
            if start_s <= tow_s < start_s + length_s:
                starts = range(HEADER, len(payload), BLOCK)
                blocks = [payload[k : k + BLOCK] for k in starts]
                blocks = [b for b in blocks if (b[20], b[21]) in keep]
                payload[11] = len(blocks)
                payload[HEADER:] = b"".join(blocks)
                body = RAWX + struct.pack("<H", len(payload)) + payload
                raw = b"\xb5\x62" + body + _checksum(body)
        out += raw
    return bytes(out)


START_S, LENGTH_S = 408690.0, 30.0
FEW = np.arange(START_S, START_S + LENGTH_S, 0.25)


def _growth(solution: TrajectoryTable, all_in_view: TrajectoryTable) -> float:
    """How far a solution gets away from the one with all satellites (m)."""
    without_overlap = _errors(solution, FEW) - _errors(all_in_view, FEW)
    return float(np.hypot(*without_overlap.T).max())


@pytest.fixture(scope="module")
def coasting_growth(
    all_in_view: tuple[dict[str, Any], TrajectoryTable], tmp_path_factory: pytest.TempPathFactory
) -> float:
    """Of a solution without any satellite."""
    folder = tmp_path_factory.mktemp("coasting")
    result, coasting = _process(folder, outages=[(START_S, LENGTH_S)])
    assert result["sources"]["raw"]["withheld"] == 120
    return _growth(coasting, all_in_view[1])


@pytest.mark.parametrize(
    "keep",
    [
        {(3, 21), (3, 34), (3, 42)},
        {(3, 21), (3, 22), (3, 44)},
        {(0, 10), (0, 23), (0, 32)},
        {(0, 10), (2, 29), (3, 42)},
    ],
    ids=["BeiDou", "BeiDou, others", "GPS", "one of each"],
)
def test_three_satellites_hold_what_coasting_loses(
    keep: set[tuple[int, int]],
    all_in_view: tuple[dict[str, Any], TrajectoryTable],
    coasting_growth: float,
    tmp_path: Path,
) -> None:
    thinned = tmp_path / "thinned.ubx"
    thinned.write_bytes(_only((WALK / "gnss.ubx").read_bytes(), keep, START_S, LENGTH_S))
    result, three = _process(tmp_path, thinned)
    assert result["sources"]["raw"]["fused"] > 450
    assert _growth(three, all_in_view[1]) < coasting_growth / 3.0
