"""The catalogue of events against the code that reports them, and against the documentation."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import get_args

from drivers.base import State
from drivers.can.base_driver import CONTROLLER_EVENTS
from drivers.ntrip.client import NtripState
from drivers.rdss.mail import ENDS, Fault
from drivers.rdss.state_tables import REFUSALS
from fusiond.integrity.consistency_monitors import Verdict
from fusiond.navigation.solution import Mode
from fusiond.navigator.imu_screening import TEXTS
from fusiond.outputs.messages.event_catalogue import EVENTS, UNKNOWN, entry_of
from tests.places import REPOSITORY
from tools.event_page import PAGE, page

REPORTING = {"_event", "on_event", "_on_event", "event", "DeviceEvent", "Notice", "_notify"}
REPORTING |= {"_report", "report", "navigator_event"}
SERVERS = ("nmea", "gpsd", "prometheus", "foxglove")
NOT_TOLD = {"message_sent", "message_delivered", "message_superseded"}
"""Ends of a message that are no event: it arrived, or a later one replaced it."""
NO_EVENTS = {"queued", "sent"}
"""Stages in calls of the outbox that have the same name."""


def _codes() -> Iterator[str]:
    """Codes in calls that report an event, where they are written out."""
    for folder in ("fusiond", "drivers"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call) or _called(node) not in REPORTING:
                    continue
                code = node.args[-2] if len(node.args) > 1 else None  # the text comes last
                if isinstance(code, ast.Constant) and isinstance(code.value, str):
                    yield code.value


def _called(node: ast.Call) -> str:
    return getattr(node.func, "attr", "") or getattr(node.func, "id", "")


def families() -> set[str]:
    """Codes that are put together of a prefix and a name."""
    told = {f"message_{stage}" for stage in ENDS} - NOT_TOLD
    return {
        *(f"device_{state}" for state in get_args(State) if state != "starting"),
        *(f"ntrip_{state}" for state in get_args(NtripState)),
        *(f"mode_{mode}" for mode in Mode),
        *(f"verdict_{verdict}" for verdict in get_args(Verdict)),
        *(f"imu_{name}" for name in TEXTS),
        *(f"message_{fault}" for fault in get_args(Fault) if fault),
        *(f"rdss_{refusal.counter}" for refusal in REFUSALS.values() if refusal.text),
        *(f"{name}_absent" for name in SERVERS),
        *(f"{name}_clients_refused" for name in SERVERS),
        *(code for code, _ in CONTROLLER_EVENTS.values()),
        *told,
    }


def test_every_code_that_is_reported_is_in_the_catalogue() -> None:
    of_ports = {"absent", "origin_refused", "clients_refused"}  # Port names the server before
    found = set(_codes()) - of_ports - NO_EVENTS
    assert len(found) > 60
    assert (found | families()) - EVENTS.keys() == set()


def test_every_code_of_the_catalogue_is_reported() -> None:
    text = "\n".join(
        path.read_text(encoding="utf-8")
        for folder in ("fusiond", "drivers")
        for path in (REPOSITORY / folder).rglob("*.py")
        if path.name != "event_catalogue.py"
    )
    written = {code for code in EVENTS if f'"{code}"' in text}
    assert EVENTS.keys() - written - families() == {"foxglove_origin_refused"}
    assert '"origin_refused"' in text


def test_meaning_and_advice_are_short_sentences() -> None:
    for code, entry in EVENTS.items():
        assert len(entry.meaning) <= 70, code  # with code and time a line of 100 columns
        assert len(entry.advice) <= 72, code
        for sentence in (entry.meaning, entry.advice):
            assert sentence == "" or (sentence[0].isupper() or code.startswith("chrony"))
            assert sentence == "" or sentence.endswith(".")


def test_every_warning_and_error_has_a_next_step() -> None:
    assert [code for code, e in EVENTS.items() if e.level != "info" and not e.advice] == []


def test_a_code_of_another_package_is_information() -> None:
    assert entry_of("winch_jammed") is UNKNOWN
    assert UNKNOWN.level == "info"


def test_the_page_lists_the_catalogue() -> None:
    assert (REPOSITORY / PAGE).read_text(encoding="utf-8") == page()
