"""Driver `bestpos`: a NovAtel or Unicore receiver that sends ASCII logs, see
`docs/gnss-bestpos.md`."""

from __future__ import annotations

from drivers.bestpos.decoder import BestposDecoder
from drivers.solution_driver import SolutionDriver


class BestposDriver(SolutionDriver):
    """See `SolutionDriver`."""

    Decoder = BestposDecoder
    kind = "bestpos"
    alive_by = ("logs",)
    wanted = "log such as #BESTPOSA"
    switch_on = "switch it on (LOG BESTPOSA ONTIME 0.1, BESTNAVA 0.1)"
