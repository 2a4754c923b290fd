"""What may lie at the path of a state file when a daemon starts."""

from __future__ import annotations

import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path

from fusiond.navigator.saved_state import SavedState, save_state
from fusiond.navigator.state_file import MOST_BYTES

Spoil = Callable[[Path, random.Random], None]


def _untouched(path: Path, dice: random.Random) -> None:
    pass


def _missing(path: Path, dice: random.Random) -> None:
    path.unlink(missing_ok=True)


def _writing(content: bytes) -> Spoil:
    def write(path: Path, dice: random.Random) -> None:
        path.write_bytes(content)

    return write


def _whole(path: Path) -> bytes:
    """What is there, or a saved state as it may be from before the vehicle drove off."""
    if not path.is_file() or not path.stat().st_size:
        save_state(path, SavedState(time.time() - 60.0, (0.53, 1.99, 38.0), 3.0, 0.7, 0.05))
    return path.read_bytes()


def _truncated(path: Path, dice: random.Random) -> None:
    whole = _whole(path)
    path.write_bytes(whole[: dice.randrange(len(whole))])


def _flipped(path: Path, dice: random.Random) -> None:
    whole = bytearray(_whole(path))
    for _ in range(dice.randint(1, 16)):
        whole[dice.randrange(len(whole))] ^= 1 << dice.randrange(8)
    path.write_bytes(whole)


def _random(path: Path, dice: random.Random) -> None:
    path.write_bytes(dice.randbytes(dice.randint(1, 4096)))


def _old(path: Path, dice: random.Random) -> None:
    try:
        state = json.loads(_whole(path))
    except (ValueError, RecursionError):
        state = None
    if not isinstance(state, dict):  # spoilt before: nothing to make an old one of
        state = {}
    state.pop("crc32", None)
    path.write_text(json.dumps({**state, "version": 0}))


def _directory(path: Path, dice: random.Random) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


def _pipe(path: Path, dice: random.Random) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def spoil(name: str, path: Path, dice: random.Random) -> None:
    """Bring a condition about; a pipe or a folder of an earlier one goes first."""
    if path.is_dir():
        path.rmdir()
    elif path.exists() and not path.is_file():
        path.unlink()
    CONDITIONS[name](path, dice)


CONDITIONS: dict[str, Spoil] = {
    "untouched": _untouched,
    "missing": _missing,
    "empty": _writing(b""),
    "truncated": _truncated,
    "bits flipped": _flipped,
    "random bytes": _random,
    "deep JSON": _writing(b"[" * 60_000),
    "huge integer": _writing(b'{"utc_s": 1' + b"0" * 60_000 + b"}"),
    "too large": _writing(b"0" * (MOST_BYTES + 1)),
    "foreign JSON": _writing(b'{"navigation": {"lat": 30.5, "lon": "east"}, "sd_yaw_rad": -1}'),
    "of an old version": _old,
    "directory": _directory,
    "pipe": _pipe,
}
