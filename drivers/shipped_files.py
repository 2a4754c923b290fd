"""The files that come with the package: examples of configurations, DBC files of devices.

Their one source is the folder `config` at the top of the repository. `drivers/config` is a link to
it, which a wheel holds as a folder of files: what is found is the same in a checkout, an editable
installation and an installed package, whatever the current folder.
"""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent / "config"


def shipped(name: str) -> Path:
    """The path of a shipped file or folder, named as in `config`: `vehicle.toml`, `dbc`."""
    return _FOLDER / name
