"""Home Assistant's discovery: one retained message describes the entities.

The entities read the topics `tracker`, `status` and `health`, never `nav`, which would flood Home
Assistant's recorder. The broker retains the description. It is sent again whenever Home Assistant
starts, for a broker that has lost it.

Source: "MQTT Discovery, device discovery payload" of Home Assistant's documentation, the
abbreviations of its release 2025.4.
"""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from importlib.metadata import version
from typing import Any

from pydantic import RootModel

from drivers.base import DriverStatus
from fusiond.configuration.outputs import HomeAssistant
from fusiond.navigation.solution import Mode
from fusiond.outputs.base import Surroundings
from fusiond.outputs.messages.base import Message
from fusiond.outputs.topics import HEALTH, STATUS, TRACKER, Topic, base_topic

_EXPIRE_S = 60
"""A figure that is older is shown as unavailable: six times the longest wait of `tracker`."""

Component = dict[str, Any]


class Description(RootModel[dict[str, Any]]):
    """Discovery message; Home Assistant refuses it if a key is unknown to it."""


class HomeAssistantDiscovery:
    """Publisher of the entities' description. Counter: `births`, starts of Home Assistant, after
    which it is sent again."""

    name = "home_assistant"
    sets_clocks = False
    nav_rate_hz = 1.0

    def __init__(self, section: HomeAssistant, around: Surroundings) -> None:
        self._mqtt = around.broker()
        node = f"fusiond_{around.vehicle}"
        self._topic = Topic(
            f"{section.prefix}/device/{node}/config", Description, 1, True, absolute=True
        )
        self._description = Description(description(node, around.vehicle, around.sources))
        self.counters: Counter[str] = Counter()
        self._mqtt.listen(f"{section.prefix}/status", self._on_status)
        self._mqtt.publish(self._topic, self._description)

    @property
    def status(self) -> DriverStatus:
        return self._mqtt.status

    def publish(self, topic: Topic, message: Message) -> None:
        """Ignore messages: the entities read the MQTT topics."""

    async def run(self) -> None:
        await asyncio.get_running_loop().create_future()

    def _on_status(self, payload: bytes) -> None:
        if payload == b"online":
            self.counters["births"] += 1
            self._mqtt.publish(self._topic, self._description)


def description(node: str, vehicle: str, sources: tuple[str, ...]) -> dict[str, Any]:
    """Entities of a vehicle: position, mode and its reason, accuracy, each device."""
    base = base_topic(vehicle)
    release = version("fusiond")
    return {
        "dev": {"ids": [node], "name": vehicle, "mf": "fusiond", "sw": release},
        "o": {"name": "fusiond", "sw": release},
        "avty_t": f"{base}/online",
        "pl_avail": "online",
        "pl_not_avail": "offline",
        "cmps": dict(_entities(node, base, sources)),
    }


def _entities(node: str, base: str, sources: tuple[str, ...]) -> list[tuple[str, Component]]:
    """Entities by key."""

    def entity(key: str, platform: str, name: str | None, **more: Any) -> tuple[str, Component]:
        identity = {"p": platform, "uniq_id": f"{node}_{key}", "name": name}
        return key, identity | more

    entities = [
        entity("pos", "device_tracker", None, src_type="gps", json_attr_t=f"{base}/{TRACKER.name}"),
        entity(
            "mode",
            "sensor",
            "Mode",
            stat_t=f"{base}/{STATUS.name}",
            val_tpl="{{ value_json.mode }}",
            dev_cla="enum",
            ops=[str(mode) for mode in Mode],
        ),
        entity(
            "why",
            "sensor",
            "Reason",
            stat_t=f"{base}/{STATUS.name}",
            val_tpl="{{ value_json.why[:255] }}",  # longest text of a state
            ent_cat="diagnostic",
        ),
        entity(
            "sig",
            "sensor",
            "Accuracy",
            stat_t=f"{base}/{TRACKER.name}",
            val_tpl="{{ value_json.gps_accuracy }}",
            dev_cla="distance",
            unit_of_meas="m",
            stat_cla="measurement",
            exp_aft=_EXPIRE_S,
        ),
    ]
    for source in sources:
        state = f"value_json.sources[{source!r}].state"
        entities.append(
            entity(
                "source_" + re.sub(r"\W", "_", source),
                "binary_sensor",
                source,
                stat_t=f"{base}/{HEALTH.name}",
                val_tpl=f"{{{{ 'ON' if {state} == 'running' else 'OFF' }}}}",
                dev_cla="connectivity",
                ent_cat="diagnostic",
            )
        )
    return entities
