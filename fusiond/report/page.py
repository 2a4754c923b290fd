"""HTML page of a report: one file, which fetches nothing.

uPlot 1.6.32 (MIT, `assets/uplot/LICENSE`) is included unchanged. A policy in the page forbids the
browser to fetch anything, and content of files is only shown as text.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

_STYLES = ("uplot/uPlot.min.css", "report.css")
_SCRIPTS = ("uplot/uPlot.iife.min.js", "base.js", "plots.js", "track.js", "grid.js", "page.js")


def page(title: str, document: Mapping[str, Any]) -> str:
    """HTML of a document (`fusiond.report.report`)."""
    return Template(_file("report.html")).substitute(
        title=escape(title),
        style="\n".join(map(_file, _STYLES)),
        data=_inert(json.dumps(document, separators=(",", ":"), allow_nan=False)),
        script=f"/* uPlot:\n{_file('uplot/LICENSE')}\n*/\n" + "\n".join(map(_file, _SCRIPTS)),
    )


def _inert(text: str) -> str:
    """JSON that cannot end the script or begin a comment in HTML."""
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _file(name: str) -> str:
    return files("fusiond.report").joinpath("assets", name).read_text(encoding="utf-8")
