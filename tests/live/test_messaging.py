"""Short messages in the daemon: commands, reports, the fleet, and what lies on disk."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.measurements import TimeReport
from drivers.rdss.driver import RdssDriver, RdssOptions
from drivers.rdss.mail import FleetFix, MessageReceived
from drivers.rdss.report import (
    REPORT,
    SHORT_REPORT,
    PositionReport,
    decode_report,
    encode_short,
)
from fusiond.clock.clock import Clock
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.kept_messages import KEPT_MESSAGES, KeptMessages
from fusiond.live.loaded import LOADED, Loaded
from fusiond.live.message_keeper import MessageKeeper
from fusiond.live.messaging import MOST_CARDS, MOST_UNTOLD, Messaging
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.state_file import MOST_BYTES, DamagedStateError, read_state
from fusiond.outputs.commands import BadCommandError, CommandRefusedError, SendMessage, parse
from fusiond.outputs.messages.fleet import FleetMessage
from fusiond.outputs.messages.short_message import ShortMessage

S = 1_000_000_000
OTHER = 242407
UTC_NS = 1_795_217_587 * S
SOLUTION = Solution(
    0,
    Mode.NAVIGATING,
    "aided by gnss",
    lat_rad=math.radians(30.0),
    lon_rad=math.radians(114.0),
    height_m=38.0,
    v_ned_m_s=(3.0, 4.0, 0.0),
    sd_ned_m=(3.0, 4.0, 2.0),
)


class Desk:
    """Messaging with real drivers whose lines nobody opens."""

    def __init__(self, names: tuple[str, ...] = ("rdss",), **reports: Any) -> None:
        sources = {name: {"driver": "rdss", "port": f"/dev/{name}"} for name in names}
        self.config = Config.model_validate({"sources": sources, "position_reports": reports})
        self.clock = Clock(self.config.clock)
        now_ns = self.clock.now_ns()
        self.clock.report(TimeReport("gnss", now_ns, UTC_NS, trusted=True))
        self.clock.report(TimeReport("gnss", now_ns, UTC_NS, trusted=True))
        self.events: list[tuple[str, str, str]] = []
        self.drivers = {
            name: RdssDriver(name, RdssOptions(port=f"/dev/{name}"), self._emit, self.clock.now_ns)
            for name in names
        }
        self.messaging = Messaging(
            self.config, self.clock, self.drivers, lambda *event: self.events.append(event)
        )

    def _emit(self, item: Any) -> None:
        self.messaging.take(item)

    def send(self, text: str = "hello", **more: Any) -> str:
        command = {"id": "m1", "card": OTHER, "text": text, **more}
        return self.messaging.send(SendMessage.model_validate(command), self.clock.now_ns())

    def told(self) -> list[tuple[str, Any]]:
        return [(topic.path, message) for topic, message in self.messaging.take_waiting()]

    def received(self, **given: Any) -> None:
        mail = {
            "source": "rdss",
            "t_seen_ns": self.clock.now_ns(),
            "sender": OTHER,
            "receiver": 242286,
            "kind": "text",
            "payload": b"\xa4hi",
            "encoding": "mixed",
            "text": "hi",
            "minute_of_day": 615,
        }
        self.messaging.take(MessageReceived(**{**mail, **given}))


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
        desk.messaging.tick(now, replace(SOLUTION, t_ns=now, height_m=float(k)))
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
    desk.messaging.heard("mode_navigating")
    desk.messaging.tick(t_ns, replace(SOLUTION, t_ns=t_ns))
    assert not posted(desk)
    desk.messaging.heard("mode_coasting")
    desk.messaging.tick(t_ns, Solution(t_ns, Mode.WAITING, "no IMU data yet"))
    assert not posted(desk)
    desk.messaging.tick(t_ns, replace(SOLUTION, t_ns=t_ns, height_m=math.nan))
    (report,) = posted(desk)
    assert report.height_m is None


def test_a_card_that_may_not_report_says_so_once() -> None:
    desk = Desk(card=OTHER, interval_s=1.0)
    desk.drivers["rdss"].outbox.comm_level = 0
    t_ns = desk.clock.now_ns()
    for k in range(5):
        desk.messaging.tick(t_ns + k * S, replace(SOLUTION, t_ns=t_ns))
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
    desk.messaging.take(fix)
    ((path, place),) = desk.told()
    assert (path, place.by, place.sd_n_m, place.mode) == (f"fleet/{OTHER}", "centre", 100.0, None)


def test_more_cards_than_a_fleet_has_are_counted_and_not_told() -> None:
    desk = Desk()
    for card in range(1, MOST_CARDS + 3):
        fix = FleetFix("rdss", desk.clock.now_ns(), card, 0.0, 30.0, 114.0, 40.0, 100.0)
        desk.messaging.take(fix)
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


# --------------------------------------------------------------------------- on disk


def keeper(desk: Desk, path: Path) -> tuple[MessageKeeper, list[tuple[str, str]]]:
    events: list[tuple[str, str]] = []
    config = desk.config.model_copy(update={"state_file": path / "v.json"})
    return MessageKeeper(config, desk.clock, lambda *e: events.append(e)), events


async def again(desk: Desk, folder: Path) -> Desk:
    """What another process makes of what this one has kept."""
    kept, _ = keeper(desk, folder)
    assert await kept.kept(desk.messaging.revision, desk.messaging) == ""
    other = Desk()
    assert keeper(other, folder)[0].load(other.messaging) is not None
    return other


async def test_what_waits_and_what_nobody_was_told_goes_on(tmp_path: Path) -> None:
    desk = Desk()
    desk.send(receipt=True)
    desk.send("bye", id="m2")
    desk.received()
    outbox = desk.drivers["rdss"].outbox
    outbox.written(outbox.waiting[0])
    before = [message for _, message in desk.told()]
    desk.messaging.told(before[1])
    other = await again(desk, tmp_path)
    waiting = other.drivers["rdss"].outbox.waiting
    assert [(m.key, m.text, m.attempts) for m in waiting] == [("m1", "hello", 1), ("m2", "bye", 0)]
    assert waiting[0].wordings == outbox.waiting[0].wordings, "the receiver must know it again"
    assert waiting[0].receipted == outbox.waiting[0].receipted
    told = [message for _, message in other.told()]
    assert told[:2] == [before[0], before[2]]
    assert [(m.id, m.why) for m in told[2:]] == [(k, "kept over a restart") for k in ("m1", "m2")]
    assert told[2].serial > before[2].serial
    with pytest.raises(CommandRefusedError, match="queued already"):
        other.send()


async def test_a_receipt_that_is_awaited_is_asked_for_again_after_a_restart(tmp_path: Path) -> None:
    desk = Desk()
    desk.send(receipt=True)
    outbox = desk.drivers["rdss"].outbox
    outbox.written(outbox.waiting[0])
    outbox.accepted(desk.clock.now_ns())
    other = await again(desk, tmp_path)
    (waiting,) = other.drivers["rdss"].outbox.waiting
    assert (waiting.stage, waiting.attempts) == ("queued", 1)
    assert waiting.receipted is not None
    other.drivers["rdss"].outbox.receipt(OTHER, waiting.receipted)
    assert not other.drivers["rdss"].outbox.waiting


async def test_messages_age_while_nobody_runs(tmp_path: Path) -> None:
    desk = Desk()
    desk.send()
    kept, _ = keeper(desk, tmp_path)
    await kept.kept(desk.messaging.revision, desk.messaging)
    path = tmp_path / "v.messages.json"
    state = read_state(path, KEPT_MESSAGES)
    assert state is not None
    assert state.utc_s is not None
    path.write_bytes(KEPT_MESSAGES.dump_json(replace(state, utc_s=state.utc_s - 1000.0)))
    found = keeper(desk, tmp_path)[0].load(Desk().messaging)
    assert found is not None
    aged = KEPT_MESSAGES.validate_json(found)
    assert aged.boxes["rdss"].waiting[0].age_s == pytest.approx(1000.0, abs=5.0)


async def test_a_terminal_that_is_no_more_gives_its_messages_up_and_says_so(tmp_path: Path) -> None:
    desk = Desk(("a", "b"))
    desk.send(source="b")
    kept, _ = keeper(desk, tmp_path)
    await kept.kept(desk.messaging.revision, desk.messaging)
    other = Desk(("a",))
    assert keeper(other, tmp_path)[0].load(other.messaging) is not None
    assert [code for _, code, _ in other.events] == ["message_failed"]


async def test_a_disk_that_cannot_be_written_is_said_once_and_in_the_reply(tmp_path: Path) -> None:
    desk = Desk()
    kept, events = keeper(desk, tmp_path / "nowhere")
    for n in range(2):
        desk.send(id=f"m{n}")
        said = await kept.kept(desk.messaging.revision, desk.messaging)
        assert said.startswith("not kept on disk")
    assert [code for code, _ in events] == ["messages_not_kept"]
    (tmp_path / "nowhere").mkdir()
    desk.send(id="m9")
    kept.keep(0, desk.messaging)
    await kept.close(0, desk.messaging)
    assert (tmp_path / "nowhere" / "v.messages.json").exists()


async def test_without_a_state_file_the_reply_says_that_nothing_is_kept(tmp_path: Path) -> None:
    desk = Desk()
    nowhere = MessageKeeper(desk.config, desk.clock, lambda *e: None, environ={})
    desk.send()
    assert "not kept over a restart" in await nowhere.kept(1, desk.messaging)


def test_the_fullest_state_fits_its_file() -> None:
    desk = Desk()
    for n in range(32):
        desk.send("x" * 203, id=f"{n:064d}", receipt=True)
    for _ in range(3 * MOST_UNTOLD):
        desk.received(payload=b"\xa4" + b"\xff" * 209, text="\\u" * 100)
    assert desk.drivers["rdss"].counters["message_untold"] > 0
    from fusiond.live.message_keeper import _text  # noqa: PLC0415

    text = _text(desk.messaging.state(desk.clock.now_ns()))
    assert len(text) <= MOST_BYTES - 100
    assert len(KEPT_MESSAGES.validate_json(text).boxes["rdss"].waiting) == 32


@given(st.binary(max_size=400))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_lies_there_a_start_outlives_it(tmp_path: Path, data: bytes) -> None:
    desk = Desk()
    desk.send()
    good = KEPT_MESSAGES.dump_json(desk.messaging.state(desk.clock.now_ns()))
    for text in (data, good[: len(data)], good[: len(data)] + data + good[2 * len(data) :]):
        (tmp_path / "v.messages.json").write_bytes(text)
        other = Desk()
        kept, events = keeper(other, tmp_path)
        found = kept.load(other.messaging)
        assert (found is None) == (bool(events) and events[0][0] == "messages_damaged")


def test_a_directory_or_a_pipe_is_put_aside(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "v.messages.json")
    kept, events = keeper(Desk(), tmp_path)
    assert kept.load(Desk().messaging) is None
    assert events[0][0] == "messages_damaged"


def test_what_is_kept_round_trips() -> None:
    desk = Desk()
    desk.send(receipt=True)
    state = desk.messaging.state(desk.clock.now_ns())
    assert KEPT_MESSAGES.validate_json(KEPT_MESSAGES.dump_json(state)) == state
    assert isinstance(state, KeptMessages)
    with pytest.raises(DamagedStateError):
        read_state(Path("/dev/null"), KEPT_MESSAGES)


async def test_a_replay_starts_from_the_messages_that_the_daemon_had_loaded(tmp_path: Path) -> None:
    desk = Desk()
    desk.send(receipt=True)
    kept, _ = keeper(desk, tmp_path)
    await kept.kept(desk.messaging.revision, desk.messaging)
    daemon = Chain(desk.config, desk.clock, Events(desk.clock))
    messages = keeper(desk, tmp_path)[0].load(daemon.messaging)
    recorded = json.dumps(LOADED.dump_python(Loaded(messages=messages), mode="json"))
    again = Chain(desk.config, desk.clock, Events(desk.clock))
    LOADED.validate_json(recorded).offer(again)
    boxes = [c.sources.all["rdss"].driver.outbox.waiting for c in (daemon, again)]  # type: ignore[attr-defined]
    assert boxes[0] == boxes[1] != []
    assert [m for _, m in daemon.messaging.take_waiting()] == [
        m for _, m in again.messaging.take_waiting()
    ]
    command = SendMessage(id="m2", card=OTHER, text="bye")
    said = {c.operator.carry_out(command, desk.clock.now_ns()) for c in (daemon, again)}
    assert said == {"queued for card 0242407, 2 waiting"}
