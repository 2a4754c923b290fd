"""What is kept of a vehicle's words, how old it may be, and what a viewer is told of it."""

from __future__ import annotations

import pytest

from fusiond.dashboard.vehicle import (
    LIMITS_S,
    MOST_CARDS,
    MOST_INNOVATIONS,
    MOST_ROWS,
    ROW_EVERY_S,
    Vehicle,
)
from tests.dashboard.serving import NAMES, said


def latest(vehicle: Vehicle, count: int = 0) -> dict[str, dict[str, object]]:
    messages = vehicle.since(count)["messages"]
    assert isinstance(messages, dict)
    return messages


def test_every_topic_is_taken() -> None:
    vehicle = Vehicle("truck")
    vehicle.receive("online", "online", 0.5)
    for k, topic in enumerate(NAMES):
        vehicle.receive(topic, said(topic), 1.0 + k)
    new = vehicle.since(0)
    for k, topic in enumerate(NAMES):
        if topic in ("event", "message"):
            assert new["rows"][topic] == [[1.0 + k, said(topic)]]
        elif topic == "fleet":
            assert new["messages"]["fleet/242407"]["said"] == said("fleet")
        elif topic not in ("tracker", "innovations", "events"):  # `nav` says it better; rows do
            assert new["messages"][topic]["said"] == said(topic)
            assert new["messages"][topic]["at"] == 1.0 + k
    assert new["rows"]["nav"][0][3:5] == [said("nav")["lat_deg"], said("nav")["lon_deg"]]
    assert [row[1:] for row in new["rows"]["nis"]] == [["rdss", 0.893, 0.7422, 1.2956]]
    assert new["messages"]["online"]["said"] == "online"


def test_other_vehicles_are_kept_by_card_and_no_more_than_a_daemon_tells() -> None:
    vehicle = Vehicle("truck")
    for card in range(MOST_CARDS + 5):
        vehicle.receive("fleet", {**said("fleet"), "card": card}, 1.0)
    vehicle.receive("fleet", {**said("fleet"), "card": 0, "lat_deg": 1.0}, 2.0)
    messages = latest(vehicle)
    assert len(messages) == MOST_CARDS
    first = messages["fleet/0"]["said"]
    assert isinstance(first, dict)
    assert first["lat_deg"] == 1.0


def test_events_before_the_first_look_are_those_that_the_broker_has_kept() -> None:
    vehicle = Vehicle("truck")
    vehicle.receive("events", said("events"), 5.0, kept=True)
    vehicle.receive("event", said("event"), 6.0)
    vehicle.receive("events", said("events"), 6.0)
    told = said("events")["events"]
    expected = [*([None, one] for one in told), [6.0, said("event")]]
    assert vehicle.since(0)["rows"]["event"] == expected


def test_only_what_is_new_is_told() -> None:
    vehicle = Vehicle("truck")
    vehicle.receive("nav", said("nav"), 1.0)
    vehicle.receive("status", said("status"), 1.0)
    count = vehicle.count
    assert vehicle.since(count) == {"messages": {}, "rows": {}}
    vehicle.receive("nav", said("nav", height_m=5.0), 1.1)
    vehicle.receive("nav", said("nav", height_m=6.0), 1.0 + ROW_EVERY_S)
    assert set(latest(vehicle, count)) == {"nav"}
    assert latest(vehicle, count)["nav"]["said"]["height_m"] == 6.0  # type: ignore[index]
    assert [row[5] for row in vehicle.since(count)["rows"]["nav"]] == [6.0]


def test_retained_messages_have_no_age() -> None:
    vehicle = Vehicle("truck")
    vehicle.receive("status", said("status"), 100.0, kept=True)
    vehicle.receive("health", said("health"), 100.0, kept=True)
    vehicle.receive("consistency", said("consistency"), 100.0, kept=True)
    assert latest(vehicle)["status"]["at"] is None
    assert "nis" not in vehicle.since(0)["rows"]
    vehicle.receive("status", said("status"), 101.0)
    assert latest(vehicle)["status"]["at"] == 101.0


@pytest.mark.parametrize(
    ("every_s", "limit_s"), [(0.1, LIMITS_S["health"]), (1.0, 3.0), (5.0, 15.0), (10.0, 30.0)]
)
def test_a_topic_is_old_after_three_of_its_own_intervals(every_s: float, limit_s: float) -> None:
    vehicle = Vehicle("truck")
    for k in range(6):
        vehicle.receive("health", said("health"), k * every_s)
    assert vehicle.limit_s("health") == pytest.approx(limit_s)


def test_a_long_silence_does_not_make_what_comes_later_young() -> None:
    vehicle = Vehicle("truck")
    for at_s in (0.0, 0.1, 0.2, 0.3, 600.0, 600.1, 600.2):
        vehicle.receive("nav", said("nav"), at_s)
    assert vehicle.limit_s("nav") == LIMITS_S["nav"]


