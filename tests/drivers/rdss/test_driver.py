"""The RDSS driver over a real pty, against a terminal that speaks the wire format."""

from __future__ import annotations

import asyncio
import os
import re
import termios
import time
import tomllib
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.measurements import DelayedFix, DeviceEvent, TimeOfDayStamp, TimeReport
from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.driver import RdssDriver, RdssOptions
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    DeviceClock,
    Family,
    Feedback,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
)
from fusiond.configuration.schema import Config
from tests.places import REPOSITORY

USER = 242286
MODULES = {"4.0": binary_4_0, "2.1": text_2_1}
FIX = Fix(USER, 84787.0, 23.0373889, 113.3944444, 438.0, -6.0, 100, multi_value=True)


class PtyTerminal:
    """Answers on the master side of a pty, in one family, at one rate, once per request."""

    def __init__(self, family: Family, rate: int = termios.B115200) -> None:
        self.master, slave = os.openpty()
        self.port = os.ttyname(slave)
        tty.setraw(slave)
        self._slave = slave
        self._module = MODULES[family]
        self._decoder = self._module.Decoder()
        self._rate = rate
        self.heard: list[Message] = []
        self.before = b""
        self.mute = False
        asyncio.get_running_loop().add_reader(self.master, self._read)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.master)
        os.close(self.master)
        os.close(self._slave)

    def write(self, *messages: Message) -> None:
        os.write(self.master, self.before + b"".join(map(self._module.encode, messages)))

    def _read(self) -> None:
        data = os.read(self.master, 4096)
        if self.mute or termios.tcgetattr(self.master)[4] != self._rate:
            return
        for message in self._decoder.feed(data):
            self.heard.append(message)
            match message:
                case IdentityRequest():
                    self.write(Identity(USER, 60))
                case BeamPowerRequest():
                    self.write(BeamPower((0, 3, 4, 0, 2, 0)))
                case SelfTestRequest():
                    self.write(SelfTest(80.0, inbound_state=2))
                case PositionRequest():
                    self.write(Feedback(Outcome.OK, "DWA" if self.text else "DWSQ"), FIX)

    @property
    def text(self) -> bool:
        return self._module is text_2_1


