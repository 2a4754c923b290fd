"""Installation of an extra into the running Python. fusiond is on no package index, so that the
command names the extra's packages."""

from __future__ import annotations

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec


def install_command(extra: str) -> str:
    """Command that installs `extra`, from fusiond's metadata. The Debian package lacks pip and uses
    the system's."""
    try:
        stated = requires("fusiond") or []
    except PackageNotFoundError:  # run from a folder, without an installation
        stated = []
    names = [
        line.partition(";")[0].strip()
        for line in stated
        if f'extra == "{extra}"' in line.replace("'", '"')
    ]
    python = shlex.quote(sys.executable)
    pip = f"python3 -m pip --python {python}" if find_spec("pip") is None else f"{python} -m pip"
    return f"{pip} install {' '.join(map(shlex.quote, names))}"
