"""Sections on the inertial unit's samples and on the computer."""

from __future__ import annotations

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.report.page_items import Item, Plot, Section, Sentence, Series
from fusiond.report.run import Run

_BINS = 80


def inertial(run: Run) -> Section | None:
    if run.log is None:
        return None
    look = run.log.imu
    if look is None:
        text = "No source of this log can be decoded here as an inertial unit."
        return Section("Inertial unit", [("none", Sentence(text))])
    looked = f"{look.samples} samples, {look.seconds:.0f} s"
    intervals = [
        Series("arrival", look.arrived_ms, "points"),
        Series("its own stamp", look.stamped_ms),
    ]
    items: list[tuple[str, Item]] = [
        (
            "intervals",
            Plot(
                f"Interval between samples of {look.source} ({looked} looked at)",
                "ms",
                look.t_s,
                intervals,
                "Good: its own stamps in one line at the sample interval; twice that is a lost"
                " sample. Arrivals scatter by the bus and the host.",
            ),
        )
    ]
    known = look.arrived_ms[np.isfinite(look.arrived_ms)]
    if len(known):
        items.append(("arrivals", _histogram(known)))
    if not len(look.frequency_hz):
        items.append(("spectrum", Sentence("Too few samples in a row for a spectrum.")))
        return Section("Inertial unit", items)
    good = (
        "Good: flat, at the data sheet's noise, with a rise at the low end: the vehicle's motion."
        " Lines are an engine or a loose mount; a rise to the right end folds back (aliasing)."
    )
    for what, unit, density in (
        ("rate", "deg/s/√Hz", look.gyro),
        ("specific force", "m/s²/√Hz", look.accel),
    ):
        series = [Series(axis, density[:, k]) for k, axis in enumerate("xyz")]
        plot = Plot(
            f"Spectrum of {what}, sensor axes",
            unit,
            look.frequency_hz,
            series,
            good,
            x_label="Hz",
            log=True,
        )
        items.append((f"spectrum_{what}", plot))
    return Section("Inertial unit", items)


def _histogram(arrived_ms: Floats) -> Plot:
    counts, edges = np.histogram(arrived_ms, bins=_BINS)
    return Plot(
        "Intervals between arrivals",
        "samples",
        0.5 * (edges[1:] + edges[:-1]),
        [Series("count", counts.astype(np.float64), "bars")],
        "Good: one hump at the sample interval; one at 0 is frames that waited and came at once.",
        x_label="ms",
        log=True,
    )


def computer(run: Run) -> Section | None:
    if run.log is None:
        return None
    items: list[tuple[str, Item]] = []
    if run.log.tick_delay_ms is None:
        items.append(("late", Sentence("The log holds no tick: lateness is not known.")))
    else:
        t_s, tick_delay_ms = run.log.tick_delay_ms
        middle, far = np.percentile(tick_delay_ms, [50.0, 99.0])
        good = (
            f"Good: below one tick's interval; here median {middle:.2f}, 99 % below {far:.2f} ms."
        )
        series = [Series("after its deadline", tick_delay_ms)]
        items.append(("late", Plot("Lateness of the ticks", "ms", t_s, series, good)))
    if run.log.usage is None:
        items.append(
            ("usage", Sentence("The log holds no `/health`: CPU and memory are not known."))
        )
        return Section("Computer", items)
    t_s, cpu, memory = run.log.usage
    good = "Good: level, with room to 100; a rise over hours is a fault."
    items.append(("cpu", Plot("CPU", "% of a core", t_s, [Series("CPU", cpu)], good)))
    if np.isfinite(memory).any():
        good = "Good: level after the first minutes; a steady rise is a leak."
        plot = Plot("Memory, resident", "MB", t_s, [Series("memory", memory)], good)
        items.append(("memory", plot))
    return Section("Computer", items)
