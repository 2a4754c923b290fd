r"""Search for the delay of a receiver's fixes, by the IMU alone.

The velocities of the last seconds are compared with the motion sensed by the IMU
(fusiond.navigator.alignment.motion_fit), each assumed valid tau before its stamp. Attitude, sensor
errors and the first velocity are free within their priors, so that

    J(tau) = min cost,   J(tau) - J(tau*) = (tau - tau*)^2 / s^2    near the best tau*

is the profile of twice the negative log likelihood, s^2 = 2 h^2 / (J(tau* + h) - 2 J(tau*) + J(tau*
- h)). Neither the filter nor positions are used: a filter that has followed delayed fixes agrees
with them. A change of velocity shows tau. At constant velocity J is flat: delayed positions on a
straight cannot be distinguished from ones that have jumped along the track.

The search runs when a start is found; a delay that begins later is a hypothesis of the bank
(fusiond.integrity.catalogue). A receiver is delayed by tau* if

    J(tau*) <= chi-square of its degrees    the IMU works; one that has turned fits at no tau
    J(now) - J(tau*) > EVIDENCE             chi-square of one: 4.5 sigma, one in 130,000
    |tau* - now| > PRIOR_SIGMAS s_0         s_0 of the filter's own state for it

in several searches that agree, over fixes of one delay, unless the positions have followed the
velocities since the last known delay (fusiond.navigator.alignment.position_jumps). On drive_0708
and css_164, which have no delayed fixes, two of 452 searches met all but the first condition; the
smoothing of receivers shifts tau* by 0.1 s.

The delay is subtracted from the stamps, by the IMU's clock: an IMU cannot be early, so the fixes
are delayed. From then on solutions are published by that clock
(fusiond.estimators.published_state).

Source: Wu and Pan (as motion); profile likelihood: Venzon, Moolgavkar, Applied Statistics 37
(1988), 87; the offset in time as a parameter of alignment: Li, Mourikis, Online temporal
calibration for camera-IMU systems, IJRR 33 (2014), 947.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate, VelocityCandidate
from fusiond.estimators.base import gate_threshold
from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model
from fusiond.navigation.earth import gravity
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.alignment import sensed_motion
from fusiond.navigator.alignment.course import ways
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.position_jumps import (
    LOOKED_NS,
    Epoch,
    since_leap,
    unchanged,
    velocities_alone,
)
from fusiond.navigator.alignment.sensed_motion import MOST_FIXES
from fusiond.navigator.mode_reasons import reason

MOST_DELAY_S = 3.0
"""The longest that is searched."""
# What is searched (s): a change of course at 10 deg/s is still one valley at twice the step.
SEARCHED_S = tuple(0.2 * k for k in range(16))
# Half a step (s) of the two parabolas that follow it.
NEAR_S = (0.1, 0.04)
# Probability with which fixes that are on time fit. Those that do are looked at once more as if
# they were late by GLANCE_S (s), where half the evidence for twice that would show.
FITS, GLANCE_S = 0.999, 0.4
EVIDENCE = 20.0
PRIOR_SIGMAS = 3.0
# Of a receiver whose offset in time the filter does not estimate (s).
LEAST_PRIOR_S = 0.05
# Fixes of so long are looked at, and so many at least; kept are a minute's of a receiver of 10 Hz,
# and handed on the last of them.
KEPT_NS, MOST_KEPT, HANDED_ON, FEWEST = 15_000_000_000, 600, 300, 5
MOST_WAITING = 4 * MOST_KEPT
# The valley is sought with `sensed_motion.MOST_FIXES`, its bottom with all of a receiver of 5 Hz.
ALL_FIXES = 5 * KEPT_NS // 1_000_000_000
# A delay that is known worse (s) is waited for so long (ns) to be known better: half the sigma
# of the filter's own state for it, which takes over.
SETTLED_SD_S, TIMEOUT_NS = 0.05, 10_000_000_000
# So many looks must have seen it, within so many sigmas of each other.
SEEN, AGREED = 3, 4.0
# A look is 6 fits of 0.3 ms of a fast computer each, one that searches 45: as often is looked, and
# so long nothing is searched for again where nothing was found.
EVERY_NS, SEARCHED_NS = 1_000_000_000, 10_000_000_000
# Looks of the last minute, and some more, are remembered.
MOST_LOOKS = 100
# One fit at a time: no tick waits for many. A tenth of a processor, whatever the rate of ticks.
FIT_EVERY_NS = 10_000_000


# Twice the negative log likelihood of a delay and its degrees of freedom, a fit at a time.
Fitting = Generator[None, None, tuple[float, int]]


class Delay(NamedTuple):
    """Delay against the stamps (s), and one sigma."""

    seconds: float
    sd: float

    def agrees(self, other: Delay) -> bool:
        """True if both delays agree within their sigmas."""
        return abs(self.seconds - other.seconds) <= AGREED * math.hypot(self.sd, other.sd)


class Found(NamedTuple):
    """Result of a search: reason to restart from the receiver's fixes, and one sigma (s) of their
    instants."""

    why: str
    sd_s: float


@dataclass(slots=True)
class _Received:
    """Aiding measurements of one device measurement as stamped; its velocities on demand."""

    measurements: tuple[AidingMeasurement, ...]
    found: list[Epoch] | None = None

    def epochs(self) -> list[Epoch]:
        """Velocities with their positions."""
        if self.found is None:
            candidates = [candidate for m in self.measurements for candidate in m.candidates()]
            position = next((o for o in candidates if isinstance(o, PositionCandidate)), None)
            self.found = [
                Epoch(o, position) for o in candidates if isinstance(o, VelocityCandidate)
            ]
        return self.found


@dataclass(slots=True)
class _Receiver:
    """Receiver: last measurements, assumed delay (ns), and start (ns) of the evidence for another
    one."""

    received: deque[_Received] = field(default_factory=lambda: deque(maxlen=MOST_KEPT))
    delay_ns: int = 0
    suspected: Delay | None = None
    since_ns: int = 0
    seen: int = 0

    def suspect(self, delay: Delay, t_ns: int) -> None:
        """Delay by the fixes until `t_ns`: the best of agreeing searches."""
        before = self.suspected
        if before is None or not delay.agrees(before):
            self.suspected, self.since_ns, self.seen = delay, t_ns, 1
            return
        self.seen += 1
        if delay.sd < before.sd:
            self.suspected = delay

    def settled(self, t_ns: int) -> Delay | None:
        """Delay, once known; ends a suspicion that did not last."""
        delay = self.suspected
        if delay is None:
            return None
        waited = t_ns - self.since_ns >= TIMEOUT_NS
        if self.seen >= SEEN and (waited or delay.sd <= SETTLED_SD_S):
            self.delay_ns, self.suspected = round(delay.seconds * 1e9), None
            return delay
        if waited:
            self.suspected = None
        return None


class LatencySearch:
    """Search for each receiver's delay over its last fixes; `on_event(code, text)` receives the
    results."""

    def __init__(
        self,
        options: AlignmentOptions,
        noise: ImuNoise,
        model: Model,
        on_event: Callable[[str, str], None],
    ) -> None:
        self._options, self._noise, self._model = options, noise, model
        self._event = on_event
        self._receivers: dict[str, _Receiver] = {}
        self.on_time: set[str] = set()
        """Known receivers whose stamps need no correction."""
        self.waiting: deque[tuple[str, Sequence[AidingMeasurement]]] = deque(maxlen=MOST_WAITING)
        """Measurements of receivers that are `on_time`, taken in when somebody looks."""
        self._due_ns = self._fitted_ns = 0
        self._looking: Generator[None, None, Found | None] | None = None
        self._looks: deque[int] = deque(maxlen=MOST_LOOKS)

    def _catch_up(self) -> None:
        """Process waiting measurements."""
        while self.waiting:
            source, measurements = self.waiting.popleft()
            self._receivers[source].received.append(_Received(tuple(measurements)))

    def receive(
        self, source: str, measurements: Sequence[AidingMeasurement]
    ) -> Sequence[AidingMeasurement]:
        """Shift aiding measurements of one device measurement to their instants of validity."""
        self._catch_up()
        receiver = self._receivers.get(source)
        if receiver is None:
            if not any(m.moves and not m.screened for m in measurements):
                return measurements
            receiver = self._receivers[source] = _Receiver()
        receiver.received.append(_Received(tuple(measurements)))
        delay_ns = receiver.delay_ns
        if delay_ns:
            self.on_time.discard(source)
        else:
            self.on_time.add(source)
        return [_earlier(m, delay_ns) for m in measurements] if delay_ns else measurements

    def kept(self) -> list[AidingMeasurement]:
        """Last measurements of all receivers, at their instants of validity."""
        self._catch_up()
        return [
            _earlier(measurement, receiver.delay_ns)
            for receiver in self._receivers.values()
            for received in tuple(receiver.received)[-HANDED_ON:]
            for measurement in received.measurements
        ]

    def due(self, t_ns: int) -> bool:
        """True if a search is due or in progress."""
        return self._looking is not None or not 0 < self._due_ns - t_ns <= SEARCHED_NS

    @property
    def looking(self) -> bool:
        """True during a search."""
        return self._looking is not None

    def stop(self) -> None:
        """Abort the present search: the start that it examined was dropped."""
        self._looking, self._due_ns = None, 0

    @property
    def suspects(self) -> str:
        """Text on a receiver with a suspected delay; empty without one."""
        for source, receiver in self._receivers.items():
            if receiver.suspected is not None:
                delay = receiver.suspected
                return reason("fixes_delayed", source=source, seconds=delay.seconds)
        return ""

    def look(self, imu: ImuBuffer) -> Found | None:
        """Start or continue a search over the samples and fixes of the last seconds before it; its
        result, if any."""
        t_ns = imu.latest_ns
        if not self.due(t_ns):
            return None
        if self._looking is None:
            self._looking, self._fitted_ns = self._look(imu), t_ns
            self._looks.append(t_ns)
        due = (t_ns - self._fitted_ns) // FIT_EVERY_NS
        self._fitted_ns = t_ns
        for _ in range(max(1, due)):
            try:
                next(self._looking)
            except StopIteration as end:
                self._looking = None
                found: Found | None = end.value
                return found
        return None

    def _doubted_ns(self, t_ns: int) -> int:
        """Last contradiction before the data of the present search (ns)."""
        return max((look for look in self._looks if look <= t_ns - LOOKED_NS), default=0)

    def _look(self, imu: ImuBuffer) -> Generator[None, None, Found | None]:
        """Run a search on all present data, one fit at a time."""
        self._catch_up()
        t_ns = imu.latest_ns
        self._due_ns = t_ns + EVERY_NS
        earliest_ns = round((MOST_DELAY_S + NEAR_S[0]) * 1e9)
        first_ns = max(imu.oldest_ns + earliest_ns, t_ns - KEPT_NS)
        past = sensed_motion.span_since(imu, first_ns - earliest_ns)
        # What was not felt, gravity neither, shows in a fix that falls there, and in none that
        # would be earlier.
        lost = np.flatnonzero(np.diff(past.times) > imu.hold_ns)
        if lost.size:
            first_ns = max(first_ns, int(past.times[lost[-1] + 1]) + earliest_ns)
        for source, receiver in tuple(self._receivers.items()):
            yield from self._weigh(receiver, past, first_ns, t_ns)
            delay = receiver.settled(t_ns)
            if delay is None:
                continue
            self.on_time.discard(source)
            text = (
                f"{source} is {delay.seconds:.2f} s later than its stamps (sigma {delay.sd:.2f}); "
                "corrected"
            )
            self._event("fixes_late", text)
            return Found(text, delay.sd)
        return None

    def _weigh(
        self, receiver: _Receiver, past: sensed_motion.Past, first_ns: int, t_ns: int
    ) -> Generator[None, None, None]:
        """Estimate the delay by the fixes of a span; the estimate of least sigma counts."""
        of_each = (epoch for received in receiver.received for epoch in received.epochs())
        epochs = sorted(of_each, key=lambda epoch: epoch.velocity.t_ns)
        looked = [e for e in epochs if first_ns <= e.velocity.t_ns <= t_ns]
        fixes, place = _fixes(looked)
        # The last must have a course.
        while fixes and math.hypot(*fixes[-1].v_ned[:2]) < self._options.course_speed_m_s:
            fixes.pop()
        if len(fixes) < FEWEST or place is None:
            return
        by = fixes[-1], self._options, self._noise, gravity(place.lat_rad, place.height_m or 0.0)
        said = {most: sensed_motion.measured(fixes, most) for most in (ALL_FIXES, MOST_FIXES)}
        # Of each delay (ns) and share of the fixes: some are asked for twice or three times.
        known: dict[tuple[int, int], tuple[float, int]] = {}

        def cost(delay_s: float, most: int = ALL_FIXES) -> Fitting:
            asked = round(delay_s * 1e9), math.ceil(len(fixes) / most)
            if asked not in known:
                m = said[most]
                either = ways(past, m._replace(instants=m.instants - asked[0]), *by)
                forward = either.fit(backward=False)
                yield
                backward = either.fit(backward=True)
                yield
                known[asked] = min((fit.cost, fit.degrees) for fit in (forward, backward))
            return known[asked]

        now_s, suspected = receiver.delay_ns * 1e-9, receiver.suspected
        now, degrees = yield from cost(now_s)
        some = yield from cost(now_s, MOST_FIXES)
        later = yield from cost(now_s + GLANCE_S, MOST_FIXES)
        if now <= gate_threshold(FITS, degrees) and some[0] - later[0] <= 0.5 * EVIDENCE:
            return
        if suspected is not None:
            about_s = suspected.seconds
        else:
            self._due_ns = t_ns + SEARCHED_NS
            costs = []
            for s in SEARCHED_S:
                costs.append(((yield from cost(s, MOST_FIXES))[0], s))
            about_s = min(costs)[1]
        delay = yield from _bottom(cost, about_s)
        if delay is None or delay.seconds > MOST_DELAY_S:
            return
        least, _ = yield from cost(delay.seconds)
        time = self._model.slots_of(fixes[-1].time)
        prior = max([LEAST_PRIOR_S, *(float(self._model.initial[slot]) for slot in time)])
        if (
            least > gate_threshold(FITS, degrees)
            or now - least <= EVIDENCE
            or abs(delay.seconds - now_s) <= PRIOR_SIGMAS * prior
            or unchanged(epochs, abs(delay.seconds - now_s), self._doubted_ns(t_ns))
            or velocities_alone(since_leap(looked), delay.seconds - now_s)
        ):
            return
        self._due_ns = t_ns + EVERY_NS
        receiver.suspect(Delay(max(0.0, delay.seconds), delay.sd), t_ns)


def _fixes(epochs: Sequence[Epoch]) -> tuple[list[VelocityCandidate], PositionCandidate | None]:
    """Velocities of one delay, and a position. A fix that repeats the one before bit for bit is no
    measurement, except at rest."""
    left = since_leap(epochs)
    found = [epoch.velocity for epoch in left]
    place = next((e.position for e in reversed(left) if e.position is not None), None)
    new = (not k or o.v_ned != found[k - 1].v_ned or not any(o.v_ned) for k, o in enumerate(found))
    return list(compress(found, new)), place


def _bottom(
    cost: Callable[[float], Fitting], about_s: float
) -> Generator[None, None, Delay | None]:
    """Minimum of costs by parabolas, and the sigma of its curvature; None without a minimum."""
    sd = math.inf
    for h in NEAR_S:
        before, _ = yield from cost(about_s - h)
        here, _ = yield from cost(about_s)
        after, _ = yield from cost(about_s + h)
        bent = before - 2.0 * here + after
        if bent <= 0.0:
            return None
        about_s += max(-h, min(h, 0.5 * h * (before - after) / bent))
        sd = h * math.sqrt(2.0 / bent)
    return Delay(about_s, sd)


def _earlier(measurement: AidingMeasurement, delay_ns: int) -> AidingMeasurement:
    return replace(measurement, t_ns=measurement.t_ns - delay_ns)
