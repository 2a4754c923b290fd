"""What is given in the place of a receiver's log is named by every kind of measurement that reads
one."""

from __future__ import annotations

import bz2
import io
import lzma
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.decoder_options import SolutionDecoding
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import ImuTable
from fusiond.files.mistaken_log_kind import mistaken_log_kind
from fusiond.offline.measurement_files import READERS
from fusiond.offline.nmea_file import read_nmea, receiver_of
from fusiond.offline.receiver_logs import read_solutions


def zipped(data: bytes) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a.nmea", data)
    return made.getvalue()


NMEA = b"$GPGSV,1,1,00*79\r\n" * 9
FILES = {
    "empty": (b"", "the file is empty"),
    "zeros": (bytes(4096), "nothing but zeros"),
    "xz": (lzma.compress(NMEA), "an xz file: unpack it"),
    "pcap": (b"\xd4\xc3\xb2\xa1" + bytes(200), "pcap"),
    "gpx": (b'<?xml version="1.0"?>\n<gpx version="1.1">', "a GPX track"),
    "html": (b"<!DOCTYPE html><html>404", "a page of the web"),
    "table": (b"t_s,lat_deg,lon_deg,height_m\n1,47,8,400\n", "a table: --aid gnss=FILE"),
}
IMU = ImuTable(np.arange(3.0), np.zeros((3, 6)), [])


def read(kind: str, path: Path) -> None:
    if kind == "nmea":
        read_nmea(path, None, receiver_of("gnss", Config()))
    elif kind == "raw":
        READERS["raw"](path, IMU, "raw")
    else:
        read_solutions(kind, path, IMU, "gnss", SolutionDecoding())


@pytest.mark.parametrize("kind", ["nmea", "ubx", "bestpos", "sbf", "raw"])
@pytest.mark.parametrize("name", FILES)
def test_what_it_is_instead_is_named(name: str, kind: str, tmp_path: Path) -> None:
    data, words = FILES[name]
    path = tmp_path / "log"
    path.write_bytes(data)
    with pytest.raises(TableError, match=words.replace("(", r"\(")):
        read(kind, path)


def test_archives_that_rinex_may_be_in_are_named_elsewhere() -> None:
    assert "a zip archive" in mistaken_log_kind(zipped(NMEA))
    assert "a bzip2 file" in mistaken_log_kind(bz2.compress(NMEA))
    assert mistaken_log_kind(NMEA) == ""


@given(st.binary(max_size=300))
def test_any_bytes_are_something_or_nothing(data: bytes) -> None:
    assert mistaken_log_kind(data) == "" or mistaken_log_kind(data).startswith(
        ("this is ", "the file ")
    )
