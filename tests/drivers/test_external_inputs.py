"""The door of a driver: one input after the other, and time stands still meanwhile."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.external_inputs import Inputs


class Bench:
    def __init__(self) -> None:
        self.host_ns = 100
        self.inputs = Inputs(self._now)
        self.seen: list[Any] = []
        self.inputs.on("read", self._read)

    def _now(self) -> int:
        self.host_ns += 1
        return self.host_ns

    def _read(self, data: bytes, t_ns: int) -> None:
        self.inputs.sent(b"ok")
        self.seen.append((data, t_ns, self.inputs.now_ns(), self.inputs.now_ns()))
        if data == b"defect":
            raise RuntimeError("a defect")


def test_time_stands_at_the_input_while_it_is_handled() -> None:
    bench = Bench()
    bench.inputs.take("read", b"a", 50)
    bench.inputs.take("read", b"b")
    (first, second) = bench.seen
    assert first == (b"a", 50, 50, 50)
    assert second[1] == second[2] == second[3] == 101
    assert bench.inputs.now_ns() > 101


def test_who_listens_hears_each_before_it_is_handled() -> None:
    bench = Bench()
    heard: list[tuple[str, int, Any]] = []
    bench.inputs.on_input = lambda kind, t_ns, payload: heard.append((kind, t_ns, payload))
    bench.inputs.take("read", b"a", 50)
    with pytest.raises(RuntimeError):
        bench.inputs.take("read", b"defect", 60)
    assert heard == [
        ("read", 50, b"a"),
        ("sent", 50, b"ok"),
        ("read", 60, b"defect"),
        ("sent", 60, b"ok"),
    ]
    assert bench.inputs.now_ns() > 100  # the host's again, after a defect too
    with pytest.raises(KeyError):
        bench.inputs.take("unheard of")
