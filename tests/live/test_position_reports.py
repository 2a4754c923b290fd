"""Position reports of a daemon that navigates, and those of another vehicle, over real drivers."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from drivers.base import DriverStatus
from drivers.rdss.messages import TextRequest
from drivers.rdss.position_report_coding import PositionReport, decode_report
from drivers.rdss.text_coding import EncodedText
from drivers.rdss.vehicle_message_envelope import envelope_from_text
from fusiond.navigation.earth import meridian_radius
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.fleet import FleetMessage
from fusiond.outputs.messages.short_message import ShortMessage
from fusiond.outputs.topics import Topic
from fusiond.simulation.rdss.short_messages import ConvoyVehicle
from tests.live.daemon_bench import NO_MQTT, PARKED, RDSS, REST, Bench, running
from tests.patience import until

REPORTS = f"[position_reports]\ncard = {ConvoyVehicle.CARD}\ninterval_s = 2.0\n"
CONVOY = replace(REST, rdss=replace(REST.rdss, service_frequency_s=1, convoy=True))
COMMAND = replace(REST, rdss=replace(REST.rdss, service_frequency_s=1, foreign_probability=1.0))
"""A command terminal, to which the centre passes on the fixes of its subordinates."""


class Spy:
    """An output that keeps what it is given."""

    name, nav_rate_hz, sets_clocks = "spy", 1.0, False

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.status = DriverStatus("running")
        self.taken: list[tuple[str, Message]] = []

    def publish(self, topic: Topic, message: Message) -> None:
        self.taken.append((topic.path, message))

    async def run(self) -> None:
        await asyncio.Event().wait()

    def of(self, path: str) -> list[Message]:
        return [message for where, message in self.taken if where == path]


async def test_a_vehicle_reports_what_it_knows_and_hears_of_the_other(bench: Bench) -> None:
    vehicle = bench.vehicle(
        CONVOY, gnss_link=bench.folder / "gnss", rdss_link=bench.folder / "rdss"
    )
    left: list[TextRequest] = []
    carry = vehicle.terminal.carry

    def carried(card: int, message: TextRequest, t_s: float) -> None:
        left.append(message)
        carry(card, message, t_s)

    vehicle.terminal.carry = carried
    daemon = bench.daemon(RDSS, NO_MQTT, REPORTS)
    spy = Spy()
    daemon.outputs["spy"] = spy
    other = f"fleet/{ConvoyVehicle.CARD}"

    def ended() -> list[ShortMessage]:
        found = [m for m in spy.of("message") if isinstance(m, ShortMessage)]
        return [m for m in found if m.kind == "report" and m.state == "sent" and m.over]

    async with running(daemon, vehicle):
        await bench.mode(PARKED)
        await until(lambda: len(ended()) >= 2 and len(spy.of(other)) >= 1)
        beams = bench.health["rdss"].beams

    reports = [reported(m) for m in left]
    assert {r.mode for r in reports} <= {"aligning", "navigating", "coasting"}
    last = reports[-1]
    t_s = last.t_s - vehicle.utc_start_ns * 1e-9
    lat, lon, _ = vehicle.truth.at(np.array([t_s])).position[0]
    north, east, _ = last.sd_ned_m
    assert north is not None
    assert east is not None
    radius = meridian_radius(lat)
    assert abs(np.radians(last.lat_deg) - lat) * radius < 5.0 * north
    assert abs(np.radians(last.lon_deg) - lon) * radius < 5.0 * east
    (place, *_) = spy.of(other)
    assert isinstance(place, FleetMessage)
    assert (place.card, place.by, place.mode) == (ConvoyVehicle.CARD, "report", "navigating")
    assert place.lat_deg == pytest.approx(np.degrees(lat), abs=1e-4)
    assert beams is not None
    assert (beams.levels, beams.serving) == ((0, 3, 4, 0, 2, 0), 3)


async def test_a_subordinates_fix_is_a_place_and_none_of_ones_own(bench: Bench) -> None:
    vehicle = bench.vehicle(
        COMMAND, gnss_link=bench.folder / "gnss", rdss_link=bench.folder / "rdss"
    )
    daemon = bench.daemon(RDSS, NO_MQTT)
    spy = Spy()
    daemon.outputs["spy"] = spy

    def places() -> list[FleetMessage]:
        return [
            m for path, m in spy.taken if path.startswith("fleet/") and isinstance(m, FleetMessage)
        ]

    async with running(daemon, vehicle):
        await bench.mode(PARKED)
        await until(lambda: len(places()) >= 2)
        health = bench.health["rdss"]
    lat, lon, _ = vehicle.truth.at(np.zeros(1)).position[0]
    for place in places():
        assert place.by == "centre"
        # It is driven a tenth of a degree to the north.
        assert place.lat_deg == pytest.approx(np.degrees(lat) + 0.1, abs=0.01)
        assert place.lon_deg == pytest.approx(np.degrees(lon), abs=0.01)
    assert health.counters["foreign_fix"] >= 2
    assert abs(bench.seen[-1].lat_rad - lat) < 1e-5


def reported(message: TextRequest) -> PositionReport:
    assert message.receiver == ConvoyVehicle.CARD
    envelope = envelope_from_text(EncodedText(message.payload, message.encoding))
    assert envelope is not None
    return decode_report(envelope.kind, envelope.body)
