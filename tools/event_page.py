"""Writes docs/events.md from the catalogue of events: `python -m tools.event_page`.

A test holds that the page is of today.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from fusiond.outputs.messages import event_catalogue
from fusiond.outputs.messages.event_catalogue import Entry

PAGE = Path("docs/events.md")
_HEAD = """# Events

For the operator who reads an event, and for whoever writes a rule for one. An event goes out on
the topic [`event`](mqtt.md#event), into the log and into a recording. Its `code` is stable; its
`text` has names and figures; its `advice` is the last column here. A dash: nothing to do.

`fusiond status` shows the last events; `journalctl -u fusiond` shows all.
"""
_PARTS: tuple[tuple[str, Mapping[str, Entry]], ...] = (
    ("Devices and buses", event_catalogue.DEVICES),
    ("GNSS receivers", event_catalogue.RECEIVERS),
    ("RDSS terminal", event_catalogue.TERMINAL),
    ("Short messages", event_catalogue.MESSAGES),
    ("Clock", event_catalogue.CLOCK),
    ("Navigation", event_catalogue.NAVIGATION),
    ("Inertial unit", event_catalogue.IMU),
    ("Daemon", event_catalogue.DAEMON),
    ("Outputs", event_catalogue.OUTPUTS),
)


def page() -> str:
    """The page; the same catalogue gives the same text."""
    return "\n".join(_lines())


def _lines() -> Iterator[str]:
    yield _HEAD
    for title, entries in _PARTS:
        yield f"## {title}\n\n| code | level | meaning | next step |\n|---|---|---|---|"
        for code, entry in entries.items():
            yield f"| `{code}` | {entry.level} | {entry.meaning} | {entry.advice or '–'} |"
        yield ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
