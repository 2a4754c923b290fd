"""Error frames of a bus: what becomes of the controller, and what the operator hears."""

from __future__ import annotations

import can

from drivers.can.errors import controller_state
from tests.drivers.can.imu_at_work import Running, sample_frames
from tests.patience import until


def error_frame(classes: int, detail: int = 0) -> can.Message:
    return can.Message(
        arbitration_id=classes,
        data=bytes([0, detail, 0, 0, 0, 0, 0, 0]),
        is_error_frame=True,
        is_extended_id=False,
    )


async def test_error_frames_become_events_and_state() -> None:
    async with Running(interface="virtual", channel="t-error").run() as imu:
        with can.Bus(interface="virtual", channel="t-error", ignore_config=True) as sender:
            for message in sample_frames(0):
                sender.send(message)
            for _ in range(3):
                sender.send(error_frame(0x004, 0x20))
            sender.send(error_frame(0x004, 0x01))
            sender.send(error_frame(0x008 | 0x020 | 0x080))
            sender.send(error_frame(0x040))
            await until(lambda: "bus_off" in imu.codes)
            assert imu.driver.status.state == "silent"
            assert "left the bus" in imu.driver.status.detail
            sender.send(error_frame(0x100))
            for message in sample_frames(1):
                sender.send(message)
            await until(lambda: len(imu.samples) == 2)
            assert imu.driver.status.state == "running"
    assert imu.codes == ["error_passive", "bus_off", "error_active"]
    counters = imu.driver.counters
    assert counters["error_frames"] == 7
    assert counters["error_controller"] == 4
    assert counters["error_overflow"] == 1
    for name in ("protocol", "no_acknowledge", "bus_error", "bus_off", "restarted"):
        assert counters[f"error_{name}"] == 1


async def test_a_shorted_bus_does_not_flood_the_operator() -> None:
    async with Running(interface="virtual", channel="t-short").run() as imu:
        with can.Bus(interface="virtual", channel="t-short", ignore_config=True) as sender:
            for _ in range(50):
                sender.send(error_frame(0x040))
                sender.send(error_frame(0x100))
            await until(lambda: imu.driver.counters["error_frames"] == 100)
    assert imu.codes == ["bus_off", "error_active"]
    assert imu.driver.counters["error_bus_off"] == 50


def test_controller_state_of_error_frames() -> None:
    assert controller_state(0x040, bytes(8)) == "bus_off"
    assert controller_state(0x100, bytes(8)) == "active"
    assert controller_state(0x004, bytes([0, 0x04])) == "warning"
    assert controller_state(0x004, bytes([0, 0x10])) == "passive"
    assert controller_state(0x004, bytes([0, 0x40])) == "active"
    assert controller_state(0x004, b"") is None
    assert controller_state(0x001, bytes(8)) is None
