"""OwnTracks' locations at a real broker."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fusiond.configuration.outputs import OwnTracks
from fusiond.configuration.schema import Mqtt
from fusiond.outputs.messages.tracker import tracker_message
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.owntracks import OwnTracksLocations
from fusiond.outputs.topics import NAV, TRACKER
from tests.broker import Broker, listening
from tests.outputs.serving import Around, at_work, nav

ADDRESS = "owntracks/fusiond/truck"


def told(output: OwnTracksLocations, **changed: Any) -> None:
    """A `nav` and the `tracker` that is made of it."""
    message = nav(**changed)
    output.publish(NAV, message)
    tracker = tracker_message(nav(lat_deg=message.lat_deg))
    assert tracker is not None
    output.publish(TRACKER, tracker)


async def test_a_location_has_what_the_booklet_says_and_is_retained(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        mqtt = MqttPublisher(
            Mqtt(host="127.0.0.1", port=broker.port), "truck", on_event=lambda *_: None
        )
        output = OwnTracksLocations(OwnTracks(), Around(mqtt=mqtt).surroundings)
        told(output, t_ms=None)  # UTC is not settled
        assert (output.counters["undated"], output.counters["locations"]) == (1, 0)
        async with (
            at_work(mqtt),
            at_work(output),
            listening(broker, "owntracks/#") as (listener, _),
        ):
            told(output)
            first = (await listener.until(lambda li: li.payloads(ADDRESS)))[0]
            told(output, v_n_m_s=0.01, v_e_m_s=0.0, height_m=None)
            at_rest = (await listener.until(lambda li: li.payloads(ADDRESS)[1:]))[0]
        assert json.loads(first) == {
            "_type": "location",
            "lat": 31.0254389,
            "lon": 121.4412095,
            "tst": 1_795_217_587,
            "tid": "ck",
            "acc": 1,
            "alt": 6,
            "vac": 2,
            "vel": 30,
            "cog": 346,
        }
        said = json.loads(at_rest)
        assert said["vel"] == 0
        assert not {"cog", "alt", "vac"} & said.keys()
        async with listening(broker, "owntracks/#") as (late, _):
            await late.until(lambda li: li.payloads(ADDRESS))
            assert [m.retain for m in late.messages] == [True]
