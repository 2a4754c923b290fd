"""Events: log, level, advice and listeners."""

from __future__ import annotations

import logging
from typing import Any, cast

import pytest

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions, Config
from fusiond.live.events import Events
from fusiond.live.injection import Injection
from fusiond.live.sources import Sources
from fusiond.outputs.messages.event import EventMessage
from tests.clock.host_time import Host, S


def test_an_event_is_logged_and_every_listener_hears_it(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="fusiond")
    events = Events(Clock(ClockOptions()))
    events.report("gnss", "early", "before there is a listener")
    first: list[EventMessage] = []
    second: list[EventMessage] = []
    events.listen(first.append)
    events.listen(second.append)
    events.report("imu", "driver_fault", "a defect: restarting it")
    assert [e.advice for e in first] == ["", "Report the text of the event as a bug."]
    heard = [(e.source, e.code, e.level, e.text) for e in first]
    assert heard == [
        ("gnss", "early", "info", "before there is a listener"),
        ("imu", "driver_fault", "error", "a defect: restarting it"),
    ]
    assert second == first[1:]
    assert [(r.levelno, r.getMessage()) for r in caplog.records] == [
        (logging.INFO, "gnss: early: before there is a listener"),
        (logging.ERROR, "imu: driver_fault: a defect: restarting it"),
    ]


def test_what_happens_to_the_clock_is_an_event() -> None:
    host = Host()
    clock = Clock(ClockOptions(), host)
    events = Events(clock)
    heard: list[EventMessage] = []
    events.listen(heard.append)
    Sources(Config(), clock, cast(Any, None), Injection(events.report), events.report)
    host.suspend(20 * S)
    host.system_error = 2 * S
    clock.utc_ns(host.mono)
    assert [(e.source, e.code, e.text) for e in heard] == [
        ("clock", "host_resumed", "the host was suspended for 20.0 s"),
        ("clock", "system_clock_stepped", "the system clock was set by +2.000 s"),
    ]
