"""Worker process: takes chunks of items from its socket and replies item by item.

Input is the pickle of (work, [(index, item), ...]). Output is pickled, too: `STARTED` when `work`
has been loaded, then for each item (index, ended, reason, result).
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
import traceback
from multiprocessing.connection import Connection
from queue import SimpleQueue

STARTED = "begun"


def serve_items(descriptor: int) -> None:
    """Serve items until the pipe is closed, then exit at once, even during a run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever started us
    connection = Connection(descriptor)
    chunks: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(connection, chunks), daemon=True).start()
    while True:
        _work_off(connection, chunks.get())


def _listen(connection: Connection, chunks: SimpleQueue[bytes]) -> None:
    try:
        while True:
            chunks.put(connection.recv_bytes())
    except (EOFError, OSError):
        os._exit(0)


def _work_off(connection: Connection, chunk: bytes) -> None:
    work, items = pickle.loads(chunk)
    connection.send(STARTED)
    for index, item in items:
        try:
            answer = pickle.dumps((index, "done", "", work(item)))
        except BaseException as error:  # whatever a run raises is its outcome
            answer = pickle.dumps((index, "error", _described(error), None))
        connection.send_bytes(answer)


def _described(error: BaseException) -> str:
    """Describe an exception by class, text and the line that raised it."""
    text = f"{type(error).__name__}: {error}"
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    return f"{text} ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})"
