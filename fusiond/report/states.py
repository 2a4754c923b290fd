"""Plots of states with sigma: position, velocity, attitude, errors against a truth, biases,
calibration."""

from __future__ import annotations

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.offline.compare import Errors, NothingToCompareError, errors_of, report_of
from fusiond.report.local_plane import metres_from, origin_of
from fusiond.report.page_items import Item, Plot, Section, Sentence, Series, Table
from fusiond.report.run import Estimated, Run

_NED = ("north", "east", "down")
_RPY = ("roll", "pitch", "yaw")
TWO_SIGMA = 0.9545
"""Share of a Gaussian within two sigma."""


def states(run: Run) -> Section:
    s = run.solution
    items: list[tuple[str, Item]] = []
    origin = origin_of(s)
    if origin is not None:
        metres = metres_from(origin, s)
        good = "Good: continuous; standing, all three are still."
        up = ("north", "east", "up")
        items.append(_plot("position", "Position from its beginning", "m", s.t_s, metres, up, good))
    good = "Good: about as small as the best source's between its fixes, growing only without one."
    sds = ("sigma north", "sigma east", "sigma down")
    items.append(_plot("sd_p", "Sigma of position", "m", s.t_s, s.sd_position, sds, good, log=True))
    speeds = np.column_stack([s.v, np.hypot(s.v[:, 0], s.v[:, 1])])
    good = "Good: zero when standing; down stays near zero on a road."
    names = (*_NED, "over ground")
    items.append(_plot("velocity", "Velocity", "m/s", s.t_s, speeds, names, good))
    good = "Good: centimetres a second with GNSS velocity, falling further at every stop."
    items.append(_plot("sd_v", "Sigma of velocity", "m/s", s.t_s, s.sd_v, sds, good, log=True))
    angles = np.degrees(s.rpy)
    good = "Good: within a few degrees on a road."
    items.append(_plot("roll", "Roll and pitch", "deg", s.t_s, angles[:, :2], _RPY[:2], good))
    good = "Good: turns where the way turns, and is still where the vehicle is."
    if np.isfinite(angles[:, 2]).any():  # points: a line would cross the plot at north
        yaw = [Series("yaw", angles[:, 2] % 360.0, "points")]
        items.append(("yaw", Plot("Yaw", "deg", s.t_s, yaw, good)))
    good = "Good: falls with the first turns and stops; yaw stays above roll and pitch."
    sds = ("sigma roll", "sigma pitch", "sigma yaw")
    sd = np.degrees(s.sd_rpy)
    items.append(_plot("sd_a", "Sigma of attitude", "deg", s.t_s, sd, sds, good, log=True))
    return Section("Position, velocity, attitude", items)


def _plot(
    key: str,
    title: str,
    unit: str,
    t_s: Floats,
    columns: Floats,
    names: tuple[str, ...],
    good: str,
    log: bool = False,
) -> tuple[str, Item]:
    """Plot of the columns with any known value."""
    series = [
        Series(name, column)
        for name, column in zip(names, columns.T, strict=True)
        if np.isfinite(column).any()
    ]
    if not series:
        return key, Sentence(f"{title}: the file does not hold it.")
    return key, Plot(title, unit, t_s, series, good, log=log)


# --------------------------------------------------------------------------- truth


def errors(run: Run, truth: TrajectoryTable) -> Section:
    """Errors against a truth on the solution's time axis."""
    title = "Errors against the truth"
    try:
        found = errors_of(run.solution, truth)
    except NothingToCompareError as nothing:
        text = f"Nothing can be compared: {nothing}."
        return Section(title, [("errors", Sentence(text))])
    items: list[tuple[str, Item]] = [
        ("statistics", _statistics(found)),
        ("coverage", _coverage(found)),
    ]
    quantities = (
        ("position", "m", _NED, found.position, found.sd_position),
        ("velocity", "m/s", _NED, found.velocity, found.sd_velocity),
        ("attitude", "deg", _RPY, np.degrees(found.attitude), np.degrees(found.sd_attitude)),
    )
    for what, unit, names, error, sd in quantities:
        if not np.isfinite(error).any():
            items.append((f"e_{what}", Sentence(f"Error of {what}: the truth does not hold it.")))
            continue
        for k, name in enumerate(names):
            series = [
                Series(f"error {name}", error[:, k]),
                Series("+2 sigma", 2.0 * sd[:, k], "bound", like=0),
                Series("-2 sigma", -2.0 * sd[:, k], "bound", like=0),
            ]
            good = "Good: inside the dashed lines 95 % of the time, and not always far inside."
            plot = Plot(f"Error of {what}, {name}", unit, found.t_s, series, good)
            items.append((f"e_{what}_{name}", plot))
    return Section(title, items)


def _statistics(found: Errors) -> Item:
    report = report_of(found)
    units = {"m": "m", "m_s": "m/s", "deg": "deg"}
    names = (
        *((name, "m") for name in ("horizontal", "north", "east", "down")),
        *((name, "m_s") for name in ("v_horizontal", "v_n", "v_e", "v_d")),
        *((name, "deg") for name in ("roll", "pitch", "yaw")),
    )
    rows = [
        [
            name,
            *(f"{report[f'{name}_{what}_{unit}']:.4f}" for what in ("rms", "p95", "max")),
            units[unit],
        ]
        for name, unit in names
        if report[f"{name}_rms_{unit}"] is not None
    ]
    title = f"{report['epochs']} epochs, {report['epochs_not_covered']} not covered by the solution"
    return Table(title, ("error", "RMS", "95 %", "max", ""), rows)


