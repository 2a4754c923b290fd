"""`fusiond status`: the line below a source that is not fused as usual."""

from __future__ import annotations

from typing import Any

import pytest

from fusiond.commands.status_report import _fault


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({}, ""),
        ({"service": "probation"}, "is back; checking it against the motion"),
        ({"service": "out", "isolated": "disagrees"}, "disagrees"),
        ({"service": "probation", "diagnosis": {"text": "late by 2 s"}}, "late by 2 s"),
        ({"state": "absent", "detail": "no such port"}, "no such port"),
    ],
)
def test_reason_below_a_source(changed: dict[str, Any], text: str) -> None:
    source = {"state": "running", "detail": "", "service": "nominal", "isolated": None}
    assert _fault({**source, "diagnosis": None, **changed}) == text
