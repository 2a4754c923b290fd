"""Message `health`: devices and outputs by name, scheduler, clock and process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from drivers.base import State
from fusiond.clock.results import ClockStatus
from fusiond.integrity.consistency import Verdict
from fusiond.integrity.series_states import Service
from fusiond.outputs.messages.base import Count, Message, Number, stamp
from fusiond.outputs.messages.fault import FaultReport


class SatelliteHealth(BaseModel):
    """Satellite of the last epoch."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    azimuth_deg: Number = Field(default=None, description="clockwise from true north")
    elevation_deg: Number = None
    cno_db_hz: Number = Field(default=None, description="C/N0 of the strongest signal")


class SkyHealth(BaseModel):
    """The last epoch of a receiver's raw data."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    used: tuple[str, ...] = Field(default=(), description="satellites, such as C21")
    refused: dict[str, str] = Field(default_factory=dict, description="reason by satellite")
    gdop: Number = None
    pdop: Number = None
    hdop: Number = None
    vdop: Number = None
    tdop: Number = None
    innovation_rms: Number = Field(
        default=None, description="of the ranges used, normalised; 1 is expected"
    )
    satellites: dict[str, SatelliteHealth] = Field(
        default_factory=dict, description="all of the epoch; without ephemeris no direction"
    )


class BeamHealth(BaseModel):
    """Beams of an RDSS terminal; they are numbered from 1."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    levels: tuple[Count, ...] = Field(description="power of each beam, 0 to 4; usable from 2 on")
    serving: Count | None = Field(
        description="beam in use: named by the terminal, else the strongest; null: none"
    )
    time_difference: Count | None = Field(
        description="beam of the second satellite, if the terminal names it"
    )


class SourceHealth(BaseModel):
    """Device: state and outcomes of its measurements."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    state: State
    detail: str = ""
    received: Count = 0
    fused: Count = 0
    rejected: dict[str, Count] = Field(default_factory=dict, description="number by reason")
    age_s: Number = Field(default=None, description="since the last arrival")
    fused_age_s: Number = Field(default=None, description="since the last one was fused")
    latency_s: Number = Field(default=None, description="validity to arrival, of the last one")
    counters: dict[str, Count] = Field(default_factory=dict, description="of the driver")
    service: Service | None = Field(
        default=None, description="state of its worst series; null: nothing is fused"
    )
    series: dict[str, Service] = Field(
        default_factory=dict, description="state of each of its series, by name"
    )
    isolated: str | None = Field(
        default=None, description="reason why the series of this name is excluded; null: it is not"
    )
    diagnosis: FaultReport | None = Field(
        default=None, description="its latest active fault; null: none"
    )
    verdict: Verdict | None = Field(default=None, description="see topic `consistency`")
    sky: SkyHealth | None = Field(default=None, description="of raw GNSS data")
    beams: BeamHealth | None = Field(default=None, description="of an RDSS terminal")


class OutputHealth(BaseModel):
    """Output: state and outcomes of its messages."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    state: State
    detail: str = ""
    counters: dict[str, Count] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SchedulerStatus:
    """A snapshot for `health`. `gc_forced` collections may have delayed a tick."""

    ticks: int
    overruns: int
    lateness_p50_ms: float
    lateness_p99_ms: float
    lateness_max_ms: float
    lateness_sum_s: float
    lateness_at_most: tuple[tuple[float, int], ...]
    """Cumulative count of ticks with at most this latency (s)."""
    gc_collections: int
    gc_forced: int
    gc_max_ms: float


class HealthMessage(Message):
    """Devices and outputs by name; the scheduler, the clock and the process."""

    sources: dict[str, SourceHealth]
    outputs: dict[str, OutputHealth]
    ticks: Count
    overruns: Count
    lateness_p50_ms: float
    lateness_p99_ms: float
    lateness_max_ms: float
    lateness_sum_s: float = Field(description="sum over all ticks")
    lateness_at_most_s: dict[str, Count] = Field(
        description="number of ticks up to so many seconds late"
    )
    gc_max_ms: float
    utc_source: str
    utc_settled: bool
    system_clock_error_s: Number
    clock_counters: dict[str, Count]
    cpu_percent: float = Field(description="of one core")
    memory_mb: float | None = Field(description="resident, 10^6 bytes; null if not known")


def health_message(
    utc_ns: int | None,
    *,
    sources: Mapping[str, SourceHealth],
    outputs: Mapping[str, OutputHealth],
    scheduler: SchedulerStatus,
    clock: ClockStatus,
    cpu_percent: float,
    memory_mb: float | None,
) -> HealthMessage:
    """Build `health` from snapshots of all parts."""
    t_utc, t_ms = stamp(utc_ns)
    return HealthMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        sources=dict(sources),
        outputs=dict(outputs),
        ticks=scheduler.ticks,
        overruns=scheduler.overruns,
        lateness_p50_ms=round(scheduler.lateness_p50_ms, 3),
        lateness_p99_ms=round(scheduler.lateness_p99_ms, 3),
        lateness_max_ms=round(scheduler.lateness_max_ms, 3),
        lateness_sum_s=round(scheduler.lateness_sum_s, 6),
        lateness_at_most_s={f"{edge:.3g}": n for edge, n in scheduler.lateness_at_most},
        gc_max_ms=round(scheduler.gc_max_ms, 3),
        utc_source=clock.utc_source,
        utc_settled=clock.settled,
        system_clock_error_s=clock.system_error_s,
        clock_counters=clock.counters,
        cpu_percent=round(cpu_percent, 1),
        memory_mb=None if memory_mb is None else round(memory_mb, 1),
    )
