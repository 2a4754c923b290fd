"""What the daemon publishes: to wait for, and to judge by the simulated vehicle's truth."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from math import degrees, radians
from typing import Any

import aiomqtt
import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.navigation.earth import meridian_radius, transverse_radius
from tests.broker import Broker, Listener, listening
from tests.hil.processes import PATIENCE_S, VehicleProcess


class Heard:
    """What a vehicle has published, to look at and to wait for."""

    def __init__(self, listener: Listener, vehicle: str) -> None:
        self._listener = listener
        self._base = f"fusiond/{vehicle}"

    def all(self, name: str, since: int = 0) -> list[dict[str, Any]]:
        """The messages of a topic since number `since` of all messages."""
        messages = self._listener.messages[since:]
        topic = f"{self._base}/{name}"
        return [json.loads(_payload(m)) for m in messages if m.topic.value == topic]

    @property
    def count(self) -> int:
        """How many messages have come."""
        return len(self._listener.messages)

    async def until(
        self,
        name: str,
        condition: Callable[[dict[str, Any]], Any] = lambda message: True,
        patience_s: float = PATIENCE_S,
    ) -> dict[str, Any]:
        """The first message of a topic from now on that fulfils `condition`."""
        seen = self.count

        def found(listener: Listener) -> list[dict[str, Any]]:
            """Each message is looked at once: there are a dozen a second, for minutes."""
            nonlocal seen
            new = self.all(name, seen)
            seen = len(listener.messages)
            return [message for message in new if condition(message)]

        try:
            message: dict[str, Any] = (await self._listener.until(found, patience_s))[0]
        except TimeoutError:
            raise AssertionError(f"{name} never came so; last: {self.all(name)[-1:]}") from None
        return message

    async def online(self, word: bytes) -> None:
        """Wait for `online` to say so."""
        await self._listener.until(
            lambda heard: heard.payloads(f"{self._base}/online")[-1:] == [word], PATIENCE_S
        )


@asynccontextmanager
async def hearing(broker: Broker, vehicle: str) -> AsyncIterator[Heard]:
    """A subscriber of its own to all that a vehicle publishes."""
    async with listening(broker) as (listener, _):
        yield Heard(listener, vehicle)


STRETCH_S = 5.0
"""Over which ticks are counted."""


async def keeps_up(heard: Heard, rate_hz: float) -> None:
    """Wait for a stretch in which most periods of the scheduler were ticks.

    How many are overruns is the host's affair; but a filter that takes longer than a period makes
    one overrun or more of each tick, and never gets there. No period may go uncounted."""
    async with asyncio.timeout(PATIENCE_S):
        first = await heard.until("status")
        while True:
            status = await heard.until("status")
            elapsed_s = status["uptime_s"] - first["uptime_s"]
            if elapsed_s < STRETCH_S:
                continue
            ticks = status["ticks"] - first["ticks"]
            periods = ticks + status["overruns"] - first["overruns"]
            assert periods == pytest.approx(elapsed_s * rate_hz, abs=3)
            if ticks > 0.5 * periods:
                return
            first = status


def _payload(message: aiomqtt.Message) -> bytes:
    assert isinstance(message.payload, bytes)
    return message.payload


def nav_errors(nav: dict[str, Any], truth: NDArray[np.float64]) -> dict[str, tuple[float, float]]:
    """Error and stated sigma of each figure of a `nav` message; m, m/s and degrees."""
    lat, lon, height, v_n, v_e, v_d, roll, pitch, yaw = (float(x) for x in truth)
    errors = {
        "n_m": (radians(nav["lat_deg"]) - lat) * (meridian_radius(lat) + height),
        "e_m": (radians(nav["lon_deg"]) - lon) * (transverse_radius(lat) + height) * math.cos(lat),
        "d_m": height - nav["height_m"],
        "vn_m_s": nav["v_n_m_s"] - v_n,
        "ve_m_s": nav["v_e_m_s"] - v_e,
        "vd_m_s": nav["v_d_m_s"] - v_d,
        "roll_deg": nav["roll_deg"] - degrees(roll),
        "pitch_deg": nav["pitch_deg"] - degrees(pitch),
        "yaw_deg": (nav["yaw_deg"] - degrees(yaw) + 180.0) % 360.0 - 180.0,
    }
    return {name: (error, nav[f"sd_{name}"]) for name, error in errors.items()}


SIGMAS = 5.0
"""A consistent error exceeds them once in two million."""
STARVED = 0.2
"""Of the solutions of some seconds: a second of a busy host."""
PRINTED = {"m": 0.03, "m_s": 0.01, "deg": 0.05}
"""Figures are printed to 1e-4 m/s, the instant to 1 ms: 0.03 m at 30 m/s."""


def judge(
    vehicle: VehicleProcess, solutions: list[dict[str, Any]], bounds: dict[str, float]
) -> None:
    """`nav` messages against the truth: each error within five of its sigmas, and within the bound
    of its unit (m, m_s, deg), where there is one, whatever the sigma.

    A guest that its host lets stand still has an IMU that was silent meanwhile, and says so by its
    mode: few of them may.
    """
    silent = [nav for nav in solutions if nav["mode"] == "invalid"]
    assert len(silent) <= STARVED * len(solutions)
    for nav in solutions:
        if nav["mode"] == "invalid":
            continue
        assert nav["mode"] == "navigating"
        for name, (error, sigma) in nav_errors(nav, vehicle.truth(nav["t_ms"])).items():
            unit = name.split("_", 1)[1]
            at = f"{name} at t_s = {vehicle.t_s(nav['t_ms']):.2f}"
            assert abs(error) < SIGMAS * sigma + PRINTED[unit], f"{at}: {error}, sigma {sigma}"
            assert abs(error) < bounds.get(unit, math.inf), f"{at}: {error}"
