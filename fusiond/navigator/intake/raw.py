"""Raw epochs of a GNSS receiver (fusiond.navigator.raw_gnss)."""

from __future__ import annotations

from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.base import Aid
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.settings import clock_noise
from fusiond.models.blocks import Block, clock_blocks, position_bias
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def aids(m: RawGnssEpoch, sections: Sections, when: Instants) -> list[Aid] | str:
    """The epoch; `raw_not_used` where the receiver's fixes are the aid, not its raw data."""
    receiver = sections.receivers.get(m.source)
    if receiver is None:
        return "raw_not_used"
    return [receiver.aid(m, when.t_ns)]


def blocks(source: str, section: RawAiding, sections: Sections) -> list[Block]:
    """A clock offset a system, drift, and errors that ranges share."""
    from fusiond.aiding.pseudorange import RANGE_BIAS  # noqa: PLC0415 - as fusiond.navigator.raw_gnss

    found = clock_blocks(section.systems, clock_noise(section))
    if section.bias_sd_m > 0.0:
        tau_s = section.bias_correlation_s
        level, down = RANGE_BIAS
        found.append(position_bias(level, section.bias_sd_m, tau_s))
        found.append(position_bias(down, section.bias_down_sd_m, tau_s, "d"))
    return found


KIND = Kind(RawGnssEpoch, aids, {RawAiding: blocks})
