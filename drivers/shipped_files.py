"""Files shipped with the package: example configurations and DBC files of devices.

Their source is the folder `config` at the top of the repository. `drivers/config` is a link to it,
and a folder of files in a wheel: the same files are found in a checkout, an editable installation
and an installed package, whatever the current folder.
"""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent / "config"


def shipped(name: str) -> Path:
    """Path of a shipped file or folder, named as in `config`: `vehicle.toml`, `dbc`."""
    return _FOLDER / name
