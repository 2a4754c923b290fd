"""One message of each topic, as `docs/mqtt.md` shows them, made by the daemon's own builders."""

from __future__ import annotations

from math import radians
from typing import Any

from drivers.rdss.mail import MessageStage
from drivers.rdss.position_report_coding import PositionReport
from drivers.rdss.text_coding import encode_shortest
from fusiond.clock.results import ClockStatus
from fusiond.integrity.catalogue import velocity_kinds
from fusiond.integrity.consistency import judge
from fusiond.integrity.fault_findings import Finding
from fusiond.integrity.series_states import Service
from fusiond.navigation.solution import Bound, BoundState, Mode, Solution
from fusiond.navigator.calibration import CalibrationState, Parameter
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.calibration import calibration_message
from fusiond.outputs.messages.consistency import consistency_message
from fusiond.outputs.messages.event import event_message
from fusiond.outputs.messages.fault import fault_report
from fusiond.outputs.messages.fleet import of_report
from fusiond.outputs.messages.health import (
    BeamHealth,
    OutputHealth,
    SchedulerStatus,
    SourceHealth,
    health_message,
)
from fusiond.outputs.messages.innovations import Innovation, innovations_message
from fusiond.outputs.messages.nav import nav_message
from fusiond.outputs.messages.recent_events import events_message
from fusiond.outputs.messages.reply import ReplyMessage
from fusiond.outputs.messages.short_message import of_stage
from fusiond.outputs.messages.status import DaemonState, RecordingStatus, status_message
from fusiond.outputs.messages.tracker import tracker_message

UTC_NS = 1_795_217_587_123_456_789

SOLUTION = Solution(
    t_ns=5_000_000_000,
    mode=Mode.NAVIGATING,
    reason="aided by gnss, rdss",
    lat_rad=radians(31.025438871),
    lon_rad=radians(121.441209483),
    height_m=17.42,
    v_ned_m_s=(8.213, -2.034, 0.041),
    rpy_rad=(radians(0.412), radians(-1.205), radians(-13.91)),
    sd_ned_m=(0.9, 0.85, 1.7),
    sd_v_ned_m_s=(0.06, 0.06, 0.08),
    sd_rpy_rad=(radians(0.08), radians(0.08), radians(0.6)),
    bound=Bound(BoundState.WITHIN, 38.412, 21.07),
)

SCHEDULER = SchedulerStatus(
    ticks=360_412,
    overruns=3,
    lateness_p50_ms=0.631,
    lateness_p99_ms=1.259,
    lateness_max_ms=31.4,
    lateness_sum_s=225.1,
    lateness_at_most=(
        (0.0001, 2),
        (0.000316228, 61_022),
        (0.001, 350_117),
        (0.00316228, 360_397),
        (0.01, 360_409),
        (0.0316228, 360_412),
        (0.1, 360_412),
        (0.316228, 360_412),
        (1.0, 360_412),
    ),
    gc_collections=1811,
    gc_forced=0,
    gc_max_ms=2.1,
)

FAULT = fault_report(
    Finding(
        velocity_kinds("gnss")[0],
        t_ns=1000_000_000_000,
        since_s=998.0,
        size=(0.5213, 0.0412, -0.011),
        sd=(0.0811, 0.0798, 0.121),
        log_odds=31.24,
    ),
    "gnss",
    t_ns=1010_000_000_000,
)

EVENT = event_message(
    UTC_NS,
    source="rdss",
    code="rdss_suppressed",
    text="the terminal's transmitter is suppressed",
)

