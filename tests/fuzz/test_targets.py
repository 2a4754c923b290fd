"""The fuzz targets over their corpus, its mutations, and arbitrary bytes: `make fuzz` in little."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.parsers import PARSERS
from tests.fuzz.targets import TARGETS
from tests.places import REPOSITORY

CORPUS = Path(__file__).with_name("corpus")
SEEDS = {
    name: [path.read_bytes() for path in sorted((CORPUS / name).iterdir())] for name in TARGETS
}


def test_what_is_traced_is_there() -> None:
    """A module that has another name by now would end `make fuzz` before its first run."""
    traced = {module for parser in PARSERS.values() for module in parser.modules}
    absent = [m for m in traced if not (REPOSITORY / f"{m.replace('.', '/')}.py").is_file()]
    assert absent == []


@pytest.mark.parametrize("name", TARGETS)
def test_corpus(name: str) -> None:
    assert SEEDS[name]
    for seed in SEEDS[name]:
        for choice in (*range(16), *range(240, 256)):
            TARGETS[name](bytes((choice,)) + seed[1:])


@pytest.mark.parametrize("name", TARGETS)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_mutations(name: str, data: st.DataObject) -> None:
    seed = bytearray(data.draw(st.sampled_from(SEEDS[name]), label="seed"))
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, len(seed)))
        seed[at : at + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=12))
    TARGETS[name](bytes(seed))


@pytest.mark.parametrize("name", TARGETS)
@given(data=st.binary(max_size=400))
@settings(max_examples=60, deadline=None)
def test_any_bytes(name: str, data: bytes) -> None:
    TARGETS[name](data)
