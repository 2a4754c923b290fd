"""Options of a federated filter, and the assignment of measurements to local filters."""

from __future__ import annotations

from typing import Literal

from drivers.immutable import immutable

Mode = Literal["no_reset", "fusion_reset", "zero_reset", "rescale"]
Fusion = Literal["uncorrelated", "correlated"]


@immutable()
class FederatedOptions:
    """Options for sharing, reset and isolation of a federated filter.

    `fusion`: by bounds that allow treating estimates as uncorrelated, or by cross-covariances
    (fusiond.estimators.federated.correlated), for `no_reset` without `shares`. `shares`: relative
    factors by local filter, by default equal. In `rescale` `master_share` is the part of process
    noise and initial information of the master's own estimate, `retained` the part that an updated
    local filter keeps.
    """

    mode: Mode = "no_reset"
    shares: tuple[float, ...] = ()
    adaptive: bool = False
    master_share: float = 0.5
    retained: float = 0.5
    fault_detection: bool = True
    false_alarm: float = 1e-6
    window: int = 10
    readmit_after: int = 20
    fusion: Fusion = "uncorrelated"


def local_of(source: str, names: tuple[str, ...]) -> int | None:
    """Local filter among `names` of a source: the filter of that name, else the longest one that it
    begins with (`gnss_velocity` to `gnss`); None: common to all."""
    if source in names:
        return names.index(source)
    prefixed = [name for name in names if source.startswith(f"{name}_")]
    return names.index(max(prefixed, key=len)) if prefixed else None
