"""The consistency tests online: one source's innovations in a sliding window."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.consistency import (
    FEWEST,
    LAGS,
    NO_LIMITS,
    TOO_FEW,
    WORDS,
    Consistency,
    ConsistencyOptions,
    Verdict,
    judge,
    limits_of,
    verdict_index,
    whiten,
    word,
)
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]


@compiled(
    "f8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], i8, i8, f8[::1], f8, f8, f8[::1], f8[::1])"
)
def _slide(
    rows: Array,
    figures: Array,
    products: Array,
    sums: Array,
    now: int,
    window: int,
    row: Array,
    nis: float,
    energy: float,
    weights: Array,
    rho: Array,
) -> float:
    """Insert epoch `now` into the ring, update the window's sums, write rho (8,) by (8).

    Returns Q = sum of `weights` (8,) rho^2.

    Rings of `window` + 8: `rows` (., m), `figures` (2, .) NIS and energy, `products` (., 8) with
    the eight before; `sums` (10,) of the same.
    """
    size = figures.shape[1]
    slot = now % size
    for j in range(row.shape[0]):
        rows[slot, j] = row[j]
    figures[0, slot], figures[1, slot] = nis, energy
    if now < LAGS:
        return 0.0
    for lag in range(LAGS):
        other = (now - lag - 1) % size
        total = 0.0
        for j in range(row.shape[0]):
            total += rows[other, j] * row[j]
        products[slot, lag] = total
    k = min(now + 1 - LAGS, window)
    if slot == size - 1:  # anew, so that rounding cannot pile up
        sums[:] = 0.0
        for back in range(k):
            i = (now - back) % size
            sums[0] += figures[0, i]
            sums[1] += figures[1, i]
            for lag in range(LAGS):
                sums[2 + lag] += products[i, lag]
    else:
        leaving = now - window
        old = leaving % size
        gone = 1.0 if leaving >= LAGS else 0.0
        sums[0] += nis - gone * figures[0, old]
        sums[1] += energy - gone * figures[1, old]
        for lag in range(LAGS):
            sums[2 + lag] += products[slot, lag] - gone * products[old, lag]
    # Energy of the window moved back by each lag: what comes in before it, what goes at its end.
    moved = sums[1]
    q = 0.0
    for lag in range(LAGS):
        moved += figures[1, (now - k - lag) % size] - figures[1, (now - lag) % size]
        scale = sums[1] * moved
        rho[lag] = sums[2 + lag] / math.sqrt(scale) if scale > 0.0 else 0.0
        q += weights[lag] * rho[lag] * rho[lag]
    return q


@compiled(
    "i8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], i8, i8, f8[:, ::1], f8[::1], f8[::1],"
    " f8[::1], f8[::1], f8, f8, f8, i8, i8, i8[::1], i8[:, ::1])"
)
def _slide_over(
    rows: Array,
    figures: Array,
    products: Array,
    sums: Array,
    now: int,
    window: int,
    new: Array,
    nis: Array,
    energy: Array,
    weights: Array,
    rho: Array,
    low: float,
    high: float,
    most_q: float,
    dof: int,
    patience: int,
    held: NDArray[np.int64],
    turned: NDArray[np.int64],
) -> int:
    """Insert successive epochs `new` (n, m) from `now` on; return the number of changed verdicts.
    `turned` (n, 2) receives the epoch and the new verdict (index of `WORDS`) of each change.

    `nis` and `energy` (n,) belong to the epochs. `held` (3,): the published verdict, the window's
    verdict (0: too few epochs), and the number of epochs in which they differed; after `patience`
    epochs the window's verdict is published.
    """
    turns = 0
    for i in range(new.shape[0]):
        of_epoch = new[i], nis[i], energy[i]
        q = _slide(rows, figures, products, sums, now + i, window, *of_epoch, weights, rho)
        if patience == 0:
            continue
        held[1] = verdict_index(sums[0] / dof, q, low, high, most_q)
        held[2] = held[2] + 1 if held[1] != held[0] else 0
        if held[2] >= patience:
            held[0], held[2] = held[1], 0
            turned[turns, 0], turned[turns, 1] = i, held[1]
            turns += 1
    return turns


_TOO_FEW = WORDS.index("too_few")


class ConsistencyMonitor:
    """Sliding window over the innovations of one kind of measurement of one source.

    Input: innovations of fused measurements, in order. A changed dimension m restarts the window.
    `verdict` changes once the window's verdict has differed from it for half a window of epochs in
    a row: neighbouring windows share innovations, so a chance excess lasts, but seldom that long.
    Memory and work are bounded: K + 8 rows; O(m) an epoch, and once in K + 8 epochs the sums are
    recomputed, so that rounding errors do not accumulate.
    """

    def __init__(self, options: ConsistencyOptions | None = None) -> None:
        self.options = options or ConsistencyOptions()
        self.rejected: Counter[str] = Counter()
        """Innovations not taken: `not_finite`, `not_positive_definite`."""
        self.restarts = 0
        """Windows started over because m changed."""
        self.k = 0
        """Epochs in the window."""
        self._m = 0
        self.reset()

    def reset(self) -> None:
        """Forget the window and the verdict, as after a new alignment. Counters stay."""
        size = self.options.window + LAGS
        self._rows = np.zeros((size, self._m))
        self._figures = np.zeros((2, size))
        self._products = np.zeros((size, LAGS))
        self._sums = np.zeros(2 + LAGS)
        self._count = self.k = 0
        self._average, self._rho = math.nan, np.full(LAGS, math.nan)
        self._held = np.array([_TOO_FEW, _TOO_FEW, 0])
        self._limits_k, self._limits = 0, NO_LIMITS

    @property
    def verdict(self) -> Verdict:
        """Verdict with hysteresis."""
        return word(int(self._held[0]), self.options.shared)

    @property
    def window_verdict(self) -> Verdict:
        """Verdict of this window alone."""
        return word(int(self._held[1]), self.options.shared)

    def add(self, nu: Array, s: Array | None = None) -> None:
        """Add an innovation (m,): whitened, or unwhitened with its covariance `s` (m, m).

        Raises ValueError when the paper's form is asked for and `s` is missing.
        """
        if s is None and not self.options.whitened:
            raise ValueError("unwhitened autocorrelation needs the innovation and its covariance")
        try:
            white = nu if s is None else whiten(nu, s)
        except np.linalg.LinAlgError:
            self.rejected["not_positive_definite"] += 1
            return
        row = white if self.options.whitened else nu
        with np.errstate(over="ignore"):
            nis, energy = float(white @ white), float(row @ row)
        self.take(row[None], np.array([nis]), np.array([energy]))

    def take(
        self, rows: Array, nis: Array, energy: Array | None = None
    ) -> list[tuple[int, Verdict]]:
        """Add innovations (n, m) of successive epochs with known NIS and energy (n,), which are
        equal if whitened: `add` without its checks. Returns the epoch and the new verdict of each
        change."""
        energy = nis if energy is None else energy
        finite = np.isfinite(nis + energy)
        if not finite.all():
            places = np.flatnonzero(finite).tolist()
            self.rejected["not_finite"] += len(rows) - len(places)
            turned = self.take(rows[finite], nis[finite], energy[finite]) if places else []
            return [(places[i], to) for i, to in turned]
        if rows.shape[1] != self._m:
            self.restarts += self._m > 0
            self._m = rows.shape[1]
            self.reset()
        o = self.options
        found: list[tuple[int, Verdict]] = []
        done = 0
        while done < len(rows):
            # While the window grows, its limits change with each epoch.
            end = len(rows) if self.k == o.window else done + 1
            now, first = slice(done, end), self._count
            self._count += end - done
            if self._count > LAGS and self.k < o.window:
                self.k += 1
            k = self.k
            if k != self._limits_k and k >= FEWEST:
                self._limits = limits_of(k, k * self._m, o.alpha, o.gate, o.whitened)
                self._limits_k = k
            limits, told = self._limits, np.empty((end - done, 2), dtype=np.int64)
            low, high = limits.nis_limits
            dof, patience = k * self._m, k // 2 if k >= FEWEST else 0
            window = self._rows, self._figures, self._products, self._sums
            of_epochs = rows[now], nis[now], energy[now], limits.weights, self._rho
            by = low, high, limits.portmanteau
            turns = _slide_over(
                *window, first, o.window, *of_epochs, *by, dof, patience, self._held, told
            )
            if k >= FEWEST:
                self._average = float(self._sums[0]) / dof
            found += [(done + i, word(to, o.shared)) for i, to in told[:turns].tolist()]
            done = end
        return found

    def report(self) -> Consistency:
        """Figures of the window and the verdict."""
        o, k = self.options, self.k
        if k < FEWEST:
            return replace(TOO_FEW, k=k, dof=k * self._m, alpha=o.alpha)
        average, rho = float(self._average), self._rho.tolist()
        found = judge(
            k,
            k * self._m,
            average,
            rho,
            alpha=o.alpha,
            gate=o.gate,
            whitened=o.whitened,
            shared=o.shared,
        )
        return replace(found, verdict=self.verdict)
