"""`fusiond calibrate`: mounting, lever arms, time offsets and scales from one recorded drive.

The drive passes through the daemon's navigator twice, the second time with the first result as
configured values and with the same configured sigmas: a mounting that is 10 deg off affects lever
arms and the start, and the remainder in the second pass is small. The sigmas are those of the
second pass alone, so that no measurement counts twice.

Roll of the mounting has no effect on wheels or axle. It is estimated from gravity: roads lean to
either side by their crown, 2 to 2.5 % to the kerb, so the mean roll of driving straight on is that
of the mounting, within a crown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.si_units import DEG, PER_ROOT_HOUR, imu_noise
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    AXLE_LEVER,
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    FIX_TIME,
    MOUNTING,
    VELOCITY_TIME,
    WHEEL_LATENCY,
    WHEEL_SCALE,
)
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    rotation_vector_to_quaternion,
)
from fusiond.navigator.calibration import (
    NOT_OBSERVED_SHARE,
    SETTLED_SHARE,
    WANDERING,
    CalibrationState,
    Parameter,
    calibration_slots,
)
from fusiond.navigator.navigator import Navigator
from fusiond.offline.calibration_config import ROLL, calibrated, configured, fragment
from fusiond.offline.process import process

Array = NDArray[np.float64]
Pass = Callable[[Config, Callable[[Navigator], None]], dict[str, Any]]
"""Run through the recorded drive with a configuration, which shows the navigator as it advances;
the report of `process`."""

PASSES = 2
# Interval between two looks at the solution (ns): a bend or a stop takes seconds.
STEP_NS = 500_000_000
# Least speed, turn rate and acceleration of driving, a bend and a change of speed: 3 deg/s at 10
# m/s is a bend of 190 m radius with 0.5 m/s^2, three times the effect of a road's unevenness on a
# filtered velocity.
DRIVING_M_S = 2.0
BEND_RAD_S = 3.0 * DEG
CHANGE_M_S2 = 0.5
# Least seconds of a drive, of bends and of changes of speed: two corners, two stops.
LEAST_S = {"driving": 60.0, "bends": 10.0, "changes of speed": 10.0}
# Least time straight on at an even speed (s), in all: a kilometre of road.
STRAIGHT_S = 60.0
STRAIGHT_RAD_S, EVEN_M_S2, STRAIGHT_M_S = 1.0 * DEG, 0.3, 5.0
# One sigma of a road's lean: the usual crown is 2 % (AASHTO Green Book, section 4.2: 1.5 to 2 %).
CROWN_RAD = 0.02

SHOWN_BY = {
    MOUNTING: ("driving", "bends", "changes of speed"),
    AXLE_LEVER: ("driving", "bends"),
    WHEEL_SCALE: ("driving",),
    WHEEL_LATENCY: ("changes of speed",),
    FIX_TIME: ("driving", "changes of speed"),
    VELOCITY_TIME: ("changes of speed",),
    ANTENNA_LEVER: ("bends",),
    BAROMETER_OFFSET: ("driving",),
    BAROMETER_SCALE: ("driving",),
    BAROMETER_AIRFLOW: ("changes of speed",),
}


@dataclass(frozen=True, slots=True)
class Finding:
    """Recommended configuration of a parameter: its value in published units under `key`, one
    sigma, state and text. `key` is empty if the configuration has none."""

    key: str
    value: float
    sd: float
    state: CalibrationState
    text: str


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of a drive: findings by published name, seconds of the motion that showed them,
    observed noise (deg/sqrt(h), m/s/sqrt(h)) while driving and at rest, the resulting
    configuration, and the TOML text. `result` is that of `process` in the last pass."""

    findings: dict[str, Finding]
    shown_s: dict[str, float]
    noise: dict[str, tuple[float, float]]
    config: Config
    toml: str
    result: dict[str, Any]

    def as_json(self) -> dict[str, Any]:
        """Values for `--json`."""
        return {
            "parameters": {name: asdict(found) for name, found in self.findings.items()},
            "shown_s": self.shown_s,
            "noise_deg_sqrt_h_m_s_sqrt_h": self.noise,
            "toml": self.toml,
            "process": self.result,
        }


def files(
    imu_path: Path | None, measurements: list[tuple[str, Path]], can_log: Path | None = None
) -> Pass:
    """A pass through files. Raises what `process` raises."""
    return lambda config, look: process(config, imu_path, measurements, can_log=can_log, watch=look)


