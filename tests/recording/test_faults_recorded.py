"""A fault of the receiver, as the recording of a drive holds it and its report shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fusiond.outputs.commands import Inject
from fusiond.recording.reader import Log
from fusiond.report.report import report
from tests.recording.driven import Drive

BEGIN_S, LASTS_S, JUMP_M = 18.0, 5.0, 80.0


def test_a_jump_of_the_receiver_is_diagnosed_in_every_message(tmp_path: Path) -> None:
    drive = Drive(tmp_path / "logs", 40.0)
    drive.run(BEGIN_S)
    drive.command(Inject(id="1", source="gnss", fault="jump", duration_s=LASTS_S, size=JUMP_M))
    drive.run(38.0)
    paths = drive.close()
    log = Log(paths)
    events = [m.json() for m in log.messages("/event")]
    codes = [e["code"] for e in events if e["code"] in ("isolated", "readmitted")]
    assert codes[0] == "isolated"
    assert "readmitted" in codes

    health = [m.json()["sources"] for m in log.messages("/health")]
    gnss: list[dict[str, Any]] = [sources["gnss"] for sources in health]
    services = list(dict.fromkeys(one["service"] for one in gnss if one["service"]))
    assert services[0] == "nominal"
    assert "out" in services
    assert gnss[-1]["diagnosis"] is None or gnss[-1]["service"] == "probation"
    told = [one["diagnosis"] for one in gnss if one["diagnosis"]]
    assert told
    assert {one["source"] for one in told} == {"gnss"}
    assert all(one["action"] == "left out" for one in told)
    (what,) = {(one["kind"], one["axis"], one["unit"]) for one in told}
    assert what == ("position", "north", "m")
    assert abs(told[0]["size"] - JUMP_M) < 4.0 * told[0]["sd"]

    faults = [m.json()["faults"] for m in log.messages("/status")]
    assert faults[0] == []
    assert told[0] in [fault for one in faults for fault in one]

    (run,) = report(paths, tmp_path / "page.html")
    assert run.log is not None
    shown = run.log.faults[0]
    assert (shown.source, shown.kind, shown.axis) == ("gnss", "position", "north")
    assert run.log.service["gnss"]["out"] >= 3
