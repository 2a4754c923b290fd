"""Block of the misalignment of a sensor."""

from __future__ import annotations

import math
from collections.abc import Callable

from fusiond.configuration.aiding import Misaligned
from fusiond.configuration.si_units import ARCSEC
from fusiond.models.blocks import Block, misalignment
from fusiond.navigator.intake.kind import Sections


def misalignment_block(block: str, source: str, section: Misaligned, sections: Sections) -> str:
    """Block of a source's misalignment; empty if none is estimated."""
    if section.misalignment_sd_arcsec == 0.0:
        return ""
    return sections.own(block, source, section)


def misalignment_blocks(block: str) -> Callable[[str, Misaligned, Sections], list[Block]]:
    """Misalignment blocks of a source of the kind, named `block`."""

    def blocks(source: str, section: Misaligned, sections: Sections) -> list[Block]:
        name = misalignment_block(block, source, section, sections)
        if not name:
            return []
        tau_s = section.misalignment_correlation_s
        return [misalignment(name, section.misalignment_sd_arcsec * ARCSEC, tau_s or math.inf)]

    return blocks
