r"""Test whether the fault of a series out of service lasts, by its innovations.

    fault i lasts       z = A x + D_i b_i + v          b_i ~ N(size, M) as it was found
    it is over          z = A x + v                    v ~ N(0, R)

with x what the filter errs by. Looks that follow each other share nearly all of it, and so it is
estimated in each of these modes: what two of them explain alike tells nothing. x holds the rows of
H dx as one number each, without those states that decay (an error that fixes share), and these:

    x <- F x + w,   cov(x) = C    as published, at each look

    F = exp(-dt / tau) of a state that decays, 1 of a row; less where C has shrunk more than that:
        (1 - K) of what else was measured meanwhile is C after it over C before it
    cov(w) = C_k - F C_(k-1) F^T

A fault ends with the rate 1 / `LASTS_S`, and comes again likewise; when it does the other mode's
x goes on. So no certainty is lasting, and none takes long to be overcome. What nothing explains
tells nothing, and one look no more than chi-square of `MOST_TOLD`.

Source: Blom, Bar-Shalom, The interacting multiple model algorithm for systems with Markovian
switching coefficients, IEEE Trans. AC 33 (1988), 780.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.base import Looked
from fusiond.integrity.fault_finding import Finding
from fusiond.integrity.service import LASTS_S, MOST_TOLD

Array = NDArray[np.float64]

_LEAST = 1e-300


class Mode(NamedTuple):
    """One of the two stories, or one fault of several: its probability, and mean and covariance of
    x, behind it of b."""

    weight: float
    mean: Array
    covariance: Array


class Shared(NamedTuple):
    """Common error of successive looks: instant (ns) of the last, slots of states that decay, C,
    and modes, the last of which is that all is over."""

    t_ns: int
    slots: tuple[int, ...]
    covariance: Array
    modes: tuple[Mode, ...]


class Effect(NamedTuple):
    """Effect of a fault on the filter: the error (n,) that is left after what was taken out,
    and its covariance V M (n, p) with the fault's size."""

    left: Array
    common: Array


class Lasting(NamedTuple):
    """Faults for which a series may be out, the effect of each, since which instant (ns), and what
    looks have shown since."""

    findings: tuple[Finding, ...] = ()
    effects: tuple[Effect, ...] = ()
    since_ns: int = 0
    shared: Shared | None = None

    @property
    def log_odds(self) -> float:
        """Log odds that it is over, against that any of them lasts; not a number before a look."""
        if self.shared is None:
            return math.nan
        over = self.shared.modes[-1].weight
        return math.log(max(over, _LEAST) / max(1.0 - over, _LEAST))

    @property
    def log_likelihood(self) -> float:
        """The same by what has come alone; zero before a look."""
        if self.shared is None:
            return 0.0
        over = _changed(self.shared.t_ns - self.since_ns)
        return self.log_odds - math.log(max(over, _LEAST) / (1.0 - over))

    def looked(
        self, t_ns: int, look: Looked, adds: Sequence[Array], noise: Array, most: float
    ) -> Lasting:
        """After one more look, to whose rows each fault adds `adds` (m, p) times its size; of
        states `noise` (3, n) as the model has it. `most`: chi-square beyond which one explains
        nothing."""
        shared = self._predicted(t_ns, look, noise)
        rows = np.hstack((np.eye(len(look.z)), look.h[:, list(shared.slots)]))
        found, logs, least = [], [], math.inf
        for mode, add in zip(shared.modes, (*adds, np.zeros((len(look.z), 0))), strict=True):
            updated, log, nis = _updated(mode, np.hstack((rows, add)), look)
            found.append(updated)
            logs.append(log)
            least = min(least, nis)
        if least <= most:
            best = max(logs)
            weights = [
                m.weight * math.exp(max(log - best, -0.5 * MOST_TOLD))
                for m, log in zip(found, logs, strict=True)
            ]
            total = sum(weights)
            modes = (m._replace(weight=w / total) for m, w in zip(found, weights, strict=True))
            shared = shared._replace(modes=tuple(modes))
        return self._replace(shared=shared)

    def without(self, over: Lasting) -> Lasting:
        """Less those that have turned out to be over."""
        keep = [finding not in over.findings for finding in self.findings]
        if all(keep):
            return self
        at = [k for k, kept in enumerate(keep) if kept]
        shared = self.shared
        if shared is not None and at:
            modes = [shared.modes[k] for k in (*at, -1)]
            total = max(sum(mode.weight for mode in modes), _LEAST)
            those = tuple(mode._replace(weight=mode.weight / total) for mode in modes)
            shared = shared._replace(modes=those)
        return Lasting(
            tuple(self.findings[k] for k in at),
            tuple(self.effects[k] for k in at),
            self.since_ns,
            shared if at else None,
        )

    def _predicted(self, t_ns: int, look: Looked, noise: Array) -> Shared:
        """Modes at the instant of a look, before it."""
        looked = look.h.any(axis=0)
        slots = tuple(np.flatnonzero(looked & (noise[0] > 0.0)).tolist())
        h, m, q = look.h.copy(), len(look.z), len(look.z) + len(slots)
        h[:, list(slots)] = 0.0
        of = np.vstack((h, np.eye(h.shape[1])[list(slots)]))
        c, old = of @ look.covariance @ of.T, self.shared
        if old is None or old.slots != slots or len(old.covariance) != q:
            return self._begun(t_ns, slots, c, of)
        dt_s = (t_ns - old.t_ns) * 1e-9
        decay = np.ones(q)
        decay[m:] = np.exp(-dt_s * noise[0, list(slots)])
        steady = np.concatenate((np.zeros(m), noise[2, list(slots)]))
        before, after = np.diagonal(old.covariance), np.diagonal(c)
        alone = decay * decay * before + (1.0 - decay * decay) * steady
        f = decay * np.minimum(1.0, after / np.maximum(alone, _LEAST))
        w = _positive(c - f[:, None] * old.covariance * f)
        modes = _mixed(old.modes, q, _changed(t_ns - old.t_ns))
        return Shared(t_ns, slots, c, tuple(_moved(mode, f, w) for mode in modes))

    def _begun(self, t_ns: int, slots: tuple[int, ...], c: Array, of: Array) -> Shared:
        """Modes at the first look, or at one of other rows than those before it."""
        q, old, modes = len(c), self.shared, list[Mode]()
        over = _changed(t_ns - self.since_ns) if old is None else old.modes[-1].weight
        for k, (finding, effect) in enumerate(zip(self.findings, self.effects, strict=True)):
            b = np.array(finding.size) / finding.kind.per_unit
            variance = np.diag((np.array(finding.sd) / finding.kind.per_unit) ** 2)
            weight = (1.0 - over) / len(self.findings)
            left, common = of @ effect.left, of @ effect.common
            if old is not None:
                weight, rest = old.modes[k].weight, len(old.covariance)
                b, variance = old.modes[k].mean[rest:], old.modes[k].covariance[rest:, rest:]
                left, common = np.zeros(q), np.zeros_like(common)
            whole = np.block([[c, common], [common.T, variance]])
            if np.linalg.eigvalsh(whole)[0] < 0.0:  # P knows more by now
                whole[:q, q:], whole[q:, :q] = 0.0, 0.0
            modes.append(Mode(weight, np.concatenate((left, b)), whole))
        ends = [Mode(mode.weight, mode.mean[:q], mode.covariance[:q, :q]) for mode in modes]
        return Shared(t_ns, slots, c, (*modes, _merged(ends)._replace(weight=over)))


