"""Short messages in the daemon: commands, reports, the fleet, and what lies on disk."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from drivers.rdss.mail import FleetFix
from drivers.rdss.position_report_coding import (
    REPORT,
    SHORT_REPORT,
    PositionReport,
    decode_report,
    encode_short,
)
from fusiond.configuration.schema import Config
from fusiond.live.rdss_messaging import MOST_CARDS
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.commands import BadCommandError, CommandRefusedError, parse
from fusiond.outputs.messages.fleet import FleetMessage
from fusiond.outputs.messages.short_message import ShortMessage
from tests.live.message_desk import OTHER, SOLUTION, UTC_NS, Desk, S

# --------------------------------------------------------------------------- commands


def test_a_command_queues_a_text_and_says_so_on_the_topic() -> None:
    desk = Desk()
    assert desk.send(receipt=True) == "queued for card 0242407, 1 waiting"
    ((path, message),) = desk.told()
    assert path == "message"
    assert isinstance(message, ShortMessage)
    assert (message.id, message.state, message.text, message.over) == ("m1", "queued", "hello", 0)
    assert message.receipt
    with pytest.raises(CommandRefusedError, match="queued already under this id"):
        desk.send()


def test_a_command_names_its_terminal_where_there_are_several() -> None:
    desk = Desk(("a", "b"))
    with pytest.raises(CommandRefusedError, match="name one as source: a, b"):
        desk.send()
    with pytest.raises(CommandRefusedError, match="no terminal 'c'"):
        desk.send(source="c")
    desk.send(source="b")
    assert len(desk.drivers["b"].outbox.waiting) == 1
    with pytest.raises(CommandRefusedError, match="there is no RDSS terminal"):
        Desk(()).send()


@pytest.mark.parametrize(
    "payload",
    [
        {"card": 0, "text": "x"},
        {"card": 10_000_000, "text": "x"},
        {"card": "242407", "text": "x"},
        {"card": OTHER, "text": ""},
        {"card": OTHER, "text": "x" * 211},
        {"card": OTHER, "text": 5},
        {"card": OTHER},
        {"card": OTHER, "text": "x", "receipt": "yes"},
        {"card": OTHER, "text": "x", "hex": "00"},
        {"card": OTHER, "text": "\ud800"},
    ],
)
def test_commands_that_are_none_are_refused_by_name(payload: dict[str, Any]) -> None:
    with pytest.raises(BadCommandError):
        parse("send_message", json.dumps({"id": "a", **payload}).encode())


# --------------------------------------------------------------------------- reports


def posted(desk: Desk) -> list[PositionReport]:
    waiting = desk.drivers["rdss"].outbox.waiting
    return [decode_report(REPORT, m.wordings[0].payload[2:-2]) for m in waiting]


def test_reports_go_out_at_their_interval_and_the_newest_waits() -> None:
    desk = Desk(card=OTHER, interval_s=10.0)
    t_ns = desk.clock.now_ns()
    for k in range(25):
        now = t_ns + k * S
        desk.messaging.tick(now, SOLUTION._replace(t_ns=now, height_m=float(k)))
    (report,) = posted(desk)
    assert report.height_m == 20.0
    assert report.t_s == pytest.approx(UTC_NS / S + 20.0, abs=1.0)
    assert (report.speed_m_s, report.mode) == (5.0, "navigating")
    assert report.course_deg == pytest.approx(53.13, abs=0.01)
    states = [m.state for _, m in desk.told()]
    assert states == ["queued", "superseded", "queued", "superseded", "queued"]


def test_an_event_is_reported_with_the_next_solution_that_has_a_place() -> None:
    desk = Desk(card=OTHER, events=["mode_coasting"])
    t_ns = desk.clock.now_ns()
    desk.messaging.note_event("mode_navigating")
    desk.messaging.tick(t_ns, SOLUTION._replace(t_ns=t_ns))
    assert not posted(desk)
    desk.messaging.note_event("mode_coasting")
    desk.messaging.tick(t_ns, Solution(t_ns, Mode.WAITING, "no IMU data yet"))
    assert not posted(desk)
    desk.messaging.tick(t_ns, SOLUTION._replace(t_ns=t_ns, height_m=math.nan))
    (report,) = posted(desk)
    assert report.height_m is None


def test_a_card_that_may_not_report_says_so_once() -> None:
    desk = Desk(card=OTHER, interval_s=1.0)
    desk.drivers["rdss"].outbox.comm_level = 0
    t_ns = desk.clock.now_ns()
    for k in range(5):
        desk.messaging.tick(t_ns + k * S, SOLUTION._replace(t_ns=t_ns))
    assert [code for _, code, _ in desk.events] == ["report_refused"]
    assert desk.drivers["rdss"].counters["message_forbidden"] == 5


@pytest.mark.parametrize(
    ("reports", "why"),
    [
        ({"card": OTHER}, "needs interval_s, events or both"),
        ({"card": OTHER, "interval_s": 60.0, "source": "roof"}, "no terminal 'roof'"),
        ({"card": OTHER, "events": ["Mode"]}, "should match pattern"),
    ],
)
def test_reports_that_cannot_go_are_mistakes(reports: dict[str, Any], why: str) -> None:
    sources = {"rdss": {"driver": "rdss", "port": "/dev/rdss"}}
    with pytest.raises(ValueError, match=why):
        Config.model_validate({"sources": sources, "position_reports": reports})
    with pytest.raises(ValueError, match="needs a source with driver 'rdss'"):
        Config.model_validate({"position_reports": {"card": OTHER, "interval_s": 60.0}})


# --------------------------------------------------------------------------- what comes

HERE = PositionReport(UTC_NS / S - 5.0, 30.0, 114.0, "coasting", (1.0, 2.0, 3.0), 40.0, 5.0, 9.0)


def test_a_report_is_told_as_a_message_and_as_a_place() -> None:
    desk = Desk()
    desk.received(kind="report", text=None, report=HERE)
    (first, message), (second, place) = desk.told()
    assert (first, second) == ("message", f"fleet/{OTHER}")
    assert (message.direction, message.kind, message.sent_at) == ("received", "report", "10:15")
    assert isinstance(place, FleetMessage)
    assert (place.card, place.mode, place.by) == (OTHER, "coasting", "report")
    assert place.t_ms == UTC_NS // 1_000_000 - 5000
    desk.received(kind="report", text=None, report=HERE._replace(t_s=HERE.t_s - 60.0))
    assert [path for path, _ in desk.told()] == ["message"]
    assert desk.drivers["rdss"].counters["fleet_overtaken"] == 1


@pytest.mark.parametrize(("ahead_s", "days"), [(-30.0, 0), (30.0, 0), (3600.0, 1)])
def test_a_report_without_a_date_is_of_the_last_day(ahead_s: float, days: int) -> None:
    desk = Desk()
    t_s = UTC_NS / S + ahead_s
    short = decode_report(SHORT_REPORT, encode_short(HERE._replace(t_s=t_s)))
    desk.received(kind="report", text=None, report=short)
    _, (_, place) = desk.told()
    assert place.t_ms == (int(t_s) - days * 86400) * 1000


def test_a_fix_that_the_centre_passes_on_is_a_place() -> None:
    desk = Desk()
    fix = FleetFix("rdss", desk.clock.now_ns(), OTHER, 0.0, 30.0, 114.0, 40.0, 100.0)
    desk.messaging.receive(fix)
    ((path, place),) = desk.told()
    assert (path, place.by, place.sd_n_m, place.mode) == (f"fleet/{OTHER}", "centre", 100.0, None)


def test_more_cards_than_a_fleet_has_are_counted_and_not_told() -> None:
    desk = Desk()
    for card in range(1, MOST_CARDS + 3):
        fix = FleetFix("rdss", desk.clock.now_ns(), card, 0.0, 30.0, 114.0, 40.0, 100.0)
        desk.messaging.receive(fix)
    assert len(desk.told()) == MOST_CARDS
    assert desk.drivers["rdss"].counters["fleet_full"] == 2


@pytest.mark.parametrize("fault", ["crc", "cut", "damaged", "version", "other_card"])
def test_what_is_wrong_with_a_message_is_said(fault: str) -> None:
    desk = Desk()
    desk.received(fault=fault, text=None)
    ((_, message),) = desk.told()
    assert (message.fault, message.hex) == (fault, "a46869")
    ((_, code, _),) = desk.events
    assert code == f"message_{fault}"
