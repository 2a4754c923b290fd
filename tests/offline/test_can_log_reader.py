"""Logs of others, and any damage to logs of each format: frames, a count or a sentence."""

from __future__ import annotations

import importlib.util
import random
from pathlib import Path

import pytest

from fusiond.files.csv_tables import TableError
from tests.offline.can_files import FRAMES, absolute, read, terminal, written
from tests.places import DATA

CASES = DATA.parent / "cases"


@pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is missing: set FUSIOND_DATA")
@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("06_pretrigger.blf", 0),
        ("07_canfd_start_of_measurement.asc", 0),
        ("08_nul_block.log", 1),
        ("09_cp1252_comment.asc", 0),
        ("12_peak.trc", 0),
        ("13_candump_view.log", 0),
    ],
)
def test_logs_of_others(name: str, bad: int) -> None:
    found, refused, _ = read(CASES / name)
    assert len(found) == 1200
    assert sum(each.times for each in refused.all()) == bad
    stamps = [m.timestamp for m in found]
    assert stamps == sorted(stamps)


def mutated(content: bytes, draw: random.Random) -> bytes:
    """Bytes changed, taken out, put in, repeated, moved, or cut."""
    data = bytearray(content)
    for _ in range(draw.randint(1, 4)):
        at, size = draw.randrange(len(data) + 1), draw.choice([1, 1, 2, 4, 17, 300])
        match draw.randrange(7):
            case 0:
                data[at : at + 1] = bytes([draw.randrange(256)])
            case 1:
                del data[at : at + size]
            case 2:
                data[at:at] = draw.randbytes(size)
            case 3:
                data[at:at] = data[at : at + size]
            case 4:
                data[at : at + size] = bytes(size)
            case 5:
                data[at : at + size] = draw.choice(
                    [b"\n", b"[", b"#", b"(", b")", b"-", b".", b"LOBJ"]
                )
            case _:
                del data[at:]
        if not data:
            return b""
    return bytes(data)


@pytest.mark.parametrize(
    "name", ["bus.log", "view.log", "bus.asc", "bus.trc", "bus.blf", "bus.log.gz"]
)
def test_any_damage_ends_in_frames_a_count_or_a_sentence(name: str, tmp_path: Path) -> None:
    frames = FRAMES[:60]
    path = tmp_path / name
    if name == "view.log":
        path.write_text("\n".join(terminal(absolute)[:60]))
    else:
        written(path, frames)
    whole, draw = path.read_bytes(), random.Random(40)
    for _ in range(300):
        path.write_bytes(mutated(whole, draw))
        try:
            found, refused, _ = read(path)
        except TableError as error:
            assert str(path) in str(error)  # noqa: PT017
            continue
        counted = {"unreadable", "cut", "length_or_type_odd"}
        assert counted >= {each.reason for each in refused.all()}
        assert len(found) <= 16 * len(frames)  # pieces may be repeated


@pytest.mark.skipif(
    importlib.util.find_spec("asammdf") is None,
    reason="the package asammdf is not installed",
)
@pytest.mark.parametrize("content", [b"hello", b"MDF     4.10    " + bytes(range(256)) * 9])
def test_what_is_no_mf4(content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """asammdf's own file fails a second time as it is deleted, and says so on the terminal."""
    path = tmp_path / "bus.mf4"
    path.write_bytes(content)
    with pytest.raises(TableError, match=r"cannot be read as \.mf4: cut: .* MdfException: "):
        read(path)
    assert capfd.readouterr().err == ""
