"""What a simulated receiver says is read by pynmeagps and by the driver's decoder."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pynmeagps import VALCKSUM
from pynmeagps.nmeareader import NMEAReader

from drivers.measurements import Heading, PositionFix, UtcStamp
from drivers.nmea.decoder import NmeaDecoder
from fusiond.simulation.gnss.receiver import GnssOptions, GnssReceiver, latitude, longitude
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import drive
from tests.runs import ORIGIN
from tests.simulation.utc_start import UTC_START_NS


def _receiver(truth: Truth, **options: Any) -> GnssReceiver:
    return GnssReceiver(truth, GnssOptions(**options), np.random.default_rng(1))


@pytest.mark.parametrize("talker", ["GP", "GN", "BD", "GB"])
def test_pynmeagps_reads_every_sentence(truth: Truth, talker: str) -> None:
    names = ("GGA", "RMC", "VTG", "GSA", "GST", "ZDA", "HDT", "THS")
    gnss = _receiver(truth, talker=talker, sentences=names, rate_hz=1.0, outages=((100.0, 10.0),))
    for k in range(50, 150):
        lines = gnss.nmea(k, UTC_START_NS).splitlines(keepends=True)
        parsed = [NMEAReader.parse(line, validate=VALCKSUM, msgmode=0) for line in lines]
        assert [m.msgID for m in parsed if m is not None] == list(names)
        assert all(m is not None and m.talker == talker for m in parsed)
        assert all(len(line) <= 100 for line in lines)


def test_epochs_come_back_through_the_nmea_driver(truth: Truth) -> None:
    sentences = ("GGA", "RMC", "VTG", "GSA", "GST", "ZDA", "THS")
    gnss = _receiver(truth, rate_hz=5.0, outages=((200.0, 20.0),), sentences=sentences)
    decoder = NmeaDecoder("gnss")
    found = []
    for k in range(len(gnss)):
        found += decoder.feed(gnss.nmea(k, UTC_START_NS), k)
        found += decoder.silence()
    fixes = [m for m in found if isinstance(m, PositionFix)]
    expected = [gnss.fix(k) for k in range(len(gnss)) if gnss.valid[k]]
    assert len(fixes) == len(expected) == 1400
    assert len([m for m in found if isinstance(m, Heading)]) == 1400
    assert decoder.counters["no_fix"] == 100
    for fix, sent in zip(fixes, expected, strict=True):
        assert isinstance(fix.stamp, UtcStamp)  # through midnight, to 10 ms
        assert abs(fix.stamp.utc_ns - UTC_START_NS - sent.t_s * 1e9) <= 5.1e6
        assert math.degrees(fix.lat_rad) == pytest.approx(sent.lat_deg, abs=2e-9)
        assert math.degrees(fix.lon_rad) == pytest.approx(sent.lon_deg, abs=2e-9)
        assert fix.height_m == pytest.approx(sent.height_m, abs=1.1e-3)
        assert fix.sd_ned_m == pytest.approx(gnss.sd_ned_m)
        assert fix.v_ned_m_s is not None
        north, east, down = fix.v_ned_m_s
        assert (north, east) == pytest.approx(sent.v_ned_m_s[:2], abs=1e-3)
        assert down is None


def test_gnss_errors_have_the_sigma_that_gst_states(truth: Truth) -> None:
    gnss = _receiver(truth, correlated_sd_m=(0.6, 1.0), correlation_s=5.0)
    states = truth.at(gnss.t_s)
    north = (gnss.position[:, 0] - states.position[:, 0]) * 6.353e6
    down = states.position[:, 2] - gnss.position[:, 2]
    assert gnss.sd_ned_m[0] == pytest.approx(1.0)
    assert north.std() == pytest.approx(gnss.sd_ned_m[0], rel=0.2)
    assert down.std() == pytest.approx(gnss.sd_ned_m[2], rel=0.2)
    assert (gnss.v_ned[:, 1] - states.v_ned[:, 1]).std() == pytest.approx(0.05, rel=0.1)
    assert np.all(np.diff(gnss.t_arrival_s) >= 0.0)


def test_angles_round_into_the_next_minute() -> None:
    assert latitude(29.99999999999) == ("3000.0000000", "N")
    assert latitude(-0.5) == ("0030.0000000", "S")
    assert longitude(181.0) == ("17900.0000000", "W")
    with pytest.raises(ValueError, match="XYZ"):
        _receiver(Truth(drive(2.0), ORIGIN, 50.0, 2.0), sentences=("XYZ",)).nmea(0, 0)
