"""Home Assistant's discovery at a real broker, and `tracker`, which its map reads."""

from __future__ import annotations

import json
from math import nan
from pathlib import Path
from typing import Any

import pytest

from fusiond.configuration.load import ConfigError, load_config
from fusiond.configuration.outputs import HomeAssistant
from fusiond.configuration.schema import Mqtt
from fusiond.navigation.solution import Mode
from fusiond.outputs.home_assistant import HomeAssistantDiscovery, description
from fusiond.outputs.messages.tracker import LONGEST_NS, MOVED_M, SECOND_NS, Tracking
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import STATUS, TOPICS
from tests.broker import Broker, listening
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, at_work, nav
from tests.patience import until

METRE_DEG = 1.0 / 111_195.0
# Of homeassistant/components/mqtt/abbreviations.py in release 2025.4: what stands for what.
TOP = {"dev": "device", "o": "origin", "cmps": "components", "avty_t": "availability_topic",
       "pl_avail": "payload_available", "pl_not_avail": "payload_not_available"}  # fmt: skip
REQUIRED = {"p", "uniq_id", "name"}
BY_PLATFORM = {
    "device_tracker": {"src_type", "json_attr_t"},
    "sensor": {"stat_t", "val_tpl", "dev_cla", "ops", "unit_of_meas", "stat_cla", "exp_aft",
               "ent_cat"},
    "binary_sensor": {"stat_t", "val_tpl", "dev_cla", "ent_cat"},
}  # fmt: skip


def test_the_description_has_known_keys_and_topics_that_are_published() -> None:
    said = description("fusiond_truck", "truck", ("gnss", "front-imu"))
    assert said.keys() == TOP.keys()
    assert said["o"].keys() == {"name", "sw"}
    published = {f"fusiond/truck/{topic.name}" for topic in TOPICS}
    components: dict[str, dict[str, Any]] = said["cmps"]
    assert len({c["uniq_id"] for c in components.values()}) == len(components)
    for component in components.values():
        assert component.keys() >= REQUIRED
        assert component.keys() - REQUIRED <= BY_PLATFORM[component["p"]]
        for key in ("stat_t", "json_attr_t"):
            assert component.get(key, "fusiond/truck/status") in published
    assert "fusiond/truck/nav" not in json.dumps(said), "its recorder keeps every message"
    assert components["mode"]["ops"] == ["waiting", "aligning", "navigating", "coasting", "invalid"]
    wanted = "{{ 'ON' if value_json.sources['front-imu'].state == 'running' else 'OFF' }}"
    assert components["source_front_imu"]["val_tpl"] == wanted


async def test_the_broker_keeps_the_description_and_gets_it_again(tmp_path: Path) -> None:
    address = "homeassistant/device/fusiond_truck/config"
    with Broker(tmp_path) as broker:
        mqtt = MqttPublisher(
            Mqtt(host="127.0.0.1", port=broker.port), "truck", on_event=lambda *_: None
        )
        around = Around(mqtt=mqtt, sources=("gnss",)).surroundings
        output = HomeAssistantDiscovery(HomeAssistant(), around)
        async with at_work(mqtt), at_work(output):
            async with listening(broker, "homeassistant/#") as (listener, client):
                first = (await listener.until(lambda li: li.payloads(address)))[0]
                assert json.loads(first) == description("fusiond_truck", "truck", ("gnss",))
                await client.publish("homeassistant/status", b"offline", qos=1)
                await client.publish("homeassistant/status", b"online", qos=1)
                await listener.until(lambda li: len(li.payloads(address)) >= 2)
            assert output.counters["births"] == 1
            mqtt.publish(STATUS, EXAMPLES["status"])
            await until(lambda: mqtt.counters["mqtt_published"] >= 4)
        async with listening(broker, "homeassistant/#") as (late, _):
            await late.until(lambda li: li.payloads(address))
            assert [m.retain for m in late.messages] == [True]


def test_without_a_broker_it_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("[mqtt]\nenabled = false\n[outputs.home_assistant]\n")
    with pytest.raises(ConfigError, match=r"\[outputs.home_assistant\] needs \[mqtt\]"):
        load_config(path)


# ------------------------------------------------------------------ tracker


def test_a_tracker_comes_every_ten_seconds_or_twenty_metres_but_one_a_second() -> None:
    tracking = Tracking()
    assert tracking.due(0, nav(mode=Mode.ALIGNING)) is None
    first = tracking.due(1, nav(lat_deg=60.0, lon_deg=179.9999))
    assert first is not None
    assert first.gps_accuracy == pytest.approx((0.9**2 + 0.85**2) ** 0.5, abs=5e-3)

    def at(t_ns: int, east_m: float) -> bool:
        lon = 179.9999 + 2.0 * east_m * METRE_DEG  # a degree is half as long at 60 degrees
        return (
            tracking.due(t_ns, nav(lat_deg=60.0, lon_deg=(lon + 180.0) % 360.0 - 180.0)) is not None
        )

    assert not at(SECOND_NS // 2, 500.0)
    assert not at(2 * SECOND_NS, MOVED_M - 0.5)
    assert at(2 * SECOND_NS + 1, MOVED_M + 0.5)
    assert not at(LONGEST_NS + SECOND_NS, MOVED_M)
    assert at(LONGEST_NS + 2 * SECOND_NS + 2, MOVED_M)


def test_nothing_while_the_position_is_not_known() -> None:
    for unknown in ({"mode": Mode.INVALID}, {"sd_n_m": nan}, {"lat_deg": None}):
        assert Tracking().due(1, nav(**unknown)) is None
