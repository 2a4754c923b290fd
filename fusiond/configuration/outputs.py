"""Sections `[outputs.NAME]`: outputs beside MQTT. A section that is present is enabled."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from fusiond.configuration.aiding import Section


def _host(text: str) -> str:
    """IPv6 addresses have colons, of which the last is no port's."""
    if not text or "/" in text or text.count(":") == 1 or any(c.isspace() for c in text):
        raise ValueError("give a name or an address only, without scheme, port or path")
    return text


Host = Annotated[str, AfterValidator(_host)]
Port = Annotated[int, Field(ge=1, le=65535)]
Rate = Annotated[float, Field(ge=0.1, le=100.0)]


class Served(Section):
    """Common options of TCP servers."""

    host: Host = "127.0.0.1"
    """Address to listen at; `0.0.0.0` serves the whole network, without a password."""
    rate_hz: Rate = 1.0
    """Epochs a second, as receivers send them."""


class Gpsd(Served):
    """gpsd's JSON protocol, in the place of gpsd."""

    port: Port = 2947
    """Registered port of gpsd."""


class NmeaServed(Served):
    """NMEA 0183 over TCP; a receiver's own sentences are configured in `[sources.NAME]`."""

    port: Port = 10110
    """Registered port of NMEA 0183."""
    sentences: tuple[Literal["RMC", "GGA", "VTG", "GST", "THS", "HDT", "PASHR"], ...] = (
        "RMC",
        "GGA",
        "VTG",
        "GST",
        "THS",
    )
    """`THS` has the heading. `PASHR` adds roll and pitch. `HDT` not together with `GST`: gpsd 3.22
    makes JSON of it that cannot be read."""

    @model_validator(mode="after")
    def _gpsd_can_read(self) -> NmeaServed:
        if {"HDT", "GST"} <= set(self.sentences):
            raise ValueError("HDT and GST together confuse gpsd 3.22: leave one out")
        return self


class Prometheus(Section):
    """Metrics for Prometheus at `/metrics`."""

    host: Host = "127.0.0.1"
    """Address to listen at."""
    port: Port = 9947


class Foxglove(Served):
    """Foxglove's WebSocket protocol; needs the extra `foxglove`."""

    port: Port = 8765
    """Default port of Foxglove."""
    rate_hz: Rate = 10.0
    """Rate of position and attitude."""
    origins: tuple[Annotated[str, Field(pattern=r"^https?://[^/\s]+$")], ...] = ()
    """Web sites whose pages may connect, for example `https://app.foxglove.dev`. Pages of the same
    computer, and programs other than browsers, always may."""


class HomeAssistant(Section):
    """Home Assistant's discovery, through the broker of `[mqtt]`."""

    prefix: Annotated[str, Field(pattern=r"^[^#+\s]+$")] = "homeassistant"
    """Discovery prefix of its MQTT integration."""


class OwnTracks(Section):
    """A location for OwnTracks' maps, through the broker of `[mqtt]`."""

    user: Annotated[str, Field(pattern=r"^[^/#+\s]+$")] = "fusiond"
    """Second part of the topic `owntracks/<user>/<vehicle>`."""
    tid: Annotated[str, Field(pattern=r"^[A-Za-z0-9]{2}$")] | None = None
    """Two characters on the map; by default the last two of `vehicle`."""


class Chrony(Section):
    """Time for chrony's reference clock `SOCK`."""

    socket: Path = Path("/run/chrony.fusiond.sock")
    """Socket path as in chrony.conf; Debian's AppArmor profile lets chronyd make
    `/run/chrony.*.sock`."""


class Outputs(Section):
    """Shared options of outputs, and a section each."""

    geoid_separation_m: Annotated[float, Field(ge=-120.0, le=100.0)] | None = None
    """Height of the geoid above the ellipsoid, for heights above the sea; default: EGM96, to some
    metres."""
    gpsd: Gpsd | None = None
    nmea: NmeaServed | None = None
    prometheus: Prometheus | None = None
    foxglove: Foxglove | None = None
    home_assistant: HomeAssistant | None = None
    owntracks: OwnTracks | None = None
    chrony: Chrony | None = None

    @property
    def served(self) -> dict[str, Section]:
        """Configured sections by name."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: value for name, value in values.items() if isinstance(value, Section)}

    @property
    def through_the_broker(self) -> tuple[str, ...]:
        """Configured outputs that publish through the broker."""
        return tuple(name for name in ("home_assistant", "owntracks") if name in self.served)
