"""Events: their level, and who hears them."""

from __future__ import annotations

import logging

import pytest

from fusiond.clock.clock import Clock
from fusiond.configuration.schema import ClockOptions
from fusiond.live.events import Events, level_of
from fusiond.outputs.messages.event import EventMessage


@pytest.mark.parametrize(
    ("code", "level"),
    [
        ("mode_navigating", "info"),
        ("mqtt_connected", "info"),
        ("mqtt_lost", "warning"),
        ("imu_gap", "warning"),
        ("rdss_suppressed", "warning"),
        ("isolated", "warning"),
        ("driver_fault", "error"),
        ("bus_open_failed", "error"),
        ("bus_off", "error"),
        ("saved_state_damaged", "warning"),
        ("warm_start_refused", "warning"),
        ("client_name_taken", "warning"),
    ],
)
def test_the_code_gives_the_level(code: str, level: str) -> None:
    assert level_of(code) == level


def test_an_event_is_logged_and_every_listener_hears_it(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="fusiond")
    events = Events(Clock(ClockOptions()))
    events.report("gnss", "early", "before there is a listener")
    first: list[EventMessage] = []
    second: list[EventMessage] = []
    events.listen(first.append)
    events.listen(second.append)
    events.report("imu", "driver_fault", "a defect: restarting it")
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