EXAMPLES: dict[str, Any] = {
    "nav": nav_message(SOLUTION, UTC_NS),
    "status": status_message(
        SOLUTION,
        UTC_NS,
        DaemonState(
            since_utc_ns=UTC_NS - 3_500_000_000_000,
            version="0.1.0",
            config_digest="9f2c41d07be3",
            uptime_s=3604.12,
            scheduler=SCHEDULER,
            fused=35_610,
            rejected=14,
            calibrated=False,
            imu="imu",
            faults=(FAULT,),
            recording=RecordingStatus(
                "recording",
                "/var/lib/fusiond/logs/truck_20261120T223307Z_5e0c1f9a_0001.mcap",
                0,
                41_290.4,
            ),
            injected=(),
            mqtt={"mqtt_published": 43_211, "mqtt_dropped": 120, "mqtt_reconnects": 1},
        ),
    ),
    "health": health_message(
        UTC_NS,
        sources={
            "gnss": SourceHealth(
                state="running",
                detail="/dev/ttyGNSS",
                received=35_580,
                fused=35_571,
                rejected={"gated": 9},
                age_s=0.06,
                fused_age_s=0.06,
                latency_s=0.071,
                counters={"checksum": 2, "sentences": 213_480},
                service=Service.OUT,
                series={"gnss": Service.NOMINAL, "gnss_velocity": Service.OUT},
                diagnosis=FAULT,
                verdict="consistent",
            ),
            "rdss": SourceHealth(
                state="silent",
                detail="no beam above level 2",
                received=58,
                fused=53,
                rejected={"multi_value": 4, "too_old": 1},
                age_s=187.2,
                fused_age_s=187.2,
                latency_s=1.42,
                counters={"no_beam": 12, "requests": 61},
                service=Service.NOMINAL,
                series={"rdss": Service.NOMINAL},
                verdict="coloured",
                beams=BeamHealth(levels=(0, 1, 1, 0, 0, 0), serving=2, time_difference=None),
            ),
        },
        outputs={
            "mqtt": OutputHealth(
                state="running",
                detail="localhost:1883",
                counters={"mqtt_published": 43_211, "mqtt_dropped": 120, "mqtt_reconnects": 1},
            ),
            "gpsd": OutputHealth(
                state="running",
                detail="127.0.0.1:2947, 2 connected",
                counters={"clients": 5, "requests": 5, "sent": 7204, "skipped": 12},
            ),
        },
        scheduler=SCHEDULER,
        clock=ClockStatus(
            utc_source="gnss", settled=True, system_error_s=-0.012, counters={"utc_jump": 0}
        ),
        cpu_percent=17.3,
        memory_mb=141.8,
    ),
    "consistency": consistency_message(
        UTC_NS,
        {
            "rdss": judge(
                50,
                100,
                0.893,
                (-0.4054, -0.0259, -0.0411, -0.0881, 0.1637, -0.1903, 0.0842, 0.1781),
            )
        },
    ),
    "innovations": innovations_message(
        UTC_NS,
        [
            Innovation(
                source="gnss",
                t_ms=UTC_NS // 1_000_000 - 71,
                outcome="fused",
                nis=2.114,
                degrees=3,
            ),
            Innovation(
                source="rdss",
                t_ms=UTC_NS // 1_000_000 - 1420,
                outcome="gated",
                nis=31.9,
                degrees=2,
            ),
        ],
    ),
    "calibration": calibration_message(
        UTC_NS,
        [
            Parameter(
                "mounting_pitch_deg",
                "mounting",
                "mounting",
                -0.412,
                0.07,
                5.0,
                CalibrationState.SETTLED,
            ),
            Parameter(
                "axle_lever_m",
                "axle_lever",
                "axle_lever",
                -0.3,
                0.41,
                1.0,
                CalibrationState.OBSERVED,
            ),
            Parameter(
                "wheel_scale",
                "wheel_scale",
                "wheel_scale",
                0.0,
                0.02,
                0.02,
                CalibrationState.NOT_OBSERVED,
            ),
        ],
        False,
    ),
    "tracker": tracker_message(nav_message(SOLUTION, UTC_NS)),
    "event": EVENT,
    "events": events_message([EVENT]),
    "reply": ReplyMessage(
        **dict(zip(("t_utc", "t_ms"), stamp(UTC_NS), strict=True)),
        id="a1",
        command="set_position",
        ok=True,
        text="position fused: it was 3 m from the solution",
    ),
    "message": of_stage(
        MessageStage(
            "rdss",
            0,
            "m1",
            242407,
            "text",
            encode_shortest("Report fuel").payload,
            "Report fuel",
            "sent",
            "",
            1,
            False,
        ),
        17,
        UTC_NS,
    ),
    "fleet": of_report(
        PositionReport(
            UTC_NS * 1e-9 - 4.0,
            31.0251234,
            121.4409876,
            "navigating",
            (1.7, 1.6, 3.1),
            16.2,
            8.44,
            346.5,
        ),
        242407,
        "rdss",
        UTC_NS - 4_000_000_000,
        UTC_NS,
    ),
}
