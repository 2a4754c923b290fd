"""Section `[estimator]`: filter, error state, length of the history."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    Field,
    PositiveFloat,
    PositiveInt,
    field_validator,
    model_validator,
)

from fusiond.configuration.aiding import Probability, Section
from fusiond.estimators.multiscale.wavelet import MOST_SCALES, wavelet_matrix
from fusiond.files.install_extra import install_command


def _has_wavelets() -> None:
    if find_spec("pywt") is None:
        raise ValueError(f"the filter multiscale needs PyWavelets: {install_command('studies')}")


def _orthonormal(wavelet: str) -> str:
    _has_wavelets()
    wavelet_matrix(wavelet, 1)  # ValueError, with those that would do
    return wavelet


class Multiscale(Section):
    """The filter `multiscale`; see `docs/estimators.md`."""

    scales: Annotated[int, Field(ge=1, le=MOST_SCALES)] = 2
    """N: blocks of 2^(N-1) epochs. 1 is the filter `kalman`."""
    wavelet: Annotated[str, AfterValidator(_orthonormal)] = "haar"
    """Any orthonormal wavelet, by its PyWavelets name."""


class Federated(Section):
    """The federated filter, where `filter = "federated"`; see `docs/estimators.md`."""

    sources: tuple[str, ...] = ()
    """Sections `[aiding.NAME]` that have a local filter; empty: all of them."""
    mode: Literal["no_reset", "fusion_reset", "zero_reset", "rescale"] = "no_reset"
    """Reset of the local filters after a fusion; only `no_reset` keeps a fault in its own
    filter."""
    fusion: Literal["uncorrelated", "correlated"] = "uncorrelated"
    """Fusion of the estimates: by sharing factors, as if they were uncorrelated, or by
    the covariances between them (paper 004), which only `no_reset` can."""
    sharing: Literal["fixed", "adaptive"] = "fixed"
    """True if the sharing factors stay or follow the local covariances."""
    shares: dict[str, PositiveFloat] = Field(default_factory=dict)
    """Relative factors by local filter, brought to a sum of 1; empty: all equal."""
    master_share: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Share of the process noise for the master's own estimate in `rescale`."""
    retained: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Share of its information that an updated local filter keeps in `rescale`."""
    fault_detection: bool = True
    """True if a local filter that fails its tests is left out."""
    false_alarm_probability: Probability = 1e-6
    """Probability of a false alarm of one innovation or difference test."""
    window: Annotated[int, Field(ge=2, le=100)] = 10
    """Number of innovations of a test."""
    readmit_after: PositiveInt = 20
    """Innovations in a row that must fit the master before a source is taken back."""

    @model_validator(mode="after")
    def _correlated_share_nothing_out(self) -> Federated:
        if self.fusion == "uncorrelated":
            return self
        if self.mode != "no_reset":
            raise ValueError(
                "fusion 'correlated' needs mode 'no_reset': a reset ends the correlation"
            )
        if self.sharing != "fixed" or self.shares:
            raise ValueError("fusion 'correlated' has no sharing factors: leave shares out")
        return self


class Unscented(Section):
    """The filter `unscented`."""

    spread: Annotated[float, Field(ge=0.1, le=5.0)] = 1.7320508
    """Sigmas from the mean to a sigma point: sqrt(3) by the fourth moment of a Gaussian."""
    propagation: bool = False
    """Sigma points in the propagation too: dearer, honest for large attitude errors."""


class Estimator(Section):
    filter: Literal["kalman", "unscented", "federated", "multiscale"] = "kalman"
    """Kind of estimator; see `docs/estimators.md`."""
    model: Literal["ins15", "ins21", "ins17", "ins20", "ins23", "planar10", "planar15"] = "ins21"
    """The error-state model; see `docs/navigation.md`."""
    buffer_s: Annotated[float, Field(ge=10.0, le=600.0)] = 15.0
    """History for delayed measurements; at least 10 s."""
    checkpoint_s: PositiveFloat = 0.5
    """Longest interval of a rewind's checkpoints; less where measurements come late."""
    coast_after_s: PositiveFloat = 10.0
    """Without a fused position for longer than this the mode is `coasting`."""
    invalid_sd_m: PositiveFloat = 5000.0
    """Horizontal sigma beyond which the mode is `invalid`."""
    federated: Federated = Field(default_factory=Federated.unsaid)
    """The section of that name below."""
    multiscale: Multiscale = Field(default_factory=Multiscale.unsaid)
    unscented: Unscented = Field(default_factory=Unscented.unsaid)

    @field_validator("filter")
    @classmethod
    def _installed(cls, name: str) -> str:
        if name == "multiscale":
            _has_wavelets()
        return name
