"""The study of protection levels: errors stay below them, with a receiver at fault and without."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.studies import STUDIES, protection


def test_it_is_a_study() -> None:
    assert STUDIES["protection"] == protection.__name__


@pytest.mark.parametrize("case", [protection.NO_FAULT, protection.CASES[3]], ids=lambda c: c.name)
def test_errors_stay_below_the_levels(case: protection.Case) -> None:
    found = protection.drive(case, True, 3)
    seconds = len(found["beyond"])
    assert seconds > 150
    # Never beyond the level of the configured risk, seldom beyond the coarse one.
    assert (found["error_m"] < found["hpl_m"]).all()
    assert found["beyond"].mean() <= protection.SAMPLE_RISK / protection.PRIOR
    assert np.isfinite(found["vpl_m"]).all()
    # Two receivers: a level of metres as long as both are sound.
    assert np.median(found["hpl_m"][:30]) < 10.0


def test_correlation_time_of_a_first_order_sequence() -> None:
    """1 + 2 sum a^k = (1 + a) / (1 - a)."""
    rng = np.random.default_rng(1)
    a, x = 0.8, np.zeros((40_000, 2))
    for k in range(1, len(x)):
        x[k] = a * x[k - 1] + rng.standard_normal(2)
    assert protection.correlation_s(x) == pytest.approx((1 + a) / (1 - a), rel=0.15)


def test_a_run_at_least() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        protection.run_study(0)
