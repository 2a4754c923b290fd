"""Detection of an IMU's forward axis by a short drive: stand, then drive straight ahead.

    v = sum (f - f_0) dt        over the two level axes, from the first motion on

A vehicle that drives off forwards gains v along its forward axis. `f_0` is the mean specific force
while it stood, which has gravity and the accelerometers' biases in it. Both are of the sensor's
axes, (m/s^2) and (m/s); the turn about the vertical axis is summed too, since v belongs to one
direction only as long as the vehicle goes straight.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.can.bus import CanBus, CanFrame
from drivers.can.imu import CanImuDecoder, CanImuOptions
from drivers.measurements import ImuSample

Array = NDArray[np.float64]
WINDOW_S = 1.0
QUIET_RATE_RAD_S, QUIET_FORCE_M_S2 = np.radians(0.5), 0.15
"""Standard deviations in a window: the defaults of `[constraints.zero_velocity]`, twice what
standing with the engine on shows."""
SAME_FORCE_M_S2 = 0.3
"""A mean farther from `f_0` is motion: a gentle start has half a m/s^2, a bias drifts by 0.01."""
LEAST_SPEED_M_S = 4.0
"""Least speed change (m/s); a slope that changes by 3 deg adds 1.5 m/s in 3 s, a direction error of
21 deg."""
MOST_S = 8.0
"""Longest time from standstill to that speed; in a slower start slopes outweigh the engine."""
MOST_TURN_RAD = np.radians(15.0)
MOST_ASIDE_RAD = np.radians(30.0)
"""Largest angle to the nearest axis; beyond it the unit is not parallel to the vehicle."""
_REST_SPEED_M_S = 0.5
"""Largest speed after somebody got in: the vehicle was shaken, and is quiet again."""

DRIVE_S = 90.0
"""Time to get in, start the engine and drive off."""

Phase = Literal["unquiet", "standing", "moving", "found", "failed"]


class ForwardAxis:
    """Detector of the forward axis from samples; `phase`, then `axis`, or `reason` of a failure.

    `down` is the axis that gravity showed, such as `-z`.
    """

    def __init__(self, down: str) -> None:
        self.phase: Phase = "unquiet"
        self.axis: str | None = None
        self.reason = "the vehicle never stood still for a second"
        self._down = "xyz".index(down[1])
        self._level = [k for k in range(3) if k != self._down]
        self._window: list[Array] = []
        self._rest = np.zeros(6)
        self._velocity = np.zeros(2)
        self._turn_rad = self._moving_s = 0.0

    def add(self, sample: Array, dt_s: float) -> None:
        """Add one sample (6,): rates in rad/s and specific forces in m/s^2 over `dt_s`."""
        if self.phase in ("found", "failed"):
            return
        self._window.append(np.append(sample, dt_s))
        if sum(float(row[6]) for row in self._window) >= WINDOW_S:
            window, self._window = np.array(self._window), []
            self._judge(window)

    def _judge(self, window: Array) -> None:
        samples, dt = window[:, :6], window[:, 6]
        sd, mean = samples.std(axis=0), samples.mean(axis=0)
        quiet = sd[:3].max() < QUIET_RATE_RAD_S and sd[3:].max() < QUIET_FORCE_M_S2
        if self.phase == "unquiet":
            if quiet:
                self.phase, self._rest = "standing", mean
                self.reason = "the vehicle did not drive off"
            return
        quiet = quiet and float(np.abs(mean - self._rest)[3:].max()) < SAME_FORCE_M_S2
        if quiet and float(np.linalg.norm(self._velocity)) < _REST_SPEED_M_S:
            self.phase, self._velocity = "standing", np.zeros(2)
            self._turn_rad = self._moving_s = 0.0
            return
        self.phase = "moving"
        self._integrate(samples - self._rest, dt)

    def _integrate(self, samples: Array, dt: Array) -> None:
        for sample, dt_s in zip(samples, dt, strict=True):
            self._velocity += sample[3:][self._level] * dt_s
            self._turn_rad += float(sample[self._down] * dt_s)
            self._moving_s += float(dt_s)
            if abs(self._turn_rad) > MOST_TURN_RAD:
                return self._fail("the vehicle turned before it was fast enough")
            if float(np.linalg.norm(self._velocity)) >= LEAST_SPEED_M_S:
                return self._decide()
        if self._moving_s > MOST_S:
            self._fail(f"the vehicle was slower than {LEAST_SPEED_M_S:g} m/s after {MOST_S:g} s")
        return None

    def _decide(self) -> None:
        first = int(np.argmax(np.abs(self._velocity)))
        along, aside = self._velocity[first], self._velocity[1 - first]
        if abs(np.arctan2(aside, abs(along))) > MOST_ASIDE_RAD:
            self._fail("forward is between two axes: mount the unit parallel to the vehicle")
            return
        self.axis = ("+" if along > 0.0 else "-") + "xyz"[self._level[first]]
        self.phase, self.reason = "found", ""

    def _fail(self, reason: str) -> None:
        self.phase, self.reason = "failed", reason


def axes_of(forward: str, down: str) -> tuple[str, str, str]:
    """Sensor axes along forward, right and down; right = down x forward."""
    right = np.cross(_unit(down), _unit(forward))
    k = int(np.argmax(np.abs(right)))
    return forward, ("+" if right[k] > 0.0 else "-") + "xyz"[k], down


def _unit(axis: str) -> Array:
    unit = np.zeros(3)
    unit["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return unit


async def watch_departure(
    options: CanImuOptions, down: str, seconds: float, on_phase: Callable[[Phase], None]
) -> ForwardAxis:
    """Listen to the IMU until the detection of its forward axis ends, for at most `seconds`.
    `on_phase` is called with each new phase."""
    decoder, found = CanImuDecoder("imu", options), ForwardAxis(down)
    done = asyncio.Event()
    last_ns: int | None = None

    def receive(frame: CanFrame) -> None:
        nonlocal last_ns
        if frame.remote or frame.error:
            return
        for sample in decoder.feed(frame):
            if not isinstance(sample, ImuSample):
                continue
            if last_ns is not None:
                before = found.phase
                dt_s = (sample.t_seen_ns - last_ns) * 1e-9
                found.add(np.array([*sample.gyro_rad_s, *sample.accel_m_s2]), dt_s)
                if found.phase != before:
                    on_phase(found.phase)
            last_ns = sample.t_seen_ns
            if found.phase in ("found", "failed"):
                done.set()

    bus = CanBus(options.interface, options.channel)
    task = asyncio.ensure_future(bus.run(receive, lambda up, why: None, lambda state: None))
    try:
        async with asyncio.timeout(seconds):
            await done.wait()
    except TimeoutError:
        pass
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    return found
