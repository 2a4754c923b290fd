"""Outputs by section of the configuration, with their classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.outputs.base import Output, Surroundings
from fusiond.outputs.chrony import ChronySocket
from fusiond.outputs.client_sockets import Guests
from fusiond.outputs.commands import Handler
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.home_assistant import HomeAssistantDiscovery
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.nmea import NmeaServer
from fusiond.outputs.owntracks import OwnTracksLocations
from fusiond.outputs.prometheus import PrometheusEndpoint


def _foxglove(section: Any, around: Surroundings) -> Output:
    """Make the Foxglove server, which imports websockets on demand."""
    from fusiond.outputs.foxglove.server import FoxgloveServer  # noqa: PLC0415

    return FoxgloveServer(section, around)


MAKERS: dict[str, Callable[[Any, Surroundings], Output]] = {
    "gpsd": GpsdServer,
    "nmea": NmeaServer,
    "owntracks": OwnTracksLocations,
    "chrony": ChronySocket,
    "home_assistant": HomeAssistantDiscovery,
    "prometheus": PrometheusEndpoint,
    "foxglove": _foxglove,
}
"""Factories by name of the section below `[outputs]`."""


def make_outputs(
    config: Config,
    *,
    on_event: Callable[[str, str, str], None],
    on_command: Handler,
    clock: Clock,
    guests: Guests,
    kept: Mapping[str, Output] = MappingProxyType({}),
) -> dict[str, Output]:
    """Make the configured outputs by name, MQTT first. `on_event(source, code, text)` receives
    their events. All servers share `guests`, the limit on connections. `kept` outputs already run
    and are not made again.

    Raises `ConfigError` for an output that cannot be made as configured.
    """
    made: dict[str, Output] = {}
    mqtt: MqttPublisher | None = None
    if "mqtt" in kept:
        made["mqtt"] = kept["mqtt"]
    elif config.mqtt.enabled:
        made["mqtt"] = mqtt = MqttPublisher(
            config.mqtt,
            config.vehicle,
            on_event=partial(on_event, "mqtt"),
            on_command=on_command,
            utc_now=lambda: clock.utc_ns(clock.now_ns()),
        )
    for name, section in config.outputs.served.items():
        if name in kept:
            made[name] = kept[name]
            continue
        around = Surroundings(
            config.vehicle,
            partial(on_event, name),
            config.outputs.geoid_separation_m,
            tuple(config.sources),
            mqtt,
            clock,
            guests,
        )
        made[name] = MAKERS[name](section, around)
    return made
