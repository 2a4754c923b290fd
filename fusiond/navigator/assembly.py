"""Assembly of a navigator from a configuration: model, estimator, IMU buffer.

A new estimator is one module in `fusiond.estimators` and one case here; no other module knows which
one runs. Each is imported on demand, as loading its kernels takes long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from typing import TYPE_CHECKING

from fusiond.configuration.aiding import GnssAiding
from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG, imu_noise, sensor_to_body
from fusiond.estimators.base import Estimator
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.integrity.catalogue import Kind, kinds_of, table_of
from fusiond.integrity.consistency_monitors import Verdicts
from fusiond.models.blocks import CARRIER_ANCHOR, CARRIER_CLOCK, Block
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model, TooManyStatesError
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    CLOCK_SKEW,
    FIX_MARKOV,
    time_offset_block,
)
from fusiond.navigation.crosstalk_noise import Crosstalk
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.vibration import Vibration

if TYPE_CHECKING:
    from fusiond.estimators.federated.filter import FederatedFilter
    from fusiond.estimators.federated.options import FederatedOptions


def model_of(config: Config, *extra: Block) -> Model:
    """Error-state model of a configuration, with the blocks that its measurements need.

    Optional blocks are dropped if there is no room for them.

    Raises `ConfigError` for more states than the kernels hold.
    """
    name, noise = config.estimator.model, imu_noise(config.imu)
    return fitting(config, extra, lambda blocks: make_model(name, noise, *blocks))


def fitting(
    config: Config, extra: Sequence[Block], make: Callable[[Sequence[Block]], Model]
) -> Model:
    """Model by `make` of the blocks for which there is room, as in `model_of`."""
    try:
        return make(extra)
    except TooManyStatesError as error:
        for unasked in (_skews, _wanders, _unasked, _carriers):
            left_out = {block.name for block in extra if unasked(config, block)}
            if left_out:
                asked = [block for block in extra if block.name not in left_out]
                return fitting(config, [_unrated(block, left_out) for block in asked], make)
        names = ", ".join(block.name for block in extra)
        raise ConfigError(
            f"estimator.model: {error}; the measurements add {names}: choose a smaller model,"
            " such as 'ins15', or fewer sections [aiding]"
        ) from error


def _unrated(block: Block, left_out: Set[str]) -> Block:
    """Block whose rate may be among those that are `left_out`: a time offset then walks more."""
    return time_offset_block(block.name, block.initial) if block.rate in left_out else block


def _skews(_: Config, block: Block) -> bool:
    """True for the block of a difference of two clocks' rates."""
    return block.name.startswith(CLOCK_SKEW)


def _wanders(_: Config, block: Block) -> bool:
    """True for the block of an error that fixes share for seconds."""
    return block.name.startswith(FIX_MARKOV)


def _carriers(_: Config, block: Block) -> bool:
    """True for the block of the carriers' anchor; without it Dopplers are used."""
    return block.name in (CARRIER_ANCHOR, CARRIER_CLOCK)


def _unasked(config: Config, block: Block) -> bool:
    """True for the block of a lever arm that the configuration omits."""
    receivers = [each for each in config.aiding.values() if isinstance(each, GnssAiding)]
    silent = all(each.lever_arm_sd_m is None for each in receivers)
    return silent and block.name.startswith(ANTENNA_LEVER)


def kinds_of_config(config: Config, model: Model) -> list[Kind]:
    """Fault kinds of a vehicle's sensors."""
    aiding = {name: section.kind for name, section in config.aiding.items()}
    return kinds_of(model, aiding or {"gnss": "gnss"}, config.constraints.non_holonomic.enabled)


