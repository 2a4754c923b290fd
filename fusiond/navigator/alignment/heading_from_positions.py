r"""Heading from positions alone: fixes without velocity, possibly delayed, of a moving vehicle.

A bank of headings (fusiond.navigator.alignment.heading_bank) starts at the end of the last rest,
with level and gyro bias; for a vehicle that has never stood, at its first fix, with priors of a
road's slope and speed. Every later measurement is applied at its own instant: the bank runs
`DELAYED_NS` behind the samples, so that delayed measurements arrive in time. The heading is the
rotation that fits the path of the IMU to the fixes:

    sd_yaw ~ sqrt(2) sd_fix / way,   6 deg after 280 m with fixes of 20 m

The no-slip constraint is a measurement, too: at constant speed nothing else shows the heading.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.estimators.invariant import InvariantFilter
from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model, TooManyStatesError
from fusiond.models.vehicle_parameter_blocks import MOUNTING, mounting_block
from fusiond.navigation.alignment import level
from fusiond.navigation.error_model import DV, PHI
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_rpy, skew
from fusiond.navigator.alignment.evidence import AlignmentEvidence, Standstill
from fusiond.navigator.alignment.heading_bank import CELL_SD_RAD, YAWS_RAD, Cell, HeadingBank
from fusiond.navigator.alignment.motion_fit import TILT_SD_RAD
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.rate_bias_at_rest import REST_VELOCITY_SD, rest_bias
from fusiond.navigator.alignment.start import Levelled, Place, Start, build_start
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.motion_constraints import GATE
from fusiond.navigator.timeline import MOST_WAITING

Array = NDArray[np.float64]

# An RDSS fix comes 0.6 to 5 s after its instant (two hops up and down, the centre's queue).
DELAYED_NS = 6_000_000_000
# The bank is run in pieces of this length: a tick has little to do, and each piece enough.
PIECE_NS = 100_000_000
# One sigma (rad) of the heading at which the filter takes over: its sine is then wrong by 1.5 %
# and its covariance by as much.
KNOWN_SD_RAD = math.radians(10.0)
# The same of the speed (m/s).
KNOWN_SD_M_S = 2.0
# Fixes that a start needs: place, heading and speed are four numbers, and one fix may be wrong.
FEWEST_FIXES = 3
# Fixes at rest that are used for the place at its end.
MOST_AT_REST = 20
# The first fix is taken by all cells; until then the place is known to this (m).
ANYWHERE_M = 10_000.0
# How likely a sensor that was quiet for `levelling_s` was not at rest, before any fix says so.
QUIET_AT_SPEED = 0.1
# Speed (m/s) of a road vehicle that is met on the move, and one sigma: town to motorway.
ROAD_SPEED_M_S, ROAD_SPEED_SD_M_S = 12.5, 10.0
# One sigma (m/s) across, of the IMU ahead of the axle in a bend, and up or down.
ACROSS_SD_M_S = 1.0
# No slip (m/s) sideways and down, as `[constraints.non_holonomic]` has it, where that is off.
SLIP_SD_M_S, HEAVE_SD_M_S, LEAST_SPEED_M_S = 0.2, 0.5, 2.0
SLIP_NS = 500_000_000
HOW = "positions on the way"


def bank_model(model: Model, options: AlignmentOptions) -> Model:
    """Vehicle's model, with the angle between course and heading if it lacks one."""
    if model.slots_of(MOUNTING):
        return model
    try:
        return Model(
            model.name, (*model.blocks, mounting_block(options.course_sd_rad)), model.hold_height
        )
    except TooManyStatesError:
        return model


