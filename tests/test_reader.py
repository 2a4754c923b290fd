"""The reader's test: what is counted, and how budgets fall."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path

import pytest

from tools import reader

SOURCE = '''"""What a module is."""

class Door:
    """How it opens."""

    width: float = 1.0
    """Whether it is wide."""

    def told(self, {parameters}) -> None:
        """Report {sentence}."""
{body}
'''


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with one of each."""
    (tmp_path / "drivers").mkdir()
    (tmp_path / "fusiond").mkdir()
    parameters = ", ".join(f"p{k}" for k in range(10))
    text = SOURCE.format(
        parameters=parameters, sentence="word " * 26, body="        width = 1\n" * 60
    )
    (tmp_path / "fusiond" / "lateness.py").write_text(text)
    return tmp_path


def test_each_kind_is_counted(package: Path) -> None:
    counts = Counter(place.kind for place in reader.survey(package))
    assert counts == {
        "questions": 3,  # module, class, attribute
        "long_openings": 1,
        "long_functions": 1,
        "many_parameters": 1,  # with self eleven
        "private_words": 3,  # Door, told, and the file's name
    }


def test_a_name_of_many_functions_is_counted(package: Path) -> None:
    lines = "".join(f"class C{k}:\n    def take(self): ...\n" for k in range(26))
    (package / "drivers" / "many.py").write_text(lines)
    counts = Counter(place.kind for place in reader.survey(package))
    assert counts["shared_names"] == 26


def test_a_budget_only_falls() -> None:
    counts = Counter(dict.fromkeys(reader.KINDS, 5))
    budgets = dict.fromkeys(reader.KINDS, 3) | {"questions": 9}
    assert len(reader.over(counts, budgets)) == len(reader.KINDS) - 1
    after = tomllib.loads(reader.lowered(counts, budgets))
    assert after == dict.fromkeys(reader.KINDS, 3) | {"questions": 5}


def test_the_words_are_those_of_the_glossary() -> None:
    words = reader.private_words(reader.GLOSSARY.read_text(encoding="utf-8"))
    assert {"told", "lateness", "witness", "askew"} <= words
    assert "innovation" not in words
