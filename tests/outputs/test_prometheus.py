"""The metrics: their text, what answers for them, and that the Grafana dashboard asks for them."""

from __future__ import annotations

import asyncio
import json
import re
from math import inf, nan
from typing import Any

import pytest

from fusiond.configuration.outputs import Prometheus
from fusiond.navigation.solution import Mode
from fusiond.outputs.messages.base import Message
from fusiond.outputs.prometheus import Family, PrometheusEndpoint, exposition
from fusiond.outputs.topics import TOPICS
from tests.broker import free_port
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, at_work, connected, nav
from tests.patience import PATIENCE_S
from tests.places import REPOSITORY

DASHBOARD = REPOSITORY / "config" / "grafana.json"
LINE = re.compile(
    r'([a-zA-Z_:][\w:]*)(?:\{((?:\w+="(?:[^"\\\n]|\\[\\"n])*",?)*)\})? (\+Inf|-Inf|[-+\d.e]+)'
)


def endpoint(**changed: Message) -> PrometheusEndpoint:
    made = PrometheusEndpoint(Prometheus(port=free_port()), Around().surroundings)
    for topic in TOPICS:
        made.publish(topic, changed.get(topic.name, EXAMPLES.get(topic.name)))
    return made


def read(text: str) -> dict[str, float]:
    """Samples by series as written; fails for what is no exposition format 0.0.4."""
    found: dict[str, float] = {}
    kinds: dict[str, str] = {}
    for line in text.removesuffix("\n").split("\n"):
        if line.startswith("# HELP "):
            assert line.split(maxsplit=3)[3]
        elif line.startswith("# TYPE "):
            _, _, name, kind = line.split()
            assert name not in kinds
            kinds[name] = kind
            assert (kind == "counter") == name.endswith("_total")
        else:
            match = LINE.fullmatch(line)
            assert match is not None, line
            name = re.sub(r"_(bucket|sum|count)$", "", match[1])
            assert name == list(kinds)[-1], "samples stand below their own TYPE"
            series = line.rsplit(" ", 1)[0]
            assert series not in found
            found[series] = float(match[3])
    return found


def test_the_metrics_are_what_the_messages_say() -> None:
    said = read(exposition(endpoint().families()))
    assert said['fusiond_position_sigma_meters{axis="north"}'] == 0.9
    assert said['fusiond_attitude_sigma_radians{axis="yaw"}'] == pytest.approx(0.010472, abs=1e-6)
    assert said["fusiond_speed_meters_per_second"] == pytest.approx(8.4611, abs=1e-4)
    assert said['fusiond_mode{mode="navigating"}'] == 1.0
    assert sum(v for k, v in said.items() if k.startswith("fusiond_mode{")) == 1.0
    assert said['fusiond_measurements_total{source="gnss",outcome="fused"}'] == 35_571
    assert said['fusiond_measurements_total{source="gnss",outcome="gated"}'] == 9
    assert said['fusiond_source_state{source="rdss",state="silent"}'] == 1.0
    assert said['fusiond_source_service{source="gnss",state="out"}'] == 1.0
    assert said['fusiond_source_service{source="gnss",state="nominal"}'] == 0.0
    assert said['fusiond_source_service{source="rdss",state="nominal"}'] == 1.0
    fault = 'source="gnss",kind="velocity",axis="north",unit="m/s",action="left out"'
    assert said[f"fusiond_fault_size{{{fault}}}"] == 0.5213
    assert said[f"fusiond_fault_sigma{{{fault}}}"] == 0.0811
    assert said['fusiond_source_fused_age_seconds{source="rdss"}'] == 187.2
    assert said['fusiond_consistency_verdict{source="rdss",verdict="coloured"}'] == 1.0
    assert said['fusiond_output_events_total{output="gpsd",event="skipped"}'] == 12
    assert said['fusiond_tick_lateness_seconds_bucket{le="0.001"}'] == 350_117
    assert said['fusiond_tick_lateness_seconds_bucket{le="+Inf"}'] == 360_412
    assert said["fusiond_tick_lateness_seconds_count"] == 360_412
    assert said["process_resident_memory_bytes"] == 141.8e6
    series = 'fusiond_build_info{version="0.1.0",vehicle="truck",config_digest="9f2c41d07be3"}'
    assert said[series] == 1.0
    series = 'fusiond_events_total{level="warning",source="rdss",code="rdss_suppressed"}'
    assert said[series] == 1.0


def test_unknown_values_are_left_out() -> None:
    said = read(exposition(endpoint(nav=nav(sd_d_m=nan, protection_horizontal_m=inf)).families()))
    assert 'fusiond_position_sigma_meters{axis="down"}' not in said
    assert said['fusiond_protection_level_meters{direction="horizontal"}'] == inf
    invalid = read(exposition(endpoint(nav=nav(mode=Mode.INVALID)).families()))
    assert not [k for k in invalid if "_sigma_" in k]
    empty = PrometheusEndpoint(Prometheus(port=1), Around().surroundings)
    assert list(read(exposition(empty.families()))) == ["process_cpu_seconds_total"]


def test_text_in_labels_is_escaped() -> None:
    family = Family("x", "gauge", "y", (("", (("a", 'q"\\\n'),), 1.0),))
    assert exposition([family]).splitlines()[-1] == r'x{a="q\"\\\n"} 1'


async def ask(output: PrometheusEndpoint, request: bytes) -> tuple[bytes, bytes]:
    """Head and body of the answer, up to the end that the server makes; nothing if it resets."""
    async with connected(output.server.port.address) as client:
        client.writer.write(request)
        try:
            async with asyncio.timeout(PATIENCE_S):
                head, _, body = (await client.reader.read()).partition(b"\r\n\r\n")
        except ConnectionResetError:
            return b"", b""
    return head, body


async def test_metrics_are_served_over_http() -> None:
    output = endpoint()
    async with at_work(output):
        head, body = await ask(output, b"GET /metrics?x=1 HTTP/1.1\r\nHost: a\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK\r\nContent-Type: text/plain; version=0.0.4")
        assert f"Content-Length: {len(body)}".encode() in head
        assert read(body.decode())['fusiond_output_up{output="mqtt"}'] == 1.0
        assert (await ask(output, b"HEAD /metrics HTTP/1.1\r\n\r\n"))[1] == b""
        assert (await ask(output, b"GET / HTTP/1.1\r\n\r\n"))[0].startswith(b"HTTP/1.1 404")
        assert (await ask(output, b"POST /metrics HTTP/1.1\r\n\r\n"))[0].startswith(b"HTTP/1.1 405")
        assert await ask(output, b"x" * 70_000) == (b"", b"")
    assert output.counters["scrapes"] == 2
    assert output.counters["malformed"] == 2


def queries(node: Any) -> list[str]:
    """The expressions of every panel and variable."""
    if isinstance(node, dict):
        own = [node["expr"]] if "expr" in node else []
        return own + [q for value in node.values() for q in queries(value)]
    return [q for value in node for q in queries(value)] if isinstance(node, list) else []


def test_the_dashboard_asks_for_metrics_that_there_are() -> None:
    dashboard = json.loads(DASHBOARD.read_text())
    families = {family.name for family in endpoint().families()}
    asked = queries(dashboard)
    assert len(asked) >= len(dashboard["panels"])
    for expression in asked:
        names = re.findall(r"(?:fusiond|process)_\w+", expression)
        assert names, expression
        assert {re.sub(r"_bucket$", "", name) for name in names} <= families
