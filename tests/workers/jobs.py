"""Work for the workers of the tests: importable by their processes."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import numpy as np


def drawn(number: int) -> float:
    """A figure of run `number`."""
    return float(np.random.default_rng([7, number]).standard_normal())


def threads(_: int) -> str:
    return os.environ["OPENBLAS_NUM_THREADS"]


def pid(_: int) -> int:
    return os.getpid()


def mishap(kind: str) -> str:
    """Goes wrong in the way that is asked for."""
    match kind:
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "crashed":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "exit":
            os._exit(3)
        case "raises":
            raise ValueError("a mistake")
        case "endless":
            threading.Event().wait()
    return kind


def third_dies(number: int) -> int:
    if number == 2:
        mishap("killed")
    return number


def dies_once(mark: str) -> str:
    """Takes the process that started the worker with it, the first time it is called: a Dask
    worker, in the middle of a chunk."""
    path = Path(mark)
    if path.suffix == ".deadly" and not path.exists():
        path.touch()
        os.kill(os.getppid(), signal.SIGKILL)
        threading.Event().wait()
    return path.name
