"""What a person is told to do."""

from __future__ import annotations

from typing import Any

import pytest

from fusiond.dashboard.advice import advice
from fusiond.navigator.mode_reasons import joined, reason
from tests.dashboard.serving import said


def texts(status: dict[str, Any], health: dict[str, Any]) -> list[str]:
    return [step.text for step in advice(status, health)]


def status(**changed: Any) -> dict[str, Any]:
    return {**said("status"), "faults": [], **changed}


def health(**changed: Any) -> dict[str, Any]:
    sound = {"service": "nominal", "diagnosis": None}
    gnss = {**said("health")["sources"]["gnss"], **sound, **changed}
    return {**said("health"), "sources": {"gnss": gnss}}


def test_nothing_where_all_is_well() -> None:
    assert advice(status(), health()) == []
    assert advice({}, {}) == []


@pytest.mark.parametrize(
    ("mode", "why", "step"),
    [
        ("waiting", reason("no_imu"), "power and bus of the IMU"),
        ("invalid", reason("imu_silent", seconds=3.1) + ": samples at full scale", "power and bus"),
        ("aligning", reason("no_position"), "view of the sky"),
        (
            "aligning",
            joined((reason("no_heading_course", speed=3.0), reason("no_velocity"))),
            "Switch on RMC",
        ),
        ("aligning", reason("no_heading_course", speed=3.0), "Drive straight on"),
        ("aligning", reason("no_heading_path"), "Drive off"),
        ("aligning", reason("levelling_moved", seconds=4.0, needed=30.0), "Stand still"),
        ("coasting", reason("no_fix", seconds=31.0), "Get a receiver back"),
        ("invalid", reason("sigma", sd=612.0, limit=500.0), "set_position"),
    ],
)
def test_why_becomes_a_step(mode: str, why: str, step: str) -> None:
    (only,) = texts(status(mode=mode, why=why), health())
    assert step in only


@pytest.mark.parametrize(
    ("changed", "step"),
    [
        ({"state": "absent"}, "gnss cannot be opened: check cable, power and port."),
        ({"state": "silent"}, "gnss is open but silent: check power, wiring and baud rate."),
        ({"state": "failed"}, "gnss cannot work as configured: correct its section, then restart."),
        ({"state": "silent", "detail": "No card in the terminal"}, "gnss: insert a card into the"),
        ({"isolated": "jumped by 40 m"}, "gnss disagrees with the other sources and is excluded"),
        ({"service": "probation"}, "gnss is back; checking it against the motion."),
        ({"verdict": "optimistic"}, "gnss: sigma is too small"),
    ],
)
def test_advice_for_a_source(changed: dict[str, Any], step: str) -> None:
    (only,) = texts(status(), health(**changed))
    assert only.startswith(step)


def test_a_fault_is_told_once_with_its_size() -> None:
    found = texts({**status(), **said("status")}, said("health"))
    assert [text for text in found if "gnss" in text] == [
        "Check gnss: gnss velocity is off by 0.521 m/s, 0.081 at one sigma, north,"
        " since 12 s: left out."
    ]


def test_a_diagnosed_exclusion_has_one_advice() -> None:
    fault = said("status")["faults"][0]
    found = texts(status(faults=[fault]), health(isolated=fault["text"], diagnosis=fault))
    assert len(found) == 1
    assert found[0].startswith("Check gnss: ")


def test_the_most_urgent_comes_first_and_nothing_twice() -> None:
    found = advice(
        status(mode="coasting", why=reason("no_fix", seconds=31.0), injected=("gnss drop",)),
        {**health(state="absent"), "overruns": 5000, "utc_settled": False},
    )
    assert [step.level for step in found] == ["error", "error", "warning", "warning"]
    assert found[0].text == "Simulated faults (gnss drop): do not navigate by this solution."
    assert len(set(found)) == len(found)


def test_the_host_is_judged_by_its_ticks() -> None:
    late = "More than one tick in 1000 was late: reduce the load on this computer."
    assert texts(status(), {**health(), "ticks": 5000, "overruns": 6}) == [late]
    assert texts(status(), {**health(), "ticks": 5000, "overruns": 5}) == []
    assert texts(status(), {**health(), "ticks": 900, "overruns": 30}) == []  # it has just begun
