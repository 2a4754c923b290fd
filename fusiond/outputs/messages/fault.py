"""Identified fault, as an object of `health` and `status`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from fusiond.integrity.fault_findings import Finding
from fusiond.outputs.messages.base import Number


class FaultReport(BaseModel):
    """Active fault: kind, size, start, odds and action."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str = Field(description="the device at fault")
    kind: str = Field(description="kind of fault, such as `velocity`")
    axis: str | None = Field(description="axis of its largest part; null without axes")
    size: Number = Field(description="size on that axis, in `unit`")
    sd: Number = Field(description="one sigma of `size`, in `unit`")
    unit: str
    since_s: float = Field(description="seconds since its start")
    log_odds: float = Field(description="natural logarithm of its odds against no fault")
    action: Literal["left out", "corrected"]
    text: str = Field(description="the fault as a sentence")


def fault_report(finding: Finding, source: str, t_ns: int) -> FaultReport:
    """Text and figures of a finding at `t_ns`; `source` names its device."""
    kind, row = finding.kind, finding.largest
    return FaultReport(
        source=source,
        kind=kind.name,
        axis=kind.axes[row] or None,
        size=_figures(finding.size[row]),
        sd=_figures(finding.sd[row]),
        unit=kind.unit,
        since_s=round(t_ns * 1e-9 - finding.since_s, 1),
        log_odds=round(finding.log_odds, 1),
        action="corrected" if kind.corrected else "left out",
        text=finding._replace(t_ns=t_ns).text,
    )


def _figures(value: float) -> float:
    """Round to four figures, which is finer than any sigma."""
    return float(f"{value:.4g}")
