"""Raw epochs of a GNSS receiver (fusiond.navigator.raw_gnss)."""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.si_units import clock_noise
from fusiond.models.blocks import (
    CLOCK_RAMP,
    Block,
    carrier_blocks,
    clock_blocks,
    clock_ramp,
    position_bias,
    shared_error,
)
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def measurements_of(
    m: RawGnssEpoch, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """Epoch; `raw_not_used` if the receiver's fixes are the measurement, not its raw data."""
    receiver = sections.receivers.get(m.source)
    if receiver is None:
        return "raw_not_used"
    return [receiver.measurement(m, when.t_ns)]


EPOCH_S = 0.01
"""So short a state is another one at each epoch. What the models leave of ionosphere and
troposphere lasts for hours, but orbit errors last, too, and are noise to the filter: of hundreds
of epochs it would solve for a zenith delay of 0.12 m, which differs from height and clock by the
lowest satellites alone, and find what 0.6 m of orbits make of it, many of its sigmas, and metres of
height. An epoch alone says little of them beyond their sigma. What lasts is in the displacement
(fusiond.gnss.range_error_displacement)."""


def blocks(source: str, section: RawAiding, sections: Sections) -> list[Block]:
    """Blocks of raw ranges: a clock offset for each system, drift, shared errors of ranges, and the
    carrier anchor."""
    from fusiond.aiding.pseudorange import (  # noqa: PLC0415 - as fusiond.navigator.raw_gnss
        RANGE_BIAS,
        RANGE_SHARED,
    )

    clock = clock_noise(section)
    offsets, drift = clock_blocks(section.systems, clock)
    found = [offsets, drift]
    if section.clock_drift_tau_s is None:
        found = [offsets, replace(drift, rate=CLOCK_RAMP), clock_ramp()]
    if section.bias_sd_m > 0.0:
        tau_s = section.bias_correlation_s
        level, down = RANGE_BIAS
        found.append(position_bias(level, section.bias_sd_m, tau_s))
        found.append(position_bias(down, section.bias_down_sd_m, tau_s, "d"))
    lasting = (EPOCH_S, EPOCH_S, math.inf)
    for name, lasts_s in zip(RANGE_SHARED, lasting, strict=True):
        found.append(shared_error(name, "", 1.0, lasts_s))
    return found + carrier_blocks(clock)


KIND = Kind(RawGnssEpoch, measurements_of, {RawAiding: blocks})
