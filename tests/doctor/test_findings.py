"""The catalogue of findings: length, next step, use, and the page that lists it."""

from __future__ import annotations

import re
from string import Formatter

import pytest

from fusiond.doctor.findings import FINDINGS
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
SOURCES = [p for p in (REPOSITORY / "fusiond" / "doctor").glob("*.py") if p.name != "findings.py"]


@pytest.mark.parametrize("code", FINDINGS)
def test_a_finding_is_a_symptom_and_what_to_do(code: str) -> None:
    symptom, colon, step = FINDINGS[code].partition(": ")
    assert colon
    assert step[0].islower() or step[0] == "{"
    assert symptom[0].isupper() or symptom[0] == "{"
    assert len(FINDINGS[code]) <= 170


@pytest.mark.parametrize("code", FINDINGS)
def test_the_page_lists_a_finding_by_its_words(code: str) -> None:
    """A row quotes the longest run of words between figures, or what follows the symptom."""
    literals = [text for text, *_ in Formatter().parse(FINDINGS[code])]
    section = PAGE.split("## What `doctor` finds\n", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `([^`]+)` \|", section, flags=re.MULTILINE)
    assert any(row in literal for row in rows for literal in literals)


def test_every_finding_is_made_somewhere() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES)
    assert [code for code in FINDINGS if f'"{code}"' not in text] == []