def calibrate(
    config: Config,
    navigate: Pass,
    on_pass: Callable[[int, int], None] = lambda done, total: None,
) -> Calibration:
    """Find the calibration that a drive shows. Raises what `navigate` raises."""
    now = config
    values: dict[str, Parameter] = {}
    for done in range(PASSES):
        drive = _Drive(rolled=ROLL in values and _seen(values[ROLL]))
        result = navigate(now, drive.look)
        values = drive.parameters()
        before, now = now, calibrated(now, values)
        on_pass(done + 1, PASSES)
    findings = {
        name: _finding(name, p, *configured(now, before, p), drive) for name, p in values.items()
    }
    noise = drive.noise(now.imu)
    sentences = [f.text for f in findings.values()]
    if not drive.slots:
        sentences = [
            "nothing to calibrate: no measurement has a parameter to estimate; a road vehicle's"
            " mounting and axle need constraints.non_holonomic.enabled = true"
        ]
    sentences += [
        f"noise seen {when}: gyro {gyro:.2g} deg/sqrt(h), accelerometer {accel:.2g} m/s/sqrt(h);"
        f" configured {now.imu.gyro_noise_deg_sqrt_h:g} and {now.imu.accel_noise_m_s_sqrt_h:g}: the"
        " filter adds what it sees by itself"
        for when, (gyro, accel) in noise.items()
    ]
    toml = fragment(config, now, values, sentences)
    return Calibration(findings, drive.shown_s(), noise, now, toml, result)


def _seen(p: Parameter) -> bool:
    return p.state is not CalibrationState.NOT_OBSERVED


def _finding(name: str, p: Parameter, key: str, value: float, drive: _Drive) -> Finding:
    digits = max(0, 1 - math.floor(math.log10(p.sd)))
    text = f"{key or name} {value:+.{digits}f}, sigma {p.sd:.{digits}f}: {_why(p, drive)}"
    return Finding(key, value, p.sd, p.state, text)


def _why(p: Parameter, drive: _Drive) -> str:
    """Explain a parameter's state."""
    if p.name == ROLL:
        how = "the mean of driving straight on; roads lean by as much"
        return how if _seen(p) else f"left as it is: {p.value:+.2g} is less than its sigma; {how}"
    match p.state:
        case CalibrationState.SETTLED:
            return "settled"
        case CalibrationState.NOT_OBSERVED:
            return f"not observed: {drive.missing(p)}"
        case _ if p.sd > SETTLED_SHARE * p.prior_sd:
            return (
                f"observed, not settled: a sigma of {SETTLED_SHARE * p.prior_sd:.2g} would be;"
                f" {drive.more(p)}"
            )
        case _:
            return "observed, not settled: it has moved by more than its sigma in the last minute"


