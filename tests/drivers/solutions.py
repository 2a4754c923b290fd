"""What is asked of each decoder of a receiver's own solutions."""

from __future__ import annotations

from typing import Any, TypeVar

from drivers.decoder_options import SolutionDecoding
from drivers.measurements import Measurement, PositionFix
from drivers.solution_decoder import SolutionDecoder

UTC_NS = 1_796_091_269_000_000_000
"""2026-12-01 02:14:29, of which the frames of the tests are."""

Decoder = TypeVar("Decoder", bound=SolutionDecoder[Any, Any])


def decoded(
    kind: type[Decoder], *pieces: bytes, decoding: SolutionDecoding | None = None
) -> tuple[list[Measurement], Decoder]:
    """What a new decoder makes of pieces of a stream."""
    decoder = kind("gnss", decoding)
    found = [m for piece in pieces for m in decoder.feed(piece, 7)]
    return found + decoder.flush(), decoder


def fixes(found: list[Any]) -> list[PositionFix]:
    return [m for m in found if isinstance(m, PositionFix)]


def check_refused(kind: type[Decoder], stream: bytes, name: str) -> None:
    """The stream's last epoch ends in the counter `name`, and says so."""
    found, decoder = decoded(kind, stream)
    assert len(fixes(found)) == (name == "duplicate_epoch")
    assert decoder.counters[name] == 1
    assert decoder.refusal == name


def check_split_anywhere(
    kind: type[Decoder],
    stream: bytes,
    sizes: tuple[int, ...] = (1, 2, 7, 61, 300),
    decoding: SolutionDecoding | None = None,
) -> None:
    """Measurements and counters do not depend on where reads end."""
    whole = decoded(kind, stream, decoding=decoding)
    for size in sizes:
        cut = [stream[k : k + size] for k in range(0, len(stream), size)]
        pieces = decoded(kind, *cut, decoding=decoding)
        assert pieces[0] == whole[0]
        assert pieces[1].counters == whole[1].counters
