"""A position that is back after an outage: what is published until it is seen to go along."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.recording import Drive
from fusiond.studies.faults.runs import VEHICLE, navigate

OUTAGE_S = (40.0, 80.0)
SECONDS = 120.0


@pytest.mark.parametrize("white", [True, False])
def test_what_may_drift_is_open_where_sigma_would_shrink(white: bool) -> None:
    """Fixes that are configured to share nothing take the filter along within seconds, faster than
    a drift can be told. Where they share an error, P never falls below it."""
    gnss = {} if white else {"bias_sd_m": 1.0}
    made = VEHICLE.model_dump(exclude_unset=True)
    made["aiding"]["gnss"].update(gnss)
    config = Config.model_validate(made)
    truth, recording = Drive(duration_s=SECONDS, gnss_rate_hz=1.0).recorded(config, seed=5)
    opened: list[float] = []

    def watch(navigator: Navigator) -> None:
        e = navigator.estimator
        if e.t_ns * 1e-9 > OUTAGE_S[1] + 2.0:
            wider = navigator.timeline.isolation.hedge.wider.get("gnss", np.zeros(9))
            opened.append(float(wider[0] / e.covariance[6, 6]))

    navigate(config, recording.withheld(*OUTAGE_S), truth, watch)
    assert max(opened) > 0.2 if white else max(opened) < 0.05
