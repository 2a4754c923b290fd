"""The messages of the MQTT topics: flat JSON, numbers, units in the names as in the CSV files.

A quantity that is not known is `null` (NaN here). `t_utc` and `t_ms` are the instant the message
speaks of, null while the daemon knows no UTC. The schemas of `fusiond schema` come from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from math import degrees
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import models_json_schema

from drivers.base import State
from fusiond.clock.clock import ClockStatus
from fusiond.integrity.consistency import Consistency, Verdict
from fusiond.live.scheduler import SchedulerStatus
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.commands import COMMANDS

Number = float | None
Count = Annotated[int, Field(ge=0)]


class Message(BaseModel):
    """Base of every message."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    t_utc: str | None = Field(description="ISO 8601 with milliseconds, UTC")
    t_ms: int | None = Field(description="POSIX milliseconds, UTC")


class NavMessage(Message):
    """The solution of the body origin: WGS 84, north-east-down, one sigma each."""

    mode: Mode
    lat_deg: Number
    lon_deg: Number
    height_m: Number = Field(description="above the ellipsoid")
    v_n_m_s: Number
    v_e_m_s: Number
    v_d_m_s: Number
    roll_deg: Number
    pitch_deg: Number
    yaw_deg: Number = Field(description="true heading, 0 to 360, clockwise from north")
    sd_n_m: Number
    sd_e_m: Number
    sd_d_m: Number
    sd_vn_m_s: Number
    sd_ve_m_s: Number
    sd_vd_m_s: Number
    sd_roll_deg: Number
    sd_pitch_deg: Number
    sd_yaw_deg: Number


class StatusMessage(Message):
    """What the solution is worth, why, and since when; counters since the daemon started."""

    mode: Mode
    why: str
    since_utc: str | None
    since_ms: int | None
    version: str
    config_digest: str
    uptime_s: float
    ticks: Count
    overruns: Count
    fused: Count
    rejected: Count
    mqtt_published: Count
    mqtt_dropped: Count
    mqtt_reconnects: Count


class SkyHealth(BaseModel):
    """The last epoch of a receiver's raw data."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    used: tuple[str, ...] = Field(default=(), description="satellites, such as C21")
    refused: dict[str, str] = Field(default_factory=dict, description="satellite to reason")
    gdop: Number = None
    pdop: Number = None
    hdop: Number = None
    vdop: Number = None
    tdop: Number = None
    innovation_rms: Number = Field(
        default=None, description="of the ranges used, normalised; 1 is expected"
    )


class SourceHealth(BaseModel):
    """One device: what it is doing, and what became of its measurements."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    state: State
    detail: str = ""
    received: Count = 0
    fused: Count = 0
    rejected: dict[str, Count] = Field(default_factory=dict, description="by reason")
    age_s: Number = Field(default=None, description="since the last measurement came in")
    fused_age_s: Number = Field(default=None, description="since the last one was fused")
    latency_s: Number = Field(default=None, description="from validity to arrival, the last one")
    counters: dict[str, Count] = Field(default_factory=dict, description="of the driver")
    isolated: str | None = Field(
        default=None, description="why the fault detection leaves it out; null: it does not"
    )
    verdict: Verdict | None = Field(default=None, description="on sigma, see `consistency`")
    sky: SkyHealth | None = Field(default=None, description="of raw GNSS data")


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
    """Can the filter's sigma be believed: one verdict a source."""

    sources: dict[str, SourceConsistency]


class HealthMessage(Message):
    """Devices by name; the scheduler, the clock and the process."""

    sources: dict[str, SourceHealth]
    ticks: Count
    overruns: Count
    lateness_p50_ms: float
    lateness_p99_ms: float
    lateness_max_ms: float
    gc_max_ms: float
    utc_source: str
    utc_settled: bool
    system_clock_error_s: Number
    clock_counters: dict[str, Count]
    cpu_percent: float = Field(description="of one core")
    memory_mb: float = Field(description="resident, 10^6 bytes")


Level = Literal["info", "warning", "error"]


class EventMessage(Message):
    """Something an operator should know."""

    level: Level
    code: str = Field(description="stable, for rules")
    source: str
    text: str


class ReplyMessage(Message):
    """The answer to a command; `id` is the request's, null if it could not be read."""

    id: str | None
    command: str
    ok: bool
    text: str


# ------------------------------------------------------------------ builders


def stamp(utc_ns: int | None) -> tuple[str | None, int | None]:
    """`t_utc` and `t_ms` of a UTC instant in ns; both null if it is not known."""
    if utc_ns is None:
        return None, None
    t_ms = utc_ns // 1_000_000
    second = datetime.fromtimestamp(t_ms // 1000, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{t_ms % 1000:03d}Z", t_ms


def nav_message(solution: Solution, utc_ns: int | None) -> NavMessage:
    """`nav` of a solution whose instant is `utc_ns`; 1e-9 deg is 0.1 mm."""
    t_utc, t_ms = stamp(utc_ns)
    s = solution
    return NavMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        mode=s.mode,
        lat_deg=round(degrees(s.lat_rad), 9),
        lon_deg=round(degrees(s.lon_rad), 9),
        height_m=round(s.height_m, 4),
        v_n_m_s=round(s.v_ned_m_s[0], 4),
        v_e_m_s=round(s.v_ned_m_s[1], 4),
        v_d_m_s=round(s.v_ned_m_s[2], 4),
        roll_deg=round(degrees(s.rpy_rad[0]), 5),
        pitch_deg=round(degrees(s.rpy_rad[1]), 5),
        yaw_deg=round(degrees(s.rpy_rad[2]), 5) % 360.0,
        sd_n_m=round(s.sd_ned_m[0], 4),
        sd_e_m=round(s.sd_ned_m[1], 4),
        sd_d_m=round(s.sd_ned_m[2], 4),
        sd_vn_m_s=round(s.sd_v_ned_m_s[0], 4),
        sd_ve_m_s=round(s.sd_v_ned_m_s[1], 4),
        sd_vd_m_s=round(s.sd_v_ned_m_s[2], 4),
        sd_roll_deg=round(degrees(s.sd_rpy_rad[0]), 5),
        sd_pitch_deg=round(degrees(s.sd_rpy_rad[1]), 5),
        sd_yaw_deg=round(degrees(s.sd_rpy_rad[2]), 5),
    )


