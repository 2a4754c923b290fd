"""A file of NMEA that gives nothing, or less than it could, says why in one sentence."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from drivers.measurements import PositionFix
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import ImuTable
from fusiond.offline.measurement_files import READERS

DAY = datetime(2026, 3, 24, 7, 33, 2, tzinfo=UTC)
SECONDS = 30


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n"


def log(day: datetime = DAY, talker: str = "GN", rmc: bool = True, gga: bool = True) -> str:
    text = ""
    for i in range(SECONDS):
        at = day + timedelta(seconds=i)
        place = "4712.0000,N,00812.0000,E"
        if gga:
            text += sentence(f"{talker}GGA,{at:%H%M%S}.00,{place},1,14,0.9,403.0,M,47.0,M,,")
        if rmc:
            text += sentence(f"{talker}RMC,{at:%H%M%S}.00,A,{place},3.0,90.0,{at:%d%m%y},,,A,V")
    return text


def imu(start_s: float) -> ImuTable:
    t_s = start_s + np.arange(0.0, SECONDS, 0.1)
    return ImuTable(t_s, np.zeros((len(t_s), 6)), [])


OF_WEEK = imu(200000.0)  # Tuesday 07:33:02 UTC and 18 leap seconds


def read(tmp_path: Path, text: str, table: ImuTable = OF_WEEK) -> tuple[list[float], list[str]]:
    """Instants (s) of its fixes, and what is said of the file."""
    path = tmp_path / "log.nmea"
    path.write_text(text, newline="")
    rows, rejected = READERS["nmea"](path, table, "gnss")
    assert all(isinstance(row.measurement, PositionFix) for row in rows)
    return [row.t_arrival_ns * 1e-9 for row in rows], [str(r) for r in rejected]


def test_fixes_stand_at_gps_second_of_week_or_posix(tmp_path: Path) -> None:
    times, said = read(tmp_path, log())
    assert (times[0], len(times), said) == (200000.0, SECONDS, [])
    times, said = read(tmp_path, log(), imu(DAY.timestamp()))
    assert (times[0], said) == (DAY.timestamp(), [])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("".join(line.partition("*")[0] + "\r\n" for line in log().splitlines()), "without a che"),
        (log(talker="LC"), "positions of talker LC"),
        (log(rmc=False), "no measurement with a date (RMC or ZDA missing)"),
        (log(DAY.replace(year=1999)), "the receiver's date is 1999-03-24, before 2000-05-01"),
        (log().replace("4712", "4713"), "wrong checksums against 0 sound"),
        (log(rmc=False, gga=False) + sentence("GPGSV,1,1,00"), "switch on GGA"),
        ("\xb5b\x05\x01" * 4, "no NMEA sentence whose checksum is right"),
        ("", "the file is empty"),
    ],
)
def test_a_file_without_fixes_says_why(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(TableError, match=re.escape(words)):
        read(tmp_path, text)


def test_gll_alone_gives_fixes_by_the_date_of_zda(tmp_path: Path) -> None:
    """Its time is the fifth field; the epochs of what has none go by it."""
    lines = []
    for k in range(SECONDS):
        when = DAY + timedelta(seconds=k)
        lines.append(sentence(f"GPZDA,{when:%H%M%S}.00,{when:%d,%m,%Y},00,00"))
        lines.append(sentence(f"GPGLL,4712.{k:04d},N,00812.0,E,{when:%H%M%S}.00,A,A"))
        lines.append(sentence("GPVTG,90.0,T,,M,19.4,N,36.0,K"))
    times, said = read(tmp_path, "".join(lines))
    assert len(times) == SECONDS - 1
    assert any(line.startswith("gll_alone: only GLL has a position") for line in said)


def test_rmc_alone_gives_fixes_and_says_so(tmp_path: Path) -> None:
    times, said = read(tmp_path, log(gga=False))
    assert len(times) == SECONDS - 1
    assert any(line.startswith("rmc_alone: only RMC has a position") for line in said)


def test_a_week_that_has_rolled_over_is_mended_by_posix_time(tmp_path: Path) -> None:
    old = log(DAY - timedelta(weeks=1024))
    times, said = read(tmp_path, old, imu(DAY.timestamp()))
    assert times[0] == DAY.timestamp()
    (line,) = said
    assert line.startswith("week_rollover: the fixes are of 2006-08-08, 1024 weeks off")
    # A file of another day is no rollover: it has no time in common with the IMU's.
    times, said = read(tmp_path, log(DAY - timedelta(weeks=1023)), imu(DAY.timestamp()))
    assert times[0] == (DAY - timedelta(weeks=1023)).timestamp()
    assert said == []


def test_leap_seconds_of_a_rolled_over_date_are_told(tmp_path: Path) -> None:
    times, said = read(tmp_path, log(DAY - timedelta(weeks=1024)))
    assert times[0] == 199996.0
    (line,) = said
    assert line.startswith("old_date: the fixes are of 2006-08-08, with the leap seconds of then")
    assert line.endswith("their times are 4 s too early")
