"""Prometheus output: the daemon's state as metrics at `/metrics`.

The reply is made from the latest messages, at most once a second, so that scrapes do not load the
tick. Units are Prometheus's base units: seconds, metres, radians, bytes.

Source: Prometheus text exposition format 0.0.4; OpenMetrics 1.0 for state sets (one series for each
state, 1 for the present state).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from math import inf, isinf, isnan, radians
from typing import Any, Literal, NamedTuple, get_args

from drivers.base import DriverStatus, State
from fusiond.configuration.outputs import Prometheus
from fusiond.integrity.series_states import Service
from fusiond.navigation.solution import Mode
from fusiond.outputs.base import Surroundings
from fusiond.outputs.derived_figures import motion, usable
from fusiond.outputs.listening_port import Port
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.consistency import ConsistencyMessage
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.health import HealthMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.messages.status import StatusMessage
from fusiond.outputs.tcp import Client, TcpServer
from fusiond.outputs.topics import Topic

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MOST_SCRAPERS = 32
"""Most simultaneous connections; Prometheus opens one and keeps none."""
_KEPT_S = 1.0
"""Time for which a text is reused; `health` comes once a second."""
_MOST_HEAD_BYTES = 8192
"""Largest request line and headers, as in HTTP servers."""

Labels = tuple[tuple[str, str], ...]


class Family(NamedTuple):
    """Metric family; `samples` are (suffix of the name, labels, value)."""

    name: str
    kind: Literal["gauge", "counter", "histogram"]
    text: str
    samples: tuple[tuple[str, Labels, float], ...]


class PrometheusEndpoint:
    """`GET /metrics` at `host:port`. Counters: those of `TcpServer`, and `scrapes`, `malformed`."""

    name = "prometheus"
    sets_clocks = False
    nav_rate_hz = 1.0
    """Sigma between two scrapes is of no use; they come every 15 s by default."""

    def __init__(self, section: Prometheus, around: Surroundings) -> None:
        self._vehicle = around.vehicle
        self._latest: dict[type[Message], Message] = {}
        self._events: Counter[tuple[str, str, str]] = Counter()
        self._nav_s: float | None = None
        self._text, self._text_s = b"", -inf
        port = Port(self.name, section.host, section.port, around.on_event)
        self.server = TcpServer(self.name, port, around.guests, self._greet, MOST_SCRAPERS)
        self.counters = self.server.counters

    @property
    def status(self) -> DriverStatus:
        return self.server.port.status

    def publish(self, topic: Topic, message: Message) -> None:
        if isinstance(message, EventMessage):
            self._events[message.level, message.source, message.code] += 1
            return
        self._latest[type(message)] = message
        if isinstance(message, NavMessage):
            self._nav_s = time.monotonic()

    async def run(self) -> None:
        await self.server.run()

    def _greet(self, client: Client) -> _Scrape:
        client.request_due = True
        return _Scrape(self, client)

    def answer(self, head: bytes) -> bytes:
        """Reply to a request with the head `head`."""
        method, path, *_ = [*head.split(b"\r\n", 1)[0].split(), b"", b""]
        if method not in (b"GET", b"HEAD"):
            self.counters["malformed"] += 1
            return _response("405 Method Not Allowed", b"GET or HEAD\n", head=False)
        if path.split(b"?")[0] != b"/metrics":
            return _response("404 Not Found", b"/metrics\n", head=method == b"HEAD")
        self.counters["scrapes"] += 1
        return _response("200 OK", self._metrics(), head=method == b"HEAD")

    def _metrics(self) -> bytes:
        now_s = time.monotonic()
        if now_s - self._text_s >= _KEPT_S:
            self._text, self._text_s = exposition(self.families()).encode(), now_s
        return self._text

    # ------------------------------------------------------------------ metrics

    def families(self) -> list[Family]:
        """Present metrics."""
        found: list[Family] = []
        for message in self._latest.values():
            match message:
                case NavMessage():
                    found += _of_nav(message)
                case StatusMessage():
                    found += _of_status(message, self._vehicle)
                case HealthMessage():
                    found += _of_health(message)
                case ConsistencyMessage():
                    found += _of_consistency(message)
        if self._nav_s is not None:
            age_s = time.monotonic() - self._nav_s
            text = "Since the tick that made the last solution; grows when the daemon hangs."
            found.append(_gauge("fusiond_solution_age_seconds", text, age_s))
        text = "Events by level, source and code."
        names = ("level", "source", "code")
        found.append(_labelled("fusiond_events_total", "counter", text, names, self._events))
        cpu_s = time.process_time()
        text = "Processor time that the daemon has used."
        found.append(Family("process_cpu_seconds_total", "counter", text, (("", (), cpu_s),)))
        return [family for family in found if family.samples]


class _Scrape:
    """Connection of one request and one reply."""

    def __init__(self, endpoint: PrometheusEndpoint, client: Client) -> None:
        self._endpoint, self._client = endpoint, client
        self._head = bytearray()

    def receive(self, data: bytes) -> None:
        self._head += data
        if b"\r\n\r\n" in self._head:
            self._client.request_due = False
            self._client.finish(self._endpoint.answer(bytes(self._head)))
        elif len(self._head) > _MOST_HEAD_BYTES:
            self._client.drop("malformed")

    def end(self) -> None:
        pass


def _gauge(name: str, text: str, value: float | None) -> Family:
    known = value is not None and not isnan(value)
    return Family(name, "gauge", text, (("", (), float(value or 0.0)),) if known else ())


def _labelled(
    name: str,
    kind: Literal["gauge", "counter"],
    text: str,
    labels: tuple[str, ...],
    values: Mapping[Any, float | None],
) -> Family:
    """Make a family of `values`, whose keys are tuples of label values; unknown values are
    omitted."""
    samples = tuple(
        ("", tuple(zip(labels, key, strict=True)), float(value))
        for key, value in values.items()
        if value is not None and not isnan(value)
    )
    return Family(name, kind, text, samples)


def _states(
    name: str, text: str, labels: tuple[str, ...], held: Iterable[tuple[tuple[str, ...], str]],
    states: Iterable[str],
) -> Family:  # fmt: skip
    """Make a state set: 1 for the present state, 0 for all others."""
    known = tuple(states)
    values = {(*key, state): float(state == now) for key, now in held for state in known}
    return _labelled(name, "gauge", text, labels, values)


def _of_nav(nav: NavMessage) -> Iterator[Family]:
    if not usable(nav):
        return
    axes = ("north", "east", "down")
    yield _labelled(
        "fusiond_position_sigma_meters", "gauge", "One sigma of the position.", ("axis",),
        {(a,): v for a, v in zip(axes, (nav.sd_n_m, nav.sd_e_m, nav.sd_d_m), strict=True)},
    )  # fmt: skip
    velocity = (nav.sd_vn_m_s, nav.sd_ve_m_s, nav.sd_vd_m_s)
    yield _labelled(
        "fusiond_velocity_sigma_meters_per_second", "gauge", "One sigma of the velocity.",
        ("axis",), {(a,): v for a, v in zip(axes, velocity, strict=True)},
    )  # fmt: skip
    angles = zip(
        ("roll", "pitch", "yaw"), (nav.sd_roll_deg, nav.sd_pitch_deg, nav.sd_yaw_deg), strict=True
    )
    yield _labelled(
        "fusiond_attitude_sigma_radians", "gauge", "One sigma of the attitude.", ("axis",),
        {(a,): None if v is None else radians(v) for a, v in angles},
    )  # fmt: skip
    levels = {
        ("horizontal",): nav.protection_horizontal_m,
        ("vertical",): nav.protection_vertical_m,
    }
    text = "Bound of the position error at the configured integrity risk."
    yield _labelled("fusiond_protection_level_meters", "gauge", text, ("direction",), levels)
    moving = motion(nav)
    speed = None if moving is None else moving.speed_m_s
    yield _gauge("fusiond_speed_meters_per_second", "Over the ground.", speed)


def _of_status(status: StatusMessage, vehicle: str) -> Iterator[Family]:
    text = "Version, vehicle and configuration."
    build = {(status.version, vehicle, status.config_digest): 1.0}
    names = ("version", "vehicle", "config_digest")
    yield _labelled("fusiond_build_info", "gauge", text, names, build)
    yield _gauge("fusiond_uptime_seconds", "Since the daemon started.", status.uptime_s)
    yield _states(
        "fusiond_mode", "What the solution is worth.", ("mode",), [((), status.mode)], Mode
    )
    labels = ("source", "kind", "axis", "unit", "action")
    keys = [(f.source, f.kind, f.axis or "", f.unit, f.action) for f in status.faults]
    text = "Size of each fault that is not over, in its unit."
    sizes = dict(zip(keys, (f.size for f in status.faults), strict=True))
    yield _labelled("fusiond_fault_size", "gauge", text, labels, sizes)
    text = "One sigma of that size."
    sigmas = dict(zip(keys, (f.sd for f in status.faults), strict=True))
    yield _labelled("fusiond_fault_sigma", "gauge", text, labels, sigmas)


def _of_health(health: HealthMessage) -> Iterator[Family]:
    sources = health.sources
    outcomes: dict[tuple[str, ...], float | None] = {}
    for name, source in sources.items():
        outcomes[name, "fused"] = source.fused
        outcomes |= {(name, reason): count for reason, count in source.rejected.items()}
    text = "What became of measurements: fused, or why not."
    yield _labelled("fusiond_measurements_total", "counter", text, ("source", "outcome"), outcomes)
    text = "Measurements that came in."
    received = {(name,): float(source.received) for name, source in sources.items()}
    yield _labelled("fusiond_measurements_received_total", "counter", text, ("source",), received)
    text = "What a device is doing."
    held = [((name,), source.state) for name, source in sources.items()]
    yield _states("fusiond_source_state", text, ("source", "state"), held, get_args(State))
    text = "Whether what a source sends is fused; of a device that of its worst series."
    served = [((name,), source.service) for name, source in sources.items() if source.service]
    yield _states("fusiond_source_service", text, ("source", "state"), served, Service)
    ages = (
        ("age", "Since the last measurement came in.", "age_s"),
        ("fused_age", "Since the last measurement was fused.", "fused_age_s"),
        ("latency", "From validity to arrival, of the last measurement.", "latency_s"),
    )
    for name, text, field in ages:
        values = {(key,): getattr(source, field) for key, source in sources.items()}
        yield _labelled(f"fusiond_source_{name}_seconds", "gauge", text, ("source",), values)
    text = "The driver's own counters."
    counted = {(n, c): float(v) for n, s in sources.items() for c, v in s.counters.items()}
    yield _labelled("fusiond_driver_events_total", "counter", text, ("source", "event"), counted)
    text = "1 while an output serves."
    up = {(name,): float(output.state == "running") for name, output in health.outputs.items()}
    yield _labelled("fusiond_output_up", "gauge", text, ("output",), up)
    text = "The outputs' own counters."
    counted = {(n, c): float(v) for n, o in health.outputs.items() for c, v in o.counters.items()}
    yield _labelled("fusiond_output_events_total", "counter", text, ("output", "event"), counted)
    yield from _of_scheduler(health)
    yield _gauge(
        "fusiond_utc_settled", "1 while UTC is known without a doubt.", float(health.utc_settled)
    )
    text = "The system clock minus the receiver's UTC."
    yield _gauge("fusiond_system_clock_error_seconds", text, health.system_clock_error_s)
    memory = None if health.memory_mb is None else health.memory_mb * 1e6
    yield _gauge("process_resident_memory_bytes", "Resident memory.", memory)


def _of_scheduler(health: HealthMessage) -> Iterator[Family]:
    text = "Ticks that were skipped because one before was late."
    overruns = (("", (), float(health.overruns)),)
    yield Family("fusiond_tick_overruns_total", "counter", text, overruns)
    buckets: list[tuple[str, Labels, float]] = [
        ("_bucket", (("le", edge),), float(count))
        for edge, count in health.lateness_at_most_s.items()
    ]
    buckets += [
        ("_bucket", (("le", "+Inf"),), float(health.ticks)),
        ("_sum", (), health.lateness_sum_s),
        ("_count", (), float(health.ticks)),
    ]
    text = "How much later than its deadline a tick started."
    yield Family("fusiond_tick_lateness_seconds", "histogram", text, tuple(buckets))


def _of_consistency(consistency: ConsistencyMessage) -> Iterator[Family]:
    text = "Normalised innovation squared per degree of freedom; 1 is expected."
    averages = {(name,): s.nis_average for name, s in consistency.sources.items()}
    yield _labelled("fusiond_innovation_nis_average", "gauge", text, ("source",), averages)
    text = "What the innovation tests say of a source's sigma."
    verdicts = {(name, s.verdict): 1.0 for name, s in consistency.sources.items()}
    yield _labelled("fusiond_consistency_verdict", "gauge", text, ("source", "verdict"), verdicts)


# ------------------------------------------------------------------ text


def exposition(families: Iterable[Family]) -> str:
    """Format the families as text."""
    lines: list[str] = []
    for family in families:
        lines += [f"# HELP {family.name} {family.text}", f"# TYPE {family.name} {family.kind}"]
        for suffix, labels, value in family.samples:
            pairs = ",".join(f'{name}="{_escaped(text)}"' for name, text in labels)
            series = f"{{{pairs}}}" if pairs else ""
            lines.append(f"{family.name}{suffix}{series} {_number(value)}")
    return "\n".join(lines) + "\n"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(value: float) -> str:
    if isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(int(value)) if value == int(value) else repr(value)


def _response(status: str, body: bytes, *, head: bool) -> bytes:
    start = (
        f"HTTP/1.1 {status}\r\nContent-Type: {CONTENT_TYPE}\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    ).encode()
    return start if head else start + body
