"""A receiver's own solutions as `--aid`: UBX, BESTPOS and SBF of one walk give one navigation."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.decoder_options import SolutionDecoding
from drivers.measurements import PositionFix, UtcStamp
from drivers.ubx.decoder import UbxDecoder
from fusiond.commands.app import app
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import TrajectoryTable, read_imu, read_solution
from fusiond.navigation.gps_time import utc_ns_to_gps
from fusiond.offline.nmea_file import EARLIEST_DATE
from fusiond.offline.receiver_logs import decoding_of, read_solutions
from tests.drivers.bestpos import logs as bestpos
from tests.drivers.sbf import blocks as sbf
from tests.drivers.ubx.frames import posllh, pvt
from tests.places import DATA, REPOSITORY

WALK = DATA / "walk_0827"
CONFIG = REPOSITORY / "config" / "walk_0827.toml"

pytestmark = pytest.mark.skipif(
    not WALK.is_dir(), reason=f"real walk walk_0827 is absent: {WALK} (set FUSIOND_DATA)"
)


def _fixes() -> list[PositionFix]:
    decoder = UbxDecoder("gnss", SolutionDecoding(earliest_date=EARLIEST_DATE))
    found = [*decoder.feed((WALK / "gnss.ubx").read_bytes(), 0), *decoder.flush()]
    return [m for m in found if isinstance(m, PositionFix)]


def _as_bestpos(fix: PositionFix, week: int, tow_s: float) -> bytes:
    assert fix.sd_ned_m is not None
    assert fix.v_ned_m_s is not None
    assert fix.sd_v_ned_m_s is not None
    n, e, d = fix.v_ned_m_s
    lat, lon = math.degrees(fix.lat_rad), math.degrees(fix.lon_rad)
    sd = ",".join(f"{x:.4f}" for x in fix.sd_ned_m)
    speed, course = math.hypot(n, e), math.degrees(math.atan2(e, n)) % 360.0
    sd_v = fix.sd_v_ned_m_s[0]
    kind = {4: "NARROW_INT", 5: "NARROW_FLOAT"}[fix.quality]
    place = f"{lat:.11f},{lon:.11f},{(fix.height_m or 0.0) + 21.4:.4f},-21.4000,WGS84,{sd}"
    moving = f"SOL_COMPUTED,DOPPLER_VELOCITY,0.000,0.000,{speed:.4f},{course:.6f},{-(d or 0.0):.4f}"
    body = (
        f'SOL_COMPUTED,{kind},{place},"0",0,0,50,25,25,0,1,12,12,41,{moving},{sd_v:.4f},{sd_v:.4f}'
    )
    when = f"GPS,FINE,{week},{round(tow_s * 1000)}"
    return bestpos.log(f"BESTNAVA,97,{when},0,0,18,12", body)


def _as_sbf(fix: PositionFix, week: int, tow_s: float) -> bytes:
    assert fix.v_ned_m_s is not None
    assert fix.sd_ned_m is not None
    assert fix.sd_v_ned_m_s is not None
    n, e, d = fix.v_ned_m_s
    when = round(tow_s * 1000), week
    return (
        sbf.pvt(
            mode=fix.quality,
            lat=fix.lat_rad,
            lon=fix.lon_rad,
            height=fix.height_m,
            v=(n, e, -(d or 0.0)),
            when=when,
        )
        + _variances(5906, when, fix.sd_ned_m[0], fix.sd_ned_m[2])
        + _variances(5908, when, fix.sd_v_ned_m_s[0], fix.sd_v_ned_m_s[0])
        + sbf.block(5921, struct.pack("<IH", *when))
    )


def _variances(number: int, when: tuple[int, int], level: float, down: float) -> bytes:
    squares = (level**2, level**2, down**2)
    return sbf.block(number, struct.pack("<IHBB10f", *when, 4, 0, *squares, *[0.0] * 7))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("logs")
    made = {"ubx": WALK / "gnss.ubx", "bestpos": folder / "walk.log", "sbf": folder / "walk.sbf.gz"}
    texts, blocks = bytearray(), bytearray()
    for fix in _fixes():
        assert isinstance(fix.stamp, UtcStamp)
        week, tow_s = utc_ns_to_gps(fix.stamp.utc_ns)
        texts += _as_bestpos(fix, week, tow_s)
        blocks += _as_sbf(fix, week, tow_s)
    made["bestpos"].write_bytes(texts)
    made["sbf"].write_bytes(gzip.compress(blocks))
    return made


def _solution(kind: str, path: Path, out: Path) -> TrajectoryTable:
    command = ["process", str(CONFIG), "--imu", str(WALK / "imu.csv")]
    result = CliRunner().invoke(app, [*command, "--aid", f"{kind}={path}", "--out", str(out)])
    assert result.exit_code == 0, result.output
    return read_solution(out)


def test_three_protocols_give_one_navigation(logs: dict[str, Path], tmp_path: Path) -> None:
    fixes = _fixes()
    solutions = {kind: _solution(kind, path, tmp_path / kind) for kind, path in logs.items()}
    ubx = solutions["ubx"]
    assert len(ubx.t_s) > 10_000
    times = [utc_ns_to_gps(f.stamp.utc_ns)[1] for f in fixes if isinstance(f.stamp, UtcStamp)]
    lat = np.interp(ubx.t_s[-1], times, [f.lat_rad for f in fixes])
    assert abs(ubx.lat_rad[-1] - lat) * 6.4e6 < 0.1
    for kind in ("bestpos", "sbf"):
        other = solutions[kind]
        # Whole milliseconds may put the start one sample later.
        rows = min(len(other.t_s), len(ubx.t_s))
        assert rows > len(ubx.t_s) - 3
        assert np.array_equal(other.t_s[-rows:], ubx.t_s[-rows:])
        for a, b, metres in (
            (other.lat_rad, ubx.lat_rad, 6.4e6),
            (other.lon_rad, ubx.lon_rad, 6.4e6),
            (other.height_m, ubx.height_m, 1.0),
        ):
            without_overlap = np.abs(a[-rows:] - b[-rows:]) * metres
            assert np.quantile(without_overlap, 0.5) < 0.005
            assert np.quantile(without_overlap, 0.99) < 0.2  # a decision may fall an epoch apart
            assert (
                without_overlap.max() < 0.5
            )  # where the course starts it half a millisecond later


@pytest.mark.parametrize(
    ("kind", "content", "words"),
    [
        ("ubx", b"$GNGGA,nothing*00\r\n", "no UBX navigation message (UBX-NAV-PVT)"),
        ("ubx", pvt(flags=0), "no fix: the receiver does not stand by its fixes"),
        ("ubx", pvt(fix=5), "no fix: the receiver repeats a surveyed place"),
        ("ubx", posllh(), "without the receiver's own judgement"),
        ("bestpos", b"", "the file is empty"),
        ("bestpos", bestpos.bestpos(kind="INS_PSRSP"), "own inertial solution"),
        ("sbf", b"\x00" * 100, "nothing but zeros"),
        ("sbf", sbf.pvt(datum=250), "not on WGS 84"),
        ("ubx", b"\x1f\x8bnot a gzip", "no gzip file that can be unpacked"),
    ],
)
def test_a_log_without_a_fix_says_why(
    kind: str, content: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "log"
    path.write_bytes(content)
    imu = read_imu(WALK / "imu.csv")
    with pytest.raises(TableError, match=words.replace("(", r"\(").replace(")", r"\)")):
        read_solutions(kind, path, imu, "gnss", SolutionDecoding(earliest_date=EARLIEST_DATE))


def test_options_are_those_of_the_configured_receiver() -> None:
    """As the daemon has them, but that a log may be of any date."""
    options = {"port": "/dev/ttyUSB0", "heading_offset_deg": 90.0}
    config = Config.model_validate({"sources": {"gnss": {"driver": "ubx", **options}}})
    assert decoding_of("gnss", config) == SolutionDecoding(
        heading_offset_deg=90.0, earliest_date=EARLIEST_DATE
    )
    assert decoding_of("gnss", Config()).heading_offset_deg == 0.0
