"""The catalogue of reasons: every template, its figures, its length and its page."""

from __future__ import annotations

import ast
import re
from string import Formatter

import pytest

from fusiond.navigator.mode_reasons import JOIN, REASONS, joined, reason, recognised
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
GIVE = [REPOSITORY / "fusiond" / room for room in ("navigator", "live")]
FIGURES = {"source": "gnss", "how": "GNSS course", "heading": "compass", "unit": "g"}
FIGURES |= {"device": "gnss", "sources": "compass, saved", "sensor": "Gyro", "what": "yaw 3 deg"}
IN_TWO_PARTS = {
    "force_unit",
    "searching",
    "searching_speed",
    "shaken",
    "rate_size",
    "rate_turns",
    "rate_path",
}
"""Texts with what helps after a semicolon."""


def example(code: str) -> str:
    """The text with figures of the usual size."""
    names = [name for _, name, _, _ in Formatter().parse(REASONS[code].text) if name]
    return reason(code, **{name: FIGURES.get(name, 12.3456) for name in names})


@pytest.mark.parametrize("code", REASONS)
def test_a_text_is_short_and_recognised(code: str) -> None:
    text = example(code)
    assert len(text) <= (140 if code in IN_TWO_PARTS else 100)
    assert "{" not in text
    assert (JOIN in text) == (code in IN_TWO_PARTS)
    assert code in recognised(text)
    assert code in recognised(joined(("Something else", text, "and more")))


@pytest.mark.parametrize("code", REASONS)
def test_an_advice_is_a_sentence_of_one_line(code: str) -> None:
    advice = REASONS[code].advice
    assert not advice or (advice[0].isupper() and advice.endswith(".") and len(advice) <= 72)


def test_the_most_urgent_comes_first() -> None:
    why = joined((example("no_heading_course"), example("imu_rate")))
    assert recognised(why) == ["imu_rate", "no_heading_course"]


def test_nothing_is_recognised_in_other_words() -> None:
    assert recognised("the weather is fine") == []


def test_every_reason_is_given_somewhere() -> None:
    """As the code in a call, or as one of two that a condition chooses from."""
    used = set()
    for path in (path for room in GIVE for path in room.rglob("*.py")):
        if path.name != "reasons.py":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            used |= {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    assert REASONS.keys() - used == set()


def test_the_page_has_a_row_for_every_reason() -> None:
    rows = re.findall(r"^\| `([^`]+)` \|", PAGE, flags=re.MULTILINE)
    missing = [c for c in REASONS if c != "allowed" and not any(r in example(c) for r in rows)]
    assert missing == []
