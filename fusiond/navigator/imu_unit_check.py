r"""Check of the IMU's units, in a file as in a running vehicle.

Specific force: its median magnitude is gravity under any motion; another unit shows as a factor.
Rates are compared with the course of the fixes: between two fixes of a moving vehicle the yaw
rate's integral is the change of course,

    k = sum(dpsi_gyro dpsi_course) / sum(dpsi_course^2),

1 for rad/s and 180 / pi for deg/s.

With positions alone, the path between them is used (fusiond.navigator.rate_unit_check).

Before the path has turned, the unit is unknown. Rates in deg/s then show only by their bias, which
is 57 times too large: while it exceeds the data sheet, the solution counts as unproven.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from drivers.measurements import PositionFix
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.estimators.base import Estimator
from fusiond.models.model import Model
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import FORCE_ERROR, RATE_ERROR
from fusiond.navigation.imu_buffer import ImuBuffer, squares
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.rate_unit_check import PROOF, WayTurns

# In a loop of 2 g for half of the time nobody flies, and half of gravity for as long nobody falls.
FORCE_RANGE = (0.5, 2.0)
FORCE_UNITS = {"g": STANDARD_GRAVITY_M_S2, "milli-g": 1e-3 * STANDARD_GRAVITY_M_S2, "cm/s^2": 1e-2}
# RMS over a file, or over ten seconds, that no vehicle turns with: a turn a second, all the time.
MOST_RATE_RAD_S = 2.0 * math.pi
RMS_S = 10.0
# A course is one from the speed at which alignment takes it for the heading by default. Over a
# second a bend changes it by more than its noise; changes of 30 deg in all show the factor of 57.
COURSE_SPEED_M_S = 3.0
COURSE_STEP_NS = (900_000_000, 2_100_000_000)
NEVER_NS = -(1 << 62)
LEAST_TURN_RAD = math.radians(30.0)
DEGREES_RANGE = (10.0, 300.0)
# Rates that fit the course: what its noise and a bias of some deg/s make of a factor of one.
FITS_RANGE = (0.5, 2.0)
# A bias so many sigmas of its data sheet off is none of that sheet: chance does that on one axis of
# 16,000. Of rates in deg/s all three axes stay below it on one vehicle in 6,000.
SHEET_SIGMAS = 4.0


def force_unit(magnitude: float) -> str | None:
    """Text on forces of this median magnitude; None if they can be m/s^2."""
    if FORCE_RANGE[0] <= magnitude / STANDARD_GRAVITY_M_S2 <= FORCE_RANGE[1]:
        return None
    unit = other_unit(magnitude)
    if unit is None:
        return reason("force_unknown", size=magnitude)
    name, factor = unit
    return reason("force_unit", size=magnitude, unit=name, factor=factor)


def other_unit(magnitude: float) -> tuple[str, float] | None:
    """Unit in which a force of this magnitude is gravity, and its size in m/s^2."""
    for name, factor in FORCE_UNITS.items():
        if FORCE_RANGE[0] <= magnitude * factor / STANDARD_GRAVITY_M_S2 <= FORCE_RANGE[1]:
            return name, factor
    return None


def rms_unit(rms_rad_s: float) -> str | None:
    """Text on rates of this RMS; None if a vehicle can turn so."""
    if rms_rad_s <= MOST_RATE_RAD_S:
        return None
    return reason("rate_size", size=rms_rad_s)


class CourseTurns:
    """Ratio k of the gyro's turns to those of a receiver's course."""

    def __init__(self) -> None:
        self._last: tuple[int, float] | None = None
        self.next_ns = NEVER_NS
        """Instant before which no velocity adds information."""
        self._product = self._square = self._turn = 0.0

    def fix(self, t_ns: int, v_ned: tuple[float, ...], turned: Callable[[int, int], float]) -> None:
        """A velocity (m/s) at an instant, in order; `turned(a, b)` (rad) is the gyro's between two
        instants, NaN where it is not known."""
        last = self._last
        if t_ns < self.next_ns:
            return
        if not COURSE_SPEED_M_S <= math.hypot(*v_ned[:2]) < math.inf:
            return
        course = math.atan2(v_ned[1], v_ned[0])
        self._last, self.next_ns = (t_ns, course), t_ns + COURSE_STEP_NS[0]
        if last is None:
            return
        last_ns, before = last
        gyro = turned(last_ns, t_ns)
        if t_ns - last_ns > COURSE_STEP_NS[1] or not math.isfinite(gyro):
            return
        change = math.remainder(course - before, 2.0 * math.pi)
        self._product += gyro * change
        self._square += change**2
        self._turn += abs(change)

    @property
    def decided(self) -> bool:
        """True if the course has turned enough for a decision."""
        return self._turn >= LEAST_TURN_RAD

    @property
    def fits(self) -> bool:
        """True if the rates are known to be in rad/s."""
        return self.decided and FITS_RANGE[0] <= self._factor <= FITS_RANGE[1]

    @property
    def _factor(self) -> float:
        return abs(self._product / self._square)

    def said(self) -> str | None:
        """Text on wrong rates; None if they fit or are undecided."""
        if not self.decided or not DEGREES_RANGE[0] <= (factor := self._factor) <= DEGREES_RANGE[1]:
            return None
        return reason("rate_turns", factor=factor)

    def restart(self) -> None:
        """Forget the turns so far."""
        self._product = self._square = self._turn = 0.0


class RateUnits:
    """Check of a running vehicle's rates. `wrong`: text on rates in another unit, by the last turns
    of 30 deg, the last chord or the last ten seconds with evidence.

    `bias_sd` (rad/s) is one sigma of the data sheet's. `on_event(code, text)` receives `imu_units`
    and `imu_units_well`.
    """

    def __init__(self, bias_sd: float, on_event: Callable[[str, str], None]) -> None:
        self._bias_sd, self._event = bias_sd, on_event
        self._first: tuple[Model, list[tuple[int, int]]] | None = None
        """Columns and slots of the first bias of each gyro and accelerometer, in the filter's
        model."""
        self.change()

    def change(self) -> None:
        """Reset for another sensor."""
        self.wrong: str | None = None
        self.fits = False
        """True if the rates are known to be in rad/s."""
        self._turns: dict[str, CourseTurns] = {}
        self.due_ns: dict[str, int] = {}
        """Instant before which a receiver's next velocity adds no information."""
        self._ways: dict[str, WayTurns] = {}
        self._squares, self._count, self._since_ns = 0.0, 0, 0

    def unproven(self, estimator: Estimator) -> tuple[str | None, float]:
        """Reason why a solution with biases outside the data sheet is unproven before the course
        has turned, and their size in sigmas of the sheet: the unit's noise and scale may be as many
        times worse. None and 1 for normal biases."""
        if self.fits:
            return None, 1.0
        model = estimator.model
        if self._first is None or self._first[0] is not model:
            columns = [*range(RATE_ERROR, RATE_ERROR + 3), *range(FORCE_ERROR, FORCE_ERROR + 3)]
            slots = [(c, s) for c in columns for s in model.parameters(c)[:1]]
            self._first = model, slots
        worst, found, xi = SHEET_SIGMAS, None, estimator.xi
        for column, slot in self._first[1]:
            bias = abs(xi.item(slot))
            sigmas = bias / model.initial.item(slot)
            if sigmas > worst:
                gyro, worst = column < FORCE_ERROR, sigmas
                size, unit = (math.degrees(bias), "deg/s") if gyro else (bias, "m/s^2")
                sensor = "Gyro" if gyro else "Accelerometer"
                found = reason("bias_size", sensor=sensor, size=size, unit=unit, sigmas=sigmas)
        return (None, 1.0) if found is None else (found, worst)

    def samples(self, imu: ImuBuffer, new: int) -> None:
        """Process the samples from row `new` on."""
        count = imu.end - new
        if not count:
            return
        if not self._count:
            self._since_ns = int(imu.times[new])
        for way in () if self.fits else self._ways.values():
            if way.samples(imu.times[new : imu.end], imu.samples[new : imu.end, 2]):
                self._weigh(way)
        self._squares += squares(imu.samples, new, imu.end)
        self._count += count
        if imu.latest_ns - self._since_ns >= RMS_S * 1e9:
            self._report(rms_unit(math.sqrt(self._squares / self._count)) or self.wrong)
            self._squares, self._count = 0.0, 0

    def fix(
        self, m: object, t_ns: int, imu: ImuBuffer, measurements: Sequence[AidingMeasurement]
    ) -> None:
        """Add a measurement valid at `t_ns`, as its aiding measurements: velocities count, and
        positions of a source without velocities."""
        if not isinstance(m, PositionFix) or m.v_ned_m_s is None:
            for measurement in () if self.fits else measurements:
                for candidate in measurement.candidates():
                    if isinstance(candidate, PositionCandidate):
                        way = self._ways.setdefault(measurement.source, WayTurns(self._bias_sd))
                        way.fix(candidate._replace(t_ns=t_ns))
            return
        turns = self._turns.get(m.source)
        if turns is None:
            turns = self._turns[m.source] = CourseTurns()
        turns.fix(t_ns, m.v_ned_m_s[:2], lambda a, b: _turned(imu, a, b))
        self.due_ns[m.source] = turns.next_ns
        if turns.decided:
            self._report(turns.said())
            self.fits = self.wrong is None and (self.fits or turns.fits)
            turns.restart()

    def _weigh(self, way: WayTurns) -> None:
        """Judge the unit by the continued path."""
        evidence = way.log_odds()
        if abs(evidence) <= PROOF:
            return
        well = evidence > 0.0
        self._report(None if well else reason("rate_path"))
        self.fits = well
        way.restart()

    def _report(self, wrong: str | None) -> None:
        if wrong is not None and self.wrong is None:
            self._event("imu_units", wrong)
        elif wrong is None and self.wrong is not None:
            self._event("imu_units_well", "Rates fit the turns of the course again")
        self.wrong = wrong


def _turned(imu: ImuBuffer, begin_ns: int, end_ns: int) -> float:
    """Yaw (rad) by the gyro between two instants; NaN if samples are missing."""
    if not imu.end or begin_ns < imu.oldest_ns or end_ns > imu.latest_ns:
        return math.nan
    rows = slice(imu.index_after(begin_ns), imu.index_after(end_ns))
    if rows.start == rows.stop:
        return math.nan
    mean = float(np.add.reduce(imu.samples[rows, 2])) / (rows.stop - rows.start)
    return mean * (end_ns - begin_ns) * 1e-9