def estimator_of(config: Config, model: Model, kinds: Sequence[Kind] = ()) -> Estimator:
    """Estimator named by `[estimator] filter`, with a bank of the `kinds` if it supports one."""
    match config.estimator.filter:
        case "kalman":
            if config.integrity.watched:
                devices, gap_s = config.positioning, config.imu.gap_s
                return SeparatedEstimator(model, gap_s, devices, table_of(kinds))
            return InvariantFilter(model, config.imu.gap_s, faults=table_of(kinds))
        case "multiscale":
            from fusiond.estimators.multiscale.filter import MultiscaleEstimator  # noqa: PLC0415

            m = config.estimator.multiscale
            return MultiscaleEstimator(model, config.imu.gap_s, m.scales, m.wavelet)
        case "unscented":
            from fusiond.estimators.unscented.filter import UnscentedEstimator  # noqa: PLC0415

            u = config.estimator.unscented
            return UnscentedEstimator(model, config.imu.gap_s, u.spread, u.propagation)
        case "federated":
            names = config.estimator.federated.sources or tuple(config.aiding)
            return _federated(config, model, names, config.imu.gap_s)


def imu_buffer_of(config: Config, model: Model) -> ImuBuffer:
    """Buffer of IMU samples, with their observed noise.

    The noise includes vibration, axes out of square, and scale factors without states in the
    model."""
    imu, noise = config.imu, imu_noise(config.imu)
    period_s, misalignment = 1.0 / imu.rate_hz, imu.misalignment_deg * DEG
    left_out = (0.0, 0.0) if model.scale_factors else (noise.rate_scale, noise.force_scale)
    any_noise = misalignment > 0.0 or not model.scale_factors
    crosstalk = Crosstalk(period_s, misalignment, *left_out) if any_noise else None
    return ImuBuffer(
        imu.rate_hz,
        config.estimator.buffer_s,
        sensor_to_body(imu),
        imu.time_offset_s,
        imu.gap_s,
        Vibration(period_s, noise.rate_noise, noise.force_noise),
        crosstalk,
    )


def verdicts_of(config: Config, model: Model, on_event: Callable[[str, str], None]) -> Verdicts:
    """Verdicts on each source's sigma; changes are reported."""
    test = config.consistency
    return Verdicts(
        test.window, test.alpha, model, lambda s, v: on_event(f"verdict_{v}", f"innovations of {s}")
    )


def estimator_without_imu(config: Config, model: Model, gap_s: float) -> Estimator:
    """Estimator of a vehicle without an inertial unit: `federated`, with a local filter for each
    receiver, if configured; else the Kalman filter."""
    if config.estimator.filter == "federated":
        names = config.estimator.federated.sources or tuple(config.aiding)
        received = tuple(name for name in names if name in config.positioning)
        return _federated(config, model, received or names, gap_s)
    return KalmanEstimator(model, gap_s)


def federated(
    model: Model, gap_s: float, names: tuple[str, ...], options: FederatedOptions
) -> FederatedFilter:
    """The federated filter of a mode."""
    if options.fusion == "correlated":
        from fusiond.estimators.federated.correlated import CorrelatedFilter  # noqa: PLC0415

        return CorrelatedFilter(model, gap_s, names, options)
    from fusiond.estimators.federated.no_reset import NoResetFilter  # noqa: PLC0415
    from fusiond.estimators.federated.reset import ResetFilter  # noqa: PLC0415

    resets = options.mode in ("fusion_reset", "zero_reset")
    return (ResetFilter if resets else NoResetFilter)(model, gap_s, names, options)


def _federated(
    config: Config, model: Model, names: tuple[str, ...], gap_s: float
) -> FederatedFilter:
    from fusiond.estimators.federated.options import FederatedOptions  # noqa: PLC0415

    o = config.estimator.federated
    options = FederatedOptions(
        mode=o.mode,
        fusion=o.fusion,
        shares=tuple(o.shares[name] for name in names) if o.shares else (),
        adaptive=o.sharing == "adaptive",
        master_share=o.master_share,
        retained=o.retained,
        fault_detection=o.fault_detection,
        false_alarm=o.false_alarm_probability,
        window=o.window,
        readmit_after=o.readmit_after,
    )
    return federated(model, gap_s, names, options)
