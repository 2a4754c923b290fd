"""Display of the demo: the broker's messages beside the true errors, on a terminal or as lines."""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, TextIO

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live as RichLive
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

REFRESH_S = 0.25
LINE_EVERY_S = 5.0
WIDE = 112
"""Terminal width, in columns, from which two tables stand side by side."""
RATE_WINDOW_S = 5.0
_EVENTS = 40
_LEAST_EVENTS = 3
"""Lines for events on a small terminal: what the parts of the filter do gives way to them."""
_SWITCH_INTERVAL_S = 0.0005
"""Rendering takes about 10 ms in a thread; this is how long a tick waits for the interpreter."""
_MODE_STYLE = {
    "waiting": "bold yellow",
    "aligning": "bold yellow",
    "navigating": "bold green",
    "coasting": "bold yellow",
    "invalid": "bold red",
}
_STATE_STYLE = {"running": "green", "starting": "yellow", "silent": "yellow"}
_LEVEL_STYLE = {"warning": "yellow", "error": "red"}
_Row = tuple[int, str, str, int, str, str, str]
# place among the true errors, label, field of `nav`, decimals, unit, field of its sigma, its unit
_ROWS: tuple[_Row, ...] = (
    (0, "latitude", "lat_deg", 7, "°", "sd_n_m", "m"),
    (1, "longitude", "lon_deg", 7, "°", "sd_e_m", "m"),
    (2, "height", "height_m", 2, "m", "sd_d_m", "m"),
    (3, "v north", "v_n_m_s", 3, "m/s", "sd_vn_m_s", "m/s"),
    (4, "v east", "v_e_m_s", 3, "m/s", "sd_ve_m_s", "m/s"),
    (5, "v down", "v_d_m_s", 3, "m/s", "sd_vd_m_s", "m/s"),
    (6, "roll", "roll_deg", 2, "°", "sd_roll_deg", "°"),
    (7, "pitch", "pitch_deg", 2, "°", "sd_pitch_deg", "°"),
    (8, "yaw", "yaw_deg", 2, "°", "sd_yaw_deg", "°"),
)
_WITHOUT_VELOCITY = tuple(row for row in _ROWS if not row[1].startswith("v "))
_MADE_INSIDE = "made by the filter or part of another source"


class Live:
    """Latest messages of the broker, and the state of the simulation."""

    def __init__(self, duration_s: float, port: int, vehicle: str, page: str | None = None) -> None:
        self.duration_s = duration_s
        self.port = port
        self.vehicle = vehicle
        self.page = page
        """Address of the dashboard; None without one."""
        self.started = time.monotonic()
        self.nav: dict[str, Any] = {}
        self.status: dict[str, Any] = {}
        self.health: dict[str, Any] = {}
        self.events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        self.errors: list[float] = []
        """True errors: m north, east, down; m/s; degrees roll, pitch, yaw."""
        self.outage: tuple[str, float] | None = None
        """Unplugged device and the instant (monotonic, s) at which it returns."""
        self.aligning = ""
        """Display while no solution exists yet."""
        self.received = 0
        self._arrivals: deque[float] = deque(maxlen=4096)

    def message(self, topic: str, payload: bytes) -> None:
        """Store a message from the broker."""
        self.received += 1
        self._arrivals.append(time.monotonic())
        if topic == "nav":
            self.nav = json.loads(payload)
        elif topic == "status":
            self.status = json.loads(payload)
        elif topic == "health":
            self.health = json.loads(payload)
        elif topic == "event":
            self.events.append(json.loads(payload))

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.started

    @property
    def rate_hz(self) -> float:
        """Rate of messages from the broker over the last seconds."""
        since = time.monotonic() - RATE_WINDOW_S
        count = sum(t >= since for t in tuple(self._arrivals))
        return count / max(1.0, min(RATE_WINDOW_S, self.elapsed_s))

    @property
    def mode(self) -> str:
        return str(self.nav.get("mode", "waiting"))

    @property
    def scene(self) -> str:
        """Name of the scene on the road."""
        if self.outage is not None:
            device, until = self.outage
            left = max(0.0, until - time.monotonic())
            return f"{device} unplugged for {left:.0f} s more: the others carry on"
        speed = abs(self.nav.get("v_n_m_s") or 0.0) + abs(self.nav.get("v_e_m_s") or 0.0)
        if self.mode in ("waiting", "aligning"):
            return self.aligning
        return "all devices" if speed > 0.5 else "all devices, standing"


