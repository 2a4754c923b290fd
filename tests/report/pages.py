"""What the tests read out of a page, and logs that are written message by message."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.configuration.schema import Config
from fusiond.files.solution_csv import STATUS, SolutionWriter
from fusiond.recording.channels import CHANNELS
from fusiond.recording.log_metadata import about_run
from fusiond.recording.mcap_writer import About, LogFile

SECOND = 1_000_000_000
EPOCH_NS = 1_800_000_000 * SECOND
"""Of `written`: log time minus monotonic time."""


def read_page(path: Path) -> dict[str, Any]:
    """The document that a page draws."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    document: dict[str, Any] = json.loads(found[1])
    return document


def items(document: Mapping[str, Any], title: str, run: int = 0) -> list[dict[str, Any]]:
    """Those of a section, of one run."""
    rows = next(s["rows"] for s in document["sections"] if s["title"] == title)
    return [row[run] for row in rows if row[run] is not None]


def item(document: Mapping[str, Any], section: str, title: str, run: int = 0) -> dict[str, Any]:
    return next(i for i in items(document, section, run) if i.get("title", "").startswith(title))


def numbers(text: str) -> NDArray[np.float64]:
    return np.frombuffer(base64.b64decode(text), dtype="<f4").astype(np.float64)


def series(plot: Mapping[str, Any], label: str) -> NDArray[np.float64]:
    return numbers(next(s["y"] for s in plot["series"] if s["label"] == label))


def written(
    path: Path,
    messages: list[tuple[str, float, bytes]],
    config: Config | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """A log of (topic, seconds, data) in order, as a recorder would write it."""
    about = about_run(config or Config(), "run", EPOCH_NS, ())
    described = About({**about.metadata, **(metadata or {})}, about.attachments)
    file = LogFile(path, described.part(0), EPOCH_NS)
    for number, (topic, t_s, data) in enumerate(messages, start=1):
        file.write(CHANNELS[topic], EPOCH_NS + round(t_s * SECOND), data, number)
    file.finish()
    return path


def solution(path: Path, from_s: float, east_m: float = 0.0, rows: int = 400) -> Path:
    """Northward at 10 m/s, 10 rows a second."""
    t = from_s + 0.1 * np.arange(rows)
    lat = 0.5 + 10.0 * (t - t[0]) / 6.35e6
    lon = np.full(rows, 2.0) + east_m / (6.378e6 * np.cos(0.5))
    v = np.tile([10.0, 0.0, 0.0], (rows, 1))
    status = np.full(rows, STATUS.index("navigating"), dtype=np.int64)
    status[-50:] = STATUS.index("coasting")
    with SolutionWriter(path) as file:
        nothing = np.zeros((rows, 3))
        file.rows(t, lat, lon, np.full(rows, 30.0), v, nothing, np.full((rows, 9), 0.5), status)
    return path


def fusiond(*args: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["report", *map(str, args)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output
