"""Driver `ubx`: a u-blox receiver that sends UBX navigation messages, see `docs/gnss-ubx.md`."""

from __future__ import annotations

from drivers.solution_driver import SolutionDriver
from drivers.ubx.decoder import UbxDecoder


class UbxDriver(SolutionDriver):
    """See `SolutionDriver`."""

    Decoder = UbxDecoder
    kind = "ubx"
    alive_by = ("ubx_frames",)
    wanted = "UBX frame"
    switch_on = "switch on UBX-NAV-PVT"
