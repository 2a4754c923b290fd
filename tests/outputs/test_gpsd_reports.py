"""gpsd's requests as its clients end and cut them, and its reports."""

from __future__ import annotations

import json
from math import nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.geoid import geoid_separation_m
from fusiond.outputs.gpsd import reports
from fusiond.outputs.gpsd.requests import MOST_BYTES, Malformed, Request, RequestReader
from fusiond.outputs.messages.health import SatelliteHealth, SkyHealth
from fusiond.outputs.messages.nav import nav_message
from tests.outputs.serving import nav

# ------------------------------------------------------------------ requests


@pytest.mark.parametrize(
    ("data", "requests"),
    [
        (
            b'?WATCH={"enable":true,"json":true};',
            [Request("WATCH", {"enable": True, "json": True})],
        ),
        (b'?WATCH={"json":true}', [Request("WATCH", {"json": True})]),  # gps3
        (b'?WATCH={"json":true}\n?POLL\r\n', [Request("WATCH", {"json": True}), Request("POLL")]),
        (b"?DEVICES;?VERSION;\r\n", [Request("DEVICES"), Request("VERSION")]),
        (b'?WATCH={"device":"a;}\\"b"};', [Request("WATCH", {"device": 'a;}"b'})]),
        (b"?POLL", []),
        (b'?WATCH={"enable"', []),
        (b";;\n\n", []),
    ],
)
def test_requests_however_they_end_and_are_cut(data: bytes, requests: list[Request]) -> None:
    for size in (1, 2, 7, len(data)):
        reader = RequestReader()
        pieces = [data[k : k + size] for k in range(0, len(data), size)]
        assert [r for piece in pieces for r in reader.feed(piece)] == requests


@pytest.mark.parametrize(
    "data", [b"GET / HTTP/1.1\r\n", b"?WATCH={nonsense};", b"?WATCH=7;", b"?;", b"x" * 20_000]
)
def test_invalid_requests_get_an_error(data: bytes) -> None:
    reader = RequestReader()
    assert [type(r) for r in reader.feed(data)] == [Malformed]
    assert list(reader.feed(b"?POLL;")) == [Request("POLL")]


@settings(max_examples=40)
@given(st.lists(st.binary(max_size=60), max_size=8))
def test_the_reader_survives_everything(pieces: list[bytes]) -> None:
    reader = RequestReader()
    for piece in pieces:
        for found in reader.feed(piece):
            assert isinstance(found, Request | Malformed)
    list(reader.feed(b'"' + b"}" * 50 + b"x" * MOST_BYTES))
    assert list(reader.feed(b"?POLL;"))[-1:] == [Request("POLL")]


# ------------------------------------------------------------------ reports


def test_reports_have_no_spaces_and_nothing_unknown() -> None:
    """cgps reads `"mode": 3` as no fix; the protocol knows neither null nor NaN."""
    message = nav(height_m=nan, sd_d_m=None, v_d_m_s=nan, sd_vd_m_s=nan)
    line = reports.encoded(reports.tpv("fusiond://truck", message, 11.3))
    assert b" " not in line
    assert line.startswith(b'{"class":"TPV","device":"fusiond://truck","status":6,"mode":2,')
    said = json.loads(line, parse_constant=pytest.fail)
    assert None not in said.values()
    assert not {"altHAE", "altMSL", "alt", "epv", "climb", "velD", "epc"} & said.keys()


def test_tpv_is_the_solution_in_gpsds_units() -> None:
    said = reports.tpv("d", nav(), 11.3)
    assert (said["mode"], said["status"]) == (3, 6)
    assert (said["lat"], said["lon"], said["altHAE"]) == (31.025438871, 121.441209483, 17.42)
    assert (said["altMSL"], said["alt"]) == (6.12, 6.12)
    assert (said["climb"], said["velD"]) == (-0.041, 0.041)
    assert said["track"] == pytest.approx(346.0902, abs=1e-4)
    assert said["speed"] == pytest.approx(8.4611, abs=1e-4)
    # 1.96 sigma each axis; the horizontal one at twice the root of the summed variances.
    assert (said["epx"], said["epy"], said["epv"]) == (1.666, 1.764, 3.332)
    assert said["eph"] == pytest.approx(2.476, abs=1e-3)
    assert said["time"] == "2026-11-20T23:33:07.123Z"
    separation_m = geoid_separation_m(31.025438871, 121.441209483)
    by_table = reports.tpv("d", nav(), None)["altMSL"]
    assert by_table == pytest.approx(17.42 - separation_m, abs=1e-3)
    assert "altMSL" not in reports.known_only(reports.tpv("d", nav(sd_d_m=None), None))


def test_unusable_solutions_are_no_fix() -> None:
    waiting = nav_message(Solution(0, Mode.WAITING, "no IMU data yet"), None)
    assert json.loads(reports.encoded(reports.tpv("d", waiting, 11.3))) == {
        "class": "TPV",
        "device": "d",
        "mode": 1,
    }
    invalid = nav(mode=Mode.INVALID)
    assert reports.tpv("d", invalid, 11.3).keys() == {"class", "device", "mode", "time"}
    assert reports.att("d", invalid) is None
    assert reports.gst("d", invalid) is None
    assert reports.tpv("d", nav(mode=Mode.COASTING), None)["status"] == 5


def test_a_vehicle_at_rest_has_no_course() -> None:
    creeping = reports.tpv("d", nav(v_n_m_s=0.05, v_e_m_s=-0.05), None)
    assert creeping["track"] is None
    assert creeping["speed"] == pytest.approx(0.0707)
    assert creeping["epd"] > 45.0
    still = reports.tpv("d", nav(v_n_m_s=0.0, v_e_m_s=0.0), None)
    assert (still["track"], still["speed"], still["epd"]) == (None, 0.0, 180.0)


def test_satellites_by_gpsds_numbers() -> None:
    seen = {"C21": SatelliteHealth(azimuth_deg=12.5, elevation_deg=60.0, cno_db_hz=44.0)}
    sky = SkyHealth(used=("C21", "G07"), refused={"E30": "gated"}, hdop=0.9, satellites=seen)
    said = reports.sky("d", None, sky)
    first = said["satellites"][0]
    assert (first["az"], first["el"], first["ss"]) == (12.5, 60.0, 44.0)
    assert "az" not in said["satellites"][1]
    assert (said["nSat"], said["uSat"], said["hdop"]) == (3, 2, 0.9)
    assert [s["PRN"] for s in said["satellites"]] == [421, 7, 330]
    assert [s["used"] for s in said["satellites"]] == [True, True, False]
