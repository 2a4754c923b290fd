"""Reload of a configuration, and the keys that need a restart.

A reload applies the outputs (`mqtt`, `outputs`), the gates (`gate_probability` of every
measurement) and `log_level`: they can change without losing the solution. All other keys need a
restart, since the model, the buffers and the drivers are made of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config

GATE = "gate_probability"
MQTT = "mqtt"


@dataclass(frozen=True, slots=True)
class Difference:
    """Result of a reload: `config` is the new configuration. `taken` and `restart` are dotted keys:
    those applied, and those that need a restart."""

    config: Config
    taken: tuple[str, ...]
    restart: tuple[str, ...]
    outputs: frozenset[str]
    """Outputs that are changed, new or removed."""
    gates: Mapping[str, float]
    """New gate probability, by section of `aiding`."""


def difference(running: Config, read: Config) -> Difference:
    """Compare the running configuration with the file. Raises `ConfigError` if the applied changes
    conflict with those that need a restart."""
    before, after = dict(_flat(running.model_dump())), dict(_flat(read.model_dump()))
    changed = sorted(
        key
        for key in before.keys() | after.keys()
        if key not in before or key not in after or before[key] != after[key]
    )
    gates = {
        name: section.gate_probability
        for name, section in read.aiding.items()
        if f"aiding.{name}.{GATE}" in changed and name in running.aiding
    }
    taken = tuple(key for key in changed if _can_be_taken(key, gates))
    aiding = {
        name: section.model_copy(update={GATE: gates.get(name, section.gate_probability)})
        for name, section in running.aiding.items()
    }
    update = {
        "mqtt": read.mqtt,
        "outputs": read.outputs,
        "log_level": read.log_level,
        "aiding": aiding,
    }
    config = running.model_copy(update=update)
    try:
        Config.model_validate(config.model_dump())
    except ValidationError as error:
        mistakes = "; ".join(e["msg"] for e in error.errors())
        raise ConfigError(f"only with a restart: {mistakes}") from error
    restart = tuple(key for key in changed if key not in taken)
    return Difference(config, taken, restart, _restarted(running, read), gates)


def _can_be_taken(key: str, gates: Mapping[str, float]) -> bool:
    section, _, rest = key.partition(".")
    if section == "aiding":
        name, _, field = rest.rpartition(".")
        return field == GATE and name in gates
    return section in ("mqtt", "outputs", "log_level")


def _restarted(running: Config, read: Config) -> frozenset[str]:
    """Outputs to restart: their section has changed, or the broker through which they publish."""
    before, after = running.outputs.served, read.outputs.served
    found = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    if running.outputs.geoid_separation_m != read.outputs.geoid_separation_m:
        found |= before.keys() | after.keys()
    by_broker = {*running.outputs.through_the_broker, *read.outputs.through_the_broker}
    if running.mqtt != read.mqtt or found & by_broker:
        found |= {MQTT, *by_broker}
    return frozenset(found)


def _flat(section: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