def _coverage(found: Errors) -> Item:
    """Shares inside sigmas; horizontally by the ellipse (fusiond.offline.compare)."""
    report = report_of(found)
    rows = [
        [f"inside {k} sigma horizontally", f"{100 * share:.1f} %", f"{100 * expected:.1f} %"]
        for k in (1, 2, 3)
        if (share := report[f"horizontal_inside_{k}_sigma"]) is not None
        and (expected := report[f"expected_inside_{k}_sigma"]) is not None
    ]
    for what, names, error, sd in (
        ("position", _NED, found.position, found.sd_position),
        ("velocity", _NED, found.velocity, found.sd_velocity),
        ("attitude", _RPY, found.attitude, found.sd_attitude),
    ):
        for k, name in enumerate(names):
            ratio = np.abs(error[:, k] / sd[:, k])
            ratio = ratio[np.isfinite(ratio)]
            if len(ratio):
                inside = f"{100 * float(np.mean(ratio <= 2.0)):.1f} %"
                rows.append([f"{what} {name} inside 2 sigma", inside, f"{100 * TWO_SIGMA:.1f} %"])
    if not rows:
        return Sentence("The solution states no sigma: coverage cannot be told.")
    for name, mean in (("horizontal_nees", "2"), ("position_nees", "3")):
        if report[name] is not None:
            rows.append([f"mean {name.replace('_nees', ' NEES')}", f"{report[name]:.2f}", mean])
    good = (
        "Good: near the Gaussian's share. Less: sigma is too small; much more: too large. A truth's"
        " own error counts as the solution's."
    )
    return Table("Coverage", ("", "found", "Gaussian"), rows, good)


def difference(first: Run, second: Run) -> Section | None:
    """Difference of two runs at common instants, as a section; None without common time."""
    try:
        found = errors_of(second.solution, first.solution)
    except NothingToCompareError:
        return None
    horizontal = np.hypot(found.position[:, 0], found.position[:, 1])
    title = "The second run against the first"
    if not np.any(found.position):
        text = f"The same positions at all {len(found.t_s)} instants that both have."
        return Section(title, [("same", Sentence(text))])
    metres = Plot(
        "Distance between the two",
        "m",
        found.t_s,
        [Series("horizontal", horizontal), Series("down", np.abs(found.position[:, 2]))],
        "Good: far below sigma where both had the same measurements.",
        log=True,
    )
    items: list[tuple[str, Item]] = [("apart", metres)]
    if np.isfinite(found.sd_position).any():
        with np.errstate(divide="ignore", invalid="ignore"):
            sigmas = np.abs(found.position / found.sd_position)
        series = [Series(name, sigmas[:, k]) for k, name in enumerate(_NED)]
        good = "Good: below 1: the two differ by less than the second says it may be wrong."
        plot = Plot("The same in sigmas of the second", "sigma", found.t_s, series, good, log=True)
        items.append(("apart_sigma", plot))
    return Section(title, items)


# --------------------------------------------------------------------------- parameters


def parameters(run: Run) -> Section | None:
    """Biases and calibration of a log."""
    if run.log is None:
        return None
    items: list[tuple[str, Item]] = []
    for what in ("gyro", "accel"):
        axes = {n: e for n, e in run.log.biases.items() if n.startswith(what)}
        if axes:
            items += _biases(what, axes)
    if not run.log.biases:
        items.append(("bias", Sentence("The log holds no state of the filter: no biases.")))
    if not run.log.calibration:
        text = "Nothing is calibrated in this configuration, or no `/calibration` came."
        items.append(("calibration", Sentence(text)))
    for name, found in run.log.calibration.items():
        title = f"{name}, beyond the configured value: {found.state}"
        good = "Good: sigma well below where it began, and the value settled within two of them."
        items.append((f"calibration_{name}", _with_bounds(title, name, found, good)))
    return Section("Biases and calibration", items)


def _biases(what: str, axes: dict[str, Estimated]) -> list[tuple[str, Item]]:
    one = next(iter(axes.values()))
    values = [Series(name, e.value) for name, e in axes.items()]
    sds = [Series(f"sigma {name}", e.sd) for name, e in axes.items()]
    good = (
        "Good: level, and within two sigma of what it was before; a bias that runs away means"
        " temperature or a wrong scale."
    )
    title = f"Bias of the {what}, as the filter's states have it"
    fall = "Good: falls from the data sheet's turn-on bias as the vehicle stops and turns."
    return [
        (f"bias_{what}", Plot(title, one.unit, one.t_s, values, good)),
        (f"sd_bias_{what}", Plot(f"Sigma of it, {what}", one.unit, one.t_s, sds, fall, log=True)),
    ]


def _with_bounds(title: str, name: str, found: Estimated, good: str) -> Plot:
    """Plot of a value with two sigma around it."""
    series = [
        Series(name, found.value),
        Series("+2 sigma", found.value + 2.0 * found.sd, "bound", like=0),
        Series("-2 sigma", found.value - 2.0 * found.sd, "bound", like=0),
    ]
    unit = "ratio" if found.unit == "1" else found.unit
    return Plot(title, unit, found.t_s, series, good)
