"""Raw epochs of a GNSS receiver (fusiond.navigator.raw_gnss)."""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.si_units import clock_noise
from fusiond.models.blocks import Block, carrier_blocks, clock_blocks, position_bias, shared_error
from fusiond.navigator.intake.kind import Instants, Kind, Sections


def measurements_of(
    m: RawGnssEpoch, sections: Sections, when: Instants
) -> list[AidingMeasurement] | str:
    """The epoch; `raw_not_used` where the receiver's fixes are the measurement, not its raw
    data."""
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


CLOCK_RAMP = "clock_ramp"
RAMP_M_S2, RAMP_S = 0.2, 1000.0
"""One sigma and correlation time of how a clock's drift runs on while its crystal warms or cools: a
temperature-compensated one is held to 0.5 ppm over 70 K, and by so steep a curve in places that a
tenth of a kelvin a second is half a ppb a second. A receiver on a walk had 0.17 m/s^2 for two
minutes; what is left beside it is the drift's walk."""


def ramp() -> Block:
    """The rate of a clock's drift."""
    sd = RAMP_M_S2
    return Block(CLOCK_RAMP, "m/s^2", ("ramp",), (-1,), initial=sd, tau_s=RAMP_S, steady=sd)


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
        found = [offsets, replace(drift, rate=CLOCK_RAMP), ramp()]
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
