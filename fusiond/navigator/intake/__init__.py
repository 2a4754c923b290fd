"""Input of the navigator: aiding measurements of a device's, or the name of its refusal.

The configuration is applied here: lever arm, sigma where the device states none, floors
and gates. Behind it everything is in SI units with a settled instant, and can be true (`plausible`,
`pace`). Each kind of measurement has a module of its own, which `KINDS` lists; nothing else knows
them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from drivers.measurements import DelayedFix, Measurement, PositionFix, UtcStamp
from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.aiding import AnyAiding
from fusiond.configuration.plausibility import PLAUSIBILITY, Plausibility
from fusiond.models.blocks import Block
from fusiond.navigator.intake import (
    attitude,
    compass,
    gnss,
    heading,
    height,
    landmark_bearing,
    raw,
    rdss,
    wheel,
)
from fusiond.navigator.intake.kind import Instants, Kind, Sections, shown_as
from fusiond.navigator.intake.plausible import refusal
from fusiond.navigator.intake.rate_check import Pace

if TYPE_CHECKING:
    from fusiond.navigator.sensor_drift_magnitudes import DriftLevels

KINDS: tuple[Kind, ...] = (
    gnss.KIND,
    raw.KIND,
    rdss.KIND,
    wheel.KIND,
    heading.KIND,
    compass.KIND,
    attitude.KIND,
    height.KIND,
    landmark_bearing.KIND,
)


class Intake:
    """Intake of measurements, with `aiding` by source name; a source without a section has its
    kind's defaults.

    `limits` are those of the vehicle's class; `report(code, text)` hears of a source that is too
    fast.
    """

    def __init__(
        self,
        aiding: Mapping[str, AnyAiding],
        limits: Plausibility = PLAUSIBILITY["aircraft"],
        report: Callable[[str, str], None] = lambda code, text: None,
    ) -> None:
        self._sections = Sections(aiding)
        self._limits = limits
        self._pace = Pace(report)
        self.receivers = self._sections.receivers

    def set_gates(self, gates: Mapping[str, float]) -> None:
        """`gate_probability` by section."""
        self._sections.set_gates(gates)

    def measurements_of(
        self, m: Measurement | RawGnssEpoch, t_ns: int, sd_time_s: float, seen_ns: int = 0
    ) -> Sequence[AidingMeasurement] | str:
        """Aiding measurements of `m`, valid at `t_ns`, or the name of its refusal."""
        when = Instants(t_ns, sd_time_s, seen_ns)
        for kind in KINDS:
            if isinstance(m, kind.reported):
                refused = refusal(m, self._limits) or self._pace.refusal(m, t_ns)
                if refused is not None:
                    return refused
                sections = self._sections
                if isinstance(m, (PositionFix, DelayedFix)):
                    sections.place = m.lat_rad, m.lon_rad
                    if isinstance(m.stamp, UtcStamp):
                        sections.utc_ns = m.stamp.utc_ns
                found = kind.measurements_of(m, sections, when)
                if isinstance(found, str) or not sections.any_robust:
                    return found
                if not sections.robust(m.source):
                    return found
                return [replace(measurement, robust=True) for measurement in found]
        return "not_a_measurement"

    @property
    def fixes_shown(self) -> dict[str, tuple[float, ...]]:
        """Sums of each receiver's fixes about their errors, for the next start."""
        return {shown_as(*key): each.shown for key, each in self._sections.fix_errors.items()}

    def take_up(self, fixes_shown: Mapping[str, tuple[float, ...]]) -> None:
        """Resume receivers without a fix so far from these sums."""
        self._sections.fixes_shown = fixes_shown

    def count_drifts(self, drifts: DriftLevels) -> None:
        """Set the weights of the configured drifts from now on."""
        self._sections.drifts = drifts

    def extra_blocks(self) -> list[Block]:
        """Blocks of the model for the measurements: errors that successive measurements share. The
        first source determines the noise of a common block."""
        blocks: dict[str, Block] = {}
        for source, section in self._sections.aiding.items():
            for kind in KINDS:
                found = kind.blocks.get(type(section))
                if found is not None:
                    for block in found(source, section, self._sections):
                        blocks.setdefault(block.name, block)
        return list(blocks.values())
