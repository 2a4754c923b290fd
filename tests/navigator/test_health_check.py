"""What nobody thought of: a measurement that raises costs itself, a filter of no numbers starts
anew."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.immutable import immutable
from drivers.measurements import Height, MonotonicStamp
from fusiond.aiding.base import AidingMeasurement, Innovation, State
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from tests.navigator.vehicle import CONFIG, drive, feed, outcomes_of, started


@immutable()
class Raising(AidingMeasurement):
    """A measurement of somebody else's."""

    error: Exception

    def innovation(self, state: State) -> Innovation:
        raise self.error


def rest_of_the_drive(navigator: Navigator, row: int) -> None:
    feed(navigator, row, [25], [0.0] * len(drive().measurements))


@pytest.mark.parametrize(
    "error", [ValueError("domain"), ZeroDivisionError(), np.linalg.LinAlgError("singular")]
)
def test_a_measurement_that_raises_costs_itself(error: Exception) -> None:
    told: list[tuple[str, str]] = []
    navigator, row = started(on_event=lambda code, text: told.append((code, text)))
    after = navigator.imu.latest_ns
    for k in range(3):
        navigator.timeline.insert(Raising("odd", after + (k + 1) * 100_000_000, 0.99, error))
    rest_of_the_drive(navigator, row)
    assert outcomes_of(navigator)["odd"] == {"failed": 3}
    assert outcomes_of(navigator)["gnss"]["fused"] == 34
    assert told.count(("measurement_failed", f"odd could not be used: {error!r}")) == 1
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.NAVIGATING


@pytest.mark.parametrize("where", ["comes", "judge"])
def test_so_does_one_whose_judgement_raises(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the velocity alone, of which every tenth raises."""
    told: list[str] = []
    navigator, row = started(on_event=lambda code, text: told.append(code))
    diagnosis, count = navigator.timeline.diagnosis, iter(range(10**6))
    judged = getattr(diagnosis, where)

    def raising(measurement: AidingMeasurement, *given: Any) -> Any:
        if measurement.source == "gnss_velocity" and next(count) % 10 == 9:
            raise ValueError("too many values to unpack")
        return judged(measurement, *given)

    monkeypatch.setattr(diagnosis, where, raising)
    monkeypatch.setattr(diagnosis, "plain", lambda _: None)  # none is taken by its row
    rest_of_the_drive(navigator, row)
    found = outcomes_of(navigator)["gnss_velocity"]
    assert found["failed"] > 0
    assert found["fused"] > found["failed"]
    assert told.count("measurement_failed") == 1
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.NAVIGATING


def test_a_measurement_that_raises_at_the_door_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, str]] = []
    navigator, _ = started(on_event=lambda code, text: told.append((code, text)))

    def overflow(*_: object) -> str:
        raise OverflowError("too large")

    monkeypatch.setattr(navigator._intake, "measurements_of", overflow)
    now = navigator.imu.latest_ns
    for _ in range(2):
        assert navigator.add(Height("baro", now, MonotonicStamp(now), 40.0), now) == "failed"
    assert navigator.outcome_watch.refused == {"baro": {"failed": 2}}
    assert [code for code, _ in told] == ["aligned", "measurement_failed"]


def lose_state(navigator: Navigator) -> None:
    navigator.estimator.nav[3] = math.nan


def lose_parameter(navigator: Navigator) -> None:
    navigator.estimator.xi[-1] = math.inf


def lose_covariance(navigator: Navigator) -> None:
    navigator.estimator.covariance[6, 6] = math.nan


@pytest.mark.parametrize("lose", [lose_state, lose_parameter, lose_covariance])
def test_a_filter_that_is_not_finite_starts_anew(lose: Callable[[Navigator], None]) -> None:
    told: list[str] = []
    # What is configured of the heading is of the first start: anew it is the course.
    alignment = {**CONFIG["alignment"], "heading": ["config", "gnss_course"]}
    settings = {**CONFIG, "alignment": alignment}
    navigator, row = started(settings, on_event=lambda code, text: told.append(code))
    lose(navigator)
    navigator.advance()
    assert told == ["aligned", "filter_not_finite"]
    mode, reason = navigator.mode(navigator.imu.latest_ns)
    assert mode is Mode.ALIGNING
    assert "not finite" in reason
    rest_of_the_drive(navigator, row)
    assert told[:3] == ["aligned", "filter_not_finite", "aligned"]
    assert "filter_not_finite" not in told[2:]
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.NAVIGATING
    assert np.isfinite(navigator.solution(navigator.imu.latest_ns).lat_rad)
