"""An RTCM file says neither year nor week: both are those of the inertial unit's time."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from drivers.measurements import MonotonicStamp
from drivers.raw.messages import RawGnssEpoch
from fusiond.files.measurement_csv import ImuTable
from fusiond.offline.measurement_files import READERS
from tests.places import DATA

FILE = DATA.parent / "cases" / "18_rtcm_of_2016.rtcm3"
TOW_S = 3 * 86_400 + 20 * 3600 + 38 * 60 + 17
"""Of its first epoch, a Wednesday."""

pytestmark = pytest.mark.skipif(not FILE.is_file(), reason=f"{FILE} is missing: set FUSIOND_DATA")


@pytest.mark.parametrize(
    ("day", "leap_seconds"),
    [
        ((1999, 8, 18), 13),  # the last week before GPS's first rollover, and the first after
        ((1999, 8, 25), 13),
        ((2005, 12, 28), 13),
        ((2006, 1, 4), 14),
        ((2008, 12, 31), 14),
        ((2012, 7, 4), 16),
        ((2015, 7, 1), 17),
        ((2016, 12, 28), 17),
        ((2017, 1, 4), 18),
        ((2019, 4, 3), 18),  # the second rollover
        ((2019, 4, 10), 18),
        ((2038, 11, 17), 18),  # the third
        ((2038, 11, 24), 18),
    ],
)
def test_weeks_and_leap_seconds_of_other_years(
    day: tuple[int, int, int], leap_seconds: int
) -> None:
    midnight = datetime(*day, tzinfo=UTC).timestamp()
    begin = midnight + TOW_S % 86_400 - leap_seconds
    imu = ImuTable(np.array([begin - 30.0, begin + 60.0]), np.zeros((2, 6)), [])
    rows, refused = READERS["raw"](FILE, imu, "raw")
    found = [row.measurement for row in rows if isinstance(row.measurement, RawGnssEpoch)]
    assert len(found) == 24
    assert isinstance(found[0].stamp, MonotonicStamp)
    assert found[0].stamp.t_ns * 1e-9 == pytest.approx(begin, abs=1e-3)
    assert refused == []