class HeadlessView:
    """View without a terminal: a line every five seconds."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    async def show(self, live: Live) -> None:
        """Write until cancelled."""
        if live.page is not None:
            print(f"dashboard: {live.page}", file=self._out, flush=True)
        print(f"broker: 127.0.0.1:{live.port}", file=self._out, flush=True)
        while True:
            await asyncio.sleep(LINE_EVERY_S)
            print(line(live), file=self._out, flush=True)


class LiveView:
    """The terminal, redrawn four times a second by a thread: drawing must not hold up a tick."""

    async def show(self, live: Live) -> None:
        """Draw until cancelled."""
        console = Console()
        before = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        try:
            with RichLive(
                console=console, screen=True, auto_refresh=False, transient=True
            ) as screen:
                while True:
                    await asyncio.to_thread(screen.update, Screen(live), refresh=True)
                    await asyncio.sleep(REFRESH_S)
        finally:
            sys.setswitchinterval(before)


def line(live: Live) -> str:
    """The state of the demo in one line."""
    parts = [f"{live.elapsed_s:5.1f} s  {live.mode:<10}"]
    if live.errors:
        north, east = live.errors[:2]
        n, e = live.nav.get("sd_n_m") or 0.0, live.nav.get("sd_e_m") or 0.0
        parts.append(
            f"error {(north**2 + east**2) ** 0.5:6.2f} m (sigma {(n * n + e * e) ** 0.5:.2f})"
        )
        known = math.isfinite(live.errors[8])
        parts.append(f"yaw {live.errors[8]:+.2f} deg" if known else "no heading")
    fused = [
        f"{name} {live.health['sources'][name]['fused']}"
        for name in ("gnss", "rdss")
        if name in live.health.get("sources", {})
    ]
    if fused:
        parts.append("fused " + " ".join(fused))
    parts.append(live.scene if live.mode == "navigating" else str(live.status.get("why", "")))
    return "  ".join(parts)


class Screen:
    """Screen layout, fitted to the terminal's size when it is drawn."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width, height = options.max_width, console.height
        live = self._live
        mode = self._mode()
        head: list[RenderableType] = [self._title(), mode, Rule(style="dim")]
        lines = len(head) - 1 + len(mode.wrap(console, width))
        foot = self._foot()
        for inside, rows in ((True, _ROWS), (False, _ROWS), (False, _WITHOUT_VELOCITY)):
            solution, sources = self._solution(rows), self._sources(inside)
            if width >= WIDE:
                body = Table.grid(padding=(0, 2))
                body.add_row(solution, sources)
                used = lines + max(solution.row_count, sources.row_count) + 1
                parts = [*head, body]
            else:
                used = lines + solution.row_count + sources.row_count + 2
                parts = [*head, solution, sources]
            room = height - used - len(foot) - 1
            if room >= _LEAST_EVENTS:
                break
        events = list(live.events)[-room:] if room > 0 else []
        if events:
            parts += [Rule("events", style="dim", align="left"), *map(self._event, events)]
        parts += foot
        yield Group(*parts)

    def _title(self) -> Text:
        live = self._live
        text = Text(no_wrap=True, overflow="ellipsis")
        text.append("fusiond demo", style="bold")
        text.append(f"  {min(live.elapsed_s, live.duration_s):5.1f} / {live.duration_s:g} s  ")
        text.append(live.scene, style="yellow" if live.outage is not None else "dim")
        return text

    def _mode(self) -> Text:
        live = self._live
        text = Text()  # it wraps: the end says what to do
        text.append(live.mode.upper(), style=_MODE_STYLE.get(live.mode, ""))
        text.append(f"  {live.status.get('why', '')}")
        return text

    def _solution(self, rows: Sequence[_Row]) -> Table:
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
        table.add_column("solution", min_width=9, no_wrap=True)
        table.add_column("", min_width=13, justify="right", no_wrap=True)
        table.add_column("sigma", min_width=10, justify="right", no_wrap=True)
        table.add_column("true error", min_width=11, justify="right", no_wrap=True)
        table.add_column("ratio", justify="right", no_wrap=True)
        nav, errors = self._live.nav, self._live.errors
        for place, label, key, digits, unit, sd_key, sd_unit in rows:
            value, sd = nav.get(key), nav.get(sd_key)
            if value is None or sd is None:
                table.add_row(label, "-", "-", "-", "-")
                continue
            error = ratio = Text("-")
            if errors:
                size = abs(errors[place]) / sd if sd > 0.0 else float("inf")
                style = "green" if size <= 2.0 else "yellow" if size <= 3.0 else "red"
                error = Text(f"{errors[place]:+.3f} {sd_unit}")
                ratio = Text(f"{size:.1f}", style=style)
            table.add_row(label, f"{value:.{digits}f} {unit}", f"{sd:.3f} {sd_unit}", error, ratio)
        return table

    def _sources(self, with_inside: bool) -> Table:
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
        table.add_column("source", min_width=13, no_wrap=True)
        table.add_column("state", min_width=8, no_wrap=True)
        table.add_column("fused", justify="right", no_wrap=True)
        table.add_column("rejected", min_width=16, no_wrap=True)
        table.add_column("latency", justify="right", no_wrap=True)
        table.add_column("age", min_width=6, justify="right", no_wrap=True)
        for name, source in self._live.health.get("sources", {}).items():
            inside = source["detail"] == _MADE_INSIDE
            if inside and not with_inside:
                continue
            state = "" if inside else source["state"]
            table.add_row(
                Text(name, style="dim" if inside else ""),
                Text(state, style=_STATE_STYLE.get(state, "red")),
                str(source["fused"]),
                _rejected(source["rejected"]),
                _time(source["latency_s"]),
                _time(source["fused_age_s"]),
            )
        return table

    def _event(self, event: dict[str, Any]) -> Text:
        text = Text(no_wrap=True, overflow="ellipsis", style=_LEVEL_STYLE.get(event["level"], ""))
        text.append(str(event["t_utc"] or "")[11:19] + " ", style="dim")
        text.append(f"{event['source']} {event['code']}: {event['text']}")
        return text

    def _foot(self) -> list[RenderableType]:
        live, health, status = self._live, self._live.health, self._live.status
        text = Text(no_wrap=True, overflow="ellipsis", style="dim")
        if health:
            text.append(
                f"ticks {health['ticks']}, overruns {health['overruns']}, late p50 "
                f"{health['lateness_p50_ms']:.2f} p99 {health['lateness_p99_ms']:.2f} ms   "
                f"CPU {health['cpu_percent'] or 0:.0f} % {health['memory_mb'] or 0:.0f} MB   "
            )
        lost = status.get("mqtt_dropped", 0)
        mqtt = Text(
            f"MQTT {live.rate_hz:.1f}/s, {lost} dropped; mosquitto_sub -p {live.port} -v "
            f"-t 'fusiond/{live.vehicle}/#'",
            no_wrap=True,
            overflow="ellipsis",
            style="dim",
        )
        if live.page is None:
            return [Rule(style="dim"), text, mqtt]
        page = Text(f"in a browser: {live.page}", no_wrap=True, overflow="ellipsis")
        return [Rule(style="dim"), text, mqtt, page]


def _rejected(reasons: dict[str, int]) -> Text:
    """Most frequent reason of rejection and its count, without measurements from before the
    start."""
    if not reasons:
        return Text("-")
    reason, count = max(reasons.items(), key=lambda item: item[1])
    more = f" +{sum(reasons.values()) - count}" if len(reasons) > 1 else ""
    return Text(f"{count} {reason}{more}", style="dim" if reason == "before_start" else "yellow")


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{seconds * 1e3:.0f} ms" if abs(seconds) < 1.0 else f"{seconds:.1f} s"
