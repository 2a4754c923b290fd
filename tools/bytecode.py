"""Leaves the bytecode of what the commands import: a part of `make install`.

pip is told to compile none, since of the thousands of modules that come with the packages a few
hundred are ever imported. Those are imported here, once: where Python is told to write none
(`PYTHONDONTWRITEBYTECODE`, usual in containers) each start would compile them again. Kernels are
left to the first command that needs them.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points

from fusiond.navigation.compiled import gathered

# What `run`, `process`, `check`, `status` and `--help` import; the drivers come on top.
MODULES = (
    "fusiond.__main__",
    "fusiond.configuration.doubts",
    "fusiond.live.__main__",
    "fusiond.live.daemon",
    "fusiond.offline.process",
    "fusiond.outputs.broker_access",
)


def main() -> None:
    """Import it."""
    with gathered():
        for name in MODULES:
            import_module(name)
        for driver in entry_points(group="fusiond.drivers"):
            driver.load()


if __name__ == "__main__":
    main()