def _changed(dt_ns: int) -> float:
    """Probability that a fault which lasted does no more, or one that was over does again."""
    return 0.5 * -math.expm1(-2.0 * max(dt_ns, 1) * 1e-9 / LASTS_S)


def _positive(matrix: Array) -> Array:
    """The nearest covariance."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    found: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found


def _mixed(modes: tuple[Mode, ...], q: int, changed: float) -> list[Mode]:
    """Modes after some have changed into others; x goes on, and so does a fault's size."""
    *lasting, over = modes
    total = max(sum(mode.weight for mode in lasting), _LEAST)
    found = []
    for mode in lasting:
        again = np.concatenate((over.mean, mode.mean[q:]))
        spread = np.zeros_like(mode.covariance)
        spread[:q, :q], spread[q:, q:] = over.covariance, mode.covariance[q:, q:]
        comes = over.weight * changed * mode.weight / total
        stays = mode._replace(weight=mode.weight * (1.0 - changed))
        found.append(_merged([stays, Mode(comes, again, spread)]))
    ends = [Mode(m.weight * changed, m.mean[:q], m.covariance[:q, :q]) for m in lasting]
    found.append(_merged([over._replace(weight=over.weight * (1.0 - changed)), *ends]))
    return found


def _merged(modes: Sequence[Mode]) -> Mode:
    """One of the moments of several."""
    total = max(sum(mode.weight for mode in modes), _LEAST)
    mean = sum((mode.weight / total) * mode.mean for mode in modes)
    assert isinstance(mean, np.ndarray)
    spread = np.zeros((len(mean), len(mean)))
    for mode in modes:
        apart = mode.mean - mean
        spread += (mode.weight / total) * (mode.covariance + np.outer(apart, apart))
    return Mode(total, mean, spread)


def _moved(mode: Mode, f: Array, w: Array) -> Mode:
    """A mode whose x has gone on."""
    q, mean, spread = len(f), mode.mean.copy(), mode.covariance.copy()
    mean[:q] *= f
    spread[:q] *= f[:, None]
    spread[:, :q] *= f
    spread[:q, :q] += w
    return Mode(mode.weight, mean, spread)


def _updated(mode: Mode, rows: Array, look: Looked) -> tuple[Mode, float, float]:
    """A mode with a look folded in, the log likelihood of that and its chi-square."""
    along = rows @ mode.covariance
    s = along @ rows.T + np.diag(look.r)
    nu = look.z - rows @ mode.mean
    solved = np.linalg.solve(s, np.column_stack((nu, along)))
    nis = float(nu @ solved[:, 0])
    log = -0.5 * (nis + float(np.linalg.slogdet(s)[1]))
    spread = mode.covariance - along.T @ solved[:, 1:]
    mean = mode.mean + along.T @ solved[:, 0]
    return Mode(mode.weight, mean, 0.5 * (spread + spread.T)), log, nis
