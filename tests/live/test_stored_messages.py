"""Short messages that lie on disk: what goes on after a restart, and what does not."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.rdss_message_keeper import MessageKeeper
from fusiond.live.rdss_messaging import MOST_UNCONFIRMED
from fusiond.live.restored_state import RESTORED_STATE, RestoredState
from fusiond.live.stored_messages import KEPT_MESSAGES, KeptMessages
from fusiond.navigator.state_file import MOST_BYTES, DamagedStateError, read_state
from fusiond.outputs.commands import CommandRefusedError, SendMessage
from tests.live.message_desk import OTHER, Desk


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
    desk.messaging.confirm(before[1])
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
    for _ in range(3 * MOST_UNCONFIRMED):
        desk.received(payload=b"\xa4" + b"\xff" * 209, text="\\u" * 100)
    assert desk.drivers["rdss"].counters["message_untold"] > 0
    from fusiond.live.rdss_message_keeper import _text  # noqa: PLC0415

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
    recorded = json.dumps(RESTORED_STATE.dump_python(RestoredState(messages=messages), mode="json"))
    again = Chain(desk.config, desk.clock, Events(desk.clock))
    RESTORED_STATE.validate_json(recorded).restore_into(again)
    boxes = [c.sources.all["rdss"].driver.outbox.waiting for c in (daemon, again)]  # type: ignore[attr-defined]
    assert boxes[0] == boxes[1] != []
    assert [m for _, m in daemon.messaging.take_waiting()] == [
        m for _, m in again.messaging.take_waiting()
    ]
    command = SendMessage(id="m2", card=OTHER, text="bye")
    said = {c.operator.carry_out(command, desk.clock.now_ns()) for c in (daemon, again)}
    assert said == {"queued for card 0242407, 2 waiting"}
