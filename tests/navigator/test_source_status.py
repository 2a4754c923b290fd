"""Faults as people are told of them: from the finding until the last series is nominal again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import pytest

from drivers.measurements import Measurement, PositionFix
from fusiond.integrity.series_states import Service
from fusiond.navigator.source_status import CORRECTED_SHOWN_NS, WORST_FIRST, SourceService, worst
from fusiond.outputs.messages.fault import FaultReport, fault_report
from tests.navigator import vehicle

BEGIN_S, END_S = 18.0, 24.0


class Look(NamedTuple):
    """What is told at one instant."""

    t_s: float
    states: dict[str, Service]
    faults: tuple[FaultReport, ...]


class Seen(NamedTuple):
    """What a drive has told: once every fifth of a second, and as events; the end's service."""

    looks: list[Look]
    events: list[tuple[str, str]]
    end_ns: int
    service: SourceService


def _drive(
    changed: Callable[[float, Measurement], Measurement] = lambda t_s, m: m,
    stepped_rad_s: float = 0.0,
) -> Seen:
    """The vehicle's drive with `changed` measurements, and its yaw gyro off from `BEGIN_S` on."""
    d = vehicle.drive()
    samples = d.samples.copy()
    samples[round(BEGIN_S * vehicle.RATE_HZ) :, 2] += stepped_rad_s
    events: list[tuple[str, str]] = []
    navigator, row = vehicle.started(on_event=lambda code, text: events.append((code, text)))
    waiting: Iterator[Measurement] = iter(d.measurements)
    m = next(waiting, None)
    looks, t_ns = [], 0
    while row < len(d.times):
        navigator.add_imu(d.times[row : row + 10], samples[row : row + 10])
        row += 10
        t_ns = int(d.times[min(row, len(d.times)) - 1])
        while m is not None and m.t_seen_ns <= t_ns:
            navigator.add(changed((m.t_seen_ns - vehicle.START_NS) * 1e-9, m), m.t_seen_ns)
            m = next(waiting, None)
        navigator.advance()
        service = navigator.service
        told = tuple(fault_report(f.finding, "gnss", t_ns) for f in service.faults(t_ns))
        states = service.states("gnss")
        looks.append(Look((t_ns - vehicle.START_NS) * 1e-9, states, told))
    return Seen(looks, events, t_ns, navigator.service)


@lru_cache(maxsize=1)
def velocity_off() -> Seen:
    """The receiver's velocity is off by 4 m/s towards north for six seconds."""

    def off(t_s: float, m: Measurement) -> Measurement:
        if not isinstance(m, PositionFix) or m.v_ned_m_s is None or not BEGIN_S <= t_s < END_S:
            return m
        north, *others = m.v_ned_m_s
        return replace(m, v_ned_m_s=(north + 4.0, *others))

    return _drive(off)


@lru_cache(maxsize=1)
def gyro_stepped() -> Seen:
    return _drive(stepped_rad_s=0.05)


def test_a_fault_of_a_receiver_is_told_until_it_is_nominal_again() -> None:
    seen = velocity_off()
    told = [look for look in seen.looks if look.faults]
    course = list(dict.fromkeys(look.states["gnss_velocity"] for look in told))
    assert course == [Service.OUT, Service.PROBATION]
    assert BEGIN_S < told[0].t_s < BEGIN_S + 3.0
    assert seen.looks[-1].states == {"gnss": Service.NOMINAL, "gnss_velocity": Service.NOMINAL}
    assert seen.looks[-1].faults == ()
    assert all(look.states["gnss"] is Service.NOMINAL for look in told)
    assert all(look.faults for look in seen.looks if told[0].t_s <= look.t_s <= told[-1].t_s)


def test_its_report_says_what_how_much_and_since_when() -> None:
    told = [look for look in velocity_off().looks if look.faults]
    for look in told:
        (fault,) = look.faults
        assert (fault.kind, fault.axis, fault.unit) == ("velocity", "north", "m/s")
        assert fault.action == "left out"
        assert fault.size == pytest.approx(4.0, abs=4.0 * (fault.sd or 0.0))
        assert fault.since_s == pytest.approx(look.t_s - BEGIN_S, abs=1.5)
        assert fault.text.startswith("gnss velocity is off by ")
        assert f"north, since {fault.since_s:.0f} s: left out" in fault.text
        assert fault.log_odds > 6.9  # a thousand to one


def test_each_turn_is_one_event() -> None:
    events = [(c, t) for c, t in velocity_off().events if c != "aligned"]
    assert [code for code, _ in events] == ["isolated", "readmitted"]
    assert events[0][1].startswith("gnss_velocity is excluded from the solution: gnss velocity is")
    assert events[1][1] == "gnss_velocity is used again"


def test_a_step_of_the_gyro_is_told_for_a_minute_after_it_was_corrected() -> None:
    seen = gyro_stepped()
    codes = [code for code, _ in seen.events]
    assert codes.count("sensor_fault") >= 1
    assert not {"isolated", "diverged"} & set(codes)
    (text, *_) = (text for code, text in seen.events if code == "sensor_fault")
    assert text.startswith("the gyros have stepped by ")
    assert text.endswith(": corrected")
    (fault,) = seen.looks[-1].faults
    assert (fault.kind, fault.axis, fault.action) == ("gyro", "z", "corrected")
    assert fault.size == pytest.approx(2.86, abs=4.0 * (fault.sd or 0.0))  # 0.05 rad/s
    (last,) = seen.service.faults(seen.end_ns)
    over_ns = last.finding.t_ns + CORRECTED_SHOWN_NS
    assert seen.service.faults(over_ns) == [last]
    assert seen.service.faults(over_ns + 1) == []


def test_the_worst_state_counts() -> None:
    assert set(WORST_FIRST) == set(Service)
    assert worst([]) is None
    assert worst([Service.NOMINAL, Service.SUSPECTED]) is Service.SUSPECTED
    assert worst([Service.PROBATION, Service.SUSPECTED]) is Service.PROBATION
    assert worst([Service.PROBATION, Service.OUT, Service.NOMINAL]) is Service.OUT
