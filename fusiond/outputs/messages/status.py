"""Message `status`: navigation status, and counters since the daemon's start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pydantic import Field

from fusiond.navigation.solution import BoundState, Mode, Solution
from fusiond.outputs.messages.base import Count, Message, Milliseconds, Number, stamp
from fusiond.outputs.messages.fault import FaultReport
from fusiond.outputs.messages.health import SchedulerStatus

RecordingState = Literal["off", "waiting", "recording", "failed"]


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """State of a recording."""

    state: RecordingState = "off"
    file: str | None = None
    dropped: int = 0
    free_mb: float | None = None


class StatusMessage(Message):
    """Mode, reason and counters since the daemon started."""

    mode: Mode
    why: str
    protection: BoundState
    imu: str | None = Field(description="source of the samples in use")
    faults: tuple[FaultReport, ...] = Field(
        default=(), description="active faults of all devices, the latest last"
    )
    calibrated: bool = Field(description="every parameter of `calibration` has settled")
    since_utc: str | None
    since_ms: Milliseconds | None
    version: str
    config_digest: str
    uptime_s: float
    ticks: Count
    overruns: Count
    fused: Count
    rejected: Count
    recording: RecordingState = Field(description="state of the log; `waiting`: until an event")
    recording_file: str | None = Field(description="the file that is being written")
    recording_dropped: Count = Field(description="messages lost to a slow disk")
    disk_free_mb: Number = Field(description="free space for the log, 10^6 bytes")
    injected: tuple[str, ...] = Field(description="active faults of `cmd/inject`")
    mqtt_published: Count
    mqtt_dropped: Count
    mqtt_reconnects: Count
    mqtt_taken_over: Count
    mqtt_commands_limited: Count


@dataclass(frozen=True, slots=True)
class DaemonState:
    """State of the daemon beside its solution; defaults: before the first tick.

    `since_utc_ns`: when the mode began; `mqtt`: the publisher's counters.
    """

    since_utc_ns: int | None
    version: str
    config_digest: str
    uptime_s: float
    scheduler: SchedulerStatus
    fused: int = 0
    rejected: int = 0
    calibrated: bool = False
    imu: str | None = None
    faults: tuple[FaultReport, ...] = ()
    recording: RecordingStatus = field(default_factory=RecordingStatus)
    injected: tuple[str, ...] = ()
    mqtt: Mapping[str, int] = field(default_factory=dict)


def status_message(solution: Solution, utc_ns: int | None, daemon: DaemonState) -> StatusMessage:
    """Build `status` at `utc_ns`."""
    t_utc, t_ms = stamp(utc_ns)
    since_utc, since_ms = stamp(daemon.since_utc_ns)
    recording, mqtt = daemon.recording, daemon.mqtt
    return StatusMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        mode=solution.mode,
        why=solution.reason,
        protection=solution.bound.state,
        imu=daemon.imu,
        faults=daemon.faults,
        calibrated=daemon.calibrated,
        since_utc=since_utc,
        since_ms=since_ms,
        version=daemon.version,
        config_digest=daemon.config_digest,
        uptime_s=round(daemon.uptime_s, 3),
        ticks=daemon.scheduler.ticks,
        overruns=daemon.scheduler.overruns,
        fused=daemon.fused,
        rejected=daemon.rejected,
        recording=recording.state,
        recording_file=recording.file,
        recording_dropped=recording.dropped,
        disk_free_mb=None if recording.free_mb is None else round(recording.free_mb, 1),
        injected=daemon.injected,
        mqtt_published=mqtt.get("mqtt_published", 0),
        mqtt_dropped=mqtt.get("mqtt_dropped", 0),
        mqtt_reconnects=mqtt.get("mqtt_reconnects", 0),
        mqtt_taken_over=mqtt.get("mqtt_taken_over", 0),
        mqtt_commands_limited=mqtt.get("mqtt_commands_limited", 0),
    )
