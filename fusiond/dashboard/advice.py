"""Steps for the operator, the most urgent first, from `status` and `health`.

The step for a `why` comes from the catalogue `fusiond.navigator.mode_reasons`; sources, host and
faults add theirs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from fusiond.navigator.mode_reasons import REASONS, Weight, recognised

Said = Mapping[str, Any]


class Advice(NamedTuple):
    """One step; `about` names the source or part concerned."""

    level: Weight
    about: str
    text: str


_ORDER: dict[str, int] = {"error": 0, "warning": 1, "info": 2}

_STATES: dict[str, tuple[Weight, str]] = {
    "absent": ("error", "cannot be opened: check cable, power and port"),
    "silent": ("warning", "is open but silent: check power, wiring and baud rate"),
    "failed": ("error", "cannot work as configured: correct its section, then restart"),
}
_TERMINAL: tuple[tuple[str, str], ...] = (
    ("no card", "insert a card into the terminal"),
    ("no beam", "give its antenna a free view towards the equator"),
    ("suppressed", "the RDSS centre suppresses it: wait, requests resume by themselves"),
    ("radio silence", "lift the radio silence at the terminal"),
)
_VERDICTS: dict[str, str] = {
    "optimistic": "sigma is too small: raise `sigma_scale` of its section",
    "coloured": "its errors last from fix to fix: see docs/consistency.md",
}


def advice(status: Said, health: Said) -> list[Advice]:
    """Steps to take, the most urgent first; none if all is well. Counters are of the last
    minute."""
    found = [*_of_status(status), *_of_sources(health), *_of_the_host(status, health)]
    found.sort(key=lambda each: _ORDER[each.level])
    return list(dict.fromkeys(found))


def _of_status(status: Said) -> Iterator[Advice]:
    injected = status.get("injected")
    if injected:
        faults = ", ".join(map(str, injected))
        yield Advice(
            "error", "injection", f"Simulated faults ({faults}): do not navigate by this solution."
        )
    why = str(status.get("why", ""))
    if status.get("mode") != "navigating":
        steps = [REASONS[code] for code in recognised(why) if REASONS[code].advice]
        for weight, _, text in steps[:1]:  # the most urgent
            yield Advice(weight, "navigation", text)
    for fault in _objects(status, "faults"):
        source, text = str(fault.get("source", "")), str(fault.get("text", ""))
        yield Advice("warning", source, f"Check {source}: {text}.")
    if status.get("protection") == "beyond":
        text = "The protection level is beyond its limit: do not rely on the position."
        yield Advice("error", "integrity", text)
    if status.get("recording") == "failed":
        yield Advice("error", "recording", "Recording failed: free disk space, or check the disk.")
    if status.get("mqtt_taken_over"):
        text = "Another MQTT client has this daemon's name: give each its own `mqtt.client_id`."
        yield Advice("warning", "mqtt", text)


def _of_sources(health: Said) -> Iterator[Advice]:
    for name, source in _mappings(health, "sources"):
        state, detail = str(source.get("state", "")), str(source.get("detail", ""))
        terminal = next((text for word, text in _TERMINAL if word in detail.lower()), None)
        if terminal is not None:
            yield Advice("warning", name, f"{name}: {terminal}.")
        elif state in _STATES:
            level, text = _STATES[state]
            yield Advice(level, name, f"{name} {text}.")
        if source.get("isolated") and not source.get("diagnosis"):
            yield Advice(
                "warning",
                name,
                f"{name} disagrees with the other sources and is excluded: wait for its return.",
            )
        if source.get("service") == "probation":
            yield Advice("info", name, f"{name} is back; checking it against the motion.")
        verdict = source.get("verdict")
        if verdict in _VERDICTS:
            yield Advice("info", name, f"{name}: {_VERDICTS[verdict]}.")


def _of_the_host(status: Said, health: Said) -> Iterator[Advice]:
    ticks, overruns = health.get("ticks"), health.get("overruns")
    # One tick in a thousand is what the daemon is held to (docs/configuration.md, [scheduler]).
    if isinstance(ticks, int) and isinstance(overruns, int) and overruns * 1000 > ticks > 1000:
        text = "More than one tick in 1000 was late: reduce the load on this computer."
        yield Advice("warning", "scheduler", text)
    if health.get("utc_settled") is False and status.get("mode") == "navigating":
        yield Advice(
            "info", "clock", "UTC may have jumped: messages have no date until it settles."
        )


def _objects(said: Said, name: str) -> list[Said]:
    inner = said.get(name)
    return [each for each in inner if isinstance(each, Mapping)] if isinstance(inner, list) else []


def _mappings(said: Said, name: str) -> list[tuple[str, Said]]:
    inner = said.get(name)
    if not isinstance(inner, Mapping):
        return []
    return [(key, value) for key, value in inner.items() if isinstance(value, Mapping)]