def status_message(
    solution: Solution,
    utc_ns: int | None,
    *,
    since_utc_ns: int | None,
    version: str,
    config_digest: str,
    uptime_s: float,
    scheduler: SchedulerStatus,
    fused: int,
    rejected: int,
    mqtt: Mapping[str, int],
) -> StatusMessage:
    """`status`; `mqtt` are the publisher's counters."""
    t_utc, t_ms = stamp(utc_ns)
    since_utc, since_ms = stamp(since_utc_ns)
    return StatusMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        mode=solution.mode,
        why=solution.reason,
        since_utc=since_utc,
        since_ms=since_ms,
        version=version,
        config_digest=config_digest,
        uptime_s=round(uptime_s, 3),
        ticks=scheduler.ticks,
        overruns=scheduler.overruns,
        fused=fused,
        rejected=rejected,
        mqtt_published=mqtt.get("mqtt_published", 0),
        mqtt_dropped=mqtt.get("mqtt_dropped", 0),
        mqtt_reconnects=mqtt.get("mqtt_reconnects", 0),
    )


def health_message(
    utc_ns: int | None,
    *,
    sources: Mapping[str, SourceHealth],
    scheduler: SchedulerStatus,
    clock: ClockStatus,
    cpu_percent: float,
    memory_mb: float,
) -> HealthMessage:
    """`health` from the parts' own snapshots."""
    t_utc, t_ms = stamp(utc_ns)
    return HealthMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        sources=dict(sources),
        ticks=scheduler.ticks,
        overruns=scheduler.overruns,
        lateness_p50_ms=round(scheduler.lateness_p50_ms, 3),
        lateness_p99_ms=round(scheduler.lateness_p99_ms, 3),
        lateness_max_ms=round(scheduler.lateness_max_ms, 3),
        gc_max_ms=round(scheduler.gc_max_ms, 3),
        utc_source=clock.utc_source,
        utc_settled=clock.settled,
        system_clock_error_s=clock.system_error_s,
        clock_counters=clock.counters,
        cpu_percent=round(cpu_percent, 1),
        memory_mb=round(memory_mb, 1),
    )


def consistency_message(
    utc_ns: int | None, reports: Mapping[str, Consistency]
) -> ConsistencyMessage:
    """`consistency` from the monitors' reports."""
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


def event_message(
    utc_ns: int | None, *, source: str, code: str, text: str, level: Level = "info"
) -> EventMessage:
    t_utc, t_ms = stamp(utc_ns)
    return EventMessage(t_utc=t_utc, t_ms=t_ms, level=level, code=code, source=source, text=text)


# ------------------------------------------------------------------ topics


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic below `fusiond/<vehicle>`: what it carries and how it is delivered."""

    name: str
    message: type[BaseModel]
    qos: Literal[0, 1]
    retained: bool


NAV = Topic("nav", NavMessage, 0, False)
STATUS = Topic("status", StatusMessage, 1, True)
HEALTH = Topic("health", HealthMessage, 0, True)
CONSISTENCY = Topic("consistency", ConsistencyMessage, 0, True)
EVENT = Topic("event", EventMessage, 1, False)
REPLY = Topic("reply", ReplyMessage, 1, False)
TOPICS = (NAV, STATUS, HEALTH, CONSISTENCY, EVENT, REPLY)


def base_topic(vehicle: str) -> str:
    return f"fusiond/{vehicle}"


def asyncapi(vehicle: str) -> dict[str, Any]:
    """The AsyncAPI 3.0 document of a vehicle's topics, with the schemas of the models."""
    base = base_topic(vehicle)
    received = [Topic(f"cmd/{name}", model, 1, False) for name, model in COMMANDS.items()]
    models: list[tuple[type[BaseModel], Literal["validation", "serialization"]]] = [
        *((t.message, "serialization") for t in TOPICS),
        *((t.message, "validation") for t in received),
    ]
    names, definitions = models_json_schema(models, ref_template="#/components/schemas/{model}")
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    messages: dict[str, Any] = {
        "Online": {"contentType": "text/plain", "payload": {"enum": ["online", "offline"]}}
    }

    def add(topic: str, message: str, action: str, qos: int, retained: bool) -> None:
        key = topic.replace("/", "_")
        channels[key] = {
            "address": f"{base}/{topic}",
            "messages": {message: {"$ref": f"#/components/messages/{message}"}},
        }
        operations[f"{action}_{key}"] = {
            "action": action,
            "channel": {"$ref": f"#/channels/{key}"},
            "bindings": {"mqtt": {"qos": qos, "retain": retained}},
        }

    add("online", "Online", "send", 1, True)
    for topic, mode, action in [
        *((t, "serialization", "send") for t in TOPICS),
        *((t, "validation", "receive") for t in received),
    ]:
        name = topic.message.__name__
        payload = next(v for (m, k), v in names.items() if m is topic.message and k == mode)
        messages[name] = {"contentType": "application/json", "payload": payload}
        add(topic.name, name, action, topic.qos, topic.retained)
    return {
        "asyncapi": "3.0.0",
        "info": {"title": "fusiond", "version": "1", "description": f"Vehicle {vehicle}"},
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": definitions["$defs"]},
    }
