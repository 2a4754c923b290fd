"""Printed page of `fusiond status`: retained messages and solution of a daemon."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import atan2, degrees, hypot
from typing import Any

_SHOWN_EVENTS = 6
_SHOWN_REASONS = 2
_UNKNOWN = "-"


def status_page(answer: dict[str, Any]) -> list[str]:
    """Lines of the page. `answer` has the messages by topic, `status` at least."""
    status = answer["status"]
    health, nav = answer.get("health"), answer.get("nav")
    lines = [
        f"{answer['vehicle']}: fusiond {status['version']}, up {duration(status['uptime_s'])}, "
        f"configuration {status['config_digest']}",
        f"{status['mode'].upper()} for {_since(status)}: {status['why']}",
    ]
    facts = [
        *(_solution(nav) if nav is not None else ()),
        *(("FAULT", fault["text"]) for fault in status["faults"]),
        *_vehicle(status),
        *(_process(health) if health is not None else ()),
    ]
    width = max([11, *(len(name) for name, _ in facts)])
    lines += [f"{name:<{width}} {text}" for name, text in facts]
    if health is not None:
        lines += ["", *_sources(health["sources"], answer.get("consistency"))]
    events = answer.get("events", {}).get("events", [])
    if events:
        lines += ["", *map(_event, events[-_SHOWN_EVENTS:])]
    return lines


def duration(seconds: float) -> str:
    """Format a duration in its two greatest units: 3 d 4 h, 58 min 20 s, 4.2 s."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    whole = int(seconds)
    units = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
    first = next(i for i, (_, size) in enumerate(units) if whole >= size)
    parts = []
    for name, size in units[first : first + 2]:
        count, whole = divmod(whole, size)
        parts.append(f"{count} {name}")
    return " ".join(parts)


def _since(status: dict[str, Any]) -> str:
    if status["t_ms"] is None or status["since_ms"] is None:
        return "a time not known before UTC is"
    return duration(max(0.0, (status["t_ms"] - status["since_ms"]) * 1e-3))


def _figure(value: float | None, form: str) -> str:
    return _UNKNOWN if value is None else format(value, form)


def _solution(nav: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if nav["lat_deg"] is None:
        yield "position", "none yet"
        return
    sd = ", ".join(_figure(nav[f"sd_{axis}_m"], ".2f") for axis in "ned")
    height = _figure(nav["height_m"], ".1f")
    yield (
        "position",
        (f"{nav['lat_deg']:.7f} {nav['lon_deg']:.7f} deg, {height} m; sigma n, e, d {sd} m"),
    )
    north, east = nav["v_n_m_s"], nav["v_e_m_s"]
    if north is not None and east is not None:
        course = degrees(atan2(east, north)) % 360.0
        yield "speed", f"{hypot(north, east):.2f} m/s towards {course:.0f} deg"
    angles = ", ".join(_figure(nav[f"{a}_deg"], ".2f") for a in ("roll", "pitch", "yaw"))
    sds = ", ".join(_figure(nav[f"sd_{a}_deg"], ".2f") for a in ("roll", "pitch", "yaw"))
    yield "attitude", f"roll, pitch, yaw {angles} deg; sigma {sds} deg"
    horizontal, vertical = nav["protection_horizontal_m"], nav["protection_vertical_m"]
    if horizontal is not None:
        bound = _figure(vertical, ".1f")
        yield "bounded by", f"{horizontal:.1f} m horizontal, {bound} m vertical"


def _vehicle(status: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if status["protection"] != "off":
        yield "protection", status["protection"]
    yield "calibration", "settled" if status["calibrated"] else "not settled"
    recording = status["recording"]
    if status["recording_file"]:
        recording += f" {status['recording_file']}"
    if status["disk_free_mb"] is not None:
        recording += f", {status['disk_free_mb'] / 1000:.1f} GB free"
    if status["recording_dropped"]:
        recording += f", {status['recording_dropped']} messages lost to a slow disk"
    yield "recording", recording
    if status["injected"]:
        yield "INJECTED", ", ".join(status["injected"])


def _process(health: dict[str, Any]) -> Iterator[tuple[str, str]]:
    clock = f"UTC from {health['utc_source']}"
    if not health["utc_settled"]:
        clock += ", not settled"
    if health["system_clock_error_s"] is not None:
        clock += f"; system clock {health['system_clock_error_s']:+.3f} s against GNSS"
    yield "clock", clock
    memory = _figure(health["memory_mb"], ".0f")
    yield (
        "ticks",
        (
            f"{health['ticks']}, {health['overruns']} overruns, "
            f"p99 {health['lateness_p99_ms']:.1f} ms late; "
            f"CPU {health['cpu_percent']:.0f} %, {memory} MB"
        ),
    )
    for name, output in health["outputs"].items():
        detail = f": {output['detail']}" if output["detail"] else ""
        yield f"to {name}", output["state"] + detail


def _sources(
    sources: dict[str, dict[str, Any]], consistency: dict[str, Any] | None
) -> Iterator[str]:
    """Table of sources; below each the reason why it is not fused, within 80 columns."""
    verdicts = {} if consistency is None else consistency["sources"]
    rows = [("source", "state", "fused", "refused", "age", "latency", "verdict")]
    for name, source in sources.items():
        refused = sum(source["rejected"].values())
        rows.append(
            (
                name,
                _state(source),
                str(source["fused"]),
                str(refused) if refused else _UNKNOWN,
                _time(source["age_s"]),
                _time(source["latency_s"]),
                verdicts.get(name, {}).get("verdict") or source["verdict"] or _UNKNOWN,
            )
        )
    head, *lines = aligned_columns(rows)
    yield head
    for line, source in zip(lines, sources.values(), strict=True):
        yield line
        why = "; ".join(part for part in (_fault(source), _refused(source["rejected"])) if part)
        if why:
            yield f"  {why}"


def _state(source: dict[str, Any]) -> str:
    """State of a device; for a running device its service, unless that is normal."""
    service = source["service"]
    if source["state"] == "running" and service not in (None, "nominal"):
        return f"running, {service}"
    return str(source["state"])


def _fault(source: dict[str, Any]) -> str:
    """Describe the fault of a device or of its measurements; empty without one."""
    if source["state"] != "running":
        return str(source["detail"])
    fault = source["diagnosis"]
    if fault is not None:
        return str(fault["text"])
    returned = "is back; checking it against the motion" * (source["service"] == "probation")
    return str(source["isolated"] or returned)


def _refused(reasons: dict[str, int]) -> str:
    """Most frequent reasons with their counts."""
    if not reasons:
        return ""
    first = sorted(reasons.items(), key=lambda item: -item[1])
    words = ", ".join(f"{count} {reason}" for reason, count in first[:_SHOWN_REASONS])
    others = sum(count for _, count in first[_SHOWN_REASONS:])
    return f"refused {words}" + (f", {others} others" if others else "")


def _time(seconds: float | None) -> str:
    if seconds is None:
        return _UNKNOWN
    # What came a moment after the tick that this message is of has a negative age.
    seconds = max(0.0, seconds)
    return f"{seconds * 1e3:.0f} ms" if seconds < 1.0 else duration(seconds)


def aligned_columns(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Align rows of cells into columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield "  ".join(cells).rstrip()


def _event(event: dict[str, Any]) -> str:
    when = (event["t_utc"] or "")[11:19] or "before UTC"
    line = f"{when} {event['level']}: {event['source']} {event['code']}: {event['text']}"
    return f"{line}\n{'':9}-> {event['advice']}" if event.get("advice") else line