def test_invalid_messages_are_ignored() -> None:
    vehicle = Vehicle("truck")
    vehicle.receive("nav", [1, 2], 0.0)
    vehicle.receive("online", "maybe", 0.0)
    vehicle.receive("cmd", {"id": "a"}, 0.0)
    vehicle.receive("event", 5, 0.0)
    assert vehicle.count == 0
    vehicle.receive("nav", {"lat_deg": "here", "mode": 7, "t_ms": True}, 0.0)
    vehicle.receive("health", {"sources": {"gnss": 5, "rdss": {"counters": []}}}, 0.0)
    vehicle.receive("health", {"sources": []}, 1.0)
    assert vehicle.since(0)["rows"] == {"nav": [[0.0, *[None] * 12]]}


def test_history_is_bounded_and_in_order() -> None:
    vehicle = Vehicle("truck")
    for k in range(MOST_ROWS["nav"] + 50):
        vehicle.receive("nav", said("nav"), k * ROW_EVERY_S)
    for k in range(MOST_ROWS["event"] + 5):
        vehicle.receive("event", said("event"), k)
    rows = vehicle.since(0)["rows"]
    times = [row[0] for row in rows["nav"]]
    assert len(times) == MOST_ROWS["nav"]
    assert times == sorted(times)
    assert times[-1] == (MOST_ROWS["nav"] + 49) * ROW_EVERY_S
    assert len(rows["event"]) == MOST_ROWS["event"]


def test_each_fix_of_a_terminal_has_one_delay() -> None:
    vehicle = Vehicle("truck")
    source = said("health")["sources"]["rdss"]

    def terminal(received: int, latency_s: float) -> dict[str, object]:
        counters = {"requested": received + 1}
        rdss = {**source, "received": received, "latency_s": latency_s, "counters": counters}
        return {"sources": {"rdss": rdss, "gnss": said("health")["sources"]["gnss"]}}

    for k, (received, latency_s) in enumerate([(1, 1.4), (1, 1.4), (2, 0.9), (2, 0.9), (2, 0.9)]):
        vehicle.receive("health", terminal(received, latency_s), float(k))
    assert vehicle.since(0)["rows"]["delay"] == [[0.0, "rdss", 1.4], [2.0, "rdss", 0.9]]


def test_innovations_of_a_bundle_stand_at_their_validity() -> None:
    vehicle = Vehicle("truck")
    for at_s in (10.0, 11.0):  # the same two again: a rewind
        vehicle.receive("innovations", said("innovations"), at_s)
    rows = vehicle.since(0)["rows"]["innovation"]
    assert [row[1:] for row in rows] == [["gnss", "fused", 2.114, 3], ["rdss", "gated", 31.9, 2]]
    assert [row[0] for row in rows] == pytest.approx([10.0 - 0.071, 10.0 - 1.42])
    count = vehicle.count
    for bad in ({}, {"innovations": 5}, {"t_ms": 1, "innovations": [3, {"source": 1}]}):
        vehicle.receive("innovations", bad, 12.0)
    assert vehicle.count == count


def test_an_innovation_that_comes_again_takes_the_place_of_the_first() -> None:
    vehicle = Vehicle("truck")

    def innovation(t_ns: int, outcome: str, nis: float | None) -> dict[str, object]:
        return {"t_ns": t_ns, "source": "gnss", "outcome": outcome, "nis": nis, "degrees": 3}

    vehicle.receive("innovation", innovation(1, "gated", 40.0), 1.0)
    vehicle.receive("innovation", innovation(2, "fused", 3.0), 2.0)
    count = vehicle.count
    vehicle.receive("innovation", innovation(1, "fused", 2.5), 3.0)
    vehicle.receive("innovation", {"source": "gnss"}, 4.0)
    assert vehicle.since(count)["rows"]["innovation"] == [[1.0, "gnss", "fused", 2.5, 3]]
    assert vehicle.since(0)["rows"]["innovation"] == [
        [2.0, "gnss", "fused", 3.0, 3],
        [1.0, "gnss", "fused", 2.5, 3],
    ]
    for t_ns in range(MOST_INNOVATIONS + 100):
        vehicle.receive("innovation", innovation(t_ns, "fused", 1.0), float(t_ns))
    assert len(vehicle.since(0)["rows"]["innovation"]) == MOST_INNOVATIONS


def _told_late(vehicle: Vehicle) -> bool:
    return any("was late" in step.text for step in vehicle.said("advice") or ())


def test_an_alarm_ends_a_minute_after_what_it_tells_of() -> None:
    """Ticks that came late when the daemon began are no reason to look at the computer now."""
    vehicle, sound = Vehicle("truck"), {**said("health"), "utc_settled": True}
    told = []
    for second in range(200):
        late = 5 * min(second, 20)  # of the first 20 s
        vehicle.receive("health", {**sound, "ticks": 100 * second, "overruns": late}, float(second))
        told.append(_told_late(vehicle))
    assert told[15]
    assert told[60]
    assert not any(told[81:])


def test_a_daemon_that_begins_anew_begins_without_alarms() -> None:
    vehicle = Vehicle("truck")
    for second in range(30):
        health = {**said("health"), "ticks": 100 * second, "overruns": 10 * second}
        vehicle.receive("health", health, float(second))
    assert _told_late(vehicle)
    vehicle.receive("health", {**said("health"), "ticks": 50, "overruns": 0}, 31.0)
    assert not _told_late(vehicle)
