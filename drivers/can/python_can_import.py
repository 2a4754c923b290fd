"""Import of python-can without asammdf, which only its MF4 reader and writer need.

`import can` imports every log format, among them asammdf with pandas, pyarrow and canmatrix: 0.75 s
of processor time at the start of a daemon that reads no such log. So asammdf is hidden during that
import. cantools imports python-can, too: this package imports this module before any other.
"""

from __future__ import annotations

import importlib
import sys

_known = sys.modules.get("asammdf")
sys.modules["asammdf"] = None  # type: ignore[assignment]  # to an import: not installed
try:
    import can
finally:
    del sys.modules["asammdf"]
    if _known is not None:
        sys.modules["asammdf"] = _known

__all__ = ["can", "with_mf4"]


def with_mf4() -> None:
    """Enable MF4 in python-can, if asammdf is installed."""
    importlib.reload(importlib.import_module("can.io.mf4"))