class _Drive:
    """Watch of a navigator: its calibration, and the vehicle's motion that shows it.

    `rolled`: an earlier pass has removed a roll.
    """

    def __init__(self, rolled: bool) -> None:
        self._rolled = rolled
        self._last: Navigator | None = None
        self._next = 0
        self._cell = -1
        self._t_s: list[float] = []
        self._rows: list[Array] = []
        self._history: list[tuple[float, tuple[Parameter, ...]]] = []
        self.slots: list[str] = []

    def look(self, navigator: Navigator) -> None:
        """Evaluate the navigator after an advance."""
        if self._last is not navigator:
            self._last = navigator
            self.slots = [s.name for s in calibration_slots(navigator.model)]
        if navigator.started is None:
            return
        found = navigator.calibrating.parameters
        if found and (not self._history or self._history[-1][1] is not found):
            self._history.append((navigator.estimator.t_ns * 1e-9, found))
        imu, passed = navigator.imu, navigator.estimator.sample
        first = max(self._next, imu.index_after(navigator.started.t_ns) + imu.start)
        self._next = max(passed, self._next)
        times = imu.times[first - imu.start : passed - imu.start]
        for row in np.flatnonzero(np.diff(times // STEP_NS, prepend=self._cell)):
            at = first - imu.start + int(row)
            mounting = navigator.model.slots_of(MOUNTING)
            turn = [navigator.estimator.xi[slot] for slot in mounting] or [0.0, 0.0]
            self._t_s.append(float(times[row]) * 1e-9)
            roll = _roll(imu.nav[at, 6:], float(turn[0]), float(turn[1]))
            self._rows.append(
                np.concatenate(
                    [imu.nav[at, 3:5], [roll[0], roll[1], imu.sigmas[at, 6]], imu.densities[at]]
                )
            )
        if len(times):
            self._cell = int(times[-1]) // STEP_NS

    def _table(self) -> tuple[Array, Array, Array, Array]:
        """Speed (n,), turn rate (n,), acceleration along (n,), rows (n, 11)."""
        if len(self._rows) < 3:
            return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 11))
        rows, t = np.array(self._rows), np.array(self._t_s)
        speed = np.hypot(rows[:, 0], rows[:, 1])
        return speed, np.gradient(np.unwrap(rows[:, 3]), t), np.gradient(speed, t), rows

    def shown_s(self) -> dict[str, float]:
        """Duration (s) of the motion that makes a parameter observable."""
        speed, turn, change, _ = self._table()
        driving = speed > DRIVING_M_S
        step_s = STEP_NS * 1e-9
        return {
            "driving": step_s * float(driving.sum()),
            "bends": step_s * float((driving & (np.abs(turn) > BEND_RAD_S)).sum()),
            "changes of speed": step_s * float((np.abs(change) > CHANGE_M_S2).sum()),
        }

    def missing(self, p: Parameter) -> str:
        """Reason why a parameter was not observed."""
        shown = self.shown_s()
        lacking = [what for what in SHOWN_BY[p.kind] if shown[what] < LEAST_S[what]]
        if lacking:
            return "the drive has " + " and ".join(
                f"no {what}" if shown[what] < 1.0 else f"{shown[what]:.0f} s of {what} only"
                for what in lacking
            )
        share = (1.0 - NOT_OBSERVED_SHARE) * 100.0
        return f"what was fused narrows its sigma by less than {share:.0f} %"

    def more(self, p: Parameter) -> str:
        """Motion that would determine a parameter better."""
        shown = self.shown_s()
        said = ", ".join(f"{shown[what]:.0f} s of {what}" for what in SHOWN_BY[p.kind])
        return f"the drive has {said}: more is needed"

    def parameters(self) -> dict[str, Parameter]:
        """Parameters by name at the end; of a varying one (offsets in time) the mean over the
        second half, and its spread. Roll follows from the mounting's pitch and yaw."""
        if not self._history:
            return {}
        last_s = self._history[-1][0]
        first_s = self._history[0][0]
        half = [found for t_s, found in self._history if t_s >= 0.5 * (first_s + last_s)]
        found: dict[str, Parameter] = {}
        for i, p in enumerate(self._history[-1][1]):
            if p.kind in WANDERING:
                values = np.array([each[i].value for each in half])
                sd = math.hypot(p.sd, float(values.std()))
                found[p.name] = replace(p, value=float(values.mean()), sd=sd)
                if p.state is CalibrationState.SETTLED and sd > SETTLED_SHARE * p.prior_sd:
                    found[p.name] = replace(found[p.name], state=CalibrationState.OBSERVED)
            else:
                found[p.name] = p
        roll = self._mean_roll()
        if roll is not None:
            found[ROLL] = roll
        return found

    def _mean_roll(self) -> Parameter | None:
        if MOUNTING not in {p.kind for p in self._history[-1][1]}:
            return None
        speed, turn, change, rows = self._table()
        straight = (
            (speed > STRAIGHT_M_S) & (np.abs(turn) < STRAIGHT_RAD_S) & (np.abs(change) < EVEN_M_S2)
        )
        if straight.sum() * STEP_NS * 1e-9 < STRAIGHT_S:
            return None
        rolls, sigmas = rows[straight, 2], rows[straight, 4]
        value = float(rolls.mean())
        sd = math.hypot(CROWN_RAD, float(sigmas.mean()))
        seen = self._rolled or abs(value) > sd
        state = CalibrationState.OBSERVED if seen else CalibrationState.NOT_OBSERVED
        return Parameter(ROLL, MOUNTING, MOUNTING, value / DEG, sd / DEG, math.inf, state)

    def noise(self, imu: Imu) -> dict[str, tuple[float, float]]:
        """Gyro (deg/sqrt(h)) and accelerometer (m/s/sqrt(h)) noise, median of the rms of the axes,
        at rest and while driving, if there is enough data."""
        speed, _, _, rows = self._table()
        sheet = imu_noise(imu)
        found = {}
        for when, chosen in {"at rest": speed < 0.5, "driving": speed > DRIVING_M_S}.items():
            if chosen.sum() * STEP_NS * 1e-9 < LEAST_S["bends"]:
                continue
            gyro = np.sqrt(np.median(rows[chosen, 5:8].mean(axis=1)) + sheet.rate_noise**2)
            accel = np.sqrt(np.median(rows[chosen, 8:11].mean(axis=1)) + sheet.force_noise**2)
            found[when] = (float(gyro) / DEG / PER_ROOT_HOUR, float(accel) / PER_ROOT_HOUR)
        return found


def _roll(q: Array, pitch: float, yaw: float) -> tuple[float, float]:
    """Roll and yaw (rad) of the vehicle whose IMU, at attitude `q`, is mounted at pitch and yaw."""
    turn = dcm_from_quaternion(np.array(rotation_vector_to_quaternion(0.0, pitch, yaw)))
    c = dcm_from_quaternion(q) @ turn.T
    return math.atan2(c[2, 1], c[2, 2]), math.atan2(c[1, 0], c[0, 0])
