"""A line's budget of bytes: a burst, then the line's rate."""

from __future__ import annotations

import pytest

from drivers.port import BURST, LINE_BYTES_S, ByteBudget


def test_a_burst_is_read_at_once_and_the_rest_at_the_lines_rate() -> None:
    now_s = 100.0
    budget = ByteBudget(now_s=lambda: now_s)
    for _ in range(int(BURST) // 1024):
        assert budget.spend(1024) == 0.0
    read, began_s = 0, now_s
    for _ in range(500):
        wait_s = budget.spend(1024)
        read += 1024
        assert wait_s == pytest.approx(1024 / LINE_BYTES_S)
        now_s += wait_s
    assert read / (now_s - began_s) == pytest.approx(LINE_BYTES_S)
    now_s += 3600.0  # an hour of silence gives no more than a burst
    assert budget.spend(int(BURST)) == 0.0
    assert budget.spend(1024) > 0.0


def test_a_faster_line_has_its_own_rate() -> None:
    budget = ByteBudget(4_000_000, now_s=lambda: 0.0)
    budget.spend(int(BURST))
    assert budget.spend(1024) == pytest.approx(1024 / 400_000)