async def until(condition: Callable[[], Any], seconds: float = 20.0) -> None:
    """Wait for a condition; the limit only ends a test that has already failed."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - what is waited for is the driver's public state
            await asyncio.sleep(0.01)


@asynccontextmanager
async def running(
    options: dict[str, Any], now_ns: Callable[[], int] = time.monotonic_ns
) -> AsyncIterator[tuple[RdssDriver, list[Any]]]:
    said: list[Any] = []
    driver = RdssDriver("rdss", RdssOptions(**options), said.append, now_ns)
    task = asyncio.create_task(driver.run())
    try:
        yield driver, said
        assert not task.done(), "the driver ended by itself"
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def of(kind: type, said: list[Any]) -> list[Any]:
    return [item for item in said if isinstance(item, kind)]


def states_said(said: list[Any]) -> list[str]:
    return [e.code for e in of(DeviceEvent, said) if e.code.startswith("device_")]


@pytest.mark.parametrize(("family", "rate"), [("4.0", termios.B19200), ("2.1", termios.B115200)])
async def test_finds_the_terminal_asks_and_hands_on_the_fix(family: Family, rate: int) -> None:
    terminal = PtyTerminal(family, rate)
    terminal.before = b"\x00$\xff$garbage\r\n"
    began = time.monotonic_ns()
    async with running({"port": terminal.port}) as (driver, said):

        def fix_came_while_hinting() -> bool:
            driver.height_hint(438.4, 3.0, time.monotonic_ns())
            return bool(of(DelayedFix, said))

        await until(fix_came_while_hinting)
        (fix,) = of(DelayedFix, said)
        assert fix.lat_rad == pytest.approx(0.40207828, abs=1e-6)
        assert fix.lon_rad == pytest.approx(1.97910641, abs=1e-6)
        assert (fix.height_m, fix.precision_class_m, fix.multi_value) == (438.0, 100.0, True)
        assert isinstance(fix.stamp, TimeOfDayStamp)
        assert fix.stamp.time_of_day_s == pytest.approx(84787.0)
        assert fix.stamp.zones_h == (0, 8)
        assert fix.stamp.requested_ns is not None
        assert began < fix.stamp.requested_ns <= fix.t_seen_ns
        (request,) = [m for m in terminal.heard if isinstance(m, PositionRequest)]
        assert (request.user, request.period_s, request.emergency) == (USER, 0, False)
        assert request.height_mode is HeightMode.GIVEN
        assert request.height_m == pytest.approx(438.4, abs=0.5)
        await until(lambda: "next request in" in driver.status.detail)
        assert driver.status.state == "running"
        assert driver.counters["fixes"] == driver.counters["multi_value"] == 1
        assert driver.counters["garbage_bytes"] > 0
        assert driver.request_now(time.monotonic_ns()).startswith("request in")
        assert "rdss_card" in [e.code for e in of(DeviceEvent, said)]
        assert len([m for m in terminal.heard if isinstance(m, PositionRequest)]) == 1
    terminal.close()


async def test_device_clock_is_reported_and_trusted_only_when_it_may_be() -> None:
    terminal = PtyTerminal("2.1")
    clock = DeviceClock(2026, 11, 20, 84787.25, zone_h=-8, locked=True)
    async with running({"port": terminal.port, "family": "2.1", "baud": 115200}) as (driver, said):
        await until(lambda: driver.status.state == "running")
        terminal.write(clock, DeviceClock(2016, 12, 31, 86400.0, zone_h=-8, locked=False))
        await until(lambda: len(of(TimeReport, said)) == 2)
    good, leap = of(TimeReport, said)
    assert (good.utc_ns, good.trusted) == (1795217587_250_000_000, True)
    assert (leap.utc_ns, leap.trusted) == (1483228799_000_000_000, False)
    terminal.close()


async def test_sjxx_states_no_zone_and_is_not_trusted() -> None:
    terminal = PtyTerminal("4.0")
    async with running({"port": terminal.port, "baud": 115200}) as (driver, said):
        await until(lambda: driver.status.state == "running")
        terminal.write(DeviceClock(2026, 11, 20, 84787.0))
        await until(lambda: of(TimeReport, said))
    assert of(TimeReport, said)[0].trusted is False
    terminal.close()


async def test_absent_port_is_said_and_picked_up_and_lost_and_found(tmp_path: Path) -> None:
    port = tmp_path / "ttyRDSS"
    async with running({"port": str(port), "family": "4.0", "baud": 115200}) as (driver, said):
        await until(lambda: driver.status.state == "absent")
        terminal = PtyTerminal("4.0")
        port.symlink_to(terminal.port)
        await until(lambda: driver.status.state == "running")
        terminal.close()
        port.unlink()
        await until(lambda: driver.status.state == "absent")
        assert "rdss_closed" in [e.code for e in of(DeviceEvent, said)]
        again = PtyTerminal("4.0")
        port.symlink_to(again.port)
        await until(lambda: driver.status.state == "running")
        again.close()
    assert states_said(said)[:4] == [
        "device_absent",
        "device_running",
        "device_absent",
        "device_running",
    ]
    first = next(e for e in of(DeviceEvent, said) if e.code == "device_absent")
    assert str(port) in first.text
    assert "does not exist; retrying" in first.text


class LeapingClock:
    """The monotonic clock, and what a test adds to it so as not to wait."""

    added_s = 0

    def __call__(self) -> int:
        return time.monotonic_ns() + self.added_s * 1_000_000_000


async def test_a_terminal_that_falls_silent_is_said_and_picked_up() -> None:
    terminal, clock = PtyTerminal("4.0"), LeapingClock()
    options = {"port": terminal.port, "family": "4.0", "baud": 115200}
    async with running(options, clock) as (driver, said):

        def state() -> str:
            return driver.status.state

        def left(before: str, leap_s: int) -> bool:
            clock.added_s += leap_s * (state() == before)
            return state() != before

        await until(lambda: driver.status.state == "running")
        terminal.mute = True
        await until(lambda: left("running", 31))
        assert state() == "silent", "at once, not after a round of probes"
        terminal.mute = False
        await until(lambda: left("silent", 3))
        assert state() == "running"
    assert states_said(said) == ["device_running", "device_silent", "device_running"]
    terminal.close()


async def test_a_port_on_which_nobody_answers_is_silent() -> None:
    terminal, clock = PtyTerminal("4.0"), LeapingClock()
    terminal.mute = True
    async with running({"port": terminal.port, "baud": 115200}, clock) as (driver, said):
        await until(lambda: driver.counters["probes"] == 1)
        assert driver.status.state == "starting"
        clock.added_s += 3
        await until(lambda: driver.status.state == "silent")
    assert states_said(said) == ["device_silent"]
    terminal.close()


async def test_a_frame_that_never_ends_does_not_hide_the_next() -> None:
    terminal = PtyTerminal("4.0")
    async with running({"port": terminal.port, "family": "4.0", "baud": 115200}) as (driver, said):
        await until(lambda: driver.status.state == "running")
        os.write(
            terminal.master, b"$ABCD\x00\xf0" + binary_4_0.encode(DeviceClock(2026, 1, 1, 0.0))
        )
        await until(lambda: of(TimeReport, said))
        assert driver.counters["abandoned"] == 1
    terminal.close()


def test_driver_is_an_entry_point() -> None:
    (point,) = entry_points(group="fusiond.drivers", name="rdss")
    assert point.load() is RdssDriver


@pytest.mark.parametrize(
    "wrong",
    [
        {"baud": 0},
        {"family": "4.1"},
        {"t_fraction": "0.001"},
        {"antenna_height_m": 400.0},
        {"height_m": 20000.0},
        {"timeout_s": 1.0},
        {"suppression_hold_s": 1.0},
        {"emergency": True},
    ],
)
def test_options_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        RdssOptions(port="/dev/null", **wrong)


def test_config_block_of_the_guide_is_valid() -> None:
    guide = REPOSITORY / "docs" / "rdss-terminal.md"
    blocks = re.findall(r"```toml\n(.*?)```", guide.read_text(), re.S)
    assert blocks
    for block in blocks:
        config = Config.model_validate(tomllib.loads(block))
        options = RdssOptions(**config.sources["rdss"].options)
        written = set(config.sources["rdss"].options)
        assert written == set(RdssOptions.model_fields), "the guide shows every key"
        assert options.port.startswith("/dev/")
