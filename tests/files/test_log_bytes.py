"""Logs of receivers as they come from a disk: packed, cut, redirected."""

from __future__ import annotations

import gzip
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusiond.files.csv_tables import TableError
from fusiond.files.log_bytes import log_bytes

LINES = b"$GNGGA,0,\xb5\x62\xff\r\n" * 2000
ZIPPED = gzip.compress(LINES, mtime=0)


def _of(folder: Path, data: bytes) -> tuple[bytes, list[str]]:
    path = folder / "receiver.log"
    path.write_bytes(data)
    found = log_bytes(path)
    return found.data, [note.detail for note in found.notes]


@pytest.mark.parametrize("data", [LINES, ZIPPED, ZIPPED + b"\0" * 512], ids=["plain", "gz", "pad"])
def test_what_is_whole(data: bytes, tmp_path: Path) -> None:
    assert _of(tmp_path, data) == (LINES, [])


def test_members_one_after_another(tmp_path: Path) -> None:
    """A logger that goes on with its file after each start."""
    assert _of(tmp_path, ZIPPED * 3) == (LINES * 3, [])


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_what_powershell_wrote(encoding: str, tmp_path: Path) -> None:
    text = "$GNGGA,073300.00,4712.0000,N*00\r\n"
    mark = "" if encoding == "utf-16" else "\ufeff"
    assert _of(tmp_path, (mark + text).encode(encoding)) == (text.encode(), [])


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_what_powershell_appended(encoding: str, tmp_path: Path) -> None:
    text = "$GNGGA,073300.00,4712.0000,N*00\r\n"
    assert _of(tmp_path, text.encode(encoding)) == (text.encode(), [])


@pytest.mark.parametrize(
    "data", [bytes(90), b"\x01\0" * 50, b"$\0" * 20, b"\xb5\0" * 50, b"$G\0\0" * 40]
)
def test_binary_with_zeros_is_no_text(data: bytes, tmp_path: Path) -> None:
    assert _of(tmp_path, data)[0] == data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ZIPPED[: len(ZIPPED) // 2], "ends before its end"),
        (ZIPPED + ZIPPED[:20], "ends before its end"),
        (ZIPPED * 2 + ZIPPED[:-8] + bytes(8), "damaged"),
        (ZIPPED + b"and more", "something follows"),
    ],
)
def test_what_is_cut_is_read_as_far_as_it_goes(data: bytes, words: str, tmp_path: Path) -> None:
    found, notes = _of(tmp_path, data)
    assert (LINES * 2).startswith(found)
    assert found
    assert len(notes) == 1
    assert words in notes[0]


@given(st.binary(max_size=300), st.integers(0, len(ZIPPED)))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_some(tmp_path: Path, data: bytes, at: int) -> None:
    for content in (data, ZIPPED[:at] + data, b"\x1f\x8b" + data, b"\xff\xfe" + data):
        with suppress(TableError):
            _of(tmp_path, content)


@pytest.mark.parametrize("data", [ZIPPED[:12], b"\x1f\x8bnot a gzip"])
def test_what_cannot_be_unpacked_at_all_is_refused(data: bytes, tmp_path: Path) -> None:
    with pytest.raises(TableError, match="no gzip file that can be unpacked"):
        _of(tmp_path, data)
