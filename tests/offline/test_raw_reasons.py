"""Raw data that no satellite can be used of: the reason names what is missing."""

from __future__ import annotations

from fusiond.offline.failure_reasons import FileRead, nothing_navigated

WAITING = "Waiting for a first position fix"
FILES = {"imu": FileRead((0.0, 9.0), 900, []), "raw": FileRead((0.0, 9.0), 9, [])}


def test_epochs_without_a_signal_that_is_read() -> None:
    said = nothing_navigated(FILES, {"raw": {"too_few": 9}}, WAITING)
    assert said.startswith(f"{WAITING}: the epochs of raw hold too few satellites of GPS, Galileo")


def test_what_was_refused_of_satellites_is_told_by_its_name() -> None:
    refused = {"raw": {"too_few": 9, "C_no_group_delay": 31}}
    assert nothing_navigated(FILES, refused, WAITING).endswith(
        "(9 of raw too_few, 31 of raw C_no_group_delay)"
    )
