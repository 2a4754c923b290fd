"""The navigator: samples and measurements in, solution out. A function of its arrivals alone.

It holds no clock and does no I/O. `add_imu` and `add` take what has arrived, `advance` runs the
filter as far as the IMU reaches, `solution` reads the state at an instant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import Measurement
from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch
from fusiond.aiding.position import PositionAid
from fusiond.configuration.schema import Config
from fusiond.configuration.settings import imu_noise, sensor_to_body
from fusiond.integrity.verdicts import Verdicts
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.alignment.aligner import Aligner
from fusiond.navigator.alignment.options import alignment_options
from fusiond.navigator.alignment.start import Start
from fusiond.navigator.constraints import ConstraintMaker
from fusiond.navigator.filters import estimator_of, model_of
from fusiond.navigator.health_check import RAISED_BY_NUMBERS, FailedAids, broken
from fusiond.navigator.intake import Intake
from fusiond.navigator.isolation import Isolation
from fusiond.navigator.readout import solution_of
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.timeline import Entry, Timeline

Array = NDArray[np.float64]

# A measurement may be valid this far ahead of the arrivals around it (clock mapping, jitter).
AHEAD_NS = 200_000_000


class Navigator:
    """Navigation of one vehicle. `on_event(code, text)` hears what an operator should know."""

    def __init__(
        self,
        config: Config,
        saved: SavedState | None = None,
        on_event: Callable[[str, str], None] | None = None,
        on_outcome: Callable[[Entry], None] | None = None,
    ) -> None:
        self.config = config
        self._saved = saved
        self._event = on_event or (lambda code, text: None)
        e, imu = config.estimator, config.imu
        self._noise = imu_noise(imu)
        self._intake = Intake(config.aiding, config.plausibility, self._event)
        self.raw = self._intake.receivers
        self.model = model_of(config, *self._intake.extra_blocks())
        self.imu = ImuBuffer(
            imu.rate_hz, e.buffer_s, sensor_to_body(imu), imu.time_offset_s, imu.gap_s
        )
        self.estimator = estimator_of(config, self.model)
        self.verdicts = Verdicts(
            config.consistency.window,
            config.consistency.alpha,
            lambda source, verdict: self._event(f"verdict_{verdict}", f"innovations of {source}"),
        )
        self.timeline = Timeline(
            self.estimator, self.imu, e.buffer_s, e.checkpoint_s, self._outcome
        )
        self._on_outcome = on_outcome
        self._constraints = ConstraintMaker(config.constraints)
        names = e.federated.sources or tuple(config.aiding)
        self._failed = FailedAids(self._event)
        self._isolation = Isolation(self.estimator, names, self._event)
        self.refused: dict[str, Counter[str]] = {}
        self.last_fused_ns: dict[str, int] = {}
        self._last_position_ns = 0
        self.started: Start | None = None
        self._aligner = self._new_aligner()

    def _new_aligner(self) -> Aligner:
        return Aligner(alignment_options(self.config), self._noise, self.model, self._saved)

    # ------------------------------------------------------------------ arrivals

    def add_imu(self, times: NDArray[np.int64], samples: Array) -> int:
        """IMU samples (m,) ns of validity, (m, 6) rate and force in sensor axes; how many count.

        A silence as long as the whole history ends the navigation: alignment begins anew.
        """
        if self.imu.end and len(times):
            silence = (int(times[0]) - self.imu.latest_ns) * 1e-9
            if silence > self.config.estimator.buffer_s and self.started is not None:
                self._event("imu_gap", f"IMU silent for {silence:.1f} s: aligning anew")
                self.reset("IMU was silent")
        taken = self.imu.append(times, samples)
        stuck_s = self.imu.backward_in_a_row / self.config.imu.rate_hz
        if stuck_s > self.config.imu.gap_s:
            # One stamp far ahead, or a clock set back: nothing would be taken until it is made up.
            self._event("imu_time", f"IMU stamps went back {stuck_s:.1f} s ago: aligning anew")
            self.imu.restart()
            self.reset("IMU stamps went back")
        if taken:
            felt = self._constraints.feed(self.imu, max(0, self.imu.end - taken))
            if self.started is None:
                for window in felt.windows:
                    self._aligner.known.window(window)
            for aid in felt.aids:
                self.timeline.insert(aid)
        return taken

    def learn(self, message: Ephemeris | Klobuchar) -> None:
        """What a satellite broadcasts, for the raw epochs of the same source."""
        if message.source in self.raw:
            self.raw[message.source].learn(message)

    def add(
        self, m: Measurement | RawGnssEpoch, t_ns: int, sd_time_s: float = 0.0, seen_ns: int = 0
    ) -> str:
        """A measurement valid at `t_ns`; returns `accepted` or the name of its refusal."""
        if seen_ns and t_ns > seen_ns + AHEAD_NS:
            return self._refuse(m.source, "from_future")
        try:
            aids = self._intake.aids(m, t_ns, sd_time_s, seen_ns)
        except RAISED_BY_NUMBERS as error:
            self._failed.tell(m.source, repr(error))
            return self._refuse(m.source, "failed")
        if isinstance(aids, str):
            return self._refuse(m.source, aids)
        if self.started is None:
            self._aligner.known.aids(aids)
        for aid in aids:
            self.timeline.insert(aid)
        return "accepted"

    def reset(self, why: str) -> None:
        """Forget the solution and align anew."""
        self.started = None
        self.timeline.clear()
        self._saved = None
        self._aligner = self._new_aligner()
        self._aligner.reason = why

    def set_position(self, lat_rad: float, lon_rad: float, height_m: float, sd_m: float) -> None:
        """An operator's position, now: the fix to align by, or a fix like any other."""
        aid = PositionAid(
            "operator",
            self.imu.latest_ns,
            1.0 - 1e-9,
            lat_rad,
            lon_rad,
            height_m,
            (sd_m, sd_m, sd_m),
            (0.0, 0.0, 0.0),
        )
        if self.started is None:
            self._aligner.known.aids([aid])
        self.timeline.insert(aid)

    # ------------------------------------------------------------------ running

    def advance(self, record: bool = False) -> None:
        """Run as far as the IMU reaches. `record` keeps the solution at each sample in `imu`."""
        if self.started is None:
            start = self._aligner.attempt(self.imu)
            if start is None:
                return
            first = self.imu.index_after(start.t_ns) + self.imu.start
            self.estimator.initialise(start.t_ns, first, start.nav, start.xi, start.covariance)
            self.timeline.start()
            self.verdicts.reset()
            self.started = start
            self._last_position_ns = max(start.t_ns, self._last_position_ns)
            self._event("aligned", f"heading from {start.how}")
        self.timeline.run(record)
        what = broken(self.estimator)
        if what is not None:
            self._event("filter_not_finite", f"{what}: aligning anew")
            self.reset(what)
            return
        self._isolation.tell()

    def isolated(self, source: str) -> str | None:
        """Why the fault detection leaves a source out; None if it does not."""
        return self._isolation.reason(source)

    def solution(self, t_ns: int) -> Solution:
        """The solution at `t_ns`, of all that has been run by `advance`.

        Later than the newest sample it is carried ahead by holding that sample's rates, at most for
        `gap_s`: beyond it the mode says that the IMU is silent. Earlier it is the filter's state at
        that very instant, with the aids valid until then and no later ones; before the history that
        is kept (`buffer_s`, and the start) nothing is known. The mode is always that of what is
        known now.
        """
        if self.started is None or t_ns >= self.estimator.t_ns:
            return self._present(t_ns)
        if t_ns < self.timeline.oldest_ns:
            return Solution(t_ns, Mode.INVALID, "before the history that is kept")
        with self.timeline.past(t_ns):
            return self._present(t_ns)

    def _present(self, t_ns: int) -> Solution:
        mode, reason = self.mode(t_ns)
        if self.started is None:
            return Solution(t_ns, mode, reason)
        gap_ns = round(self.config.imu.gap_s * 1e9)
        return solution_of(self.estimator, self.imu, t_ns, gap_ns, mode, reason)

    def mode(self, t_ns: int) -> tuple[Mode, str]:
        """What the solution is worth at `t_ns`, and why."""
        e = self.config.estimator
        if not self.imu.end:
            return Mode.WAITING, "waiting for IMU data"
        silent = (t_ns - self.imu.latest_ns) * 1e-9
        if self.started is None:
            if silent > self.config.imu.gap_s:
                return Mode.WAITING, f"IMU silent for {silent:.1f} s"
            return Mode.ALIGNING, self._aligner.reason
        if silent > self.config.imu.gap_s:
            return Mode.INVALID, f"IMU silent for {silent:.1f} s"
        horizontal = float(np.hypot(*np.sqrt(np.diag(self.estimator.covariance)[6:8])))
        if not horizontal <= e.invalid_sd_m:
            return Mode.INVALID, f"horizontal sigma {horizontal:.0f} m"
        unaided = (t_ns - self._last_position_ns) * 1e-9
        if unaided > e.coast_after_s:
            return Mode.COASTING, f"no position fused for {unaided:.0f} s"
        return Mode.NAVIGATING, f"heading from {self.started.how}"

    # ------------------------------------------------------------------ inside

    def _refuse(self, source: str, name: str) -> str:
        self.refused.setdefault(source, Counter())[name] += 1
        return name

    def _outcome(self, entry: Entry) -> None:
        outcome = entry.outcome
        if outcome is not None and outcome.name == "fused":
            if outcome.whitened and not entry.judged:
                entry.judged = True
                self.verdicts.judge(entry.aid, outcome)
            source, t_ns = entry.aid.source, entry.key[0]
            self.last_fused_ns[source] = max(t_ns, self.last_fused_ns.get(source, 0))
            if entry.aid.locates:
                self._last_position_ns = max(t_ns, self._last_position_ns)
        if outcome is not None:
            entry.aid.judged(outcome.rows, outcome.whitened)
        if entry.error:
            self._failed.tell(entry.aid.source, entry.error)
        if self._on_outcome is not None:
            self._on_outcome(entry)
