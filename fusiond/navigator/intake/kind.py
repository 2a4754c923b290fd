"""Interface of a kind of device measurement: its sections, aiding measurements and blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from drivers.immutable import immutable
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.fix_error_correlation import FixErrors
from fusiond.configuration.aiding import Aiding, AnyAiding, RawAiding
from fusiond.models.blocks import Block

if TYPE_CHECKING:
    from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels
    from fusiond.navigator.raw_gnss import RawGnss

S = TypeVar("S", bound=Aiding)
LEAST_SPEED_SD_M_S = 1e-3
"""Least credible sigma: a hundredth of a good receiver's or wheel sensor's."""


class Instants(NamedTuple):
    """Instants of a measurement: valid at `t_ns` with sigma `sd_time_s`, seen at `seen_ns` (0: at
    `t_ns`)."""

    t_ns: int
    sd_time_s: float
    seen_ns: int


def raw_receivers(aiding: Mapping[str, AnyAiding]) -> dict[str, RawGnss]:
    """Raw receivers by name, whose code is imported on demand since loading it is slow."""
    raw = {name: each for name, each in aiding.items() if isinstance(each, RawAiding)}
    if not raw:
        return {}
    from fusiond.navigator.raw_gnss import RawGnss  # noqa: PLC0415

    return {name: RawGnss(name, section) for name, section in raw.items()}


def shown_as(source: str, by_phase: bool) -> str:
    """Name of a group of a receiver's fixes with one error model."""
    return f"{source} by {'phase' if by_phase else 'code'}"


class Sections:
    """The configuration's `[aiding.NAME]` by source name; `receivers` are those whose raw data are
    the measurement, not their fixes."""

    def __init__(self, aiding: Mapping[str, AnyAiding]) -> None:
        self.aiding = aiding
        self.receivers = raw_receivers(aiding)
        self.place: tuple[float, float] | None = None
        """Latitude and longitude (rad) of the last fix."""
        self.by_code: set[tuple[str, int]] = set()
        """Receivers and the qualities of fixes for which they have stated a sigma of code."""
        self.fix_errors: dict[tuple[str, bool], FixErrors] = {}
        """Shared errors of each receiver's fixes, by code or by phase."""
        self.fixes_shown: Mapping[str, tuple[float, ...]] = {}
        """Shared errors from another drive, by `shown_as`."""
        self.drifts: DriftLevels | None = None
        """Levels of typed drifts; without them all of each counts."""
        self.utc_ns: int | None = None
        """Last dated instant of a fix's stamp (POSIX)."""
        self.any_robust = any(section.robust for section in aiding.values())
        """True if large residuals weigh less: by default none does."""
        self._found: dict[tuple[str, type[Aiding]], Aiding] = {}
        self._names: dict[tuple[str, type[Aiding], tuple[str, ...]], tuple[str, ...]] = {}
        self.made: dict[tuple[str, object], Any] = {}
        """Constants of a section by source and maker."""

    def drift_counts(self, block: str, t_ns: int) -> float:
        """Factor on the configured drift for a measurement of `t_ns`."""
        return 1.0 if self.drifts is None else self.drifts.counts(block, t_ns)

    def white_counts(
        self, source: str, t_ns: int, sd: float, lasts_s: float, rounding_sd: float
    ) -> float:
        """Factor on the configured white noise for a measurement of `t_ns`."""
        if self.drifts is None:
            return 1.0
        return self.drifts.white.counts(source, t_ns, sd, lasts_s, rounding_sd)

    def set_gates(self, gates: Mapping[str, float]) -> None:
        """Set `gate_probability` by section for further measurements."""
        changed = {
            name: self.aiding[name].model_copy(update={"gate_probability": gate})
            for name, gate in gates.items()
        }
        self.aiding = {**self.aiding, **changed}
        self._found.clear()
        self.made.clear()
        for name in self.receivers.keys() & gates:
            self.receivers[name].gate = gates[name]

    def of(self, source: str, kind: type[S]) -> S:
        """Section of the source, else of the kind, else defaults."""
        section = self._found.get((source, kind))
        if not isinstance(section, kind):
            names = (source, str(kind.model_fields["kind"].default))
            named = (self.aiding.get(name) for name in names)
            section = next((s for s in named if isinstance(s, kind)), None) or kind()
            self._found[source, kind] = section
        return section

    def robust(self, source: str) -> bool:
        """True if the section of a measurement's source enables robust weights."""
        section: Aiding | None = self.aiding.get(source)
        if section is None:
            used = (found for (name, _), found in self._found.items() if name == source)
            section = next(used, None)
        return section is not None and section.robust

    def own(self, block: str, source: str, section: Aiding) -> str:
        """Name of a block: with the source's name, if the source has a section not named after its
        kind."""
        return self.each_own((block,), source, section)[0]

    def each_own(self, blocks: tuple[str, ...], source: str, section: Aiding) -> tuple[str, ...]:
        """`own` of several blocks, needed by each measurement."""
        key = source, type(section), blocks
        names = self._names.get(key)
        if names is None:
            kind = type(section).model_fields["kind"].default
            own = self.aiding.get(source) is section and source != kind
            names = tuple(f"{block}_{source}" if own else block for block in blocks)
            self._names[key] = names
        return names


@immutable()
class Kind:
    """A kind of device measurement.

    `reported`: its class. `measurements_of(reported, sections, instants)`: its aiding measurements,
    or the name of its rejection. `blocks`: by class of section, `blocks(source, section, sections)`
    gives the model's blocks of errors that successive measurements share.
    """

    reported: type
    measurements_of: Callable[[Any, Sections, Instants], Sequence[AidingMeasurement] | str]
    blocks: Mapping[type[Aiding], Callable[[str, Any, Sections], list[Block]]]
