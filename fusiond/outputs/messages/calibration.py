"""Message `calibration`: estimated mounting, lever arms, delays and scales."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, Field

from fusiond.navigator.calibration import CalibrationState, Parameter
from fusiond.outputs.messages.base import Message, stamp


class CalibratedParameter(BaseModel):
    """Calibrated parameter, in the unit at the end of its name (none: a ratio)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    value: float = Field(description="difference from the configured value")
    sd: float = Field(description="one sigma")
    prior_sd: float = Field(description="the configured sigma, before anything is observed")
    state: CalibrationState


class CalibrationMessage(Message):
    """Calibration by the filter: mounting, lever arms, offsets in time and scales."""

    settled: bool = Field(description="every estimated parameter has settled")
    parameters: dict[str, CalibratedParameter]


def calibration_message(
    utc_ns: int | None, parameters: Iterable[Parameter], settled: bool
) -> CalibrationMessage:
    """Build `calibration` from the navigator's estimates; 1e-5 is 0.01 mm, 10 us, 0.04 arcsec."""
    t_utc, t_ms = stamp(utc_ns)
    return CalibrationMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        settled=settled,
        parameters={
            p.name: CalibratedParameter(
                value=round(p.value, 5),
                sd=round(p.sd, 5),
                prior_sd=round(p.prior_sd, 5),
                state=p.state,
            )
            for p in parameters
        },
    )
