"""docs/troubleshooting.md speaks of what the daemon says, in its words, and leaves none out."""

from __future__ import annotations

import re

from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
NAVIGATOR = REPOSITORY / "fusiond" / "navigator"


def quoted(section: str) -> list[str]:
    """The first column of a section's table."""
    text = PAGE.split(f"## {section}\n", 1)[1].split("\n## ", 1)[0]
    return re.findall(r"^\| `([^`]+)` \|", text, flags=re.M)


def source() -> str:
    """All texts of the navigator's modules, with strings that are broken over lines joined."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in NAVIGATOR.rglob("*.py"))
    return re.sub(r'"\s*\n\s*f?"', "", text)


def test_every_sentence_of_the_page_is_one_of_the_navigator() -> None:
    said = source()
    rows = quoted("It does not align") + quoted("It has aligned, but is not `navigating`")
    assert len(rows) > 30
    assert [row for row in rows if row not in said] == []


def test_receiver_findings_on_the_page_are_those_of_the_code() -> None:
    """The sentences of the table are parts of those of the code."""
    places = (REPOSITORY / "drivers" / "nmea", REPOSITORY / "fusiond" / "doctor")
    text = "\n".join(path.read_text() for place in places for path in place.rglob("*.py"))
    said = re.sub(r'"\s*\n\s*f?"', "", text)
    rows = quoted("The receiver sends, but there is no fix")
    assert len(rows) >= 8
    assert [row for row in rows if row not in said] == []
