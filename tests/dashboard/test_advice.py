"""What a person is told to do."""

from __future__ import annotations

from typing import Any

import pytest

from fusiond.dashboard.advice import WHY, advice
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
        ("waiting", "waiting for IMU data", "power and bus of the inertial unit"),
        ("invalid", "IMU silent for 3.1 s: samples at full scale", "inertial unit has stopped"),
        ("aligning", "no position yet: no fix, none configured", "view of the sky"),
        (
            "aligning",
            "no heading yet (allowed: gnss_course); no velocity has come, for a course",
            "Drive straight on",
        ),
        ("aligning", "no heading yet; drive off: the fixes will show the heading", "Drive off"),
        ("aligning", "at rest for 4 s of the 30 that levelling needs; then moved", "Stand still"),
        ("coasting", "no position fused for 31 s", "Get a receiver back"),
        ("invalid", "horizontal sigma 612 m", "set_position"),
    ],
)
def test_why_becomes_a_step(mode: str, why: str, step: str) -> None:
    (only,) = texts(status(mode=mode, why=why), health())
    assert step in only


def test_every_pattern_is_a_sentence_for_a_person() -> None:
    for _, level, text in WHY:
        assert level in ("error", "warning", "info")
        assert text[0].isupper()
        assert text.endswith(".")
        assert len(text) <= 72  # a line of the page


@pytest.mark.parametrize(
    ("changed", "step"),
    [
        ({"state": "absent"}, "gnss cannot be opened: check plug, power and port."),
        ({"state": "silent"}, "gnss is open and says nothing: check power, wiring and baud rate."),
        ({"state": "failed"}, "gnss cannot work as configured: correct its section, then restart."),
        ({"state": "silent", "detail": "no card in the terminal"}, "gnss: put a card into the"),
        ({"isolated": "jumped by 40 m"}, "gnss disagrees with the rest and is left out."),
        ({"verdict": "optimistic"}, "gnss: sigma is too small"),
    ],
)
def test_what_a_source_needs(changed: dict[str, Any], step: str) -> None:
    (only,) = texts(status(), health(**changed))
    assert only.startswith(step)


def test_a_fault_is_told_once_with_its_size() -> None:
    found = texts({**status(), **said("status")}, said("health"))
    assert [text for text in found if "gnss" in text] == [
        "Look after gnss: gnss velocity is off by 0.521 m/s, 0.081 at one sigma, north,"
        " since 12 s: left out."
    ]


def test_what_is_left_out_and_diagnosed_is_not_said_to_disagree() -> None:
    fault = said("status")["faults"][0]
    found = texts(status(faults=[fault]), health(isolated=fault["text"], diagnosis=fault))
    assert len(found) == 1
    assert found[0].startswith("Look after gnss: ")


def test_the_most_urgent_comes_first_and_nothing_twice() -> None:
    found = advice(
        status(mode="coasting", why="no position fused for 31 s", injected=("gnss drop",)),
        {**health(state="absent"), "overruns": 5000, "utc_settled": False},
    )
    assert [step.level for step in found] == ["error", "error", "warning", "warning"]
    assert found[0].text == "Faults are put in (gnss drop): do not navigate by it."
    assert len(set(found)) == len(found)


def test_the_host_is_judged_by_its_ticks() -> None:
    late = "More than one tick in 1000 came too late: take load off the computer."
    assert texts(status(), {**health(), "ticks": 5000, "overruns": 6}) == [late]
    assert texts(status(), {**health(), "ticks": 5000, "overruns": 5}) == []
    assert texts(status(), {**health(), "ticks": 900, "overruns": 30}) == []  # it has just begun
