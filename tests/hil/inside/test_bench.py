"""The test bench itself: the kernel's CAN, ptys and the broker are the real ones."""

from __future__ import annotations

import asyncio
import os
import subprocess
import threading

import aiomqtt
import can
import numpy as np
import pytest
import serial

from tests.broker import Broker
from tests.hil.bench import SerialLine
from tests.patience import PATIENCE_S


def test_a_frame_crosses_the_bus_with_the_kernels_stamp(can_channel: str) -> None:
    with (
        can.Bus(channel=can_channel, interface="socketcan") as sender,
        can.Bus(channel=can_channel, interface="socketcan") as receiver,
    ):
        sent = can.Message(arbitration_id=0x132, data=b"\x01\x02\xff", is_extended_id=False)
        sender.send(sent)
        received = receiver.recv(timeout=PATIENCE_S)
        assert received is not None
        assert received.equals(
            sent, timestamp_delta=None, check_channel=False, check_direction=False
        )
        assert received.timestamp > 1e9  # POSIX seconds of the kernel, not a counter


def test_the_interface_can_go_down_and_come_back(can_channel: str) -> None:
    subprocess.run(["ip", "link", "set", can_channel, "down"], check=True)
    try:
        with (
            can.Bus(channel=can_channel, interface="socketcan") as bus,
            pytest.raises(can.CanOperationError),
        ):
            bus.send(can.Message(arbitration_id=1))
    finally:
        subprocess.run(["ip", "link", "set", can_channel, "up"], check=True)
    with can.Bus(channel=can_channel, interface="socketcan") as bus:
        bus.send(can.Message(arbitration_id=1))


def test_bytes_cross_a_serial_line_both_ways(serial_line: SerialLine) -> None:
    with serial.Serial(serial_line.path, 115200, timeout=PATIENCE_S) as port:
        os.write(serial_line.fd, b"$GNGGA\r\n\x00\x11\x13\xff")
        assert port.read(12) == b"$GNGGA\r\n\x00\x11\x13\xff"
        port.write(b"$CCICA\r\n")
        assert os.read(serial_line.fd, 64) == b"$CCICA\r\n"


async def test_a_message_goes_round_through_the_broker(broker: Broker) -> None:
    async with aiomqtt.Client("127.0.0.1", broker.port, timeout=PATIENCE_S) as client:
        await client.subscribe("fusiond/bench/#", qos=1)
        await client.publish("fusiond/bench/nav", b"\x00payload", qos=1)
        message = await asyncio.wait_for(anext(aiter(client.messages)), timeout=PATIENCE_S)
    assert (str(message.topic), message.payload) == ("fusiond/bench/nav", b"\x00payload")


async def test_the_broker_dies_and_returns_on_its_port(broker: Broker) -> None:
    async with aiomqtt.Client("127.0.0.1", broker.port, timeout=PATIENCE_S):
        pass
    broker.kill()
    with pytest.raises(aiomqtt.MqttError):
        async with aiomqtt.Client("127.0.0.1", broker.port, timeout=PATIENCE_S):
            pass
    broker.start()
    async with aiomqtt.Client("127.0.0.1", broker.port, timeout=PATIENCE_S):
        pass


def test_threads_keep_their_vector_registers() -> None:
    """The guest saves AVX state across switches (`xstate.c`): sums of integers stay exact."""
    wrong: list[float] = []
    start = threading.Barrier(4)

    def work(value: int) -> None:
        values = np.full(100_000, float(value))
        start.wait()
        for _ in range(1000):
            total = float(values @ values)
            if total != value * value * 100_000.0:
                wrong.append(total)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
