"""What to do, in the order of what it is worth to do first: from `status` and `health`.

The daemon's `why` says what is wrong and where it can what helps; this adds the step that a person
takes: a plug, a cable, a view of the sky, a key of the configuration. Nothing to do is no advice.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

Said = Mapping[str, Any]
Level = Literal["error", "warning", "info"]


class Advice(NamedTuple):
    """One step; `about` names the source or part that it concerns."""

    level: Level
    about: str
    text: str


_ORDER: dict[str, int] = {"error": 0, "warning": 1, "info": 2}

WHY: tuple[tuple[str, Level, str], ...] = (
    (r"^compiling", "info", "Wait: kernels are compiled, once."),
    (r"^waiting for IMU data", "error", "Check power and bus of the inertial unit."),
    (r"^IMU silent", "error", "The inertial unit has stopped: check its power and its bus."),
    (r"multiply the|another unit", "error", "Correct the unit of the inertial data, then restart."),
    (r"upside down|mounting_deg", "error", "Correct [imu] axes and mounting_deg, then restart."),
    (r"correct imu\.rate_hz", "warning", "Correct imu.rate_hz in the configuration."),
    (r"^no position yet", "warning", "Give a receiver a view of the sky, or set_position."),
    (r"levelling needs|no level yet", "info", "Stand still until it is level."),
    (r"gyrocompassing needs|to gyrocompass", "info", "Stand still: it seeks north by itself."),
    (r"no velocity has come", "info", "Drive straight on, faster than a walk: the course tells."),
    (r"drive off", "info", "Drive off: the fixes will show the heading."),
    (r"^no heading yet", "info", "Drive straight on, faster than a walk: the course tells."),
    (r"no fix has confirmed|no motion has confirmed", "info", "Drive on: it needs to be seen."),
    (r"^no position fused", "warning", "Get a receiver back; meanwhile trust sigma, which grows."),
    (r"^horizontal sigma", "error", "Get a receiver back, or set_position: it is lost."),
)
"""Patterns of `why` (the navigator's and the aligner's words), and what helps; the first counts."""

_STATES: dict[str, tuple[Level, str]] = {
    "absent": ("error", "cannot be opened: check plug, power and port"),
    "silent": ("warning", "is open and says nothing: check power, wiring and baud rate"),
    "failed": ("error", "cannot work as configured: correct its section, then restart"),
}
_TERMINAL: tuple[tuple[str, str], ...] = (
    ("no card", "put a card into the terminal"),
    ("no beam", "give its antenna a free view towards the equator"),
    ("suppressed", "the system has silenced it: wait, it tries again by itself"),
    ("radio silence", "lift the radio silence at the terminal"),
)
_VERDICTS: dict[str, str] = {
    "optimistic": "sigma is too small: raise what the configuration says of its noise",
    "coloured": "its errors are alike from one to the next: see docs/consistency.md",
}


def advice(status: Said, health: Said) -> list[Advice]:
    """What to do, the most urgent first; nothing where all is well. Counters are those of the last
    minute."""
    found = [*_of_status(status), *_of_sources(health), *_of_the_host(status, health)]
    found.sort(key=lambda each: _ORDER[each.level])
    return list(dict.fromkeys(found))


def _of_status(status: Said) -> Iterator[Advice]:
    injected = status.get("injected")
    if injected:
        faults = ", ".join(map(str, injected))
        yield Advice("error", "injection", f"Faults are put in ({faults}): do not navigate by it.")
    why = str(status.get("why", ""))
    if status.get("mode") != "navigating":
        for pattern, level, text in WHY:
            if re.search(pattern, why):
                yield Advice(level, "navigation", text)
                break
    for fault in _objects(status, "faults"):
        source, text = str(fault.get("source", "")), str(fault.get("text", ""))
        yield Advice("warning", source, f"Look after {source}: {text}.")
    if status.get("protection") == "beyond":
        text = "The protection level is beyond its limit: do not rely on the position."
        yield Advice("error", "integrity", text)
    if status.get("recording") == "failed":
        yield Advice("error", "recording", "It has failed: make room on the disk, or check it.")
    if status.get("mqtt_taken_over"):
        text = "Another client has the daemon's name at the broker: give each a name."
        yield Advice("warning", "mqtt", text)


def _of_sources(health: Said) -> Iterator[Advice]:
    for name, source in _mappings(health, "sources"):
        state, detail = str(source.get("state", "")), str(source.get("detail", ""))
        terminal = next((text for word, text in _TERMINAL if word in detail), None)
        if terminal is not None:
            yield Advice("warning", name, f"{name}: {terminal}.")
        elif state in _STATES:
            level, text = _STATES[state]
            yield Advice(level, name, f"{name} {text}.")
        if source.get("isolated") and not source.get("diagnosis"):
            yield Advice("warning", name, f"{name} disagrees with the rest and is left out.")
        verdict = source.get("verdict")
        if verdict in _VERDICTS:
            yield Advice("info", name, f"{name}: {_VERDICTS[verdict]}.")


def _of_the_host(status: Said, health: Said) -> Iterator[Advice]:
    ticks, overruns = health.get("ticks"), health.get("overruns")
    # One tick in a thousand is what the daemon is held to (docs/configuration.md, [scheduler]).
    if isinstance(ticks, int) and isinstance(overruns, int) and overruns * 1000 > ticks > 1000:
        text = "More than one tick in 1000 came too late: take load off the computer."
        yield Advice("warning", "scheduler", text)
    if health.get("utc_settled") is False and status.get("mode") == "navigating":
        yield Advice("info", "clock", "UTC may have jumped: nothing is dated until it settles.")


def _objects(said: Said, name: str) -> list[Said]:
    inner = said.get(name)
    return [each for each in inner if isinstance(each, Mapping)] if isinstance(inner, list) else []


def _mappings(said: Said, name: str) -> list[tuple[str, Said]]:
    inner = said.get(name)
    if not isinstance(inner, Mapping):
        return []
    return [(key, value) for key, value in inner.items() if isinstance(value, Mapping)]
