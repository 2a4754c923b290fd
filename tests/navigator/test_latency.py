"""A receiver that is later than its stamps: found by the IMU, by how much, and not where it is
not."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.navigator.alignment import latency, motion_fit
from fusiond.navigator.alignment.latency import SETTLED_SD_S, LatencySearch
from fusiond.navigator.alignment.options import alignment_options
from fusiond.navigator.alignment.position_jumps import Epoch
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults import imu_faults, measurement_faults
from fusiond.studies.faults.error_sigma_score import longest_lie_s
from fusiond.studies.faults.runs import VEHICLE, navigate
from fusiond.studies.faults.sensor_data import Drive, Recording

TICKS_HZ = 100.0
DELAY_S = measurement_faults.DELAY_S
TRUTH, ON_TIME = Drive(duration_s=60.0).recorded(VEHICLE, seed=5)
ALWAYS_LATE = measurement_faults.stamped_too_new(ON_TIME, 0.0, math.inf)


def looked(
    recording: Recording, until_s: tuple[float, ...], config: Config = VEHICLE
) -> tuple[list[str], LatencySearch, Navigator]:
    """What looks at some instants have told."""
    told: list[str] = []
    navigator = Navigator(config)
    late = LatencySearch(
        alignment_options(config),
        navigator._noise,
        navigator.model,
        lambda code, text: told.append(code),
    )
    given = taken = 0
    for now_ns in (round(s * 1e9) for s in until_s):
        end = int(np.searchsorted(recording.imu_seen, now_ns, side="right"))
        navigator.imu.append(recording.stamps[given:end], recording.samples[given:end])
        given = end
        while recording.received[taken].seen_ns <= now_ns:
            item = recording.received[taken]
            taken += 1
            measurements = navigator._intake.measurements_of(
                item.measurement, item.t_ns, 0.0, item.seen_ns
            )
            assert not isinstance(measurements, str)
            late.receive(item.measurement.source, measurements)
        late.look(navigator.imu)
        while late.looking:
            late.look(navigator.imu)
    return told, late, navigator


def test_lateness_is_found_when_the_vehicle_drives_off() -> None:
    told, late, navigator = looked(ALWAYS_LATE, (19.0, 20.5, 22.0, 23.5, 25.0))
    assert told == ["fixes_late"]
    item = ALWAYS_LATE.received[0]
    source = item.measurement.source
    measurements = navigator._intake.measurements_of(item.measurement, item.t_ns, 0.0, item.seen_ns)
    assert not isinstance(measurements, str)
    shifted_s = (measurements[0].t_ns - late.receive(source, measurements)[0].t_ns) * 1e-9
    assert shifted_s == pytest.approx(DELAY_S, abs=4.0 * SETTLED_SD_S)


def test_a_receiver_that_cannot_have_become_late_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """What else fits is told by none of its fixes: a phone that was turned for 15 s on a motorway
    fitted velocities of 1 s before."""
    asked: list[float] = []

    def unchanged(epochs: Sequence[Epoch], by_s: float, doubted_ns: int) -> bool:
        asked.append(by_s)
        return len(epochs) > 0

    monkeypatch.setattr(latency, "unchanged", unchanged)
    told, late, _ = looked(ALWAYS_LATE, (19.0, 20.5, 22.0, 23.5, 25.0))
    assert not told
    assert not late.suspects
    assert asked == pytest.approx([DELAY_S] * len(asked), abs=0.2)


@pytest.mark.parametrize(
    "recording",
    [
        ON_TIME,
        imu_faults.mount_turned(ON_TIME, 22.0, 40.0),
        imu_faults.bias_step(ON_TIME, 30.0, 30.0),
    ],
    ids=["nothing wrong", "IMU turned", "gyro off"],
)
def test_nothing_else_is_taken_for_lateness(recording: Recording) -> None:
    told, late, _ = looked(recording, (20.0, 30.0, 42.0, 43.5, 45.0))
    assert not told
    assert not late.suspects


def test_samples_that_were_lost_are_no_lateness() -> None:
    """Of one fix a second one falls where nothing was felt, gravity neither: 0.7 s earlier none
    would, on a straight at constant speed as well."""
    _, seldom = Drive(duration_s=95.0, gnss_rate_hz=1.0).recorded(VEHICLE, seed=5)
    recording = imu_faults.silent(seldom, 81.3, 1.0)
    told, late, _ = looked(recording, (40.0, 76.0, 86.0, 87.0, 88.0, 89.0))
    assert not told
    assert not late.suspects


def test_a_receiver_that_was_late_for_a_while_is_not_late_now() -> None:
    """A phone's inertial unit leaves so much open that one lateness fits what was late and what is
    on time again: 1.2 s for 0.8 and 0, and 33 m at 30 m/s."""
    phone = Config.model_validate(
        {
            **VEHICLE.model_dump(exclude_unset=True),
            "imu": {
                "axes": VEHICLE.imu.axes,
                "rate_hz": VEHICLE.imu.rate_hz,
                "sensor_class": "consumer",
            },
        }
    )
    _, on_time = Drive(duration_s=120.0).recorded(phone, seed=5)
    end_s = 42.0
    recording = measurement_faults.stamped_too_new(on_time, 30.0, end_s - 30.0)
    told, late, _ = looked(recording, tuple(end_s + 1.0 + 1.5 * k for k in range(10)), phone)
    assert not told
    assert not late.suspects


def test_late_from_the_first_fix_on() -> None:
    course = navigate(VEHICLE, ALWAYS_LATE, TRUTH)
    assert [e.code for e in course.events if e.code in ("fixes_late", "aligned")] == [
        "fixes_late",
        "aligned",
    ]
    assert longest_lie_s(course.samples) == 0.0
    assert course.samples[-1].mode == "navigating"
    assert course.samples[-1].horizontal_m < 1.0


def test_no_tick_waits_for_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    fits, fit = [0], motion_fit.fit

    def counted(*args: Any) -> motion_fit.Fit:
        fits[-1] += 1
        return fit(*args)

    monkeypatch.setattr(motion_fit, "fit", counted)
    told: list[str] = []
    navigator = Navigator(VEHICLE, on_event=lambda code, text: told.append(code))
    given = taken = 0
    for tick in range(round(25.0 * TICKS_HZ)):
        now_ns = round(tick / TICKS_HZ * 1e9)
        end = int(np.searchsorted(ALWAYS_LATE.imu_seen, now_ns, side="right"))
        if end > given:
            navigator.add_imu(ALWAYS_LATE.stamps[given:end], ALWAYS_LATE.samples[given:end])
        given = end
        while ALWAYS_LATE.received[taken].seen_ns <= now_ns:
            item = ALWAYS_LATE.received[taken]
            taken += 1
            navigator.add(item.measurement, item.t_ns, 0.0, item.seen_ns)
        fits.append(0)
        navigator.advance()
    assert told.count("fixes_late") == 1
    # The search of 25 costs by two fits; a tick in which a start is tried has two of its own.
    assert sum(fits) >= 50
    assert max(fits) <= 4
