"""NMEA sentences, read back by pynmeagps; tests/outputs/test_gpsd.py has a real gpsd read them."""

from __future__ import annotations

import re
from math import nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from pynmeagps import NMEAReader

from fusiond.configuration.outputs import NmeaServed
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.geoid import geoid_separation_m
from fusiond.outputs.messages.nav import nav_message
from fusiond.outputs.nmea import DEFAULT, NmeaServer, sentences
from fusiond.outputs.topics import NAV
from tests.broker import free_port
from tests.outputs.serving import GEOID_M, Around, at_work, connected, nav
from tests.patience import until

ALL = ("HDT", "PASHR", "THS", "GGA", "VTG", "RMC")


def read(epoch: bytes) -> dict[str, Any]:
    """The sentences by formatter; pynmeagps checks checksum and format."""
    lines = epoch.splitlines(keepends=True)
    assert all(line.endswith(b"\r\n") and len(line) <= 82 for line in lines), lines
    parsed = [NMEAReader.parse(line) for line in lines]
    return {m.msgID: m for m in parsed}


def test_an_epoch_says_what_the_solution_says() -> None:
    said = read(sentences(nav(), DEFAULT, GEOID_M))
    assert list(said) == list(DEFAULT)
    rmc, gga, vtg, gst, ths = said.values()
    assert rmc.talker == "GN"
    assert (str(rmc.date), str(rmc.time)) == ("2026-11-20", "23:33:07.120000")
    assert (rmc.status, rmc.posMode, gga.quality) == ("A", "A", 1)
    assert (rmc.lat, rmc.lon) == pytest.approx((31.025438871, 121.441209483), abs=2e-9)
    assert (gga.lat, gga.lon) == (rmc.lat, rmc.lon)
    assert (gga.alt, gga.sep) == pytest.approx((6.12, 11.3))
    assert rmc.spd == pytest.approx(16.447, abs=5e-4)  # knots
    assert vtg.sogk == pytest.approx(30.460, abs=5e-4)
    assert rmc.cog == pytest.approx(346.09)
    assert (gst.stdLat, gst.stdLong, gst.stdAlt) == (0.9, 0.85, 1.7)
    assert (ths.headt, ths.mi) == (346.09, "A")


def test_the_worked_example() -> None:
    line = sentences(nav(), ("RMC",), None)
    start = b"$GNRMC,233307.12,A,3101.5263323,N,12126.4725690,E,16.447,346.09,201126,,,A,V*"
    assert line.startswith(start)


def test_dead_reckoning_and_nothing() -> None:
    coasting = read(sentences(nav(mode=Mode.COASTING), DEFAULT, None))
    assert (coasting["RMC"].status, coasting["RMC"].posMode) == ("A", "E")
    assert coasting["GGA"].quality == 6
    assert coasting["THS"].mi == "E"
    separation_m = geoid_separation_m(31.025, 121.441)  # none is configured
    assert coasting["GGA"].sep == pytest.approx(separation_m, abs=0.01)
    assert coasting["GGA"].alt == pytest.approx(17.42 - separation_m, abs=0.01)
    for message in (nav(mode=Mode.INVALID), nav_message(Solution(0, Mode.WAITING, ""), None)):
        epoch = sentences(message, (*ALL, "GST"), GEOID_M)
        nothing = read(epoch)
        assert (nothing["RMC"].status, nothing["RMC"].posMode) == ("V", "N")
        assert nothing["GGA"].quality == 0
        assert nothing["RMC"].lat == nothing["GGA"].lon == ""
        assert nothing["THS"].mi == "V"
        assert not {"GST", "ASHR"} & nothing.keys()
        assert b"nan" not in epoch


def test_no_time_while_utc_is_not_settled() -> None:
    said = read(sentences(nav(t_ms=None, t_utc=None), DEFAULT, None))
    assert said["RMC"].time == said["RMC"].date == said["GGA"].time == ""
    assert said["RMC"].lat == pytest.approx(31.025438871, abs=2e-9)


def test_time_is_cut_off_not_rounded() -> None:
    assert sentences(nav(t_ms=1_795_217_579_999), ("GGA",), None).startswith(b"$GNGGA,233259.99,")


def test_pashr_comes_first_and_has_roll_and_pitch() -> None:
    epoch = sentences(nav(), ALL, GEOID_M)
    assert epoch.startswith(b"$PASHR,233307.12,346.09,T,+0.41,-1.21,,0.080,0.080,0.600,1,1*")
    assert epoch.splitlines()[-1].startswith(b"$GNHDT,346.09,T*")


def test_hdt_with_gst_is_refused() -> None:
    with pytest.raises(ValidationError, match="confuse gpsd"):
        NmeaServed(sentences=("RMC", "GST", "HDT"))


@settings(max_examples=40)
@given(
    lat=st.floats(-90.0, 90.0),
    lon=st.floats(-180.0, 180.0),
    yaw=st.floats(0.0, 359.999999),
    north=st.floats(-300.0, 300.0),
    east=st.floats(-300.0, 300.0),
    mode=st.sampled_from(list(Mode)),
    height=st.floats(-500.0, 90_000.0) | st.just(nan) | st.none(),
    t_ms=st.integers(0, 4_000_000_000_000) | st.none(),
)
def test_every_solution_can_be_read_back(
    lat: float,
    lon: float,
    yaw: float,
    north: float,
    east: float,
    mode: Mode,
    height: float | None,
    t_ms: int | None,
) -> None:
    message = nav(
        lat_deg=lat, lon_deg=lon, yaw_deg=yaw, v_n_m_s=north, v_e_m_s=east, mode=mode,
        height_m=height, t_ms=t_ms,
    )  # fmt: skip
    epoch = sentences(message, (*ALL, "GST"), GEOID_M)
    said = read(epoch)
    assert not re.search(rb"nan|None|inf|60\.0000000|,360\.00", epoch)
    if mode in (Mode.NAVIGATING, Mode.COASTING):
        assert (said["RMC"].lat, said["RMC"].lon) == pytest.approx((lat, lon), abs=2e-9)
        speed = said["VTG"].sogk / 3.6
        assert speed == pytest.approx((north**2 + east**2) ** 0.5, abs=2e-4)


async def test_everyone_gets_whole_epochs() -> None:
    server = NmeaServer(NmeaServed(port=free_port()), Around().surroundings)
    async with at_work(server):
        address = server.server.port.address
        async with connected(address) as one, connected(address) as two:
            two.writer.write(b"whatever a plotter says\r\n")
            await until(lambda: len(server.server.clients) == 2)
            server.publish(NAV, nav())
            for client in (one, two):
                lines = [await client.line() for _ in DEFAULT]
                assert [x[3:6].decode() for x in lines] == list(DEFAULT)
    assert server.counters["sent"] == 2
