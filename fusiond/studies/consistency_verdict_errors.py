r"""Error rate and detection delay of the consistency verdict.

The filter is that of `level_axis` with the MEMS IMU of config/vehicle.toml (0.1 m/s/sqrt(h),
0.3 deg/sqrt(h)), aided by GNSS, 1.5 m every 1 s, or by RDSS, 20 m every 1.5 s. Faults set in while
the window is full of good innovations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binomtest

from fusiond.integrity.consistency import FEWEST, LAGS, ConsistencyOptions, judge
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, step_counter
from fusiond.studies.single_axis_ins import AidedAxis, Fault, innovations

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

DEFAULT_RUNS = 20_000
DIMENSIONS = (1, 2, 3)
WINDOWS = (20, 50, 100, 200)
VERDICTS = ("consistent", "optimistic", "pessimistic", "coloured")
CONFIDENCE = 0.99
SETTLED, WATCHED = 300, 1500
"""Epochs before the fault, and epochs in which it may be detected."""
NOTICED = 0.9
PAPER = {
    "k": 50,
    "dof": 100,
    "nis_average": 0.893,
    "nis_interval": [0.74, 1.3],
    "rho": [-0.4054, -0.0259, -0.0411, -0.0881, 0.1637, -0.1903, 0.0842, 0.1781],
    "rho_interval": [-0.2772, 0.2772],
    "claim": "all inside",
}
SOURCES = (AidedAxis("gnss", 1.0, 1.5), AidedAxis("rdss", 1.5, 20.0))
MATCHED = Fault("none")
FAULTS = (
    MATCHED,
    Fault("R half its truth", r=2.0),
    Fault("R double its truth", r=0.5),
    Fault("Q a tenth of its truth", q=10.0),
    Fault("Q ten times its truth", q=0.1),
    Fault("noise correlated by 0.4", correlation=0.4),
    Fault("delay off by 0.5 s", delay_s=0.5),
)


def window_statistics(nu: Array, k: int) -> tuple[Array, Array]:
    """Average NIS (runs, w) and rho (runs, w, 8) of the w windows in nu (runs, K + 7 + w, m).

    They equal the monitor's figures and are computed from cumulative sums.
    """
    runs, epochs, m = nu.shape

    def over_window(x: Array, lag: int = 0) -> Array:
        total = np.concatenate([np.zeros((runs, 1)), np.cumsum(x, axis=1)], axis=1)
        ends = np.arange(LAGS + k, epochs + 1) - lag
        return np.asarray(total[:, ends] - total[:, ends - k])

    square = np.einsum("rkm,rkm->rk", nu, nu)
    energy = over_window(square)
    rho = np.empty((*energy.shape, LAGS))
    for lag in range(1, LAGS + 1):
        product = np.zeros((runs, epochs))
        product[:, lag:] = np.einsum("rkm,rkm->rk", nu[:, lag:], nu[:, :-lag])
        rho[..., lag - 1] = over_window(product) / np.sqrt(energy * over_window(square, lag))
    return energy / (k * m), rho


def window_verdicts(average: Array, rho: Array, m: int, k: int, alpha: float) -> Ints:
    """Index into VERDICTS by window, by the limits that `judge` gives."""
    given = judge(k, k * m, 1.0, [0.0] * LAGS, alpha=alpha)
    low, high = given.nis_limits
    coloured = _portmanteau(rho, k, m) > given.portmanteau_limit
    return np.select([average > high, average < low, coloured], [1, 2, 3], 0)


def _portmanteau(rho: Array, k: int, m: int) -> Array:
    weights = k * m + 2.0 * (1.0 - np.arange(1, LAGS + 1) / k)
    return np.asarray((rho * rho) @ weights)


def _largest_lag_p(rho: Array, k: int, m: int) -> Array:
    """p-value of the alternative: the largest of eight |rho| at a level corrected for eight."""
    freedom = k * m + 2.0 * (1.0 - np.arange(1, LAGS + 1) / k)
    each = np.asarray(beta.sf(rho * rho, 0.5, (freedom - 1.0) / 2.0))
    return np.asarray(1.0 - (1.0 - each.min(axis=-1)) ** LAGS)


def verdicts_with_hysteresis(outside: NDArray[np.bool_], hold: int) -> NDArray[np.bool_]:
    """Verdicts with hysteresis (runs, epochs), consistent at first, as in the monitor."""
    state = np.zeros(len(outside), dtype=bool)
    count = np.zeros(len(outside), dtype=int)
    result = np.empty_like(outside)
    for i in range(outside.shape[1]):
        count = np.where(outside[:, i] != state, count + 1, 0)
        turn = count >= hold
        state = state ^ turn
        count[turn] = 0
        result[:, i] = state
    return result


def _rate(hits: int, trials: int) -> dict[str, Any]:
    """Share with its exact (Clopper-Pearson) interval."""
    interval = binomtest(hits, trials).proportion_ci(CONFIDENCE)
    return {"rate": hits / trials, "interval": [float(interval.low), float(interval.high)]}


def false_alarms(
    windows: int, alpha: float, rng: np.random.Generator, step: Callable[[], None] = lambda: None
) -> list[dict[str, Any]]:
    """Share of windows of a matched filter not found consistent: white noise, then the filter."""
    found = []
    for k in WINDOWS:
        for m in DIMENSIONS:
            hits = 0
            for size in _pieces(windows):
                nu = rng.standard_normal((size, k + LAGS, m))
                hits += int(
                    np.count_nonzero(window_verdicts(*window_statistics(nu, k), m, k, alpha))
                )
            found.append({"innovations": "white", "k": k, "m": m, **_rate(hits, windows)})
            step()
        for source in SOURCES:
            hits = 0
            for size in _pieces(windows):
                nu = innovations(source, MATCHED, size, k + LAGS, 0, rng)
                hits += int(
                    np.count_nonzero(window_verdicts(*window_statistics(nu, k), 2, k, alpha))
                )
            found.append({"innovations": source.name, "k": k, "m": 2, **_rate(hits, windows)})
            step()
    return found


def _pieces(total: int) -> Iterator[int]:
    """Sizes of at most 5,000 that add up to `total`: bounded memory."""
    for start in range(0, total, 5000):
        yield min(5000, total - start)


def _noticed(verdicts: Ints, k: int) -> dict[str, Any]:
    """Epochs from the onset to a change of the held verdict, over runs consistent at the onset; and
    the verdicts of windows behind the onset.
    """
    verdict = verdicts_with_hysteresis(verdicts > 0, k // 2)
    first = SETTLED - (k + LAGS - 1)  # index of the window that ends with the first faulty epoch
    good = ~verdict[:, first - 1]
    after = verdict[good, first:]
    epochs = np.where(after.any(axis=1), after.argmax(axis=1) + 1, np.iinfo(np.int64).max)
    share = float(after.any(axis=1).mean())
    wanted = np.sort(epochs)[math.ceil(NOTICED * len(epochs)) - 1]
    after_onset = np.bincount(verdicts[:, first + k :].ravel(), minlength=len(VERDICTS))
    return {
        "epochs": int(wanted) if share >= NOTICED else None,
        "share": share,
        "windows": {
            name: float(n / after_onset.sum())
            for name, n in zip(VERDICTS, after_onset, strict=True)
        },
    }


def _quiet(
    source: AidedAxis, runs: int, alpha: float, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Rate of false verdicts per 1,000 epochs of a matched filter, without and with hysteresis."""
    nu = innovations(source, MATCHED, runs, SETTLED + WATCHED, 0, rng)
    rows = []
    for k in WINDOWS:
        outside = window_verdicts(*window_statistics(nu, k), 2, k, alpha) > 0
        turns = [
            1000.0
            * float((np.diff(verdicts_with_hysteresis(outside, h).astype(int), axis=1) > 0).sum())
            / outside.size
            for h in (1, k // 2)
        ]
        rows.append({"source": source.name, "k": k, "at_once": turns[0], "held": turns[1]})
    return rows


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` windows a false-alarm rate, 1/40 of them (>= 50) runs a power."""
    windows = runs or DEFAULT_RUNS
    drives = max(50, windows // 40)
    options = ConsistencyOptions()
    steps = len(WINDOWS) * (len(DIMENSIONS) + len(SOURCES)) + len(SOURCES) * (1 + len(FAULTS))
    step = step_counter(progress, steps)
    rows = false_alarms(windows, options.alpha, np.random.default_rng([seed, 0]), step)
    hits = round(sum(row["rate"] for row in rows) * windows)
    total = _rate(hits, windows * len(rows))
    quiet: list[dict[str, Any]] = []
    power: list[dict[str, Any]] = []
    tests: list[dict[str, Any]] = []
    for number, source in enumerate(SOURCES):
        quiet += _quiet(source, drives, options.alpha, np.random.default_rng([seed, 2, number]))
        step()
        for which, fault in enumerate(FAULTS):
            rng = np.random.default_rng([seed, 1, number, which])
            nu = innovations(source, fault, drives, SETTLED + WATCHED, SETTLED, rng)
            by_window: dict[str, Any] = {}
            level = 1.0 - math.sqrt(1.0 - options.alpha)
            for k in WINDOWS:
                average, rho = window_statistics(nu, k)
                verdicts = window_verdicts(average, rho, 2, k, options.alpha)
                by_window[str(k)] = _noticed(verdicts, k)
                after_onset = rho[:, SETTLED::k]  # one window behind the other, all after the onset
                given = judge(k, 2 * k, 1.0, [0.0] * LAGS, alpha=options.alpha)
                q = _portmanteau(after_onset, k, 2)
                tests.append(
                    {
                        "source": source.name,
                        "fault": fault.name,
                        "k": k,
                        "portmanteau": float((q > given.portmanteau_limit).mean()),
                        "largest_lag": float((_largest_lag_p(after_onset, k, 2) < level).mean()),
                    }
                )
            power.append({"source": source.name, "fault": fault.name, "by_window": by_window})
            step()
    return {
        "study": "consistency",
        "runs": windows,
        "power_runs": drives,
        "seed": seed,
        "alpha": options.alpha,
        "window": options.window,
        "fewest": FEWEST,
        "false_alarm_rate": total["rate"],
        "false_alarm_interval": total["interval"],
        "false_alarm_by_case": rows,
        "false_verdicts_per_1000_epochs": quiet,
        "power": power,
        "whiteness_tests": tests,
        "paper": _paper(),
        "finding": _finding(total, rows, options.alpha),
    }


def _paper() -> dict[str, Any]:
    """Printed figures and their meaning: with the paper's N(0, 1/K), and with 1/(K m)."""
    k, dof, average, rho = PAPER["k"], PAPER["dof"], PAPER["nis_average"], PAPER["rho"]
    result: dict[str, Any] = dict(PAPER)
    for name, whitened in (("variance_1_k", False), ("variance_1_km", True)):
        found = judge(k, dof, average, rho, alpha=0.05, whitened=whitened)  # type: ignore[arg-type]
        result[name] = {
            "verdict": found.verdict,
            "alpha": found.alpha,
            "nis_inside": found.nis_inside,
            "nis_interval": list(found.nis_interval),
            "rho_interval": list(found.rho_interval),
            "lags_outside": [i + 1 for i, inside in enumerate(found.rho_inside) if not inside],
            "portmanteau": found.portmanteau,
            "portmanteau_p": found.portmanteau_p,
        }
    return result


def _finding(total: dict[str, Any], rows: list[dict[str, Any]], alpha: float) -> str:
    out = [r for r in rows if not r["interval"][0] <= alpha <= r["interval"][1]]
    return (
        f"False-alarm rate {total['rate']:.4f} for a stated {alpha:g}; {len(rows) - len(out)} of "
        f"{len(rows)} cases hold it within their 99 % interval. The paper's average lies inside, "
        "its rho(1) outside the interval that it prints, though it says that all lie inside."
    )


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot false-alarm rates with intervals and detection delays to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(11.0, 6.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    rows = result["false_alarm_by_case"]
    for i, row in enumerate(rows):
        low, high = row["interval"]
        left.plot([100 * low, 100 * high], [i, i], color="tab:blue")
        left.plot(100 * row["rate"], i, "o", color="tab:blue")
    left.axvline(100 * result["alpha"], color="black", linestyle="--")
    left.set_yticks(
        range(len(rows)), [f"{r['innovations']}, m = {r['m']}, K = {r['k']}" for r in rows]
    )
    left.invert_yaxis()
    left.set_xlabel("windows not found consistent, % (99 % interval)")
    left.set_title("false alarms of a matched filter")
    for row in result["power"]:
        points = [
            (int(k), found["epochs"])
            for k, found in row["by_window"].items()
            if found["epochs"] is not None
        ]
        if points:
            fault = [f.name for f in FAULTS].index(row["fault"])
            line = "o-" if row["source"] == "gnss" else "s--"
            label = f"{row['source']}: {row['fault']}"
            right.plot(*zip(*points, strict=True), line, color=f"C{fault}", label=label)
    right.set_xscale("log", base=2)
    right.set_yscale("log", base=2)
    right.set_xticks(WINDOWS, [str(k) for k in WINDOWS])
    right.yaxis.set_major_formatter("{x:.0f}")
    right.set_xlabel("window K, epochs")
    right.set_ylabel("epochs until noticed in 90 % of runs")
    right.set_title("time to notice a fault")
    figure.legend(loc="outside lower right", ncols=3, fontsize="small")
    save_figure(figure, path)
