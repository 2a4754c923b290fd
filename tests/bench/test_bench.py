"""The benchmark runs and gives the figures that it promises; how large they are is not tested."""

from __future__ import annotations

import json

from fusiond.bench.bench import bench

FIGURES = (
    "numpy_product_us",
    "block_step_ratio",
    "single_step_ratio",
    "rewind_2s_ratio",
    "raw_epoch_40_ratio",
    "multiscale_step_ratio",
    "federated_step_ratio",
    "unscented_step_ratio",
    "unscented_propagation_step_ratio",
    "process_epoch_ratio",
    "reduced_order_step_ratio",
)


def test_figures() -> None:
    figures = bench(repetitions=2, process_s=90.0)
    assert list(figures)[: len(FIGURES)] == list(FIGURES)
    for name in FIGURES:
        assert figures[name] > 0.0, name
    assert figures["cpu"]
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
