"""Message `consistency`: results of the innovation tests of each source's sigma."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict, Field

from fusiond.integrity.consistency import Consistency, Verdict
from fusiond.outputs.messages.base import Count, Message, Number, stamp


class SourceConsistency(BaseModel):
    """The tests of one source's innovations (docs/consistency.md); figures are null with too
    few."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    verdict: Verdict
    k: Count = Field(description="innovations in the window")
    alpha: Number = Field(description="overall level of the verdict")
    nis_average: Number = Field(description="per degree of freedom; 1 is expected")
    nis_low: Number = Field(description="95 % interval")
    nis_high: Number = Field(description="95 % interval")
    rho: tuple[Number, ...] = Field(description="autocorrelation at lags 1 to 8")
    rho_high: Number = Field(description="95 % interval of one lag is +- this")
    portmanteau: Number
    portmanteau_limit: Number


class ConsistencyMessage(Message):
    """Verdict on the filter's sigma by each source's innovations."""

    sources: dict[str, SourceConsistency]


def consistency_message(
    utc_ns: int | None, reports: Mapping[str, Consistency]
) -> ConsistencyMessage:
    """Build `consistency` from the monitors' reports."""
    t_utc, t_ms = stamp(utc_ns)
    return ConsistencyMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        sources={
            name: SourceConsistency(
                verdict=r.verdict,
                k=r.k,
                alpha=r.alpha,
                nis_average=round(r.nis_average, 4),
                nis_low=round(r.nis_interval[0], 4),
                nis_high=round(r.nis_interval[1], 4),
                rho=tuple(round(x, 4) for x in r.rho),
                rho_high=round(r.rho_interval[1], 4),
                portmanteau=round(r.portmanteau, 3),
                portmanteau_limit=round(r.portmanteau_limit, 3),
            )
            for name, r in reports.items()
        },
    )
