"""`fusiond process` with a file of RTCM SSR corrections beside the raw stream of the real walk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Ephemeris, RawGnssEpoch
from fusiond.configuration.load import load_config
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import TrajectoryTable, read_solution
from fusiond.offline.process import process
from tests.drivers.raw.test_ssr import head, packed
from tests.places import DATA, REPOSITORY
from tests.runs import metres_per_unit

WALK = DATA / "walk_0827"
CONFIG, STREAM = REPOSITORY / "config" / "walk_0827.toml", WALK / "gnss.ubx"
WEEK_POSIX_S = 315_964_800 + 2381 * 604_800 - 18
INTERVAL_S = 5
CLOCK_M = 2.0
SIGNALS = (0, 7, 8, 9)
"""C/A, and those of L2C."""

pytestmark = pytest.mark.skipif(
    not WALK.is_dir(), reason=f"real walk walk_0827 is absent: {WALK} (set FUSIOND_DATA)"
)


def corrections(clock_m: float, *, other_issue: bool = False) -> bytes:
    """Messages 1059 and 1060 each five seconds for GPS: no biases, orbits as broadcast, clocks
    off by `clock_m`, every second satellite the other way; of the issues that the stream has, or of
    others."""
    issues: dict[int, int] = {}
    times: list[float] = []
    for event in RawDecoder("walk").feed(STREAM.read_bytes(), 0):
        if isinstance(event, Ephemeris) and event.system == "G":
            issues[event.prn] = event.issue
        elif isinstance(event, RawGnssEpoch):
            times.append(event.tow_s)
    stream = b""
    for tow_s in range(int(times[0]) // INTERVAL_S * INTERVAL_S, int(times[-1]), INTERVAL_S):
        fields = head(1060, len(issues), orbits=True, tow_s=tow_s)
        for k, (prn, issue) in enumerate(sorted(issues.items())):
            clock = round((clock_m if k % 2 else -clock_m) / 1e-4)
            orbit = (*((0, bits) for bits in (22, 20, 20, 21, 19, 19)),)
            fields += [(prn, 6), (issue + other_issue & 0xFF, 8), *orbit]
            fields += [(clock, 22), (0, 21), (0, 27)]
        biases = head(1059, len(issues), tow_s=tow_s)
        for prn in sorted(issues):
            biases += [
                (prn, 6),
                (len(SIGNALS), 5),
                *(f for s in SIGNALS for f in ((s, 5), (0, 14))),
            ]
        stream += packed(*biases) + packed(*fields)
    return stream


@pytest.fixture(scope="module")
def imu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walk's samples by POSIX time: corrections say no week."""
    path = tmp_path_factory.mktemp("walk") / "imu.csv"
    head_line, *rows = (WALK / "imu.csv").read_text().splitlines()
    split = (row.split(",", 1) for row in rows)
    moved = (f"{float(t_s) + WEEK_POSIX_S:.4f},{others}" for t_s, others in split)
    path.write_text("\n".join([head_line, *moved]) + "\n")
    return path


def processed(folder: Path, imu: Path, corrected: bytes | None) -> TrajectoryTable:
    """The solution by GPS alone."""
    folder.mkdir()
    measurements, out = [("raw", STREAM)], folder / "solution.csv"
    if corrected is not None:
        (folder / "corrections.rtcm3").write_bytes(corrected)
        measurements.append(("raw", folder / "corrections.rtcm3"))
    process(load_config(CONFIG), imu, measurements, None, out, ("G",))
    return read_solution(out)


def apart_m(one: TrajectoryTable, other: TrajectoryTable) -> float:
    """RMS of the horizontal distance of two solutions."""
    north, east, _ = metres_per_unit(float(one.lat_rad[0]), float(one.height_m[0]))
    t = one.t_s[(one.t_s > other.t_s[0]) & (one.t_s < other.t_s[-1])]
    lat, lon = (
        np.interp(t, one.t_s, a) - np.interp(t, other.t_s, b)
        for a, b in ((one.lat_rad, other.lat_rad), (one.lon_rad, other.lon_rad))
    )
    return float(np.sqrt(((lat * north) ** 2 + (lon * east) ** 2).mean()))


def test_corrections_of_the_ephemerides_at_hand_are_applied_and_no_others(
    imu: Path, tmp_path: Path
) -> None:
    none = processed(tmp_path / "none", imu, None)
    others = processed(tmp_path / "others", imu, corrections(CLOCK_M, other_issue=True))
    one, other = (
        processed(tmp_path / str(clock_m), imu, corrections(clock_m))
        for clock_m in (CLOCK_M, -CLOCK_M)
    )
    assert apart_m(none, others) == 0.0
    assert 0.5 * CLOCK_M < apart_m(one, other) < 10.0 * CLOCK_M


def test_corrections_without_a_week_say_so(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="SSR corrections say no week"):
        processed(tmp_path / "of the week", WALK / "imu.csv", corrections(CLOCK_M))
