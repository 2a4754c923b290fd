"""Driver `sbf`: a Septentrio receiver that sends SBF, see `docs/gnss-sbf.md`."""

from __future__ import annotations

from drivers.sbf.decoder import SbfDecoder
from drivers.solution_driver import SolutionDriver


class SbfDriver(SolutionDriver):
    """See `SolutionDriver`."""

    Decoder = SbfDecoder
    kind = "sbf"
    alive_by = ("sbf_blocks",)
    wanted = "SBF block"
    switch_on = "switch on PVTGeodetic"