class Track:
    """Measurements before the heading is known, and the bank of filters started from them."""

    def __init__(self, options: AlignmentOptions, model: Model) -> None:
        self._options = options
        self._model = bank_model(model, options)
        self._size = model.size
        # Where the vehicle's own constraint is off, the bank has one of its own.
        self._own_slip = not model.slots_of(MOUNTING) and bool(self._model.slots_of(MOUNTING))
        self._measurements: list[AidingMeasurement] = []
        self._bank: HeadingBank | None = None
        self._left: Standstill | None = None
        self._started_ns = 0

    def receive(self, measurements: Sequence[AidingMeasurement]) -> None:
        """Receive measurements and constraints."""
        if "positions" not in self._options.heading:
            return
        for measurement in measurements:
            if not measurement.screened:
                insort(self._measurements, measurement, key=lambda a: (a.t_ns, a.source))
        del self._measurements[:-MOST_WAITING]

    def give_up(self) -> None:
        """Discard everything: another source gives the heading."""
        self._measurements.clear()
        self._bank = self._left = None

    @property
    def running(self) -> bool:
        """True if a bank is running."""
        return self._bank is not None

    def start(
        self, known: AlignmentEvidence, noise: ImuNoise, imu: ImuBuffer, place: Place
    ) -> Start | None:
        """Start of the filter, once the heading is known; else None."""
        until_ns = imu.latest_ns - DELAYED_NS
        if self._bank is None:
            self._bank = self._begin(known, noise, imu, place, until_ns)
        bank = self._bank
        if bank is None:
            self._forget(imu, known.standstill)
            return None
        if until_ns < bank.t_ns + PIECE_NS:
            return None
        due = [measurement for measurement in self._measurements if measurement.t_ns <= until_ns]
        del self._measurements[: len(due)]
        if self._own_slip:
            due = self._with_slip(due, bank.t_ns, until_ns)
        bank.advance(imu, due, until_ns)
        if bank.lost:
            self._bank = None
            if bank.backwards:
                known.report("imu_backwards", reason("imu_backwards_by_fixes"))
                return None
            known.doubted(reason("searching_again"))
            return None
        found = bank.mixture()
        if bank.positions < FEWEST_FIXES or found.sd_yaw > KNOWN_SD_RAD:
            known.doubted(
                reason(
                    "searching",
                    sd=math.degrees(found.sd_yaw),
                    fixes=bank.positions,
                    limit=math.degrees(KNOWN_SD_RAD),
                    least=FEWEST_FIXES,
                )
            )
            return None
        if found.sd_speed > KNOWN_SD_M_S:
            known.doubted(reason("searching_speed", sd=found.sd_speed, limit=KNOWN_SD_M_S))
            return None
        n = self._size
        return Start(bank.t_ns, found.nav, found.xi[:n], found.covariance[:n, :n], HOW, turns=True)

    def _begin(
        self,
        known: AlignmentEvidence,
        noise: ImuNoise,
        imu: ImuBuffer,
        place: Place,
        until_ns: int,
    ) -> HeadingBank | None:
        """Start a bank from the end of a rest or the first fix; None without either."""
        if place.fix is not None and place.fix.height_m is not None:
            place = place._replace(sd_height=ANYWHERE_M)  # the bank is told the fixes themselves
        left = self._left or known.left
        if left is not None and left.end_ns < max(imu.oldest_ns, self._started_ns):
            left = None
        if left is not None and known.rested(left):
            self._left = left
            if left.end_ns > until_ns:
                return None
            there = [
                a
                for a in self._measurements
                if a.locates and left.start_ns <= a.t_ns <= left.end_ns
            ]
            begin_ns, fixes = left.end_ns, len(there)
            cells = self._from_rest(noise, imu, place, left, there[-MOST_AT_REST:])
            if not known.confirmed_rest(left):
                cells += self._on_the_move(imu, place, begin_ns, QUIET_AT_SPEED)
        else:
            first = next(
                (a for a in self._measurements if a.locates and a.t_ns >= imu.oldest_ns), None
            )
            if known.levelled() is not None or first is None or first.t_ns > until_ns:
                return None
            begin_ns, fixes = first.t_ns - 1, 0
            cells = self._on_the_move(imu, place, begin_ns, 1.0)
        self._left, self._started_ns = None, begin_ns + 1
        self._measurements = [
            measurement for measurement in self._measurements if measurement.t_ns > begin_ns
        ]
        return HeadingBank(cells, begin_ns, fixes, self._options.max_reverse_m_s)

    def _from_rest(
        self,
        noise: ImuNoise,
        imu: ImuBuffer,
        place: Place,
        left: Standstill,
        there: Sequence[AidingMeasurement],
    ) -> list[Cell]:
        """Cells of a vehicle at rest until the end of `left`; its fixes `there` give the place."""
        place = place._replace(fix=None, sd=ANYWHERE_M)
        roll, pitch = level(left.mean_force)
        there = [replace(measurement, t_ns=left.end_ns) for measurement in there]
        cells = []
        for yaw in YAWS_RAD:
            dcm = dcm_from_rpy(roll, pitch, yaw)
            start = build_start(
                self._model,
                left.end_ns,
                place,
                dcm,
                CELL_SD_RAD,
                np.zeros(3),
                REST_VELOCITY_SD,
                HOW,
                bias=rest_bias(noise, left, dcm, float(place.where[0])),
                levelled=Levelled(dcm),
            )
            cell = self._cell(imu, start, 1.0)
            for measurement in there:
                cell.filter.update(measurement)
            cells.append(cell)
        return cells

    def _on_the_move(self, imu: ImuBuffer, place: Place, t_ns: int, weight: float) -> list[Cell]:
        """Filters for a vehicle of unknown speed on a road of unknown slope."""
        where, sd = self._place(place.where, t_ns)
        place = Place(None, where, sd, place.sd_height)
        cells = []
        for yaw in YAWS_RAD:
            dcm = dcm_from_rpy(0.0, 0.0, yaw)
            velocity, zero = ROAD_SPEED_M_S * dcm[:, 0], np.zeros(3)
            start = build_start(self._model, t_ns, place, dcm, CELL_SD_RAD, velocity, zero, HOW)
            p = start.covariance
            p[0, 0] = p[1, 1] = TILT_SD_RAD**2
            p[3:6, 3:6] = (
                dcm * np.square((ROAD_SPEED_SD_M_S, ACROSS_SD_M_S, ACROSS_SD_M_S))
            ) @ dcm.T
            cell = self._cell(imu, start, weight)
            # The speed is one along the body, whatever the heading: dv = e + [v x] phi.
            turn = np.eye(self._model.size)
            turn[DV : DV + 3, PHI : PHI + 3] = skew(velocity)
            turn = cell.filter.of_vehicle(start.nav, start.xi) @ turn
            cell.filter.covariance[:] = turn @ cell.filter.covariance @ turn.T
            cells.append(cell)
        return cells

    def _cell(self, imu: ImuBuffer, start: Start, weight: float) -> Cell:
        """Started filter."""
        found = InvariantFilter(self._model, self._options.gap_s, settles=False)
        first = imu.index_after(start.t_ns) + imu.start
        found.initialise(start.t_ns, first, start.nav, start.xi, start.covariance)
        found.turns = True
        return Cell(found, weight)

    def _place(self, where: Array, t_ns: int) -> tuple[Array, float]:
        """Position (rad, rad, m) of a moving vehicle at an instant, and one sigma (m): the last fix
        with the distance driven since, or about its position `where`."""
        fixes = [
            o
            for a in self._measurements
            for o in a.candidates()
            if isinstance(o, PositionCandidate)
        ]
        before = [o for o in fixes if o.t_ns <= t_ns]
        if not before:
            return where, ANYWHERE_M
        o = before[-1]
        way = math.hypot(ROAD_SPEED_M_S, ROAD_SPEED_SD_M_S) * (t_ns - o.t_ns) * 1e-9
        return np.array([o.lat_rad, o.lon_rad, where[2]]), math.hypot(max(o.sd[:2]), way)

    def _with_slip(
        self, due: list[AidingMeasurement], begin_ns: int, until_ns: int
    ) -> list[AidingMeasurement]:
        """Due measurements, and the no-slip constraint twice a second."""
        lever = self._options.no_slip_m or (0.0, 0.0, 0.0)
        first = (begin_ns // SLIP_NS + 1) * SLIP_NS
        own: list[AidingMeasurement] = [
            NonHolonomicConstraint(
                "no_slip", t_ns, GATE, SLIP_SD_M_S, HEAVE_SD_M_S, LEAST_SPEED_M_S, lever
            )
            for t_ns in range(first, until_ns + 1, SLIP_NS)
        ]
        return sorted([*due, *own], key=lambda a: (a.t_ns, a.source))

    def _forget(self, imu: ImuBuffer, standstill: Standstill | None) -> None:
        """Drop measurements that no bank can use."""
        since = imu.latest_ns - 2 * DELAYED_NS
        begin = since if standstill is None else min(since, standstill.start_ns)
        old = [a for a in self._measurements if a.t_ns < since]
        kept = [a for a in old if a.locates and a.t_ns >= begin][-MOST_AT_REST:]
        self._measurements = kept + self._measurements[len(old) :]
