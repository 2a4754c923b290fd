"""What an operator may ask of the daemon, and how it is carried out."""

from __future__ import annotations

from fusiond.configuration.settings import DEG
from fusiond.live.sources import Sources
from fusiond.navigator.navigator import Navigator
from fusiond.outputs.commands import (
    Command,
    CommandRefusedError,
    RequestFix,
    ResetFilter,
    SetPosition,
)


class Operator:
    """Carries out the commands of `outputs.commands`, whichever way they come in."""

    def __init__(self, navigator: Navigator, sources: Sources) -> None:
        self._navigator = navigator
        self._sources = sources

    def carry_out(self, command: Command) -> str:
        """What was done. Raises `CommandRefusedError` for what cannot be done now."""
        match command:
            case SetPosition():
                if not self._navigator.imu.end:
                    raise CommandRefusedError("no IMU data yet")
                self._navigator.set_position(
                    command.lat_deg * DEG, command.lon_deg * DEG, command.height_m, command.sd_m
                )
                return "position taken"
            case RequestFix():
                said = self._sources.request_fix()
                if not said:
                    raise CommandRefusedError("there is no RDSS terminal")
                return "; ".join(said)
            case ResetFilter():
                self._navigator.reset("reset by an operator")
                return "aligning anew"
            case _:
                raise CommandRefusedError(f"unknown command {type(command).__name__}")
