"""`fusiond replay --speed`: a dashboard plays a recording."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

from fusiond.replay.replay_output import ReplayOptions, replay
from tests.broker import Broker, listening
from tests.recording.driven import Drive


async def test_a_replay_is_published_like_the_drive(tmp_path: Path) -> None:
    drive = Drive(tmp_path / "logs", 8.0)
    drive.run(3.0)
    paths = drive.close()
    with Broker(tmp_path) as broker:
        where = ("mqtt.enabled=true", "mqtt.host=127.0.0.1", f"mqtt.port={broker.port}")
        wish = ReplayOptions(settings=(*where, "vehicle=again"), speed=2.0)
        async with listening(broker, "fusiond/again/#") as (listener, _):
            summary = await asyncio.to_thread(replay, paths, wish)
            await listener.until(lambda li: b"offline" in li.payloads("fusiond/again/online"))
    assert summary["ticks"] == len(drive.solutions)
    for topic in ("nav", "status", "health", "event"):
        assert listener.payloads(f"fusiond/again/{topic}"), topic
    status = json.loads(listener.payloads("fusiond/again/status")[-1])
    assert status["mode"] == drive.solutions[-1].mode
    health = json.loads(listener.payloads("fusiond/again/health")[-1])
    assert health["sources"]["gnss"]["state"] == "running"
