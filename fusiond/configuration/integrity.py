"""Section `[integrity]`: alert limits, the risk allowed, and how likely faults are."""

from __future__ import annotations

from pydantic import Field, PositiveFloat

from fusiond.configuration.aiding import Probability, Section

DEVICE_FAULT = 1e-3
"""Rate of faults of a position device, an hour. Satellites contribute 1e-4 (ten GPS satellites of
1e-5 each: GPS SPS Performance Standard, 5th ed., 2020, section 3.5.1; a constellation: 1e-4,
Working Group C ARAIM, Milestone 3, 2016). Ten times that is assumed for the receiver and its
surroundings, for which no measurement exists. A factor of ten moves a level by about a tenth."""


class Integrity(Section):
    """Protection levels, computed where an alert limit is set; see `docs/integrity.md`."""

    horizontal_alert_limit_m: PositiveFloat | None = None
    """Horizontal protection level beyond which an alarm is raised."""
    vertical_alert_limit_m: PositiveFloat | None = None
    """Vertical protection level beyond which an alarm is raised."""
    integrity_risk_per_hour: Probability = 1e-5
    """Probability of an error beyond a protection level within an hour."""
    false_alarm_per_hour: Probability = 1e-4
    """Probability within an hour that a level grows by chance."""
    fault_probability_per_hour: dict[str, Probability] = Field(default_factory=dict)
    """Probability of a fault within an hour, by `[aiding.NAME]`; 1e-3 for one that is not
    listed."""

    def priors(self, devices: tuple[str, ...]) -> tuple[float, ...]:
        """Probability of a fault in an hour of each device."""
        return tuple(self.fault_probability_per_hour.get(d, DEVICE_FAULT) for d in devices)

    @property
    def watched(self) -> bool:
        """True if a limit is set, and protection levels are needed."""
        return self.horizontal_alert_limit_m is not None or self.vertical_alert_limit_m is not None
