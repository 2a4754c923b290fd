"""Execution of the operator's commands."""

from __future__ import annotations

import math

from fusiond.configuration.si_units import DEG
from fusiond.live.injection import Injection
from fusiond.live.rdss_messaging import Messaging
from fusiond.live.sources import Sources
from fusiond.navigator.navigator import Navigator
from fusiond.outputs.commands import (
    Command,
    CommandRefusedError,
    Inject,
    RequestFix,
    ResetFilter,
    SendMessage,
    SetGates,
    SetPosition,
)

EARTH_RADIUS_M = 6.371e6  # mean radius: for distances that only people read


class Operator:
    """Executor of the commands of `outputs.commands`, from any input."""

    def __init__(
        self, navigator: Navigator, sources: Sources, injection: Injection, messaging: Messaging
    ) -> None:
        self._messaging = messaging
        self._navigator = navigator
        self._sources = sources
        self._injection = injection

    def carry_out(self, command: Command, t_ns: int) -> str:
        """Execute a command at `t_ns` and describe its result. Raises `CommandRefusedError` for a
        command that cannot be executed now."""
        match command:
            case Inject():
                if command.source not in self._sources.all:
                    there = ", ".join(self._sources.all)
                    raise CommandRefusedError(f"no source {command.source!r}; there are {there}")
                raw = command.source in self._navigator.raw
                if raw and command.fault not in ("drop", "delay"):
                    text = "raw satellite data can be dropped and delayed, no more"
                    raise CommandRefusedError(text)
                return self._injection.inject(command, t_ns)
            case SetPosition():
                return self._set_position(command, t_ns)
            case RequestFix():
                said = self._sources.request_fix(t_ns)
                if not said:
                    raise CommandRefusedError("there is no RDSS terminal")
                return "; ".join(said)
            case SendMessage():
                return self._messaging.send(command, t_ns)
            case ResetFilter():
                self._navigator.reset("reset by an operator")
                self._navigator.without_imu.stop()
                return "aligning again"
            case SetGates():
                self._navigator.set_gates(command.gates)
                return ", ".join(f"{name} {gate:g}" for name, gate in command.gates.items())
            case _:
                raise CommandRefusedError(f"unknown command {type(command).__name__}")

    def _set_position(self, command: SetPosition, t_ns: int) -> str:
        navigator = self._navigator
        if command.force:
            navigator.reset("an operator's position")
            navigator.without_imu.stop()
        before = navigator.solution(t_ns)
        lat, lon = command.lat_deg * DEG, command.lon_deg * DEG
        outcome = navigator.set_position(lat, lon, command.height_m, command.sd_m, t_ns)
        if outcome == "aligning":
            return "position taken: aligning from it"
        if outcome == "beginning":
            return "position taken: without an inertial unit navigation begins there"
        if not math.isfinite(before.lat_rad):
            return f"position {outcome}: aligned from it"
        far = distance_m(before.lat_rad, before.lon_rad, lat, lon)
        where = f"{far:.0f} m from the solution"
        if outcome == "fused":
            return f"position fused: it was {where}"
        if outcome == "gated":
            raise CommandRefusedError(
                f"position gated: it is {where}, whose sigma is"
                f" {math.hypot(*before.sd_ned_m[:2]):.1f} m; nothing moved. To align again from it,"
                " send it with force = true"
            )
        raise CommandRefusedError(f"position refused: {outcome}")


def distance_m(lat_a: float, lon_a: float, lat_b: float, lon_b: float) -> float:
    """Distance (m) between two positions (rad) on a sphere, to half a percent: haversine
    formula."""
    across = math.cos(lat_a) * math.cos(lat_b) * math.sin(0.5 * (lon_b - lon_a)) ** 2
    chord = math.sin(0.5 * (lat_b - lat_a)) ** 2 + across
    return 2.0 * EARTH_RADIUS_M * math.asin(math.sqrt(min(1.0, chord)))
